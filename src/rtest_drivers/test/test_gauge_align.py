"""Readings of several controllers brought to common times, by hand."""

import math

import pytest

from rtest_drivers.gauges.align import GAP_PERIODS, LONGEST, Aligner, Sample
from rtest_estimation.records import Status

MS = 1_000_000
VALID, OVER, NONE, ERROR = Status


def sample(milliseconds: float, *values: float, status: Status = VALID) -> Sample:
    """Values in um at a time in ms."""
    metres = tuple(value * 1e-6 if status is VALID else math.nan for value in values)
    return Sample(round(milliseconds * MS), metres, (status,) * len(values))


def rows(aligner: Aligner, now: float) -> list[tuple]:
    """(time in ms, values in um)."""
    return [
        (row.stamp / MS, [round(value * 1e6, 6) for value in row.values])
        for row in aligner.take(round(now * MS))
    ]


def test_one_stream_is_not_touched() -> None:
    aligner = Aligner([((1, 0), 0.01)])
    for index, stamp in enumerate([10, 19, 31]):
        aligner.add(0, sample(stamp, index, 10 + index))
    assert rows(aligner, 31) == [(10, [10, 0]), (19, [11, 1]), (31, [12, 2])]
    assert aligner.skew() == (0.0, 0.0)


def test_three_displays_on_a_moving_signal() -> None:
    # Gauge k moves with (k + 1) um/ms, so that it reads (k + 1) t wherever t lies between samples.
    aligner = Aligner([((0,), 0.01), ((1,), 0.02), ((2,), 0.005)])
    for stamp in (100, 110, 120, 130, 140, 150):
        aligner.add(0, sample(stamp, stamp))
    for stamp in (104, 124, 144):
        aligner.add(1, sample(stamp, 2 * stamp))
    for stamp in range(101, 151, 5):
        aligner.add(2, sample(stamp, 3 * stamp))
    # The second is the slowest: its times, which lie 4 ms after and 6 ms before one of the first.
    assert rows(aligner, 150) == [
        (104, [104, 208, 312]),
        (124, [124, 248, 372]),
        (144, [144, 288, 432]),
    ]
    # To the first 4 ms three times, to the third (…101, 106, …) 2 ms three times.
    mean, largest = aligner.skew()
    assert mean == pytest.approx(3e-3)
    assert largest == pytest.approx(4e-3)
    assert aligner.skew() == (0.0, 0.0)


def test_interpolation_weights_the_neighbours_by_time() -> None:
    aligner = Aligner([((0,), 0.02), ((1,), 0.01)])
    aligner.add(0, sample(13, 7))
    aligner.add(1, sample(10, 100))
    aligner.add(1, sample(20, 200))
    # 3/10 of the way from 100 to 200.
    assert rows(aligner, 20) == [(13, [7, 130])]


def test_nothing_is_extrapolated() -> None:
    aligner = Aligner([((0,), 0.02), ((1,), 0.01)])
    aligner.add(1, sample(12, 1))
    aligner.add(0, sample(10, 7))
    aligner.add(0, sample(30, 8))
    # At 10 ms the other has no reading before, at 30 ms it may still get one after.
    (row,) = aligner.take(31 * MS)
    assert row.stamp == 10 * MS
    assert row.status == [VALID, NONE]
    assert math.isnan(row.values[1])
    assert aligner.take(31 * MS) == []
    aligner.add(1, sample(32, 3))
    assert rows(aligner, 32) == [(30, [8, 2.8])]


def test_a_gap_is_not_bridged() -> None:
    aligner = Aligner([((0,), 0.02), ((1,), 0.01)])
    gap = GAP_PERIODS * 10
    aligner.add(1, sample(0.5, 0))
    aligner.add(0, sample(20, 1))
    aligner.add(1, sample(0.5 + gap, 1))
    aligner.add(0, sample(60, 2))
    aligner.add(1, sample(1 + 2 * gap, 3))
    first, second = aligner.take(200 * MS)
    assert first.status == [VALID, VALID]
    assert second.status == [VALID, NONE]


def test_a_stalled_stream_is_waited_for_no_longer_than_its_gap() -> None:
    aligner = Aligner([((0,), 0.02), ((1,), 0.01)])
    aligner.add(1, sample(9, 0))
    aligner.add(0, sample(10, 1))
    assert aligner.take(59 * MS) == []
    (row,) = aligner.take(61 * MS)
    assert row.status == [VALID, NONE]


def test_the_worse_status_of_two_neighbours_counts() -> None:
    aligner = Aligner([((0,), 0.02), ((1,), 0.01)])
    for before, after, expected in [
        (VALID, OVER, OVER), (ERROR, VALID, ERROR), (NONE, OVER, NONE), (VALID, VALID, VALID),
    ]:
        aligner = Aligner([((0,), 0.02), ((1,), 0.01)])
        aligner.add(1, sample(10, 1, status=before))
        aligner.add(1, sample(20, 2, status=after))
        aligner.add(0, sample(15, 7))
        (row,) = aligner.take(20 * MS)
        assert row.status == [VALID, expected]
        assert math.isnan(row.values[1]) == (expected is not VALID)


def test_a_reading_at_the_very_time_stands_alone() -> None:
    aligner = Aligner([((0,), 0.02), ((1,), 0.01)])
    aligner.add(1, sample(10, 1))
    aligner.add(1, sample(20, 2))
    aligner.add(1, sample(30, 3, status=ERROR))
    aligner.add(0, sample(20, 7))
    assert rows(aligner, 30) == [(20, [7, 2])]


def test_when_the_slowest_is_lost_another_one_leads() -> None:
    aligner = Aligner([((0,), 0.02), ((1,), 0.01), ((2,), 0.01)])
    for stamp in range(0, 100, 10):
        aligner.add(1, sample(stamp, stamp))
        aligner.add(2, sample(stamp + 5, -stamp - 5))
    aligner.add(0, sample(8, 7))
    assert rows(aligner, 20) == [(8, [7, 8, -8])]
    aligner.lose(0)
    found = aligner.take(100 * MS)
    assert [row.stamp / MS for row in found] == [10, 20, 30, 40, 50, 60, 70, 80, 90]
    assert all(row.status == [NONE, VALID, VALID] for row in found)
    assert [row.sequence for row in found] == list(range(1, 10))
    # Back again: it leads, and time goes on.
    aligner.add(0, sample(95, 7))
    aligner.add(1, sample(100, 100))
    aligner.add(2, sample(105, -105))
    assert rows(aligner, 105) == [(95, [7, 95, -95])]


def test_all_lost_gives_nothing() -> None:
    aligner = Aligner([((0,), 0.02)])
    assert aligner.take(10 * MS) == []
    aligner.add(0, sample(1, 1))
    aligner.lose(0)
    assert aligner.take(10 * MS) == []


def test_time_never_goes_back() -> None:
    aligner = Aligner([((0,), 0.01)])
    for stamp in (10, 20, 15, 20, 30):
        aligner.add(0, sample(stamp, stamp))
    assert [stamp for stamp, _ in rows(aligner, 30)] == [10, 20, 30]


def test_a_reader_that_sleeps_loses_readings_and_sees_it() -> None:
    aligner = Aligner([((0,), 0.001)])
    for index in range(LONGEST + 100):
        aligner.add(0, sample(1 + index, index))
    found = aligner.take(10**12)
    assert len(found) == LONGEST
    assert (found[0].sequence, found[0].stamp) == (100, 101 * MS)
    assert found[-1].sequence == LONGEST + 99
