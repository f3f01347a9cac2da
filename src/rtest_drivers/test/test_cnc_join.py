"""Clocks, and the joining of axes that are told one by one."""

import math
import re
import time

import numpy as np
import pytest

from rtest_drivers.clock import HostClock
from rtest_drivers.cnc.axes import AxisSource
from rtest_drivers.cnc.clock import DeviceClock, Recent
from rtest_drivers.cnc.join import Joiner, Sample

MS = 1_000_000
AXES = (AxisSource('X', 'x', 'mm'), AxisSource('B', 'b', 'deg', -1))


def test_host_clock_is_the_wall_clock_and_goes_on_when_that_is_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = HostClock()
    assert abs(clock.now() - time.time_ns()) < 5 * MS
    assert clock.problem() == ''
    real = time.time_ns
    for step in (-3, 7200):
        monkeypatch.setattr(time, 'time_ns', lambda s=step: real() + s * 10**9)
        assert abs(clock.now() - real()) < 5 * MS
        assert f'set by {step:+.3g} s' in clock.problem()


def test_device_clock_finds_the_offset_under_jitter_and_drift() -> None:
    """Known offset 5 s, drift 20 us/s, under way 2 to 12 ms: late by the shortest way, 2 ms."""
    rng = np.random.default_rng(1)
    clock, last = DeviceClock(), []
    for step in range(3000):
        source = step * 20 * MS
        host = source + 5 * 10**9 + round(source * 20e-6)
        arrival = host + round((2.0 + 10.0 * rng.random()) * MS)
        last.append((clock.to_host([source], arrival)[0] - host) / MS)
    late = np.array(last[500:])
    # 20 s of window drift by 0.4 ms.
    assert late.max() < 2.1 and late.min() > 1.5
    assert clock.offset == pytest.approx(5e9 + 2e6 + 1.2e6, abs=0.5e6)
    assert clock.problem() == ''


@pytest.mark.parametrize('step', [-40, 40])
def test_device_clock_that_is_set_is_followed(step: int) -> None:
    """Seconds, either way; only back needs to be noticed."""
    clock = DeviceClock()
    for source in range(0, 10**9, 20 * MS):
        clock.to_host([source], source + 3 * MS)
    source = 10**9 + step * 10**9
    assert clock.to_host([source], 10**9 + 3 * MS) == [10**9 + 3 * MS]
    assert ('was set back' in clock.problem()) == (step < 0)
    clock.to_host([source + 6 * 10**9], 7 * 10**9)
    assert clock.problem() == ''


def test_stamps_that_came_together_keep_their_distance() -> None:
    assert DeviceClock().to_host([7 * MS, 2 * MS, 5 * MS], 1000 * MS) == [
        1000 * MS, 995 * MS, 998 * MS,
    ]


def test_recent_forgets(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, 'monotonic', lambda: now[0])
    recent = Recent()
    recent.add(7)
    recent.add(3)
    assert recent.largest == 7
    now[0] += 1.5
    recent.add(2)
    assert recent.largest == 7
    now[0] += 1.5
    assert recent.largest == 2
    now[0] += 5.0
    assert recent.largest == 0


@pytest.mark.parametrize(
    ('step', 'way'), [(10.0, 'forward'), (0.25, 'forward'), (-0.15, 'back'), (-10.0, 'back'),
                      (0.03, ''), (-0.03, '')],
)
def test_a_clock_that_is_set_is_told_and_followed(step: float, way: str) -> None:
    """Messages every 50 ms with up to 40 ms under way."""
    rng, clock = np.random.default_rng(3), DeviceClock()
    said, late = '', 0
    for number in range(200):
        host = 10**12 + number * 50 * MS
        ahead = round(step * 1e9) if number >= 100 else 0
        (stamp,) = clock.to_host([host + ahead], host + round(rng.uniform(0, 40)) * MS)
        late = stamp - host
        assert number >= 100 or clock.problem() == ''
        said = said or clock.problem()
    assert bool(said) == bool(way)
    if way:
        found = re.search(f'was set {way} by ([0-9.]+) s', said)
        assert float(found[1]) == pytest.approx(abs(step), abs=0.04)
    assert abs(late) < 40 * MS


def test_axes_keep_their_value_and_close_samples_are_one_feedback() -> None:
    joiner = Joiner(AXES, 5 * MS)
    assert joiner.add([Sample(10 * MS, 'X', 1.0)]) == []
    assert joiner.unknown == ('B',)
    first, second, third = joiner.add([
        Sample(43 * MS, 'X', 3.0),
        Sample(20 * MS, 'B', 180.0),
        Sample(40 * MS, 'B', 90.0),
        Sample(60 * MS),
    ])
    assert (first.stamp, second.stamp, third.stamp) == (20 * MS, 43 * MS, 60 * MS)
    assert first.axes == ('X', 'B')
    assert first.position == pytest.approx([1e-3, -math.pi])
    assert second.position == pytest.approx([3e-3, -math.pi / 2])
    assert np.array_equal(third.position, second.position)
    assert joiner.skew.largest == 3 * MS


def test_unknown_axis_stops_feedback_and_stamps_rise() -> None:
    joiner = Joiner(AXES, 5 * MS)
    assert len(joiner.add([Sample(MS, 'X', 1.0), Sample(MS, 'B', 1.0)])) == 1
    assert joiner.add([Sample(20 * MS, 'B', None), Sample(30 * MS)]) == []
    (again,) = joiner.add([Sample(40 * MS, 'B', 2.0)])
    (late,) = joiner.add([Sample(39 * MS, 'X', 2.0)])
    assert late.stamp == again.stamp + 1 and late.position[0] == 2e-3
    # A sign of life from before says nothing new.
    assert joiner.add([Sample(39 * MS)]) == []
