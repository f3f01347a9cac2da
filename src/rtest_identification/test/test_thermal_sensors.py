"""Errors against temperatures: lag, correlation, which sensor explains best."""

import numpy as np
import pytest
from independent import NMV
from warming import MINUTE, START, readings, session, settling

from rtest_identification.machine import parse_machine
from rtest_identification.symbols import parameter
from rtest_identification.thermal.pipeline import identify_thermal
from rtest_identification.thermal.sensors import Clock, changed, dependence
from rtest_identification.thermal.series import Series
from rtest_identification.thermal.temperature import Thermometer

MACHINE = parse_machine(NMV)
TAU = 50 * MINUTE
END = settling(180 * MINUTE, TAU)
TIME = 15 * MINUTE * np.arange(13)
CLOCK = Clock(START, 100.0, 15 * MINUTE)


def cover(seconds, rise=1.4, late=0.0):
    """A thermometer that warms up by so much in 3 h, so late."""
    return 22.0 + rise * settling(max(seconds - late, 0.0), TAU) / END


def thermometer(name, celsius_at, seed=0, noise=0.05):
    return Thermometer.of(name, *readings(celsius_at, 185, noise=noise, seed=seed))


def following(late, noise=0.07e-6, seed=0, size=-6e-6):
    """An error that follows the cover so late."""
    value = size * settling(np.maximum(TIME - late, 0.0), TAU) / END
    value = value + noise * np.random.default_rng(seed).normal(size=13)
    scatter = np.full(13, noise)
    return Series(
        parameter(MACHINE, 'B', 'Y'), TIME, value - value[0], np.sqrt(2.0) * scatter, scatter
    )


@pytest.mark.parametrize('late', [30 * MINUTE, 0.0, -30 * MINUTE])
def test_lag_comes_back_with_its_interval(late):
    found, inside = [], []
    for seed in range(40):
        # A negative lag is a sensor that is late.
        sensor = thermometer('T', lambda s: cover(s, late=max(-late, 0.0)), seed)
        lag = dependence(following(max(late, 0.0), seed=seed), sensor, CLOCK, True).lag
        found.append(lag.value)
        inside.append(lag.interval[0] <= late <= lag.interval[1])
        assert bool(lag.undetermined) == (late == 0.0)
    assert np.mean(found) == pytest.approx(late, abs=1.5 * MINUTE)
    assert np.mean(inside) >= 0.8


def test_a_lag_near_the_cycle_period_is_not_given():
    sensor = thermometer('T', cover)
    lag = dependence(following(10 * MINUTE), sensor, CLOCK, True).lag
    assert 'near or below the 15 min between cycles' in lag.undetermined
    assert lag.interval[0] <= 10 * MINUTE <= lag.interval[1]


def test_a_lag_near_the_length_of_the_session_is_not_given():
    sensor = thermometer('T', cover)
    lag = dependence(following(80 * MINUTE), sensor, CLOCK, True).lag
    assert 'may be longer than a third of the 180 min observed' in lag.undetermined


def test_an_error_that_does_not_drift_has_no_lag():
    still = following(0.0, size=0.0)
    found = dependence(still, thermometer('T', cover), CLOCK, False)
    assert np.isnan(found.lag.value) and 'does not drift' in found.lag.undetermined
    assert abs(found.sensitivity) < 3.0 * found.stddev


def test_sensitivity_and_correlation_within_their_uncertainty():
    inside = []
    for seed in range(60):
        found = dependence(
            following(0.0, seed=seed), thermometer('T', cover, seed), CLOCK, True
        )
        inside.append(abs(found.sensitivity + 6e-6 / 1.4) <= 2.0 * found.stddev)
        assert found.correlation == pytest.approx(-1.0, abs=6.0 * found.correlation_stddev + 1e-3)
    assert np.mean(inside) >= 0.88


def test_correlation_by_hand():
    # A sensor without noise that follows a rule of three values over and over.
    pattern = np.array([0.0, 1.0, -1.0] * 4 + [0.0])
    stamps = START + np.rint(1e9 * np.arange(-500.0, 12 * 900.0 + 500.0, 10.0)).astype(np.int64)
    celsius = pattern[np.clip(np.rint((stamps - START) * 1e-9 / 900.0), 0, 12).astype(int)]
    value = np.roll(pattern, 1) * 1e-6
    scatter = np.full(13, 1e-7)
    one = Series(parameter(MACHINE, 'B', 'Y'), TIME, value - value[0], scatter, scatter)
    found = dependence(one, Thermometer.of('T', stamps, 20.0 + celsius), CLOCK, True)
    expected = np.corrcoef(pattern, value)[0, 1]
    assert found.correlation == pytest.approx(expected, abs=1e-6)
    wrong = [
        np.corrcoef(pattern, value + 1e-7 * np.random.default_rng(s).normal(size=13))[0, 1]
        for s in range(400)
    ]
    assert found.correlation_stddev == pytest.approx(np.std(wrong), rel=0.15)


def test_the_sensor_that_explains_best():
    """Fig. 4-2: ambient, cover of B, bridge, table, R-test; the cover warms by 1.4 K."""
    def errors(time, b, c):
        f = settling(time, TAU) / END
        return {'B': {'X': -2e-6 * f, 'Y': -6e-6 * f, 'Z': -2e-6 * f}}

    sensors = [
        thermometer('T1', lambda s: 22.0 + 0.3 * s / (180 * MINUTE), 1),
        thermometer('T2', cover, 2),
        thermometer('T3', lambda s: cover(s, 0.7, 30 * MINUTE), 3),
        thermometer('T4', lambda s: 22.0, 4),
        thermometer('T5', lambda s: 22.0 + 0.2 * np.sin(s / 2000.0), 5),
    ]
    cycles = session(errors, np.arange(0, 181, 15), noise=0.25e-6, seed=1)
    result = identify_thermal(MACHINE, cycles, sensors)
    drifting = {h.parameter.symbol: h for h in result.drifting}
    assert set(drifting) == {'E_X(0Y)B', 'E_Y(0Y)B', 'E_Z(0Y)B'}
    for history in drifting.values():
        assert history.best.sensor == 'T2' and not history.best.rivals
        # The table did not warm up: there is nothing to correlate with.
        assert [d.sensor for d in history.dependence] == ['T1', 'T2', 'T3', 'T5']
        found = {d.sensor: d for d in history.dependence}
        low, high = found['T3'].lag.interval
        assert low <= -30 * MINUTE <= high and not found['T3'].lag.undetermined
        assert found['T2'].explained > 0.95 and found['T2'].misfit > 0.01
        # Both only warm up: a correlation of -0.99 rests on hardly more than four values.
        assert found['T2'].correlation < -0.97 and found['T2'].independent < 7.0
    y = drifting['E_Y(0Y)B'].dependence[1]
    assert abs(y.sensitivity + 6e-6 / 1.4) < 3.0 * y.stddev


def test_sensors_that_are_alike_are_rivals():
    def errors(time, b, c):
        return {'B': {'Y': -6e-6 * settling(time, TAU) / END}}

    sensors = [thermometer('T2', cover, 2), thermometer('T6', lambda s: cover(s, 0.9), 6)]
    cycles = session(errors, np.arange(0, 181, 15), noise=0.25e-6, seed=2)
    (y,) = identify_thermal(MACHINE, cycles, sensors).drifting
    assert {y.best.sensor, *y.best.rivals} == {'T2', 'T6'}


def test_a_silent_sensor_is_told_and_others_go_before_it():
    def errors(time, b, c):
        return {'B': {'Y': -6e-6 * settling(time, TAU) / END}}

    stamp, celsius = readings(cover, 185, noise=0.05, seed=2)
    silent = Thermometer.of('T2', stamp[:500], celsius[:500])
    sensors = [silent, thermometer('T3', lambda s: cover(s, 0.7), 3)]
    cycles = session(errors, np.arange(0, 181, 15), noise=0.25e-6, seed=3)
    result = identify_thermal(MACHINE, cycles, sensors)
    assert any('thermometer T2 was silent' in warning for warning in result.warnings)
    (y,) = result.drifting
    assert y.best.sensor == 'T3'
    assert [d.cycles for d in y.dependence] == [6, 13]


def test_means_of_a_thermometer_by_hand():
    stamp = START + np.array([0, 10, 20, 40], dtype=np.int64) * 10**9
    one = Thermometer.of('T', stamp[[2, 0, 1, 3, 3]], np.array([4.0, 0.0, 2.0, 4.0, 4.0]))
    assert one.celsius.tolist() == [0.0, 2.0, 4.0, 4.0]
    at = START + np.array([10, 30, 15], dtype=np.int64) * 10**9
    # Trapezoids: around 10 s a slope, around 30 s level, around 15 s a corner at 20 s.
    np.testing.assert_allclose(one.mean(at, 10.0), [2.0, 4.0, 3.0])
    corner = one.mean(START + np.array([20 * 10**9], dtype=np.int64), 10.0)
    assert corner[0] == pytest.approx((5.0 * 3.5 + 5.0 * 4.0) / 10.0)
    late = one.mean(START + np.array([39, 80], dtype=np.int64) * 10**9, 10.0)
    assert late[0] == pytest.approx(4.0) and np.isnan(late[1])
    # At rest before: the start of the line through the first readings.
    assert one.mean(START - np.array([10**11], dtype=np.int64), 10.0)[0] == pytest.approx(
        np.polyfit([0, 10, 20, 40], [0, 2, 4, 4], 1)[1]
    )


def test_scatter_and_resolution_of_a_thermometer():
    rng = np.random.default_rng(0)
    stamp = START + np.arange(2000) * 10**9
    slow = 20.0 + 0.5 * np.arange(2000) / 2000.0
    noisy = Thermometer.of('T', stamp, slow + 0.05 * rng.normal(size=2000))
    assert noisy.mean_stddev(100.0) == pytest.approx(0.005, rel=0.1)
    coarse = Thermometer.of('T', stamp, np.round(slow, 1))
    assert coarse.mean_stddev(100.0) == pytest.approx(0.1 / np.sqrt(12.0), rel=0.1)
    assert changed(coarse, np.array([0.0, 1900.0]), CLOCK)
    assert not changed(coarse, np.array([0.0, 100.0]), CLOCK)
    assert not changed(Thermometer.of('T', stamp[:0], slow[:0]), TIME, CLOCK)
