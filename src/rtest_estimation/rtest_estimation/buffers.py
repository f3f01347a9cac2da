"""Data of the running cycle, kept until it is finished."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from rtest_estimation.records import CyclePlan, Feedback, GaugeBlock


class FeedbackBuffer:
    """Encoder feedback in order of acquisition."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.samples: list[Feedback] = []

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def first(self) -> int:
        """Oldest stamp kept [ns]; 0 when empty."""
        return self.stamps[0] if self.stamps else 0

    @property
    def last(self) -> int:
        """Newest stamp [ns]; 0 when empty."""
        return self.stamps[-1] if self.stamps else 0

    def append(self, sample: Feedback) -> bool:
        """Add a sample; False where it is not newer than the one before."""
        if self.stamps and sample.stamp <= self.stamps[-1]:
            return False
        self.stamps.append(sample.stamp)
        self.samples.append(sample)
        return True

    def window(self, plan: CyclePlan, start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        """Stamps and positions in the plan's axes; NaN for an axis the feedback does not have."""
        stamps = np.array(self.stamps, dtype=np.int64)
        low, high = np.searchsorted(stamps, [start, end + 1])
        positions = np.full((high - low, len(plan.axes)), np.nan)
        order: dict[tuple[str, ...], tuple[list[int], list[int]]] = {}
        for row, sample in enumerate(self.samples[low:high]):
            if sample.axes not in order:
                pairs = [
                    (column, sample.axes.index(axis))
                    for column, axis in enumerate(plan.axes)
                    if axis in sample.axes
                ]
                order[sample.axes] = ([to for to, _ in pairs], [of for _, of in pairs])
            to, of = order[sample.axes]
            positions[row, to] = sample.position[of]
        finite = np.isfinite(positions)
        # A column that is never there is reported as a whole; single bad samples are left out.
        good = finite[:, finite.any(axis=0)].all(axis=1)
        return stamps[low:high][good], positions[good]

    def forget(self, before: int) -> None:
        """Drop what is older than `before` [ns]."""
        keep = bisect_left(self.stamps, before)
        del self.stamps[:keep], self.samples[:keep]


class GaugeBuffer:
    """Gauge readings in order of acquisition."""

    def __init__(self) -> None:
        self.blocks: list[GaugeBlock] = []
        self.last = 0

    @property
    def first(self) -> int:
        """Oldest stamp kept [ns]; 0 when empty."""
        return self.blocks[0].stamp if self.blocks else 0

    def append(self, block: GaugeBlock) -> None:
        """Add one message's readings."""
        self.blocks.append(block)
        self.last = max(self.last, int(block.stamps[-1]))

    def window(self, start: int, end: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stamps (n,), displacement and status (n, channels) of the readings in [start, end]."""
        blocks = [b for b in self.blocks if b.stamp <= end and b.stamps[-1] >= start]
        if not blocks:
            return np.empty(0, dtype=np.int64), np.empty((0, 0)), np.empty((0, 0), dtype=np.uint8)
        channels = blocks[-1].displacement.shape[1]
        blocks = [b for b in blocks if b.displacement.shape[1] == channels]
        times = np.concatenate([b.stamps for b in blocks])
        order = np.argsort(times, kind='stable')
        order = order[(times[order] >= start) & (times[order] <= end)]
        displacement = np.concatenate([b.displacement for b in blocks])[order]
        return times[order], displacement, np.concatenate([b.status for b in blocks])[order]

    def forget(self, before: int) -> None:
        """Drop what is older than `before` [ns]."""
        self.blocks = [b for b in self.blocks if b.stamps[-1] >= before]
