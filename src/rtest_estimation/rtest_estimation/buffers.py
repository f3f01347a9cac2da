"""Data of the running cycle, kept until it is finished."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rtest_estimation.records import CyclePlan, GaugeBlock

# Blocks of readings are put together when there are so many: a window of an hour of small ones
# would take longer than the readings may be late.
_BLOCKS = 256


class FeedbackBuffer:
    """Encoder feedback in order of acquisition; grows at the end, is forgotten at the start."""

    def __init__(self) -> None:
        self._axes: tuple[str, ...] = ()
        self._stamps = np.empty(0, dtype=np.int64)
        self._positions = np.empty((0, 0))
        self._low = self._high = 0

    def __len__(self) -> int:
        return self._high - self._low

    @property
    def first(self) -> int:
        """Oldest stamp kept [ns]; 0 when empty."""
        return int(self._stamps[self._low]) if len(self) else 0

    @property
    def last(self) -> int:
        """Newest stamp [ns]; 0 when empty."""
        return int(self._stamps[self._high - 1]) if len(self) else 0

    def extend(self, axes: tuple[str, ...], stamps: np.ndarray, positions: np.ndarray) -> int:
        """Add samples (n,) and (n, axes); returns how many were not newer than the one before."""
        newest = np.maximum.accumulate(np.append(self.last, stamps))
        newer = stamps > newest[:-1] if len(self) else np.append(True, stamps[1:] > newest[1:-1])
        if not newer.all():
            stamps, positions = stamps[newer], positions[newer]
        if axes != self._axes:
            positions = self._in_known_axes(axes, positions)
        self._reserve(len(stamps))
        rows = slice(self._high, self._high + len(stamps))
        self._stamps[rows], self._positions[rows] = stamps, positions
        self._high = rows.stop
        return len(newer) - len(stamps)

    def since(self, stamp: int, axes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Stamps and positions from `stamp` [ns] on; NaN where the feedback has no such axis."""
        low = self._low + int(np.searchsorted(self._stamps[self._low : self._high], stamp))
        return self._stamps[low : self._high], self._in(axes, slice(low, self._high))

    def window(self, plan: CyclePlan, start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        """Stamps and positions in the plan's axes; NaN for an axis the feedback does not have."""
        low, high = self._low + np.searchsorted(
            self._stamps[self._low : self._high], [start, end + 1]
        )
        positions = self._in(plan.axes, slice(low, high))
        finite = np.isfinite(positions)
        # A column that is never there is reported as a whole; single bad samples are left out.
        good = finite[:, finite.any(axis=0)].all(axis=1)
        return self._stamps[low:high][good], positions[good]

    def has(self, axis: str) -> bool:
        """Whether any sample so far had this axis."""
        return axis in self._axes

    def forget(self, before: int) -> None:
        """Drop what is older than `before` [ns]."""
        self._low += int(np.searchsorted(self._stamps[self._low : self._high], before))

    def _in(self, axes: tuple[str, ...], rows: slice) -> np.ndarray:
        """Rows in these axes."""
        if axes == self._axes:
            return self._positions[rows]
        known = [(to, self._axes.index(a)) for to, a in enumerate(axes) if a in self._axes]
        found = np.full((rows.stop - rows.start, len(axes)), np.nan)
        found[:, [to for to, _ in known]] = self._positions[rows][:, [of for _, of in known]]
        return found

    def _in_known_axes(self, axes: tuple[str, ...], positions: np.ndarray) -> np.ndarray:
        """Positions in the axes of all samples, to which new ones are added."""
        new = tuple(dict.fromkeys(axis for axis in axes if axis not in self._axes))
        if new:
            empty = np.full((len(self._positions), len(new)), np.nan)
            self._positions = np.concatenate([self._positions, empty], axis=1)
            self._axes += new
        found = np.full((len(positions), len(self._axes)), np.nan)
        for column, axis in enumerate(self._axes):
            if axis in axes:
                found[:, column] = positions[:, axes.index(axis)]
        return found

    def _reserve(self, count: int) -> None:
        """Make room for more rows, for twice as many as there are where it is used up."""
        if self._high + count <= len(self._stamps):
            return
        kept = slice(self._low, self._high)
        size = 2 * (len(self) + count)
        stamps = np.empty(size, dtype=np.int64)
        positions = np.empty((size, len(self._axes)))
        stamps[: len(self)], positions[: len(self)] = self._stamps[kept], self._positions[kept]
        self._low, self._high = 0, len(self)
        self._stamps, self._positions = stamps, positions


class _Readings(NamedTuple):
    """Readings of equal channels, in any order; first and last of their stamps [ns]."""

    first: int
    last: int
    times: np.ndarray
    displacement: np.ndarray
    status: np.ndarray


class GaugeBuffer:
    """Gauge readings in order of acquisition."""

    def __init__(self) -> None:
        # Many small blocks at the end, few large ones before.
        self.blocks: list[_Readings] = []
        self._small = 0
        self.last = 0

    @property
    def first(self) -> int:
        """Oldest stamp kept [ns]; 0 when empty."""
        return self.blocks[0].first if self.blocks else 0

    def append(self, block: GaugeBlock) -> None:
        """Add one message's readings."""
        times = block.stamps
        first, last = int(times[0]), int(times[-1])
        self.blocks.append(_Readings(first, last, times, block.displacement, block.status))
        self.last = max(self.last, last)
        self._small += 1
        if self._small >= _BLOCKS:
            self.blocks[-self._small :] = _together(self.blocks[-self._small :])
            self._small = 0

    def window(self, start: int, end: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stamps (n,), displacement and status (n, channels) of the readings in [start, end]."""
        blocks = [b for b in self.blocks if b.first <= end and b.last >= start]
        if not blocks:
            return np.empty(0, dtype=np.int64), np.empty((0, 0)), np.empty((0, 0), dtype=np.uint8)
        channels = blocks[-1].displacement.shape[1]
        blocks = [b for b in blocks if b.displacement.shape[1] == channels]
        times = np.concatenate([b.times for b in blocks])
        order = np.argsort(times, kind='stable')
        order = order[(times[order] >= start) & (times[order] <= end)]
        displacement = np.concatenate([b.displacement for b in blocks])[order]
        return times[order], displacement, np.concatenate([b.status for b in blocks])[order]

    def forget(self, before: int) -> None:
        """Drop what is older than `before` [ns]."""
        small = self.blocks[len(self.blocks) - self._small :]
        self._small = sum(b.last >= before for b in small)
        self.blocks = [b for b in self.blocks if b.last >= before]


def _together(blocks: list[_Readings]) -> list[_Readings]:
    """The same readings in one block for each run of equal channels."""
    runs: list[list[_Readings]] = []
    for block in blocks:
        if runs and runs[-1][-1].displacement.shape[1] == block.displacement.shape[1]:
            runs[-1].append(block)
        else:
            runs.append([block])
    return [
        _Readings(
            min(b.first for b in run), max(b.last for b in run),
            np.concatenate([b.times for b in run]),
            np.concatenate([b.displacement for b in run]),
            np.concatenate([b.status for b in run]),
        )
        for run in runs
    ]
