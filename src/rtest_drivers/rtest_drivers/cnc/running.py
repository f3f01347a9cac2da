"""Whether an NC program runs, by what the CNC driver says of itself."""

from __future__ import annotations

import math
from collections.abc import Mapping

# What the CNC driver says where no NC program runs.
IDLE = 'IDLE'
# An NC program that has ended for so long has left its cycle: the estimator would have finished
# it by now [s].
ENDED_S = 5.0


class NcProgram:
    """The state of the NC program, and since when it has not run.

    reports : number of reports of the driver so far
    """

    def __init__(self) -> None:
        self.reports = 0
        self._state: str | None = None
        self._is_told, self._ran, self._ended = False, False, math.nan

    def note(self, values: Mapping[str, str], wall: float) -> None:
        """One report. values : of the driver's status; wall : now, on the wall clock [s]."""
        self.reports += 1
        state = values.get('program') or None
        self._is_told |= state is not None
        if state is None and values.get('estop') == 'on':
            state = IDLE
        if state is not None and state != IDLE:
            self._ran, self._ended = True, math.nan
        elif self._state != state:
            self._ended = wall if state == IDLE else math.nan
        self._state = state

    def begin_cycle(self) -> None:
        """What ran before is the program of another cycle."""
        self._ran = False

    @property
    def stands(self) -> bool:
        """Whether none runs, as far as the controller says so."""
        return self._state in (None, IDLE)

    def has_left(self, wall: float, poses: int) -> bool:
        """Whether the program of the cycle has ended, at `wall` [s] on the wall clock.

        poses : that were reached so far; where the controller tells of no program, they do
        """
        ran = self._ran if self._is_told else poses > 0
        return ran and wall - self._ended > ENDED_S
