"""Hand-derived positions and signs: chain C-B-bed-Y-X-Z, sphere (0, -90, 40.6) mm."""

import numpy as np
import pytest

from rtest_drivers.sim.errors import GeometricErrors
from rtest_drivers.sim.kinematics import follow, sphere_in_table
from rtest_identification.machine import parse_machine

YAML = """
name: test
chain: [C, B, bed, Y, X, Z]
axes:
  X: {type: linear, direction: [1, 0, 0]}
  Y: {type: linear, direction: [0, 1, 0]}
  Z: {type: linear, direction: [0, 0, 1]}
  B: {type: rotary, direction: [0, 1, 0], sense: %d}
  C: {type: rotary, direction: [0, 0, 1], sense: %d}
"""
MACHINE = parse_machine(YAML % (1, 1))
SPHERE = np.array([0.0, -0.0900, 0.0406])
QUARTER = np.pi / 2


def moved(symbol: str, size: float, b: float, c: float, machine=MACHINE) -> np.ndarray:
    """What one constant error does to the sphere centre in the table frame."""
    pose = follow(machine, np.array([0.0, 0.0, 0.0, b, c]), SPHERE)
    errors = GeometricErrors({symbol: size}, {})
    return (sphere_in_table(machine, pose, errors) - sphere_in_table(machine, pose))[0]


def test_a_table_point_turns_with_plus_b_and_plus_c() -> None:
    # r = Ry(B) Rz(C) w. C = 90: (0, -90, 40.6) -> (90, 0, 40.6); B = 90: z -> x, x -> -z.
    turns = [[0, QUARTER], [QUARTER, 0], [QUARTER, QUARTER]]
    commands = np.column_stack([np.zeros((3, 3)), turns])
    expected = [[0.09, 0, 0.0406], [0.0406, -0.09, 0], [0.0406, 0, -0.09]]
    assert follow(MACHINE, commands, SPHERE)[:, :3] == pytest.approx(np.array(expected), abs=1e-15)


def test_sense_minus_one_turns_the_other_way() -> None:
    machine = parse_machine(YAML % (-1, -1))
    commands = np.array([[0, 0, 0, 0, QUARTER], [0, 0, 0, QUARTER, 0]])
    expected = [[-0.09, 0, 0.0406], [-0.0406, -0.09, 0]]
    assert follow(machine, commands, SPHERE)[:, :3] == pytest.approx(np.array(expected), abs=1e-15)


U, R = 1e-5, 1e-4

# The table moves by +e, so the sphere seen from it by -e, turned into the table frame:
# Rz(-C) Ry(-B). A small turn of the table side by w moves the sphere by -(w x r), r in machine.
CASES = [
    ('E_X(0Y)B', U, 0, 0, [-U, 0, 0]),
    ('E_X(0Y)B', U, 0, 1, [0, U, 0]),  # Rz(-90): -x -> +y
    ('E_X(0Y)B', U, 1, 0, [0, 0, -U]),  # Ry(-90): -x -> -z
    ('E_Y(0Y)B', U, 0, 0, [0, -U, 0]),
    ('E_Y(0Y)B', U, 1, 1, [-U, 0, 0]),
    ('E_Z(0Y)B', U, 0, 0, [0, 0, -U]),
    ('E_Z(0Y)B', U, 1, 0, [U, 0, 0]),
    # r = (0, -90, 40.6) at B = C = 0
    ('E_A(0Y)B', R, 0, 0, [0, R * 0.0406, R * 0.09]),  # -(x x r) = (0, rz, -ry)
    ('E_B(0Y)B', R, 0, 0, [-R * 0.0406, 0, 0]),  # -(y x r) = (-rz, 0, rx)
    ('E_C(0Y)B', R, 0, 0, [-R * 0.09, 0, 0]),  # -(z x r) = (ry, -rx, 0)
    ('E_B(0Y)B', R, 1, 0, [-R * 0.0406, 0, 0]),  # r = (40.6, -90, 0): (0, 0, rx) -> Ry(-90)
    # C's errors act after B's motion, so that they turn with B
    ('E_X(0B)C', U, 0, 0, [-U, 0, 0]),
    ('E_X(0B)C', U, 1, 0, [-U, 0, 0]),
    ('E_X(0B)C', U, 0, 1, [0, U, 0]),
    ('E_A(0B)C', R, 1, 0, [0, R * 0.0406, R * 0.09]),
    # Tool side: the sphere itself moves by w x (what the axis carries). Z carries (0, 0, 40.6).
    ('E_A(0Y)Z', R, 0, 0, [0, -R * 0.0406, 0]),
    ('E_B(0X)Z', R, 0, 0, [R * 0.0406, 0, 0]),
    ('E_A(0Y)Z', R, 1, 0, [0, 0, 0]),  # B = 90: Z = 0
    # X carries itself and Z: at C = 90 it is at 90 mm, and turning it about Z moves it in +y,
    # which is +x in the table.
    ('E_C(0Y)X', R, 0, 0, [0, 0, 0]),
    ('E_C(0Y)X', R, 0, 1, [R * 0.09, 0, 0]),
]


@pytest.mark.parametrize(('symbol', 'size', 'b', 'c', 'expected'), CASES)
def test_sign_of_each_error(symbol, size, b, c, expected) -> None:
    result = moved(symbol, size, b * QUARTER, c * QUARTER)
    # Second order in 1e-4 rad at 100 mm is 1 nm; a wrong sign is 4 um or more.
    assert result == pytest.approx(np.array(expected, dtype=float), abs=2e-9)


def test_errors_are_exact_not_linear() -> None:
    # E_C(0Y)X of 90 degrees: X moves along +Y.
    pose = np.array([[0.1, 0.0, 0.0, 0.0, 0.0]])
    errors = GeometricErrors({'E_C(0Y)X': QUARTER}, {})
    result = sphere_in_table(MACHINE, pose, errors)
    assert result == pytest.approx(np.array([[0, 0.1, 0]]), abs=1e-15)


def test_order_of_the_errors_of_one_axis() -> None:
    # Da(90) Dx(1): x stays x; Da(90) Dy(1): y becomes z. Tool side, axis Z standing at zero.
    pose = np.zeros((1, 5))
    for symbol, expected in (('E_X(0Y)Z', [1, 0, 0]), ('E_Y(0Y)Z', [0, 0, 1])):
        errors = GeometricErrors({'E_A(0Y)Z': QUARTER, symbol: 1.0}, {})
        assert sphere_in_table(MACHINE, pose, errors)[0] == pytest.approx(expected, abs=1e-15)


def test_rotary_axes_in_the_head() -> None:
    # Chain bed-X-Y-Z-C-A with a tool 150 mm long: at A = 90 it points the other way.
    machine = parse_machine("""
name: head
chain: [bed, X, Y, Z, C, A]
axes:
  X: {type: linear, direction: [1, 0, 0]}
  Y: {type: linear, direction: [0, 1, 0]}
  Z: {type: linear, direction: [0, 0, 1]}
  A: {type: rotary, direction: [1, 0, 0]}
  C: {type: rotary, direction: [0, 0, 1]}
tool_mm: [0, 0, -150]
""")
    pose = np.zeros((3, 5))
    pose[1, 3] = pose[2, 3] = QUARTER
    pose[2, 4] = QUARTER
    expected = np.array([[0, 0, -0.15], [0, 0.15, 0], [-0.15, 0, 0]])
    assert sphere_in_table(machine, pose) == pytest.approx(expected, abs=1e-15)
    linear = follow(machine, pose, np.array([0.2, 0.1, 0.0]))
    assert sphere_in_table(machine, linear) == pytest.approx(
        np.tile([0.2, 0.1, 0.0], (3, 1)), abs=1e-15
    )
