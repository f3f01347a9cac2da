"""Time constants and phases, on series made by hand."""

import numpy as np
import pytest
from independent import NMV
from warming import MINUTE, session, settling

from rtest_identification.machine import parse_machine
from rtest_identification.symbols import parameter
from rtest_identification.thermal.pipeline import identify_thermal
from rtest_identification.thermal.series import Series, drifts, holm, variation
from rtest_identification.thermal.time_constants import Phase, phases, time_constant

MACHINE = parse_machine(NMV)
PERIOD = 15 * MINUTE


def series(value, noise=0.0, seed=0, letter='Y'):
    value = np.asarray(value) + noise * np.random.default_rng(seed).normal(size=len(value))
    time = PERIOD * np.arange(len(value))
    scatter = np.full(len(value), max(noise, 1e-9))
    return Series(
        parameter(MACHINE, 'B', letter), time, value - value[0], np.sqrt(2.0) * scatter, scatter
    )


def whole(one):
    return Phase(0, len(one.time) - 1, one.time[0], one.time[-1])


def test_time_constant_without_noise():
    time = PERIOD * np.arange(13)
    one = series(-6e-6 * settling(time, 40 * MINUTE))
    found = time_constant(one, whole(one), PERIOD)
    assert found.tau == pytest.approx(40 * MINUTE, rel=0.02)
    assert found.level == pytest.approx(-6e-6, rel=0.01)
    assert found.rest == pytest.approx(-6e-6, rel=0.01)
    np.testing.assert_allclose(found.curve(time), one.value, atol=3e-8)
    assert not found.undetermined


def test_interval_holds_the_time_constant_in_95_of_100():
    time = PERIOD * np.arange(13)
    inside = []
    for seed in range(200):
        one = series(-6e-6 * settling(time, 50 * MINUTE), 0.1e-6, seed)
        low, high = time_constant(one, whole(one), PERIOD).interval
        inside.append(low <= 50 * MINUTE <= high)
    assert 0.92 <= np.mean(inside) <= 0.99


@pytest.mark.parametrize(
    ('tau', 'told'),
    [
        (10 * 180 * MINUTE, 'near or above the 180 min observed'),
        (5 * MINUTE, 'near or below the 15 min between cycles'),
    ],
)
def test_time_constants_that_cannot_be_known_are_not_given(tau, told):
    time = PERIOD * np.arange(13)
    one = series(-6e-6 * settling(time, tau) / settling(time[-1], tau), 0.1e-6)
    found = time_constant(one, whole(one), PERIOD)
    assert told in found.undetermined


def test_too_few_cycles_have_no_time_constant():
    one = series([0.0, -1e-6, -1.5e-6])
    assert time_constant(one, whole(one), PERIOD) is None


def test_warming_up_and_cooling_down():
    def state(time):
        turn = 150 * MINUTE
        up = settling(min(time, turn), 40 * MINUTE)
        return up * np.exp(-max(time - turn, 0.0) / (70 * MINUTE))

    def errors(time, b, c):
        f = state(time)
        return {'B': {'X': -2e-6 * f, 'Y': -6e-6 * f, 'Z': -2e-6 * f}}

    cycles = session(errors, np.arange(0, 361, 15), noise=0.25e-6, seed=1)
    result = identify_thermal(MACHINE, cycles)
    assert [(p.first, p.last) for p in result.phases] == [(0, 9), (10, 24)]
    y = next(h for h in result.errors if h.parameter.symbol == 'E_Y(0Y)B')
    up, down = y.constants
    assert up.interval[0] <= 40 * MINUTE <= up.interval[1]
    assert down.interval[0] <= 70 * MINUTE <= down.interval[1]
    assert up.interval[1] < 50 * MINUTE and down.interval[0] > 60 * MINUTE
    # It has come back: the last change is within U, the largest is not.
    assert abs(y.drift.last[0]) < 0.5e-6 < 5e-6 < abs(y.drift.largest[0])


def test_two_time_constants_one_way_are_one_phase():
    time = PERIOD * np.arange(17)
    value = settling(time, 10 * MINUTE) + 2 * settling(time, 120 * MINUTE)
    found = phases([series(-2e-6 * value, 0.05e-6)], time)
    assert len(found) == 1


def test_holm_by_hand():
    # Holm 1979: 3 x 0.01; 2 x 0.02; the largest not below the one before.
    np.testing.assert_allclose(holm([0.02, 0.01, 0.03]), [0.04, 0.03, 0.04])
    np.testing.assert_allclose(holm([0.9, 0.8]), [1.0, 1.0])


def test_variation_is_uniform_where_nothing_changes():
    rng = np.random.default_rng(0)
    covariance = np.array([[2.0, 0.5], [0.5, 1.0]])
    factor = np.linalg.cholesky(covariance)
    found = [
        variation([factor @ rng.normal(size=2) for _ in range(9)], [covariance] * 9, 10**6)
        for _ in range(300)
    ]
    assert np.mean(np.array(found) < 0.1) == pytest.approx(0.1, abs=0.05)
    assert np.mean(found) == pytest.approx(0.5, abs=0.05)


def test_drift_beyond_u_and_back():
    one = series([0.0, 1e-6, 1e-6, 1e-6, 0.0, 0.0], 0.0)
    quiet = series(np.zeros(6))
    u = np.array([0.0, *[0.2e-6] * 5])
    one, quiet = (
        Series(s.parameter, s.time, s.value, u, np.full(6, 0.14e-6)) for s in (one, quiet)
    )
    back, still = drifts([one, quiet], 500)
    assert back.significant and back.beyond_since is None
    assert back.last[0] == 0.0 and back.largest[0] == 1e-6
    assert not still.significant and still.adjusted == 1.0
    rising = Series(one.parameter, one.time, 1e-6 * np.arange(6.0), u, one.scatter)
    assert drifts([rising], 500)[0].beyond_since == PERIOD
