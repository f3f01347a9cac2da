"""Time-outs of cycles and how an outcome is told."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rtest_drivers.schedule import (
    CYCLE_MARGIN_S,
    FIRST_S,
    HEARD_S,
    POSE_MARGIN_S,
    STOPPED_S,
    Progress,
    calibration_outcome,
    outcome,
    path_duration,
    pose_count,
    pose_patience,
    turn,
)
from rtest_estimation.records import CyclePlan, Kind, NestKind


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


def test_the_first_reason_of_missing_poses_is_told():
    cycle = plan(np.zeros((9, 2)))
    reasons = {'cycle': 'a', 'pose 3': 'no gauge readings', 'pose 4': 'no gauge readings'}
    assert outcome(cycle, 7, 2, reasons) == (
        '7 of 9 poses, 2 missing (3-4: no gauge readings)'
    )
    assert outcome(cycle, 6, 3, {**reasons, 'pose 7': 'not reached'}) == (
        '6 of 9 poses, 3 missing (3-4: no gauge readings; ...)'
    )


def test_an_outcome_needs_no_reasons():
    """They may be lost on the way."""
    cycle = plan(np.zeros((9, 2)))
    assert outcome(cycle, 7, 2, {}) == '7 of 9 poses, 2 missing'
    assert outcome(cycle, 9, 0, {'pose 3': 'of another cycle'}) == '9 of 9 poses'


def test_a_dynamic_cycle_is_recorded():
    cycle = replace(plan(np.zeros((9, 2))), kind=Kind.DYNAMIC)
    assert outcome(cycle, 0, 0, {}) == 'recorded'
    assert outcome(cycle, 0, 2, {}) == '0 of 9 poses, 2 missing'


def test_the_residual_of_a_laser_nest_is_that_before_the_correction():
    assert calibration_outcome(1.234e-7, NestKind.CONTACT) == 'residual 0.12 µm'
    assert calibration_outcome(2e-6, NestKind.LASER) == 'residual 2.00 µm before the correction'


# The longest move is 2 s, or with the dwell 2.5 s.
THREE = [[0.0, 0.0], [0.1, 0.0], [0.15, 0.0]]
SECOND = 1_000_000_000


def test_patience_is_that_of_the_longest_move():
    assert pose_patience(plan(THREE)) == STOPPED_S
    assert pose_patience(plan([[0.0, 0.0], [1.0, math.pi]])) == pytest.approx(3 * (20 + 18 + 0.5))


def test_a_cycle_that_gains_no_pose_has_stopped():
    progress = Progress(plan(THREE), 0, 100.0)
    for number in range(12):
        assert not progress.stopped(number * SECOND, 100.0 + number, min(number, 2), 0.02)
    wall = 102.0 + HEARD_S
    assert not progress.stopped(30 * SECOND, wall - 0.1, 2, 0.02), 'nothing was heard since'
    why = progress.stopped(30 * SECOND, wall + 0.1, 2, 0.02)
    assert why == '2 of 3 poses, no other pose for 28 s'
    assert not progress.stopped(31 * SECOND, wall + 1.0, 3, 0.02), 'it has gone on'
    assert not progress.stopped(80 * SECOND, wall + 60.0, 3, 0.02), 'the gauges are waited for'


def test_a_cycle_without_feedback_has_stopped_even_before_its_first_pose():
    progress = Progress(plan(THREE), 0, 0.0)
    late = int((FIRST_S + 5) * SECOND)
    assert not progress.stopped(late, 60.0, 0, 0.02), 'somebody is still at the machine'
    assert not progress.stopped(late, 60.0, 0, None)
    why = progress.stopped(late, 60.0, 0, FIRST_S + 1)
    assert why == '0 of 3 poses, no encoder feedback for 61 s'
    assert 'no encoder feedback for 65 s' in progress.stopped(late, 60.0, 0, math.inf)
    assert 'not finished after' in progress.stopped(1000 * SECOND, 60.0, 0, 0.02)


def test_a_clock_that_stands_is_seen():
    progress = Progress(plan(THREE), 0, 0.0)
    assert progress.clock_stands(1, 5.0) == 0.0
    assert progress.clock_stands(1, 9.0) == 4.0
    assert progress.clock_stands(2, 10.0) == 0.0


def test_where_somebody_starts_the_machine_times_count_from_the_first_pose():
    progress = Progress(plan(THREE), 0, 0.0, attended=True)
    hours = 7200
    for second in (1, 60, hours):
        assert not progress.stopped(second * SECOND, float(second), 0, math.inf)
    assert not progress.stopped((hours + 5) * SECOND, hours + 5.0, 1, 0.02)
    assert not progress.stopped((hours + 12) * SECOND, hours + 12.0, 2, 0.02)
    why = progress.stopped((hours + 40) * SECOND, hours + 40.0, 2, 0.02)
    assert why == '2 of 3 poses, no other pose for 28 s'


def test_a_repeated_cycle_is_announced_or_told_to_be_late():
    now = 1_700_000_000_000_000_000
    assert turn(now + 875 * SECOND, now) == ('in 14.6 min', False)
    assert turn(now + 4 * SECOND, now) == turn(now - 4 * SECOND, now) == ('', False)
    text, late = turn(now - 132 * SECOND, now)
    assert late and text.startswith('2.2 min late: the cycle before')
