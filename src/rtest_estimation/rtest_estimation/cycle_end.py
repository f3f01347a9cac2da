"""When a cycle is over, seen from the encoder feedback alone."""

from __future__ import annotations

import numpy as np

from rtest_estimation.buffers import FeedbackBuffer
from rtest_estimation.dwell import ROTARY_LETTERS, DwellRules, find_dwells, trailing
from rtest_estimation.records import CyclePlan, Kind

# Arrival is seen before the axes stand still; this covers the difference [s].
ARRIVAL = 0.5


class CycleEnd:
    """Finds when a cycle is over: its last pose was stood at for the dwell, or the next began.

    The machine may stay at the last pose or go away after the dwell. Of a dynamic cycle the last
    pose counts that comes after all others.
    """

    def __init__(self, rules: DwellRules) -> None:
        self.rules = rules
        self.reset()

    def reset(self) -> None:
        """Begin anew, for another cycle."""
        self._seen = 0
        self._since: int | None = None
        self._tried: int | None = None
        self._end: int | None = None

    def find(
        self, plan: CyclePlan, feedback: FeedbackBuffer, begin: int, limit: int | None
    ) -> int | None:
        """End of the cycle [ns], or None while it is going on. Looks at new samples only.

        begin : from when feedback counts; limit : when the next cycle begins [ns]
        """
        if self._end is not None:
            return self._end
        stamps, positions = feedback.since(max(self._seen + 1, plan.stamp), plan.axes)
        near = np.array([self.rules.near[axis in ROTARY_LETTERS] for axis in plan.axes])
        # What the feedback does not have is taken to be there.
        absent = np.array([not feedback.has(axis) for axis in plan.axes])
        there_at = ((np.abs(positions - plan.commands[-1]) <= near) | absent).all(axis=1)
        for stamp, there in zip(stamps.tolist(), there_at.tolist(), strict=True):
            if limit is not None and stamp >= limit:
                return limit
            self._seen = stamp
            if self._since is None:
                self._since = stamp if there else None
                continue
            dwell = trailing(plan) * plan.dwell
            stood = (dwell + ARRIVAL if there else 0.5 * dwell) * 1e9
            since, self._since = self._since, self._since if there else None
            if stamp - since < stood or self._tried == since:
                continue
            self._tried = since
            end = since + int(stood) if there else stamp
            if self._done(plan, *feedback.window(plan, begin, end)):
                self._end = end
                return end
        return None

    def _done(self, plan: CyclePlan, stamps: np.ndarray, positions: np.ndarray) -> bool:
        """Whether the last pose was reached, and not as the first of all."""
        if plan.kind is Kind.DYNAMIC:
            return len(arrivals(plan, positions, self.rules)) == len(plan.commands)
        dwells, missing = find_dwells(plan, stamps, positions, self.rules)
        reached = {d.index for d in dwells}
        return len(plan.commands) - 1 in reached and (len(reached) > 1 or not missing)


def arrivals(plan: CyclePlan, positions: np.ndarray, rules: DwellRules) -> list[int]:
    """Rows of `positions` at which the axes first came to the poses of a plan, in its order.

    Ends before the first pose that they did not come to.

    positions : (n, axes) in the order of ``plan.axes``; NaN where the feedback has no such axis
    """
    near = np.array([rules.near[axis in ROTARY_LETTERS] for axis in plan.axes])
    found: list[int] = []
    for row in plan.commands:
        first = found[-1] if found else 0
        off = np.abs(positions[first:] - row)
        there = ((off <= near) | np.isnan(off)).all(axis=1)
        if not there.any():
            break
        found.append(first + int(np.argmax(there)))
    return found
