"""Kinematics: hand-derived cases at 0 and 90 degrees, finite differences, any chain."""

import numpy as np
import pytest

from rtest_identification.kinematics import ERROR_LETTERS, linear_positions, predict
from rtest_identification.machine import parse_machine

TABLE_TABLE = """
name: table-table
chain: [C, B, bed, Y, X, Z]
axes:
  X: {type: linear, direction: [1, 0, 0]}
  Y: {type: linear, direction: [0, 1, 0]}
  Z: {type: linear, direction: [0, 0, 1]}
  B: {type: rotary, direction: [0, 1, 0], sense: SENSE}
  C: {type: rotary, direction: [0, 0, 1], sense: SENSE}
"""
HEAD_TABLE = TABLE_TABLE.replace('[C, B, bed, Y, X, Z]', '[C, bed, Y, X, Z, B]')
HEAD_HEAD = TABLE_TABLE.replace('[C, B, bed, Y, X, Z]', '[bed, X, Y, Z, C, B]')
TOOL = '\ntool_mm: [0, 0, -150]\n'
CHAINS = {
    'table-table': TABLE_TABLE,
    'head-table': HEAD_TABLE + TOOL,
    'head-head': HEAD_HEAD + TOOL,
}
LETTERS = ('X', 'Y', 'Z', 'B', 'C')


def machine(name='table-table', sense=1):
    return parse_machine(CHAINS[name].replace('SENSE', str(sense)), name)


def pose(b=0.0, c=0.0, x=0.0, y=0.0, z=0.0):
    return np.array([[x, y, z, np.radians(b), np.radians(c)]])


def with_error(axis, letter, value):
    errors = np.zeros((5, 6))
    errors[LETTERS.index(axis), ERROR_LETTERS.index(letter)] = value
    return errors


def test_a_table_point_is_carried_by_b_and_c():
    # r = Ry(90) Rz(90) (1, 0, 0) = Ry(90) (0, 1, 0) = (0, 1, 0).
    at = linear_positions(machine(), np.array([1.0, 0, 0]), pose(90, 90))[0]
    np.testing.assert_allclose(at[:3], [0, 1, 0], atol=1e-15)
    # r = Ry(90) Rz(90) (0, 0, 1) = (1, 0, 0).
    at = linear_positions(machine(), np.array([0, 0, 1.0]), pose(90, 90))[0]
    np.testing.assert_allclose(at[:3], [1, 0, 0], atol=1e-15)


def test_sense_turns_the_axes_round():
    # Ry(-90) (0, 0, 1) = (-1, 0, 0).
    at = linear_positions(machine(sense=-1), np.array([0, 0, 1.0]), pose(90, 0))[0]
    np.testing.assert_allclose(at[:3], [-1, 0, 0], atol=1e-15)


@pytest.mark.parametrize(
    ('axis', 'letter', 'angles', 'linear', 'expected'),
    [
        # The table moved by +1 um in X: the sphere is at -1 um in the table frame.
        ('B', 'X', (0, 0), (0, 0, 0), (-1, 0, 0)),
        # The same seen from a table turned by C = 90 deg: -1 um along machine X is Rz(-90) of it.
        ('B', 'X', (0, 90), (0, 0, 0), (0, 1, 0)),
        # By B = 90 deg: machine X is table Z: Ry(-90) (-1, 0, 0) = (0, 0, -1).
        ('B', 'X', (90, 0), (0, 0, 0), (0, 0, -1)),
        ('B', 'Z', (90, 0), (0, 0, 0), (1, 0, 0)),
        # An offset of C is carried by B: no change of direction with B.
        ('C', 'X', (90, 0), (0, 0, 0), (-1, 0, 0)),
        # The table turned by +1 urad about Y with the sphere 1 m above: -(0,1,0) x (0,0,1) = -X.
        ('B', 'B', (0, 0), (0, 0, 1), (-1, 0, 0)),
        ('B', 'A', (0, 0), (0, 0, 1), (0, 1, 0)),
        ('C', 'C', (0, 0), (1, 0, 0), (0, -1, 0)),
        # The tool side moves the sphere itself: Z tilted about Y takes the sphere to +X.
        ('Z', 'B', (0, 0), (0, 0, 1), (1, 0, 0)),
        ('Z', 'A', (0, 0), (0, 0, 1), (0, -1, 0)),
        ('X', 'C', (0, 0), (1, 0, 0), (0, 1, 0)),
        # Before its own motion: a yaw of Y turns X, which Y carries.
        ('Y', 'C', (0, 0), (1, 1, 0), (-1, 1, 0)),
        ('X', 'X', (0, 0), (0, 0, 0), (1, 0, 0)),
    ],
)
def test_signs_by_hand(axis, letter, angles, linear, expected):
    at = pose(*angles, *linear)
    nominal = predict(machine(), at).centre
    moved = predict(machine(), at, with_error(axis, letter, 1e-6)).centre
    np.testing.assert_allclose((moved - nominal)[0] * 1e6, expected, atol=3e-6)
    slope = predict(machine(), at, jacobian=True).jacobian
    column = 6 * LETTERS.index(axis) + ERROR_LETTERS.index(letter)
    np.testing.assert_allclose(slope[0, :, column], expected, atol=1e-12)


@pytest.mark.parametrize('name', CHAINS)
@pytest.mark.parametrize('sense', [1, -1])
def test_jacobian_matches_finite_differences_at_large_errors(name, sense):
    rng = np.random.default_rng(4)
    positions = rng.uniform(-1, 1, size=(20, 5)) * [0.2, 0.1, 0.2, 1.3, 3.0]
    errors = 0.02 * rng.normal(size=(5, 6))
    exact = predict(machine(name, sense), positions, errors, jacobian=True).jacobian
    step = 1e-6
    for column in range(30):
        change = np.zeros(30)
        change[column] = step
        up, down = (
            predict(machine(name, sense), positions, errors + s * change.reshape(5, 6)).centre
            for s in (1, -1)
        )
        np.testing.assert_allclose(exact[:, :, column], (up - down) / (2 * step), atol=2e-9)


@pytest.mark.parametrize('name', CHAINS)
def test_linear_axes_hold_the_sphere_in_the_table(name):
    rng = np.random.default_rng(5)
    positions = rng.uniform(-1.2, 1.2, size=(30, 5))
    sphere = np.array([0.01, -0.09, 0.0406])
    held = linear_positions(machine(name), sphere, positions)
    np.testing.assert_allclose(predict(machine(name), held).centre, [sphere] * 30, atol=1e-15)


def test_errors_may_differ_from_pose_to_pose():
    positions = np.vstack([pose(10, 20), pose(30, 40)])
    errors = np.random.default_rng(6).normal(size=(2, 5, 6)) * 1e-4
    both = predict(machine(), positions, errors).centre
    for row in range(2):
        one = predict(machine(), positions[row : row + 1], errors[row]).centre
        np.testing.assert_allclose(both[row], one[0], atol=1e-18)
