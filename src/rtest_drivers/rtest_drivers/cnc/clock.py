"""A device's clock brought to this host's."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence

# Samples of one device may come out of order by less.
_BACK_NS = 200_000_000
# A clock that is set by less is not told from messages that are held up.
_STEP_NS = 100_000_000
# Messages of which one at least is not held up, as one of a block of time with as many.
_MANY, _BLOCK_NS = 10, 2_000_000_000
# Over which the shortest way from the device to here is looked for: long enough to meet a message
# that was not held up, short enough for two clocks that drift apart by 50 us/s.
_WINDOW_NS = 20_000_000_000
# How long what happened once is told.
_TOLD_NS = 5_000_000_000


class Recent:
    """The largest of what was seen in the last one to two seconds."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._before = self._now = 0

    def add(self, value: int) -> None:
        """One more."""
        self._turn()
        self._now = max(self._now, value)

    @property
    def largest(self) -> int:
        """The largest; 0 where there was nothing."""
        self._turn()
        return max(self._before, self._now)

    def _turn(self) -> None:
        age = time.monotonic() - self._began
        if age > 1.0:
            self._before, self._now = (self._now if age < 2.0 else 0), 0
            self._began += age


class DeviceClock:
    """Brings a device's time stamps to this host's clock.

    Arrival minus source is the difference of the clocks plus the time under way, which is never
    negative: its smallest value in a window of time is the best estimate of the difference. Stamps
    are late by the shortest time under way, which cannot be seen from here.

    A clock that is set forward makes the difference smaller at once. One that is set back makes it
    larger, as messages that are held up do: by `_BACK_NS` or more it is known at once, by
    `_STEP_NS` or more when every message of a block of time is as late.
    """

    def __init__(self) -> None:
        # (arrival, difference) with both rising: the first is the smallest of the window.
        self._least: deque[tuple[int, int]] = deque()
        self._latest = self._arrival = 0
        # When the clock was set, and how.
        self._set: tuple[int, str] | None = None
        self._messages = 0
        # Of the block of time: its beginning, the difference of every message.
        self._began, self._block = 0, list[int]()

    @property
    def offset(self) -> int | None:
        """Host minus device [ns]; None where nothing came yet."""
        return self._least[0][1] if self._least else None

    def problem(self) -> str:
        """Whether the clock was set in the last seconds, in one line; '' where it was not."""
        if self._set is None or self._arrival - self._set[0] > _TOLD_NS:
            return ''
        return (
            f"the controller's clock was set {self._set[1]}, or its network is as slow; what came "
            'in the seconds before may be off by as much'
        )

    def to_host(self, sources: Sequence[int], arrival: int) -> list[int]:
        """Stamps of the device that came together, in this host's time [ns].

        arrival : when they came, in this host's time [ns]
        """
        for source in sorted(sources):
            self._add(source, arrival)
        self._look_back(arrival - max(sources), arrival)
        return [source + self._least[0][1] for source in sources]

    def _add(self, source: int, arrival: int) -> None:
        difference = arrival - source
        step = difference - self._least[0][1] if self._least else 0
        if self._least and source < self._latest - _BACK_NS:
            self._begin_anew('back', step, arrival)
        elif self._messages >= _MANY and step < -_STEP_NS:
            self._begin_anew('forward', -step, arrival)
        self._latest = max(source, self._latest) if self._least else source
        self._arrival = arrival
        while self._least and self._least[-1][1] >= difference:
            self._least.pop()
        self._least.append((arrival, difference))
        while self._least[0][0] < arrival - _WINDOW_NS:
            self._least.popleft()

    def _look_back(self, difference: int, arrival: int) -> None:
        """Whether every message of the last block is late; `difference` is that of a new one."""
        self._messages += 1
        self._block.append(difference)
        if arrival - self._began < _BLOCK_NS:
            return
        least = min(self._block)
        if len(self._block) >= _MANY and (step := least - self._least[0][1]) > _STEP_NS:
            self._begin_anew('back', step, arrival)
            self._least.append((arrival, least))
        self._began, self._block = arrival, []

    def _begin_anew(self, way: str, step: int, arrival: int) -> None:
        """After the clock was set by `step` [ns]."""
        self._set = arrival, f'{way} by {step * 1e-9:.2f} s'
        self._least.clear()
        self._messages = 0
        self._began, self._block = arrival, []
