"""Dwells from encoder feedback: settled, fresh, matched in order, or missing with a reason."""

import numpy as np
import pytest

from rtest_estimation.dwell import DwellRules, find_dwells, trailing
from rtest_estimation.records import CyclePlan, Kind

T0 = 1_700_000_000_000_000_000


def plan(commands, dwell=0.3):
    commands = np.asarray(commands, dtype=float)
    axes = ('X', 'C')[: commands.shape[1]]
    return CyclePlan(T0, 's', 'c', Kind.STATIC, '1a', np.zeros(3), axes, commands, dwell)


def feedback(commands, hz=50.0, dwell=0.3, move=0.3, noise=3e-8, seed=0, wait=1.0):
    """A machine that visits the commands in turn, with smooth moves between."""
    commands = np.asarray(commands, dtype=float)
    times, points = [0.0], [commands[0]]
    for number, command in enumerate(commands):
        if number:
            times.append(times[-1] + move)
            points.append(command)
        times.append(times[-1] + (wait if number == len(commands) - 1 else dwell))
        points.append(command)
    grid = np.arange(0.0, times[-1], 1.0 / hz)
    place = np.interp(grid, times, np.arange(len(times)))
    part = place - np.floor(place)
    smooth = part * part * (3 - 2 * part)
    low = np.minimum(np.floor(place).astype(int), len(points) - 2)
    points = np.array(points)
    positions = points[low] + smooth[:, None] * (points[low + 1] - points[low])
    positions = positions + noise * np.random.default_rng(seed).normal(size=positions.shape)
    return T0 + np.round(grid * 1e9).astype(np.int64), positions


ROUND = [[0.0, 0.0], [0.01, 0.5], [0.02, 1.0], [0.01, 0.5], [0.0, 0.0]]


@pytest.mark.parametrize('hz', [16.7, 50.0, 500.0])
def test_every_pose_is_found_at_its_time(hz):
    stamps, positions = feedback(ROUND, hz)
    dwells, missing = find_dwells(plan(ROUND), stamps, positions)
    assert not missing
    assert [d.index for d in dwells] == [0, 1, 2, 3, 4]
    for number, dwell in enumerate(dwells):
        arrival = T0 + number * 600_000_000
        # Not before the axes stand, not after they leave.
        assert arrival <= dwell.start < dwell.end <= arrival + 300_000_000 + 60_000_000
        np.testing.assert_allclose(dwell.feedback, ROUND[number], atol=1e-7)


def test_approach_is_the_sign_of_the_last_motion_within_the_cycle():
    stamps, positions = feedback([[0, 0], [0.01, 0], [0.01, 0.5], [0.0, 0.5]])
    dwells, _ = find_dwells(
        plan([[0, 0], [0.01, 0], [0.01, 0.5], [0.0, 0.5]]), stamps, positions
    )
    assert [d.approach.tolist() for d in dwells] == [[0, 0], [1, 0], [1, 1], [-1, 1]]


def test_a_slow_move_is_not_a_stop():
    # 2.5 mm/s at 500 Hz: 5 um between two samples.
    commands = [[0.0, 0.0], [0.001, 0.0], [0.0, 0.0]]
    stamps, positions = feedback(commands, 500.0, move=0.4)
    dwells, missing = find_dwells(plan(commands), stamps, positions)
    assert not missing
    np.testing.assert_allclose([d.feedback[0] for d in dwells], [0, 0.001, 0], atol=1e-7)


def test_a_pose_that_was_skipped_is_missing_and_the_rest_is_not():
    stamps, positions = feedback([ROUND[0], ROUND[1], *ROUND[3:]])
    dwells, missing = find_dwells(plan(ROUND), stamps, positions)
    # The machine stood at (0.01, 0.5) once: it is the first of the two equal poses.
    assert [d.index for d in dwells] == [0, 1, 4]
    assert [(m.index, m.reason) for m in missing] == [(2, 'never reached'), (3, 'never reached')]


def test_equal_poses_in_a_row_share_a_stop():
    commands = [[0.0, 0.0], [0.01, 0.5], [0.01, 0.5], [0.0, 0.0]]
    stamps, positions = feedback(commands, move=0.0001)
    stamps, positions = feedback([commands[0], commands[1], commands[3]], dwell=0.6)
    dwells, missing = find_dwells(plan(commands), stamps, positions)
    assert not missing
    assert dwells[2].start - dwells[1].start == 300_000_000
    assert trailing(plan(commands)) == 1
    assert trailing(plan([*commands, commands[-1]])) == 2


def test_of_a_long_stop_the_last_part_is_used_but_at_the_end_the_first():
    stamps, positions = feedback(ROUND, dwell=2.0, wait=5.0)
    dwells, missing = find_dwells(plan(ROUND, 0.3), stamps, positions)
    assert not missing
    for number, dwell in enumerate(dwells[:-1]):
        leaves = T0 + number * 2_300_000_000 + 2_000_000_000
        assert leaves - 300_000_000 <= dwell.start < dwell.end <= leaves
    arrival = T0 + 4 * 2_300_000_000
    assert arrival <= dwells[-1].start < dwells[-1].end <= arrival + 320_000_000


def test_a_short_stop_is_not_settled():
    stamps, positions = feedback(ROUND, dwell=0.1)
    _, missing = find_dwells(plan(ROUND), stamps, positions)
    assert {m.index for m in missing} == {0, 1, 2, 3}
    assert all('not settled' in m.reason for m in missing)


def test_stale_feedback_is_said():
    stamps, positions = feedback(ROUND)
    # Lost from the first move until the third stands.
    keep = (stamps < T0 + 400_000_000) | (stamps > T0 + 1_450_000_000)
    dwells, missing = find_dwells(plan(ROUND), stamps[keep], positions[keep])
    assert 1 in {m.index for m in missing}
    assert 'stale for 1.0' in missing[0].reason
    assert {3, 4} <= {d.index for d in dwells}


def test_feedback_that_never_comes_back_is_stale_not_unreached():
    stamps, positions = feedback(ROUND)
    keep = stamps < T0 + 1_000_000_000
    _, missing = find_dwells(plan(ROUND), stamps[keep], positions[keep], None, T0 + 9_000_000_000)
    assert [m.index for m in missing] == [2, 3, 4]
    assert all('stale for 8.0' in m.reason for m in missing)
    _, missing = find_dwells(plan(ROUND), stamps[keep], positions[keep])
    assert {m.reason for m in missing} == {'never reached'}


def test_feedback_lost_during_a_stop_does_not_shift_the_poses():
    stamps, positions = feedback(ROUND, dwell=1.0)
    keep = (stamps < T0 + 1_400_000_000) | (stamps > T0 + 1_700_000_000)
    dwells, missing = find_dwells(plan(ROUND, 0.3), stamps[keep], positions[keep])
    assert not missing
    np.testing.assert_allclose([d.feedback[0] for d in dwells], np.array(ROUND)[:, 0], atol=1e-7)


def test_an_axis_without_feedback_is_named():
    stamps, positions = feedback(ROUND)
    positions[:, 1] = np.nan
    dwells, missing = find_dwells(plan(ROUND), stamps, positions)
    assert not dwells
    assert {m.reason for m in missing} == {'the encoder feedback has no axis C'}


def test_no_feedback_at_all():
    dwells, missing = find_dwells(plan(ROUND), np.empty(0, dtype=np.int64), np.empty((0, 2)))
    assert not dwells and len(missing) == 5


def test_coarse_encoders_still_stand():
    stamps, positions = feedback(ROUND, noise=0.0)
    quantum = np.array([1e-6, 1.7e-5])
    positions = np.round(positions / quantum) * quantum
    _, missing = find_dwells(plan(ROUND), stamps, positions, DwellRules())
    assert not missing
