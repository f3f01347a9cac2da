"""Rate of readings, in the time of their stamps."""

from __future__ import annotations


class Rate:
    """Counts readings between two looks."""

    def __init__(self) -> None:
        self._first: int | None = None
        self._last = self._count = self._open = 0

    def add(self, stamp: int, readings: int) -> None:
        """`readings` more, the first at `stamp` [ns]."""
        if self._first is None:
            self._first = stamp
        # What lies between two stamps are the readings of the earlier block.
        self._count += self._open
        self._open, self._last = readings, stamp

    def take(self) -> str:
        """Readings per second since the last call, as text; '' where that is not known."""
        span = 0.0 if self._first is None else (self._last - self._first) * 1e-9
        text = f'{self._count / span:.1f}' if span > 0.0 else ''
        if self._first is not None:
            self._first, self._count = self._last, 0
        return text
