"""When a cycle has begun, seen from the encoder feedback alone."""

from __future__ import annotations

from bisect import bisect_left

import numpy as np

from rtest_estimation.buffers import FeedbackBuffer
from rtest_estimation.dwell import ROTARY_LETTERS, DwellRules
from rtest_estimation.records import CyclePlan, Feedback


class CycleStart:
    """Finds when the axes first come to a pose of the plan.

    A person may start the machine long after the plan is known; until then nothing has to be kept.
    """

    def __init__(self, rules: DwellRules) -> None:
        self._near = {turns: rules.near[turns] for turns in (False, True)}
        self.reset()

    def reset(self) -> None:
        """Begin anew, for another cycle."""
        self._seen = 0
        self._found: int | None = None

    def find(self, plan: CyclePlan, feedback: FeedbackBuffer) -> int | None:
        """Stamp of the first sample at any pose [ns], None before. Looks at new samples only."""
        if self._found is None:
            first = bisect_left(feedback.stamps, max(self._seen + 1, plan.stamp))
            for sample in feedback.samples[first:]:
                self._seen = sample.stamp
                if self._at_a_pose(plan, sample):
                    self._found = sample.stamp
                    break
        return self._found

    def _at_a_pose(self, plan: CyclePlan, sample: Feedback) -> bool:
        """Axes that the feedback does not have are taken to be there."""
        known = [(k, sample.axes.index(a)) for k, a in enumerate(plan.axes) if a in sample.axes]
        columns = [column for column, _ in known]
        near = [self._near[plan.axes[column] in ROTARY_LETTERS] for column in columns]
        off = np.abs(plan.commands[:, columns] - sample.position[[of for _, of in known]])
        return bool((off <= near).all(axis=1).any())
