"""Readings of several controllers brought to common times."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

from rtest_estimation.records import Status

# Two readings further apart than this many periods do not tell what was between them.
GAP_PERIODS = 5
# Readings of a stream that may wait for the others.
LONGEST = 2048


@dataclass(frozen=True)
class Sample:
    """What one question gave.

    stamp : [ns]; values : of each gauge asked [m], NaN unless valid
    uncertainty : the reading was taken within this time of the stamp [s]
    """

    stamp: int
    values: tuple[float, ...]
    status: tuple[Status, ...]
    uncertainty: float = 0.0


@dataclass(frozen=True)
class Row:
    """Readings of the whole nest at one time; `sequence` counts what was read, kept or not."""

    stamp: int
    sequence: int
    values: list[float]
    status: list[Status]


class _Stream:
    def __init__(self, channels: tuple[int, ...], period: float) -> None:
        self.channels, self.gap = channels, round(GAP_PERIODS * period * 1e9)
        self.period = period
        self.samples: deque[Sample] = deque(maxlen=LONGEST)
        self.alive = False

    def neighbours(self, stamp: int) -> tuple[Sample | None, Sample | None]:
        """Last sample not after `stamp` and first one not before it; drops what is older."""
        after = self.after(stamp)
        before = self.samples[0] if self.samples and self.samples[0] is not after else None
        return before, before if before is not None and before.stamp == stamp else after

    def after(self, stamp: int) -> Sample | None:
        """First sample later than `stamp`; drops all before it but one."""
        samples = self.samples
        while len(samples) > 1 and samples[1].stamp <= stamp:
            samples.popleft()
        return next((one for one in islice(samples, 2) if one.stamp > stamp), None)


class Aligner:
    """Interpolates linearly onto the times of the slowest stream that answers.

    A stream are the readings of one question: all gauges of a controller that reads them at once.
    The readings of the slowest stream stay as they are. Of the others the two neighbours in time
    count; there is no reading (NO_SIGNAL) where one is missing or they are more than GAP_PERIODS
    of the stream's periods apart, and the worse status where one is not valid. Nothing is
    extrapolated. With one stream nothing is interpolated.

    streams : channels from 0 and period [s] of each
    """

    def __init__(self, streams: Sequence[tuple[tuple[int, ...], float]]) -> None:
        self._streams = [_Stream(*stream) for stream in streams]
        self._width = sum(len(stream.channels) for stream in self._streams)
        self._last = self._sequence = 0
        self._skews: list[float] = [0.0, 0.0, 0.0]

    def add(self, index: int, sample: Sample) -> None:
        """A sample of a stream; one that is not later than its last one is ignored."""
        stream = self._streams[index]
        if stream.samples and sample.stamp <= stream.samples[-1].stamp:
            return
        if len(stream.samples) == LONGEST and stream is self._reference():
            self._sequence += 1
        stream.samples.append(sample)
        stream.alive = True

    def lose(self, index: int) -> None:
        """Nothing is to be waited for from a stream until its next sample."""
        self._streams[index].alive = False

    def take(self, now: int) -> list[Row]:
        """Every row that is complete at the time `now` [ns]."""
        rows = []
        while (reference := self._reference()) is not None:
            sample = reference.after(self._last)
            others = [stream for stream in self._streams if stream is not reference]
            if sample is None or any(_awaited(other, sample.stamp, now) for other in others):
                break
            rows.append(self._row(reference, sample, others))
            self._last = sample.stamp
        return rows

    def skew(self) -> tuple[float, float]:
        """Mean and largest distance of a reading in time from its row since the last call [s]."""
        total, count, largest = self._skews
        self._skews = [0.0, 0.0, 0.0]
        return (total / count if count else 0.0), largest

    def _reference(self) -> _Stream | None:
        alive = [stream for stream in self._streams if stream.alive]
        return max(alive, key=lambda stream: stream.period, default=None)

    def _row(self, reference: _Stream, sample: Sample, others: list[_Stream]) -> Row:
        values, status = [math.nan] * self._width, [Status.NO_SIGNAL] * self._width
        stamp = sample.stamp
        _put(reference, sample.values, sample.status, values, status)
        for stream in others:
            before, after = stream.neighbours(stamp)
            if before is None or after is None or after.stamp - before.stamp > stream.gap:
                continue
            _put(stream, *_between(before, after, stamp), values, status)
            skew = min(stamp - before.stamp, after.stamp - stamp) * 1e-9
            self._skews[0] += skew
            self._skews[1] += 1.0
            self._skews[2] = max(self._skews[2], skew)
        self._sequence += 1
        return Row(stamp, self._sequence - 1, values, status)


def _awaited(stream: _Stream, stamp: int, now: int) -> bool:
    """Whether a sample may still come that is needed at `stamp`."""
    if not stream.alive or now - stamp > stream.gap:
        return False
    return stream.samples[-1].stamp < stamp if stream.samples else True


def _between(before: Sample, after: Sample, stamp: int) -> tuple[list[float], list[Status]]:
    span = after.stamp - before.stamp
    part = (stamp - before.stamp) / span if span else 0.0
    status = [max(pair) for pair in zip(before.status, after.status, strict=True)]
    values = [
        a + part * (b - a) if state is Status.VALID else math.nan
        for a, b, state in zip(before.values, after.values, status, strict=True)
    ]
    return values, status


def _put(
    stream: _Stream,
    some: Sequence[float],
    states: Sequence[Status],
    values: list[float],
    status: list[Status],
) -> None:
    for channel, value, state in zip(stream.channels, some, states, strict=True):
        values[channel], status[channel] = value, state
