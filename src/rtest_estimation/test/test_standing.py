"""Noise and its spectrum, on readings with lines that are known."""

import numpy as np
import pytest

from rtest_estimation.records import Feedback, GaugeBlock, Status
from rtest_estimation.standing import Standing, folded, longest_standing


def standing(rate=500.0, seconds=20.0, lines=(), noise=0.1e-6, drift=0.0, seed=3):
    times = np.arange(round(rate * seconds)) / rate
    readings = noise * np.random.default_rng(seed).standard_normal((len(times), 2))
    for frequency, amplitude in lines:
        readings[:, 0] += amplitude * np.sin(2 * np.pi * frequency * times + 0.4)
    readings[:, 0] += drift * times
    return Standing(rate, readings, np.zeros(2))


def test_a_hum_is_found_with_its_amplitude_and_only_where_it_is() -> None:
    found = standing(lines=[(50.0, 0.2e-6), (133.0, 0.08e-6)])
    first, second = found.lines(0)
    assert first.frequency == pytest.approx(50.0, abs=0.05)
    assert first.amplitude == pytest.approx(0.2e-6, rel=0.05)
    assert second.frequency == pytest.approx(133.0, abs=0.05)
    assert found.lines(1) == []


def test_noise_alone_has_no_lines_but_in_one_spectrum_of_a_hundred() -> None:
    alarms = sum(
        bool(standing(seconds=4.0, seed=seed).lines(gauge))
        for seed in range(100) for gauge in (0, 1)
    )
    # 200 spectra at one in a hundred: more than 8 has probability 2e-4 (binomial).
    assert alarms <= 8


def test_drift_is_no_line_and_not_in_the_noise() -> None:
    found = standing(drift=1e-6)
    assert found.change[0] == pytest.approx(20e-6, rel=1e-2)
    assert found.noise == pytest.approx([0.1e-6, 0.1e-6], rel=0.03)
    assert found.lines(0) == []


@pytest.mark.parametrize('lines', [(), [(50.0, 0.5e-6), (1.3, 0.1e-6)]])
def test_the_uncertainty_of_a_drift_covers_it(lines) -> None:
    """Also with hum, and with something that swings slowly: readings then depend on each other."""
    drift, rng = 2e-9, np.random.default_rng(8)
    inside = 0
    for seed in range(100):
        # Readings begin anywhere in a period.
        shifted = [(f * (1.0 + 0.02 * rng.standard_normal()), a) for f, a in lines]
        found = standing(50.1, 30.0, shifted, drift=drift, seed=seed)
        inside += abs(found.change[0] - drift * found.duration) <= found.change_spread[0]
    # 95 of 100 are wanted; fewer than 88 has probability 1e-3 (binomial).
    assert inside >= 88


def test_frequencies_above_half_the_rate_are_folded() -> None:
    # By hand: 60 Hz read at 50 /s is 10 Hz, 50 Hz is nothing at all, 20 Hz stays.
    assert [folded(f, 50.0) for f in (60.0, 50.0, 20.0, 30.0)] == [10.0, 0.0, 20.0, 20.0]
    found = standing(rate=80.0, lines=[(60.0, 0.3e-6)])
    assert found.lines(0)[0].frequency == pytest.approx(20.0, abs=0.05)


def recording(jitter=0.0):
    """Still for 1 s, a motion, still for 3 s with one invalid reading after 1 s of it."""
    rng = np.random.default_rng(1)
    feedback, gauges = [], []
    for n in range(421):
        moved = 1e-3 * min(max(n - 100, 0), 20)
        feedback.append(Feedback(n * 10_000_000, ('X', 'B'), np.array([moved, 0.0])))
        status = Status.OUT_OF_RANGE if n == 220 else Status.VALID
        stamp = round((n + jitter * rng.uniform(-0.5, 0.5)) * 10_000_000)
        gauges.append(GaugeBlock(max(stamp, 0), n, 0.0, np.array([[n * 1e-9, 0.0]]),
                                 np.array([[status, 0]], dtype=np.uint8)))
    return gauges, feedback


def test_the_longest_stretch_ends_at_motion_and_at_a_bad_reading() -> None:
    found = longest_standing(*recording())
    # From reading 221 to 420.
    assert found.readings[0, 0] == pytest.approx(221e-9)
    assert len(found.readings) == 200 and found.rate == pytest.approx(100.0)


def test_readings_near_a_motion_are_left_out() -> None:
    gauges, feedback = recording()
    good = [block if n != 220 else gauges[219] for n, block in enumerate(gauges)]
    found = longest_standing(good, feedback)
    # The axis moves from 1.0 to 1.2 s; half a second later the stretch begins, and ends with the
    # recording.
    assert found.readings[0, 0] == pytest.approx(170e-9, abs=1.1e-9)
    assert found.readings[-1, 0] == pytest.approx(420e-9)


def test_the_resolution_is_that_of_the_whole_recording() -> None:
    gauges, feedback = recording()
    coarse = [
        GaugeBlock(b.stamp, b.sequence, 0.0, np.round(b.displacement / 1e-7) * 1e-7, b.status)
        for b in gauges
    ]
    found = longest_standing(coarse, feedback)
    assert found.steps[0] == pytest.approx(1e-7) and found.steps[1] == np.inf
    assert found.noise[0] >= 1e-7 / 12.0**0.5


def test_uneven_times_are_made_even() -> None:
    found = longest_standing(*recording(jitter=0.4))
    assert found.rate == pytest.approx(100.0, rel=0.01)
    # The last one may come after the last feedback, which could have moved by then.
    assert len(found.readings) in (199, 200)


def test_nothing_where_nothing_stands_still() -> None:
    gauges, feedback = recording()
    moving = [Feedback(f.stamp, f.axes, f.position + 1e-3 * (n % 2))
              for n, f in enumerate(feedback)]
    assert longest_standing(gauges, moving) is None
    assert longest_standing([], feedback) is None
