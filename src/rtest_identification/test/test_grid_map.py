"""Map of the inner rotary axis over both, against the machine of plain matrices."""

import numpy as np
import pytest
from independent import NMV, SETUPS, B, C, noisy, static_cycle
from test_location import VALUES, constant

from rtest_identification.location import fit
from rtest_identification.machine import parse_machine
from rtest_identification.observations import stack

MACHINE = parse_machine(NMV)
NOISE = 2.5e-7
# Errors of C over (B, C): twice and three times a turn, two of them growing with B. Harmonics that
# neither turn with the table nor imitate errors of B.
SHAPES = {
    'X': lambda b, c: 1e-6 * np.cos(2 * c),
    'Y': lambda b, c: -0.8e-6 * np.sin(2 * c) * abs(b),
    'Z': lambda b, c: 0.7e-6 * np.cos(3 * c),
    'A': lambda b, c: 4e-6 * np.cos(3 * c),
    'B': lambda b, c: 3e-6 * np.sin(3 * c) * abs(b),
    'C': lambda b, c: 5e-6 * np.cos(3 * c),
}


def with_c(b, c):
    errors = constant(b, c)
    for letter, shape in SHAPES.items():
        errors['C'][letter] = errors['C'].get(letter, 0.0) + shape(b, c)
    return errors


MADE = {setup: static_cycle(setup, with_c) for setup in SETUPS}


def found(setups, seed=1, noise=NOISE):
    rng = np.random.default_rng(seed)
    return fit(stack(MACHINE, [noisy(MADE[s], noise, rng) for s in setups])).inner_map


def truth(grid):
    b, c = np.meshgrid(grid.outer, grid.inner, indexing='ij')
    return np.array([SHAPES[p.letter](b, c) for p in grid.parameters])


def test_four_setups_determine_all_six_errors_at_every_pose():
    grid = found(tuple(SETUPS))
    assert grid.axis == 'C' and not grid.undetermined
    np.testing.assert_allclose(grid.outer, B, atol=1e-9)
    np.testing.assert_allclose(grid.inner, C, atol=1e-9)
    z = (grid.value - truth(grid)) / grid.stddev
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1
    assert 0.93 < np.mean(np.abs(z) < 1.96) < 0.97
    assert grid.rms == pytest.approx(NOISE, rel=0.07)
    assert grid.significance < 1e-10
    np.testing.assert_allclose(grid.value.sum(axis=2), 0.0, atol=1e-15)


def test_what_turns_with_the_table_is_named():
    grid = found(tuple(SETUPS))
    # Once-per-turn run-out and coning, fixed in the table, are offsets of the cycles.
    assert grid.left_open == ('E_X(B)C, E_Y(B)C (2 shapes)', 'E_A(B)C, E_B(B)C (2 shapes)')


def test_two_heights_on_the_axis_leave_only_the_yaw_open():
    grid = found(('2a', '2b'))
    assert grid.undetermined == ('E_C(B)C',)
    assert np.isnan(grid.value[5]).all() and np.isfinite(grid.value[:5]).all()
    z = ((grid.value - truth(grid)) / grid.stddev)[:5]
    assert 0.85 < np.sqrt(np.mean(z**2)) < 1.15


def test_one_setup_cannot_split_tilt_from_run_out_and_says_so():
    grid = found(('1a',))
    assert {'E_X(B)C', 'E_Y(B)C', 'E_A(B)C', 'E_B(B)C'} <= set(grid.undetermined)
    assert np.isnan(grid.value[0]).any()


def test_a_machine_without_such_errors_shows_none():
    rng = np.random.default_rng(3)
    made = {s: static_cycle(s, constant) for s in SETUPS}
    significant = 0
    for _ in range(40):
        cycles = [noisy(made[s], NOISE, rng) for s in SETUPS]
        significant += fit(stack(MACHINE, cycles)).inner_map.significance < 0.01
    assert significant <= 3


def test_a_pose_missing_in_every_setup_is_open_and_the_rest_is_not():
    rng = np.random.default_rng(4)
    cycles = []
    for setup in SETUPS:
        cycle = noisy(MADE[setup], NOISE, rng)
        kept = tuple(p for p in cycle.points if p.index != 17)
        cycles.append(type(cycle)(cycle.plan, kept, (), 'cal', cycle.stamp))
    grid = fit(stack(MACHINE, cycles)).inner_map
    assert np.isnan(grid.value[0]).sum() == 1
    row, column = np.argwhere(np.isnan(grid.value[0]))[0]
    # Pose 17: second level, which runs backwards through C.
    assert (row, column) == (1, 12 - 5)
    assert np.isfinite(grid.value).sum() == 6 * 83


def test_any_map_of_c_leaves_squareness_and_location_errors_alone():
    # Generic tilts of 10 urad and run-outs of 1.5 um, harmonics 2 to 4 with and without B: fitted
    # one after the other they move squareness by micro-radians.
    rng = np.random.default_rng(8)
    size = {k: (0.75e-6 if k in 'XYZ' else 5e-6) * rng.normal(size=(3, 2)) for k in 'XYZABC'}

    def errors_at(b, c):
        errors = constant(b, c)
        for letter, pairs in size.items():
            wave = sum(
                p * np.cos(n * c) * (1 + 0.5 * b) + q * np.sin(n * c)
                for n, (p, q) in enumerate(pairs, 2)
            )
            errors['C'][letter] = errors['C'].get(letter, 0.0) + wave
        return errors

    made = [static_cycle(setup, errors_at) for setup in SETUPS]
    exact = fit(stack(MACHINE, made))
    assert exact.joint_inner
    # The map is added linearly: products of two errors of 1e-5 are left.
    np.testing.assert_allclose(exact.location.value, VALUES, atol=2e-10)
    assert exact.inner_map.rms < 1e-10
    z = []
    for _ in range(25):
        location = fit(stack(MACHINE, [noisy(c, NOISE, rng) for c in made])).location
        z.append((location.value - VALUES) / location.stddev)
    assert 0.9 < np.std(z) < 1.12
    assert np.abs(np.mean(z, axis=0)).max() < 4 / 5
