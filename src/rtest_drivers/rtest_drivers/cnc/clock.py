"""A device's clock brought to this host's."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence

# Samples of one device may come out of order by less.
_BACK_NS = 200_000_000
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
    """

    def __init__(self) -> None:
        # (arrival, difference) with both rising: the first is the smallest of the window.
        self._least: deque[tuple[int, int]] = deque()
        self._latest = self._arrival = 0
        self._set_back: int | None = None

    @property
    def offset(self) -> int | None:
        """Host minus device [ns]; None where nothing came yet."""
        return self._least[0][1] if self._least else None

    def problem(self) -> str:
        """Whether the clock was set back in the last seconds, in one line; '' where it was not."""
        if self._set_back is None or self._arrival - self._set_back > _TOLD_NS:
            return ''
        return "the controller's clock was set back; what came just then may be off by as much"

    def to_host(self, sources: Sequence[int], arrival: int) -> list[int]:
        """Stamps of the device that came together, in this host's time [ns].

        arrival : when they came, in this host's time [ns]
        """
        for source in sorted(sources):
            self._add(source, arrival)
        return [source + self._least[0][1] for source in sources]

    def _add(self, source: int, arrival: int) -> None:
        if self._least and source < self._latest - _BACK_NS:
            # A clock set back; one that is set forward is a smaller difference anyway.
            self._least.clear()
            self._set_back = arrival
        self._latest = max(source, self._latest) if self._least else source
        self._arrival, difference = arrival, arrival - source
        while self._least and self._least[-1][1] >= difference:
            self._least.pop()
        self._least.append((arrival, difference))
        while self._least[0][0] < arrival - _WINDOW_NS:
            self._least.popleft()
