"""Dynamic effects hidden in turn, and named."""

from dataclasses import replace

import pytest
from dynamic_machine import FAST, RADIUS, SLOW, Hidden
from test_dynamic_motion import MACHINE, readings

from rtest_identification.dynamic import naming
from rtest_identification.dynamic.pipeline import analyse

SLOWER = 3 * SLOW
FEEDS = ((SLOWER, 0.8), (FAST, 1.2))


def found(hidden, feeds=FEEDS, seed=0):
    return analyse(MACHINE, readings(hidden, feeds, seed))


def names(result):
    return [(one.key, one.channel) for one in result.naming.effects]


def parameter(result, key, name):
    values = next(one.values for one in result.naming.effects if one.key == key)
    return next((value, stddev) for other, value, stddev, _ in values if other == name)


def test_nothing_is_found_where_nothing_is_hidden():
    """How often in hundreds of measurements: bench/dynamic_blind.py."""
    result = found(Hidden(drift=1e-7, vibration=2e-7))
    assert result.naming.verdict == 'no gap'
    assert names(result) == []
    assert abs(result.offset.value) < 4 * result.offset.stddev


def test_the_lag_of_the_thesis_is_friction():
    """Section 5.7.2: 3 um at 358 deg/min, 6 um at 3,583, contact probes only, not in encoders."""
    lag = {round(SLOW, 6): 3e-6, round(FAST, 6): 6e-6}
    result = found(Hidden(lag=lag), ((SLOW, 0.6), (FAST, 2.2)))
    assert names(result) == [('friction-lag', 'gauges')]
    assert result.naming.verdict == 'explained'
    friction = result.naming.effects[0]
    assert not {'servo-mismatch/C', 'clock-offset'} & set(friction.rivals)
    assert 'third feed' in friction.separate_by
    # Ten times the speed, twice the lag: the exponent is log10(2).
    value, stddev = parameter(result, 'friction-lag', 'p')
    assert abs(value - 0.301) < 5 * stddev < 0.01
    for one, truth in zip(result.lags, lag.values(), strict=True):
        assert abs(one.gauges[0] - truth) < 5 * one.gauges[1]
        assert abs(one.encoders[0]) < 5 * one.encoders[1]


def test_the_same_with_lasers_is_no_friction():
    """What lasers show is not the probes' friction, whatever it looks like."""
    lag = {round(SLOWER, 6): 3e-6, round(FAST, 6): 3e-6}
    cycles = [replace(one, contact=False) for one in readings(Hidden(lag=lag), FEEDS)]
    result = analyse(MACHINE, cycles)
    assert names(result) == [('backlash/C', 'gauges')]


def test_an_equal_lag_at_all_speeds_could_be_backlash():
    lag = {round(SLOWER, 6): 2e-6, round(FAST, 6): 2e-6}
    result = found(Hidden(lag=lag))
    assert names(result) == [('friction-lag', 'gauges')]
    assert 'backlash/C' in result.naming.effects[0].rivals
    assert 'lasers' in result.naming.effects[0].separate_by


def test_servo_mismatch_is_seen_by_the_encoders():
    mismatch = -2e-5
    result = found(Hidden(mismatch=mismatch))
    assert names(result) == [('servo-mismatch/C', 'encoders')]
    assert result.naming.verdict == 'explained'
    value, stddev = parameter(result, 'servo-mismatch/C', '1/Kv difference')
    assert abs(value - mismatch) < 5 * stddev
    # The lag is the shift turned round: the sphere before the nest has a negative one.
    fast = result.lags[-1]
    assert fast.encoders[0] == pytest.approx(-FAST * RADIUS * mismatch, abs=5 * fast.encoders[1])


def test_a_clock_offset_that_shifts_the_tangential_by_v_t():
    late = -3e-5
    result = found(Hidden(late=late, shift_late=True))
    assert names(result) == [('clock-offset', 'gauges')]
    value, stddev = parameter(result, 'clock-offset', 't0')
    assert abs(value - late) < 5 * stddev < 1e-5
    # An offset that features are too few to confirm is said to be so.
    assert 'more starts and stops' in result.naming.effects[0].separate_by


def test_a_shift_in_proportion_to_speed_with_features_in_time_is_no_clock_offset():
    hidden = Hidden(lag={round(w, 6): 2e-3 * w * RADIUS for w in (SLOWER, FAST)})
    result = found(hidden)
    assert names(result) == []
    assert result.naming.verdict == 'unknown effect'
    assert 'no clock offset' in result.warnings[0]


def test_radius_shrink():
    result = found(Hidden(shrink=0.01))
    assert names(result) == [('radius-shrink', 'gauges')]
    value, stddev = parameter(result, 'radius-shrink', 'T')
    assert abs(value - 0.01) < 5 * stddev < 1e-3


def test_reversal_spikes():
    result = found(Hidden(spike=('Y', -3e-6, 0.06)))
    assert names(result) == [('reversal-spike/Y', 'gauges')]
    for name, truth in (('A', -3e-6), ('tau', 0.06)):
        value, stddev = parameter(result, 'reversal-spike/Y', name)
        assert abs(value - truth) < 5 * stddev < abs(truth)


def test_two_at_once():
    lag = {round(SLOWER, 6): 3e-6, round(FAST, 6): 5e-6}
    result = found(Hidden(lag=lag, late=0.003, mismatch=5e-5))
    assert set(names(result)) == {
        ('servo-mismatch/C', 'encoders'), ('friction-lag', 'gauges'), ('clock-offset', 'gauges'),
    }


def test_one_feed_leaves_what_depends_on_speed_open():
    lag = {round(FAST, 6): 3e-6}
    result = found(Hidden(lag=lag), ((FAST, 1.2),))
    effect = next(e for e in result.naming.effects if e.channel == 'gauges')
    alike = {effect.key, *effect.rivals}
    assert {'friction-lag', 'clock-offset', 'backlash/C'} <= alike
    assert 'another feed' in effect.separate_by
    assert any('one feed only' in line for line in result.warnings)


def test_what_the_library_lacks_is_unknown(monkeypatch):
    monkeypatch.setattr(naming, 'gauge_library', lambda scene: [
        e for e in gauge_library(scene) if not e.key.startswith(('reversal', 'backlash'))
    ])
    gauge_library = naming.encoder_library.__globals__['gauge_library']
    result = found(Hidden(spike=('X', 4e-6, 0.15)))
    assert result.naming.verdict in ('unknown effect', 'partly explained')
    assert result.naming.rest.probability < 1e-6
    assert result.naming.rest.size > 0.1e-6
