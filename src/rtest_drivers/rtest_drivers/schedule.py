"""How long a cycle may take, and how its outcome is told."""

from __future__ import annotations

import math

import numpy as np

from rtest_estimation.dwell import ROTARY_LETTERS
from rtest_estimation.records import CyclePlan

NANOSECONDS = 1_000_000_000

# Slower than a machine positions [m/s], [rad/s]: 3 m/min, 10 deg/s.
SLOW_LINEAR = 0.05
SLOW_ROTARY = math.radians(10.0)
# Settling, block change and waiting for the estimator, per pose and per cycle [s].
POSE_MARGIN_S = 2.0
CYCLE_MARGIN_S = 60.0


def path_duration(plan: CyclePlan) -> float:
    """Longest time a cycle can reasonably take [s], its axes moving one after the other."""
    slow = np.array([SLOW_ROTARY if axis in ROTARY_LETTERS else SLOW_LINEAR for axis in plan.axes])
    if plan.feed > 0.0:
        slow = np.minimum(slow, plan.feed)
    steps = np.abs(np.diff(plan.commands, axis=0)) / slow
    # The way to the first pose: as long as the longest step, or half a turn.
    approach = max(float(steps.sum(axis=1).max(initial=0.0)), math.pi / SLOW_ROTARY)
    poses = len(plan.commands) * (plan.dwell + POSE_MARGIN_S)
    return float(steps.sum()) + approach + poses + CYCLE_MARGIN_S


def pose_count(poses: int, points: int, missing: int) -> str:
    """For example ``82 of 84 poses, 2 missing``."""
    text = f'{points} of {poses} poses'
    return f'{text}, {missing} missing' if missing else text
