"""Predicted errors anywhere, against a machine of plain matrices that shares no code."""

import json
from dataclasses import replace

import numpy as np
import pytest
from independent import NMV, SETUPS, B, C, chain_centre, noisy, static_cycle
from scipy.linalg import block_diag

from rtest_estimation.errors import UserError
from rtest_identification.error_field import ErrorField
from rtest_identification.field_maps import InnerMap, OuterMap
from rtest_identification.field_sources import Sources
from rtest_identification.machine import parse_machine
from rtest_identification.output import as_dict
from rtest_identification.pipeline import identify
from rtest_identification.symbols import location_parameters, map_parameters

CHAINS = {
    'both in the table': ('C', 'B', 'bed', 'Y', 'X', 'Z'),
    'one in the head': ('C', 'bed', 'Y', 'X', 'Z', 'B'),
    'two in the head': ('bed', 'Y', 'X', 'Z', 'C', 'B'),
}
TOOL = (0.01, -0.02, -0.15)


def machine_of(name):
    text = NMV.replace('[C, B, bed, Y, X, Z]', f'[{", ".join(CHAINS[name])}]')
    if 'head' in name:
        text += f'tool_mm: [{", ".join(str(1e3 * t) for t in TOOL)}]\n'
    return parse_machine(text)


MACHINE = machine_of('both in the table')
# Of smooth maps: tilts of 30 µrad, radial errors of 1 µm, as in Fig. 3-14.
OUTER = {
    'X': lambda q: 1e-6 * np.sin(2 * q), 'Y': lambda q: 0.8e-6 * np.cos(q + 0.4),
    'Z': lambda q: 0.5e-6 * np.square(q) / 2, 'A': lambda q: 3e-5 * np.sin(q + 0.3),
    'B': lambda q: 2e-5 * np.sin(2 * q), 'C': lambda q: -1e-5 * np.square(q) / 2,
}
INNER = {
    'X': lambda p, q: 1e-6 * np.sin(q + p), 'Y': lambda p, q: 0.7e-6 * np.cos(2 * q),
    'Z': lambda p, q: 0.5e-6 * np.cos(q) * np.cos(p), 'A': lambda p, q: 1e-5 * np.sin(q),
    'B': lambda p, q: 1e-5 * np.cos(q - p), 'C': lambda p, q: 2e-5 * np.sin(2 * q) * np.cos(p),
}


def constants(machine):
    rng = np.random.default_rng(3)
    parameters = location_parameters(machine)
    return np.array([rng.normal() * (1.5e-5 if p.angular else 1e-5) for p in parameters])


def true_errors(machine, outer, inner, maps=True):
    """Errors of every axis at positions of the two rotary axes."""
    errors = {}
    for p, value in zip(location_parameters(machine), constants(machine), strict=True):
        errors.setdefault(p.axis, {})[p.letter] = value
    one, two = machine.rotary
    for letter in 'XYZABC' if maps else '':
        mine = errors.setdefault(one, {})
        mine[letter] = mine.get(letter, 0.0) + OUTER[letter](outer)
        mine = errors.setdefault(two, {})
        mine[letter] = mine.get(letter, 0.0) + INNER[letter](outer, inner)
    return errors


def true_shift(machine, positions):
    """Error of the tool point at one pose, from plain matrices."""
    named = dict(zip(machine.letters, positions, strict=True))
    errors = true_errors(machine, *(named[name] for name in machine.rotary))
    tool = tuple(machine.tool)
    return chain_centre(machine.chain, named, errors, tool) - chain_centre(
        machine.chain, named, {}, tool
    )


def exact(machine, outer=B, inner=C):
    """What an identification without any error would give at the stations."""
    parameters = location_parameters(machine)
    one, two = machine.rotary
    first, second = map_parameters(machine, one), map_parameters(machine, two)
    p, q = np.meshgrid(outer, inner, indexing='ij')
    size = len(parameters) + 6 * len(outer)
    return Sources(
        parameters, constants(machine), np.zeros((size, size)),
        OuterMap(one, first, outer, np.array([OUTER[e.letter](outer) for e in first])),
        InnerMap(two, second, outer, inner, np.array([INNER[e.letter](p, q) for e in second]),
                 np.zeros((len(outer), len(inner), 6, 6))),
        (),
    )  # fmt: skip


def poses(machine, outer, inner, seed=5):
    """Poses at points of the work volume with the rotary axes given, order of the letters."""
    rng = np.random.default_rng(seed)
    rows = rng.uniform([-0.08, -0.1, 0.03], [0.08, 0.06, 0.16], (len(outer), 3))
    named = dict(zip(machine.rotary, (outer, inner), strict=True))
    return np.column_stack([rows, named['B'], named['C']])


@pytest.mark.parametrize('name', CHAINS)
def test_the_truth_is_met_at_the_stations_and_between(name):
    machine = machine_of(name)
    field = ErrorField.of(machine, exact(machine))
    p, q = (axis.ravel() for axis in np.meshgrid(B, C, indexing='ij'))
    at_stations = poses(machine, p, q)
    rng = np.random.default_rng(6)
    between = poses(machine, rng.uniform(B[0], B[-1], 200), rng.uniform(-7, 7, 200))
    for positions, limit in ((at_stations, 1e-12), (between, 0.12e-6)):
        want = np.array([true_shift(machine, row) for row in positions])
        found = field.at(positions)
        assert np.abs(found.error - want).max() < limit
        assert np.abs(want).max() > 20e-6
    # What interpolation may be wrong by is the only uncertainty here. It covers.
    off = np.abs(found.error - want)
    assert np.mean(off <= 2 * found.stddev) > 0.95
    assert field.at(at_stations).stddev.max() < 1e-12


def test_points_of_the_table_are_followed_with_the_linear_axes():
    field = ErrorField.of(MACHINE, exact(MACHINE))
    points = np.array([[0.0, -0.05, 0.1], [0.05, 0.0, 0.1]])
    rotary = np.radians([[30, 45], [-60, 200]])
    found = field.at_points(points, rotary)
    for point, (b, c), error in zip(points, rotary, found.error, strict=True):
        x, y, z = rotation_y(b) @ rotation_z(c) @ point
        want = true_shift(MACHINE, np.array([x, y, z, b, c]))
        np.testing.assert_allclose(error, want, atol=0.1e-6)
    # Against B = C = 0 the table's own constants drop out.
    zero = field.at_points(points, [0.0, 0.0]).error
    relative = field.at_points(points, rotary, reference=[0.0, 0.0])
    np.testing.assert_allclose(relative.error, found.error - zero, atol=1e-15)


def rotation_y(q):
    return np.array([[np.cos(q), 0, np.sin(q)], [0, 1, 0], [-np.sin(q), 0, np.cos(q)]])


def rotation_z(q):
    return np.array([[np.cos(q), -np.sin(q), 0], [np.sin(q), np.cos(q), 0], [0, 0, 1]])


def test_the_six_errors_of_every_axis():
    field = ErrorField.of(MACHINE, exact(MACHINE))
    positions = poses(MACHINE, np.array([B[1], B[4]]), np.array([C[3], C[7]]))
    found = field.errors(positions)
    assert found.value.shape == found.stddev.shape == (2, 5, 6)
    for row, (b, c) in enumerate([(B[1], C[3]), (B[4], C[7])]):
        want = true_errors(MACHINE, b, c)
        for column, axis in enumerate('XYZBC'):
            expected = [want.get(axis, {}).get(letter, 0.0) for letter in 'ABCXYZ']
            np.testing.assert_allclose(found.value[row, column], expected, atol=1e-15)


def test_zero_and_a_whole_turn_of_c_are_the_same():
    field = ErrorField.of(MACHINE, exact(MACHINE))
    b, c = np.full(50, 0.2), np.linspace(-np.pi, np.pi, 50)
    one, two = (field.at(poses(MACHINE, b, c + turns * 2 * np.pi)) for turns in (0, 1))
    np.testing.assert_allclose(one.error, two.error, atol=1e-14)
    np.testing.assert_allclose(one.stddev, two.stddev, atol=1e-14)


def test_nothing_is_extrapolated():
    field = ErrorField.of(MACHINE, exact(MACHINE))
    positions = poses(MACHINE, np.radians([0.0, 76.0, -80.0]), np.radians([10.0, 20.0, 30.0]))
    with pytest.raises(UserError, match=r'pose 1 \(B = 76, C = 20 deg\).*B \(-75 to 75 deg\)'):
        field.at(positions)
    with pytest.raises(UserError, match='outside the measured stations'):
        field.errors(positions)
    found = field.at(positions, outside='nan')
    assert found.inside.tolist() == [True, False, False]
    assert np.isfinite(found.error[0]).all() and np.isnan(found.error[1:]).all()
    assert np.isnan(found.covariance[1:]).all()
    assert np.isnan(field.errors(positions, outside='nan').value[1:]).all()
    with pytest.raises(ValueError, match='outside'):
        field.at(positions, outside='ignore')


def test_a_pose_that_is_missing_in_the_inner_map_is_bridged():
    data = exact(MACHINE)
    data.inner.value[:, 2, 5] = np.nan
    field = ErrorField.of(MACHINE, data)
    found = field.at(poses(MACHINE, B[[2]], C[[5]]))
    want = true_shift(MACHINE, poses(MACHINE, B[[2]], C[[5]])[0])
    np.testing.assert_allclose(found.error[0], want, atol=1e-6)
    assert (found.stddev > 0.0).all()
    assert not field.undetermined


def random_covariance(count, scale, rng):
    root = rng.normal(size=(count, count)) * 0.3 + np.eye(count)
    return (scale[:, None] * root) @ (scale[:, None] * root).T / 4.0


def test_linear_propagation_is_that_of_finite_differences():
    rng = np.random.default_rng(21)
    outer, inner = B[::2], C[::2]
    data = exact(MACHINE, outer, inner)
    of_map = np.array([2e-6 if p.angular else 2e-7 for p in data.outer.parameters])
    scale = np.array([2e-6 if p.angular else 2e-7 for p in data.parameters])
    joint = random_covariance(35, np.concatenate([scale, np.repeat(of_map, 4)]), rng)
    cells = np.array([[random_covariance(6, of_map, rng) for _ in inner] for _ in outer])
    # Flat maps: no doubt of the interpolation.
    flat = replace(data.outer, value=np.zeros((6, 4)))
    level = replace(data.inner, value=np.zeros((6, 4, 6)), covariance=cells)
    field = ErrorField.of(MACHINE, replace(data, covariance=joint, outer=flat, inner=level))
    everything = block_diag(joint, *cells.reshape(-1, 6, 6))
    positions = poses(MACHINE, np.array([0.1, B[2], -0.9]), np.array([2.0, C[4], 5.5]))

    def moved(index):
        """The field with one of its 179 values changed."""
        step = np.zeros(35 + 144)
        step[index] = 1e-6
        of_nodes = field.inner.value + step[35:].reshape(24, 6).T
        of_axis = field.outer.value + step[11:35].reshape(6, 4)
        return replace(
            field, value=field.value + step[:11], outer=replace(field.outer, value=of_axis),
            inner=replace(field.inner, value=of_nodes),
        )

    fields = [moved(index) for index in range(35 + 144)]
    for reference in (None, np.array([0.3, -1.0])):
        zero = field.at(positions, reference)
        slope = np.array([(f.at(positions, reference).error - zero.error) / 1e-6 for f in fields])
        want = np.einsum('pni,pq,qnj->nij', slope, everything, slope)
        assert np.abs(zero.covariance - want).max() < 1e-3 * want.max()
    base = field.errors(positions)
    slope = np.array([(f.errors(positions).value - base.value) / 1e-6 for f in fields])
    want = np.sqrt(np.einsum('pnki,pq,qnki->nki', slope, everything, slope))
    np.testing.assert_allclose(base.stddev, want, rtol=1e-6, atol=1e-15)


def only_b(b, c):
    """Constants and a B map of shapes that no constant could show."""
    errors = true_errors(MACHINE, b, c, maps=False)
    for letter, more in (('B', 8e-6 * (b**2 - np.mean(B**2))), ('Y', 2e-6 * np.sin(2 * b))):
        errors['B'][letter] = errors['B'].get(letter, 0.0) + more
    return errors


CYCLES = [static_cycle(setup, only_b) for setup in SETUPS]
RNG = np.random.default_rng(1)
IDENTIFIED = identify(MACHINE, [noisy(c, 2.5e-7, RNG) for c in CYCLES])


@pytest.mark.parametrize('every_map', [False, True])
def test_stated_intervals_hold_the_truth(every_map):
    rng = np.random.default_rng(22)
    p, q = B[[0, 2, 3, 5]], C[[1, 4, 8, 11]]
    at_stations = poses(MACHINE, p, q)
    between = poses(MACHINE, np.array([-1.1, -0.6, 0.2, 1.05]), np.array([0.2, 1.8, 3.5, 6.0]))
    hits = {'at': [], 'between': [], 'zeroed': []}
    for _ in range(40):
        field = ErrorField.from_identification(
            identify(MACHINE, [noisy(c, 2.5e-7, rng) for c in CYCLES]), every_map
        )
        for name, positions, zero in (
            ('at', at_stations, None), ('between', between, None), ('zeroed', between, [0.0, 0.0]),
        ):
            found = field.at(positions, zero)
            want = np.array([only_b_shift(row) for row in positions])
            if zero:
                want -= np.array([only_b_shift(zeroed(row)) for row in positions])
            hits[name].append(np.abs(found.error - want) <= 1.96 * found.stddev)
    held = {name: np.mean(rows) for name, rows in hits.items()}
    # 480 values each.
    assert all(0.92 < share < 0.985 for share in held.values()), held


def only_b_shift(row):
    named = dict(zip('XYZBC', row, strict=True))
    errors = only_b(row[3], row[4])
    return chain_centre(MACHINE.chain, named, errors) - chain_centre(MACHINE.chain, named, {})


def zeroed(row):
    """The pose at B = C = 0 of the same nominal point of the table."""
    point = chain_centre(MACHINE.chain, dict(zip('XYZBC', row, strict=True)), {})
    return np.array([*point, 0.0, 0.0])


def test_the_file_says_the_same_as_the_identification(tmp_path):
    path = tmp_path / 'identification.json'
    path.write_text(json.dumps(as_dict(IDENTIFIED)))
    positions = poses(MACHINE, np.array([0.1, -0.9]), np.array([2.0, 5.5]))
    for every in (False, True):
        field = ErrorField.from_identification(IDENTIFIED, every)
        assert field.outer and bool(field.inner) is every
        one = field.at(positions, [0.0, 0.0])
        two = ErrorField.from_json(path, MACHINE, every).at(positions, [0.0, 0.0])
        np.testing.assert_allclose(two.error, one.error, rtol=1e-12)
        np.testing.assert_allclose(two.covariance, one.covariance, rtol=1e-9, atol=1e-22)


def test_another_machine_or_file_is_refused(tmp_path):
    path = tmp_path / 'identification.json'
    path.write_text(json.dumps(as_dict(IDENTIFIED)))
    with pytest.raises(UserError, match=r'identification\.json: not .* of the machine'):
        ErrorField.from_json(path, machine_of('two in the head'))
    path.write_text('[]')
    with pytest.raises(UserError, match=r'identification\.json'):
        ErrorField.from_json(path, MACHINE)
    with pytest.raises(UserError, match='cannot read'):
        ErrorField.from_json(tmp_path / 'none.json', MACHINE)


def test_what_one_setup_does_not_determine_stays_unknown():
    field = ErrorField.from_identification(identify(MACHINE, [CYCLES[2]]))
    assert 'E_A(0B)C' in field.undetermined
    found = field.at(poses(MACHINE, np.array([0.5]), np.array([1.0])))
    assert found.inside.all() and np.isnan(found.error).all() and np.isnan(found.covariance).all()
    errors = field.errors(poses(MACHINE, np.array([0.5]), np.array([1.0])))
    assert np.isnan(errors.value[0, MACHINE.letters.index('C'), 0])


def test_the_tool_of_a_head_machine_may_be_another():
    machine = machine_of('one in the head')
    tool = np.array([0.0, 0.0, -0.25])
    field = ErrorField.of(machine, exact(machine)).with_tool(tool)
    row = poses(machine, B[[1]], C[[0]])[0] if machine.rotary[0] == 'B' else None
    row = np.array([0.01, 0.02, 0.3, C[1], B[2]]) if row is None else row
    named = dict(zip(machine.letters, row, strict=True))
    errors = true_errors(machine, *(named[name] for name in machine.rotary))
    want = chain_centre(machine.chain, named, errors, tool) - chain_centre(
        machine.chain, named, {}, tool
    )
    np.testing.assert_allclose(field.at(row).error[0], want, atol=0.2e-6)
