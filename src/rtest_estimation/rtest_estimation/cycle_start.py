"""When a cycle has begun, seen from the encoder feedback alone."""

from __future__ import annotations

import numpy as np

from rtest_estimation.buffers import FeedbackBuffer
from rtest_estimation.dwell import ROTARY_LETTERS, DwellRules
from rtest_estimation.records import CyclePlan


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
            stamps, positions = feedback.since(max(self._seen + 1, plan.stamp), plan.axes)
            known = [column for column, axis in enumerate(plan.axes) if feedback.has(axis)]
            near = [self._near[plan.axes[column] in ROTARY_LETTERS] for column in known]
            # Axes that the feedback does not have are taken to be there.
            commands = plan.commands[:, known]
            for stamp, position in zip(stamps.tolist(), positions[:, known], strict=True):
                self._seen = stamp
                if (np.abs(commands - position) <= near).all(axis=1).any():
                    self._found = stamp
                    break
        return self._found
