"""Any five-axis chain: rotary axes in the head too, against plain 4x4 matrices."""

import numpy as np
import pytest
from independent import LETTERS, NMV, noisy
from scipy.spatial.transform import Rotation

from rtest_estimation.records import Cycle, CyclePlan, CyclePoint, Kind
from rtest_identification.location import fit
from rtest_identification.machine import parse_machine
from rtest_identification.observations import stack
from rtest_identification.symbols import location_parameters

TOOL = np.array([0.0, 0.0, -0.15])
CHAINS = {
    'head-table': ('C', 'bed', 'Y', 'X', 'Z', 'B'),
    'head-head': ('bed', 'X', 'Y', 'Z', 'C', 'B'),
    'nutating table': ('C', 'B', 'bed', 'Y', 'X', 'Z'),
}
DIRECTION = {'X': [1, 0, 0], 'Y': [0, 1, 0], 'Z': [0, 0, 1], 'B': [0, 1, 0], 'C': [0, 0, 1]}
# A nutating axis: its direction is that of no coordinate.
TILTED = {**DIRECTION, 'B': [0, 0.5**0.5, 0.5**0.5]}
SPHERES = [(0.0, -0.09, 0.04), (0.0, -0.09, 0.14), (0.05, 0.02, 0.04), (0.0, 0.0, 0.14)]


def directions(name):
    return TILTED if 'nutating' in name else DIRECTION


def machine(name):
    text = NMV.replace('[C, B, bed, Y, X, Z]', '[' + ', '.join(CHAINS[name]) + ']')
    text += f'tool_mm: {(TOOL * 1e3).tolist()}\n' if 'head' in name else ''
    b = directions(name)['B']
    return parse_machine(text.replace('direction: [0, 1, 0], sense', f'direction: {b}, sense'))


def transform(name, axis, position, errors):
    """Da Db Dc Dx Dy Dz of the errors, then the axis's own motion."""
    total = np.eye(4)
    for letter, direction in zip('ABC', np.eye(3), strict=True):
        step = np.eye(4)
        angle = errors.get(letter, 0.0)
        step[:3, :3] = Rotation.from_rotvec(angle * direction).as_matrix()
        total = total @ step
    shift = np.eye(4)
    shift[:3, 3] = [errors.get(letter, 0.0) for letter in 'XYZ']
    motion = np.eye(4)
    along = np.array(directions(name)[axis], dtype=float)
    if axis in 'BC':
        motion[:3, :3] = Rotation.from_rotvec(position * along).as_matrix()
    else:
        motion[:3, 3] = position * along
    return total @ shift @ motion


def centre(name, row, errors):
    chain = CHAINS[name]
    bed = chain.index('bed')
    sides = []
    for side in (chain[:bed][::-1], chain[bed + 1 :]):
        total = np.eye(4)
        for axis in side:
            position = row[LETTERS.index(axis)]
            total = total @ transform(name, axis, position, errors.get(axis, {}))
        sides.append(total)
    tool = np.append(TOOL if 'head' in name else np.zeros(3), 1.0)
    return (np.linalg.inv(sides[0]) @ sides[1] @ tool)[:3]


def follow(name, b, c, sphere):
    """Linear axes that hold the sphere in the table frame: the chain is affine in them."""
    row = np.array([0.0, 0.0, 0.0, b, c])
    origin = centre(name, row, {})
    slopes = np.array([centre(name, row + step, {}) - origin for step in np.eye(5)[:3]]).T
    row[:3] = np.linalg.solve(slopes, np.array(sphere) - origin)
    return row


def cycle(name, number, errors):
    sphere = SPHERES[number]
    poses = [(0.0, 0.0)] + [
        (b, c) for b in np.radians([-60, -30, 0, 30, 60]) for c in np.radians(np.arange(8) * 45)
    ]
    rows = np.array([follow(name, b, c, sphere) for b, c in poses])
    seen = np.array([centre(name, row, errors) for row in rows]) - sphere
    points = tuple(
        CyclePoint(n, n, row, np.zeros(5, np.int8), x, 1e-15 * np.eye(3), 10)
        for n, (row, x) in enumerate(zip(rows, seen - seen[0], strict=True))
    )
    plan = CyclePlan(
        number + 1, 'made', f'{number}-static', Kind.STATIC, str(number), np.array(sphere),
        LETTERS, rows, 0.3,
    )
    return Cycle(plan, points, (), 'cal', number + 2)


def given(name, seed=5):
    rng = np.random.default_rng(seed)
    errors, values = {}, []
    for p in location_parameters(machine(name)):
        value = (3e-5 if p.angular else 1e-5) * rng.normal()
        errors.setdefault(p.axis, {})[p.letter] = value
        values.append(value)
    return errors, np.array(values)


@pytest.mark.parametrize('name', CHAINS)
def test_every_error_of_the_chain_comes_back(name):
    errors, values = given(name)
    cycles = [cycle(name, n, errors) for n in range(4)]
    exact = fit(stack(machine(name), cycles)).location
    assert exact.determined.all()
    np.testing.assert_allclose(exact.value, values, atol=2e-12)


@pytest.mark.parametrize('name', CHAINS)
def test_intervals_hold_on_every_chain(name):
    errors, values = given(name)
    made = [cycle(name, n, errors) for n in range(4)]
    rng = np.random.default_rng(6)
    z = []
    for _ in range(60):
        location = fit(stack(machine(name), [noisy(c, 2.5e-7, rng) for c in made])).location
        z.append((location.value - values) / location.stddev)
    assert 0.92 < np.mean(np.abs(z) < 1.96) < 0.975
    assert 0.85 < np.std(z) < 1.15


@pytest.mark.parametrize('name', CHAINS)
def test_maps_are_of_the_outer_and_the_inner_axis(name):
    errors, _ = given(name)
    rng = np.random.default_rng(7)
    result = fit(stack(machine(name), [noisy(cycle(name, n, errors), 2.5e-7, rng)
                                       for n in range(4)]))
    outer, inner = machine(name).rotary
    assert (result.error_map.axis, result.inner_map.axis) == (outer, inner)
    # No map was given: what is found is within its uncertainty.
    assert result.error_map.significance > 0.001 and result.inner_map.significance > 0.001
    assert np.abs(result.error_map.value / result.error_map.stddev).max() < 4.5
