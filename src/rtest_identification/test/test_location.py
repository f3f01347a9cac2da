"""Location errors and B map, against a machine of plain matrices that shares no code."""

from copy import deepcopy

import numpy as np
import pytest
from independent import NMV, SETUPS, B, C, centre, noisy, static_cycle
from scipy import stats

from rtest_estimation.errors import UserError
from rtest_identification.location import fit
from rtest_identification.machine import parse_machine
from rtest_identification.observations import stack
from rtest_identification.pipeline import identify

MACHINE = parse_machine(NMV)
TRUTH = {
    'E_X(0Y)B': -7.8e-6, 'E_Y(0Y)B': 12.1e-6, 'E_Z(0Y)B': -38e-6, 'E_A(0Y)B': 1.8e-5,
    'E_B(0Y)B': 4.1e-5, 'E_C(0Y)B': 0.8e-5, 'E_X(0B)C': 5e-6, 'E_A(0B)C': -1.5e-5,
    'E_A(0Y)Z': -0.1e-5, 'E_B(0X)Z': -0.8e-5, 'E_C(0Y)X': 1.4e-5,
}
VALUES = np.array(list(TRUTH.values()))


def constant(b, c):
    errors = {}
    for symbol, value in TRUTH.items():
        errors.setdefault(symbol[-1], {})[symbol[2]] = value
    return errors


MAP = {
    'B': lambda b: 8e-6 * (b**2 - np.mean(B**2)),
    'Y': lambda b: 2e-6 * np.sin(2 * b),
}


def with_map(b, c):
    """The constants, and a B map of mean zero over the stations that no constant could show.

    E_B and E_Y are free of shapes that a constant error of C would make ((E_X, E_Z) and
    (E_A, E_C) along (cos B, -sin B) or (sin B, cos B)).
    """
    errors = constant(b, c)
    errors['B'] = {k: v + MAP.get(k, lambda b: 0.0)(b) for k, v in errors['B'].items()}
    return errors


def growing_tilt(b, c):
    """The constants, and a tilt of C that grows with |B|, as a model's effect."""
    errors = constant(b, c)
    errors['C'] = {**errors['C'], 'B': 1.4e-5 * abs(b)}
    return errors


def tilt_and_more(b, c):
    """Besides, C moves axially, which the model does not have."""
    errors = growing_tilt(b, c)
    errors['C'] = {**errors['C'], 'Z': 1.5e-6 * np.cos(5 * c)}
    return errors


def tilt_columns(observations, jacobian, fitted):
    """(n, 3, 1) of the growing tilt, as differences of the plain machine."""
    step = 1e-6
    moved = [
        (centre(*row, {'C': {'B': step * abs(row[3])}}) - centre(*row, {})) / step
        for row in observations.positions
    ]
    return np.array(moved)[:, :, None]


def cycles(errors_at, setups=tuple(SETUPS), noise=0.0, rng=None):
    made = [CACHE[errors_at.__name__, s] for s in setups]
    return [noisy(c, noise, rng) for c in made] if noise else deepcopy(made)


CACHE = {
    (e.__name__, s): static_cycle(s, e)
    for e in (constant, with_map, growing_tilt, tilt_and_more)
    for s in SETUPS
}


def test_noise_free_data_give_the_truth():
    result = fit(stack(MACHINE, cycles(constant)))
    assert result.location.symbols == tuple(TRUTH)
    # Exact kinematics: what is left is rounding, not second-order terms of 1e-9.
    np.testing.assert_allclose(result.location.value, VALUES, atol=2e-13)
    assert result.location.rank == 11 + 12
    assert not len(result.outliers)


@pytest.mark.parametrize('errors_at', [constant, with_map])
def test_stated_intervals_hold_the_truth(errors_at):
    rng = np.random.default_rng(11)
    z = []
    for _ in range(60):
        location = fit(stack(MACHINE, cycles(errors_at, noise=2.5e-7, rng=rng))).location
        z.append((location.value - VALUES) / location.stddev)
    z = np.array(z)
    # 660 values: 95 % intervals hold 95 % within Monte Carlo error (correlated: about 1.5 %).
    assert 0.92 < np.mean(np.abs(z) < 1.96) < 0.975
    assert 0.85 < z.std() < 1.15
    assert np.abs(z.mean(axis=0)).max() < 4.5 / np.sqrt(60)


def test_uncertainty_is_that_of_plain_least_squares_or_better():
    rng = np.random.default_rng(12)
    location = fit(stack(MACHINE, cycles(constant, noise=2.5e-7, rng=rng))).location
    linear = [not p.angular for p in location.parameters]
    assert location.stddev[linear].max() < 0.03e-6
    assert location.stddev[np.logical_not(linear)].max() < 0.4e-6


def test_the_map_of_b_is_found_within_its_uncertainty():
    rng = np.random.default_rng(13)
    result = fit(stack(MACHINE, cycles(with_map, noise=2.5e-7, rng=rng)))
    found = result.error_map
    assert result.joint and found.significance < 1e-6
    np.testing.assert_allclose(found.stations, B, atol=1e-9)
    for parameter, value, stddev in zip(found.parameters, found.value, found.stddev, strict=True):
        truth = np.array([MAP.get(parameter.letter, lambda b: 0.0)(b) for b in B])
        assert np.abs((value - truth) / stddev).max() < 3.8, parameter.symbol
        assert abs(value.sum()) < 1e-12
    assert result.rms == pytest.approx(2.5e-7, rel=0.06)


def test_the_effect_of_a_model_is_no_map_of_c():
    found = []
    for seed in range(4):
        rng = np.random.default_rng(40 + seed)
        result = fit(stack(MACHINE, cycles(growing_tilt, noise=2.5e-7, rng=rng)), tilt_columns)
        assert not result.joint_inner and not len(result.outliers)
        assert np.sqrt(np.mean(result.residual**2)) == pytest.approx(2.5e-7, rel=0.06)
        assert np.abs((result.location.value - VALUES) / result.location.stddev).max() < 4
        assert result.error_map.significance > 0.01
        # The same noise on a machine without the effect, identified without the model.
        rng = np.random.default_rng(40 + seed)
        plain = fit(stack(MACHINE, cycles(constant, noise=2.5e-7, rng=rng)))
        found.append((result.inner_map.significance, plain.inner_map.significance))
    found = np.array(found)
    # One column more or less among a thousand rows.
    np.testing.assert_allclose(found[:, 0], found[:, 1], atol=0.1)
    assert found.min() > 0.01


def test_a_map_of_c_beside_the_effects_of_a_model_is_found():
    rng = np.random.default_rng(44)
    result = fit(stack(MACHINE, cycles(tilt_and_more, noise=2.5e-7, rng=rng)), tilt_columns)
    assert result.joint_inner and result.inner_map.significance < 1e-6
    truth = np.zeros_like(result.inner_map.value)
    truth[2] = 1.5e-6 * np.cos(5 * C)
    z = (result.inner_map.value - truth) / result.inner_map.stddev
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.15)
    assert np.abs((result.location.value - VALUES) / result.location.stddev).max() < 4


def test_a_model_without_effects_changes_nothing():
    data = stack(MACHINE, cycles(with_map, noise=2.5e-7, rng=np.random.default_rng(45)))
    without = fit(data)
    for columns in (np.zeros((len(data), 3, 0)), np.zeros((len(data), 3, 2))):
        result = fit(data, lambda *_, columns=columns: columns)
        np.testing.assert_allclose(result.location.value, without.location.value, atol=1e-12)
        assert result.rms == pytest.approx(without.rms, rel=1e-3)


def test_what_an_r_test_cannot_see_is_named():
    found = fit(stack(MACHINE, cycles(constant))).error_map
    # Shapes of a constant E_X(0B)C, E_Z of C; and of E_A(0B)C, and the yaw of C.
    assert found.left_open == (
        'E_X(Y)B, E_Z(Y)B (2 shapes)', 'E_A(Y)B, E_C(Y)B (2 shapes)',
    )
    assert found.rank == 36 - 4


def test_one_setup_determines_less_and_says_so():
    centre_only = fit(stack(MACHINE, cycles(constant, ('2a',))))
    lost = [s for s, d in zip(TRUTH, centre_only.location.determined, strict=True) if not d]
    # With the sphere on the axis of C nothing tells tilts from shifts of a rigid table.
    assert {'E_A(0Y)B', 'E_A(0B)C', 'E_A(0Y)Z'} <= set(lost)
    assert centre_only.location.rank < 11 + 3


def test_an_outlier_is_left_out_and_listed():
    rng = np.random.default_rng(14)
    data = cycles(constant, noise=2.5e-7, rng=rng)
    data[1].points[20].displacement[1] += 50e-6
    result = fit(stack(MACHINE, data))
    assert result.outliers.tolist() == [86 + 20]
    z = (result.location.value - VALUES) / result.location.stddev
    assert np.abs(z).max() < 4


def test_sense_minus_one_gives_the_machine_that_turns_backwards():
    mirrored = parse_machine(NMV.replace('sense: 1', 'sense: -1'))
    data = cycles(constant)
    for cycle in data:
        for point in cycle.points:
            point.feedback[3:] *= -1
    result = fit(stack(mirrored, data))
    np.testing.assert_allclose(result.location.value, VALUES, atol=2e-13)


def test_a_machine_with_other_axes_is_refused():
    with pytest.raises(UserError, match='A'):
        stack(
            parse_machine(NMV.replace('  B:', '  A:').replace('[C, B,', '[C, A,')),
            cycles(constant, ('1a',)),
        )


def test_nothing_measured_is_refused():
    with pytest.raises(UserError, match='no static cycle'):
        stack(MACHINE, [])


@pytest.mark.parametrize('errors_at', [constant, with_map])
@pytest.mark.parametrize('setups', [('2a',), ('1a',), ('2a', '2b')])
def test_a_map_never_makes_the_fit_worse(setups, errors_at):
    # Also where constants are not determined.
    rng, noise = np.random.default_rng(15), 2.5e-7
    result = fit(stack(MACHINE, cycles(errors_at, setups, noise=noise, rng=rng)))
    assert not len(result.outliers) and not result.joint_inner
    # The fit without the map is the one with the map held at zero. Freeing it can only lower the
    # sum of squares; all poses weigh the same here, so that this holds to rounding for the plain
    # one. An rms is such a sum over its own degrees of freedom, and may be the larger one then.
    free = result.residual.size - result.location.rank
    before = free * result.rms_location**2
    after = (result.residual**2).sum()
    assert after <= before * (1.0 + 1e-12)
    free_after = free - result.error_map.rank
    assert free_after * result.rms**2 == pytest.approx(after, rel=1e-12)
    # And they are the right ones: the sum is that of so many normal numbers.
    assert 1e-3 < stats.chi2.cdf(after / noise**2, free_after) < 1.0 - 1e-3
    if errors_at is constant:
        assert 1e-3 < stats.chi2.cdf(before / noise**2, free) < 1.0 - 1e-3


@pytest.mark.parametrize(
    ('old', 'new'),
    [('[0, 1, 0], sense: 1', '[0, 1, 0], sense: -1'), ('[0, 1, 0], sense', '[0, 0, 1], sense'),
     ('[C, B, bed', '[B, C, bed')],
)
def test_another_machine_is_refused(old, new):
    machine = parse_machine(NMV.replace(old, new, 1))
    with pytest.raises(UserError, match='does not fit this recording'):
        identify(machine, cycles(constant))
