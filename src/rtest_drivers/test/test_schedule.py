"""Time-outs of cycles and how an outcome is told."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rtest_drivers.schedule import CYCLE_MARGIN_S, POSE_MARGIN_S, path_duration, pose_count
from rtest_estimation.records import CyclePlan, Kind


def plan(commands, feed: float = 0.0) -> CyclePlan:
    return CyclePlan(
        0, '', 'a', Kind.STATIC, 'a', np.zeros(3), ('X', 'B'), np.array(commands), 0.5, feed
    )


def test_a_cycle_may_take_as_long_as_its_slow_path():
    quarter = math.pi / 2
    # 0.1 m at 0.05 m/s, then 90 deg at 10 deg/s; half a turn to the first pose.
    limit = path_duration(plan([[0.0, 0.0], [0.1, 0.0], [0.1, quarter]]))
    assert limit == pytest.approx(2.0 + 9.0 + 18.0 + 3 * (0.5 + POSE_MARGIN_S) + CYCLE_MARGIN_S)


def test_a_slow_feed_takes_longer():
    commands = [[0.0, 0.0], [0.1, 0.0]]
    assert path_duration(plan(commands, 0.01)) > path_duration(plan(commands)) + 7.9


def test_missing_poses_are_told_only_where_there_are_some():
    assert pose_count(84, 84, 0) == '84 of 84 poses'
    assert pose_count(84, 82, 2) == '82 of 84 poses, 2 missing'
