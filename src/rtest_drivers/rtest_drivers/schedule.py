"""How long a cycle may take, and how its outcome is told."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from rtest_estimation.dwell import ROTARY_LETTERS
from rtest_estimation.missing import grouped
from rtest_estimation.records import CyclePlan, Kind, Missing, NestKind

NANOSECONDS = 1_000_000_000

# Slower than a machine positions [m/s], [rad/s]: 3 m/min, 10 deg/s.
SLOW_LINEAR = 0.05
SLOW_ROTARY = math.radians(10.0)
# Settling, block change and waiting for the estimator, per pose and per cycle [s].
POSE_MARGIN_S = 2.0
CYCLE_MARGIN_S = 60.0
# A cycle counts as stopped when no pose was gained for this many of its longest moves, and for
# this time [s].
STOPPED_MOVES = 3
STOPPED_S = 10.0
# Before the first pose somebody may still be at the machine [s].
FIRST_S = 60.0
# The poses are told once a second of wall time, on a busy computer later: what was not heard of
# for less is no sign [s].
HEARD_S = 6.0
# A repeated cycle that begins so much before or after its time is in time [s].
IN_TIME_S = 5.0


def turn(due: int, now: int) -> tuple[str, bool]:
    """How a repeated cycle that is to begin at `due` [ns] is told, '' where that is now.

    Beside it whether it is late.
    """
    ahead = (due - now) / NANOSECONDS
    if abs(ahead) <= IN_TIME_S:
        return '', False
    if ahead > 0.0:
        return f'in {ahead / 60.0:.1f} min', False
    return f'{-ahead / 60.0:.1f} min late: the cycle before it had not finished', True


def path_duration(plan: CyclePlan) -> float:
    """Longest time a cycle can reasonably take [s], its axes moving one after the other."""
    steps = _step_durations(plan)
    # The way to the first pose: as long as the longest step, or half a turn.
    approach = max(float(steps.max(initial=0.0)), math.pi / SLOW_ROTARY)
    poses = len(plan.commands) * (plan.dwell + POSE_MARGIN_S)
    return float(steps.sum()) + approach + poses + CYCLE_MARGIN_S


def pose_patience(plan: CyclePlan) -> float:
    """Time without another pose after which a cycle that has begun is taken for stopped [s]."""
    longest = float(_step_durations(plan).max(initial=0.0))
    return max(STOPPED_S, STOPPED_MOVES * (longest + plan.dwell))


def _step_durations(plan: CyclePlan) -> np.ndarray:
    """(poses - 1,) longest time from each pose to the next, one axis after the other [s]."""
    slow = np.array([SLOW_ROTARY if axis in ROTARY_LETTERS else SLOW_LINEAR for axis in plan.axes])
    if plan.feed > 0.0:
        slow = np.minimum(slow, plan.feed)
    return (np.abs(np.diff(plan.commands, axis=0)) / slow).sum(axis=1)


def pose_count(poses: int, points: int, missing: int) -> str:
    """For example ``82 of 84 poses, 2 missing``."""
    text = f'{points} of {poses} poses'
    return f'{text}, {missing} missing' if missing else text


def outcome(plan: CyclePlan, points: int, missing: int, reasons: Mapping[str, str]) -> str:
    """For example ``82 of 84 poses, 2 missing (3, 7: no gauge readings)``.

    points, missing : numbers of poses
    reasons : why poses are missing, under ``pose 3`` and so on; among other values
    """
    if plan.kind is Kind.DYNAMIC and not missing:
        return 'recorded'
    text = pose_count(len(plan.commands), points, missing)
    if missing:
        poses = [
            Missing(int(pose.removeprefix('pose ')), reason)
            for pose, reason in reasons.items()
            if pose.startswith('pose ')
        ]
        # Every reason is told with the result of the session.
        first, *more = grouped(poses) or ['']
        text += f' ({first}{"; ..." if more else ""})' if first else ''
    return text


def calibration_outcome(residual: float, kind: int) -> str:
    """For example ``residual 0.12 µm``. residual : of the nest [m]; kind : a NestKind."""
    text = f'residual {residual * 1e6:.2f} µm'
    return f'{text} before the correction' if kind == NestKind.LASER else text


class Progress:
    """Watches one cycle: whether the clock goes on, and whether poses are gained.

    stamp : start of the cycle [ns]; wall : the same on the wall clock [s]
    limit : longest time the cycle may take [s]; 0 is an estimate from its path
    attended : somebody starts the machine when all is ready, so that times count from the first
        pose on
    """

    def __init__(
        self,
        plan: CyclePlan,
        stamp: int,
        wall: float,
        limit: float = 0.0,
        attended: bool = False,
    ) -> None:
        self._poses = len(plan.commands)
        self._attended = attended
        self._stamp = stamp
        self._limit = limit or path_duration(plan)
        self._patience = pose_patience(plan)
        self._done = 0
        self._gained = self._clock = (stamp, wall)

    def clock_stands(self, now: int, wall: float) -> float:
        """How long the time `now` [ns] has been the same, on the wall clock [s]."""
        if now != self._clock[0]:
            self._clock = (now, wall)
        return wall - self._clock[1]

    def stopped(self, now: int, wall: float, done: int, feedback_age: float | None) -> str:
        """Why the cycle has stopped, '' while it goes on.

        Parameters
        ----------
        now, wall : time of the session [ns] and of the wall clock [s]
        done : poses that were reached by now
        feedback_age : of the newest encoder feedback [s]; infinite where there is none, None where
            nothing was heard of it
        """
        if done > self._done:
            self._done, self._gained = done, (now, wall)
        if self._attended and not self._done:
            self._stamp, self._gained = now, (now, wall)
            return ''
        poses = f'{self._done} of {self._poses} poses'
        waited = (now - self._gained[0]) / NANOSECONDS
        patience = self._patience if self._done else max(self._patience, FIRST_S)
        stale = feedback_age is not None and feedback_age > patience
        begun = 0 < self._done < self._poses
        if waited > patience and wall - self._gained[1] > HEARD_S and (stale or begun):
            what = 'encoder feedback' if stale else 'other pose'
            return f'{poses}, no {what} for {min(feedback_age, waited) if stale else waited:.0f} s'
        if (now - self._stamp) / NANOSECONDS > self._limit:
            return f'{poses}, not finished after {self._limit:.0f} s'
        return ''
