"""The simulated cell: motion, gauges, noise, chopping, faults."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from rtest_drivers.sim.cell import Cell
from rtest_drivers.sim.faults import Fault
from rtest_drivers.sim.kinematics import follow, sphere_in_table
from rtest_drivers.sim.motion import Drives, Timeline
from rtest_drivers.sim.truth import Truth, load_truth
from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, Feedback, GaugeBlock, Kind, Status

CONFIG = Path(__file__).parents[1] / 'config'
TRUTH = load_truth(CONFIG / 'cell_demo.yaml')
EPOCH = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
SPHERE = np.array([0.0, -0.09, 0.0406])
LETTERS = ('X', 'Y', 'Z', 'B', 'C')


def truth(**changes: object) -> Truth:
    return dataclasses.replace(TRUTH, **changes)


def quiet(**changes: object) -> Truth:
    """Neither noise nor mounting errors nor settling."""
    gauges = dataclasses.replace(
        TRUTH.gauges, noise=0.0, dwell_noise=0.0, direction_error=0.0, position_error=0.0
    )
    encoders = dataclasses.replace(TRUTH.encoders, linear_noise=0.0, rotary_noise=0.0)
    drives = dataclasses.replace(TRUTH.drives, settle=0.0)
    return truth(**{'gauges': gauges, 'encoders': encoders, 'drives': drives, **changes})


def plan(
    angles: list[tuple[float, float]], cycle: str = '1a-static', setup: str = '1a',
    sphere: np.ndarray = SPHERE, stamp: int = EPOCH,
) -> CyclePlan:
    rows = np.column_stack([np.zeros((len(angles), 3)), np.radians(angles)])
    commands = follow(TRUTH.machine, rows, sphere)
    return CyclePlan(stamp, 's', cycle, Kind.STATIC, setup, sphere, LETTERS, commands, 0.3)


ANGLES = [(0.0, 0.0), (-75.0, 0.0), (-75.0, 30.0), (50.0, 30.0), (0.0, 0.0)]


def run(cell: Cell, steps: list[int] | None = None) -> tuple[list[GaugeBlock], list[Feedback]]:
    """Until all plans are done and a second longer, in steps [ns]."""
    blocks, feedback = [], []
    index = 0
    after = None
    while after is None or cell.now < after:
        step = steps[index % len(steps)] if steps else SECOND
        index += 1
        until = cell.now + step if after is None else min(cell.now + step, after)
        output = cell.advance(until)
        blocks += output.blocks
        feedback += output.feedback
        if after is None and not cell.busy and cell.run is not None:
            after = cell.run.end + SECOND
    return blocks, feedback


def dwells(blocks: list[GaugeBlock], cell: Cell, count: int) -> np.ndarray:
    """(count, gauges) mean readings of the last dwells, found from the run's own times."""
    stamps = np.concatenate([block.stamps for block in blocks])
    values = np.concatenate([block.displacement for block in blocks])
    ends = [leg.start for leg in cell._timeline._legs[-count + 1 :]] + [cell.run.end]
    return np.array(
        [values[(stamps > end - 2 * SECOND // 10) & (stamps < end)].mean(axis=0) for end in ends]
    )


# --- motion ---


def test_the_nominal_sphere_stands_still_while_b_and_c_turn() -> None:
    timeline = Timeline(TRUTH.machine, Drives(), EPOCH)
    commands = plan(ANGLES).commands
    clock = EPOCH
    for row in commands:
        clock = timeline.append(clock, np.append(row, 0.0), 0, np.zeros(3)).arrival
    start = timeline._legs[1].arrival
    times = np.linspace(start, clock, 500).astype(np.int64)
    positions = timeline.at(times).positions
    centre = sphere_in_table(TRUTH.machine, positions[:, :5])
    assert np.abs(centre - SPHERE).max() < 1e-12
    # It does move in between, and not faster than the drives can.
    speed = np.abs(np.diff(positions, axis=0)) / np.diff(times * 1e-9)[:, None]
    assert np.rad2deg(speed[:, 3]).max() == pytest.approx(400.0, rel=0.02)
    assert speed[:, :3].max() < 0.5 * 1.01


def test_without_rotation_the_path_is_straight() -> None:
    timeline = Timeline(TRUTH.machine, Drives(), EPOCH)
    leg = timeline.append(EPOCH, np.array([0.03, -0.06, 0.01, 0, 0, 0]), 0, np.zeros(3))
    times = np.linspace(EPOCH, leg.arrival, 50).astype(np.int64)
    positions = timeline.at(times).positions
    assert positions[:, 1] == pytest.approx(-2.0 * positions[:, 0], abs=1e-12)
    assert positions[-1, :3] == pytest.approx([0.03, -0.06, 0.01], abs=1e-9)
    assert (np.diff(positions[:, 0]) >= 0.0).all()


def test_settling_is_gone_after_thirty_milliseconds() -> None:
    drives = Drives(settle=0.3e-6)
    timeline = Timeline(TRUTH.machine, drives, EPOCH)
    leg = timeline.append(EPOCH, np.array([0.001, 0, 0, 0, 0, 0]), 0, np.zeros(3))
    times = leg.arrival + np.arange(0, 60_000_000, 500_000)
    off = np.abs(timeline.at(times).positions[:, 0] - 0.001)
    assert off.max() > 0.1e-6
    assert off[60:].max() < 0.01e-6
    assert off[0] < 1e-12


# --- readings ---


def test_readings_are_the_kinematics_seen_by_the_gauges() -> None:
    given = quiet(runout=np.zeros(2))
    cell = Cell(given, EPOCH)
    cell.queue(plan(ANGLES))
    blocks, _ = run(cell)
    poses = plan(ANGLES).commands
    expected = (
        sphere_in_table(given.machine, poses, given.errors) - SPHERE
    ) @ given.gauges.directions.T
    assert dwells(blocks, cell, len(ANGLES)) == pytest.approx(expected, abs=1e-12)


def test_gauge_directions() -> None:
    # Azimuth 30, tilt 45: pushed in by a sphere that moves outwards over it and down.
    first = TRUTH.gauges.directions[0]
    assert first == pytest.approx([0.75**0.5 * 0.5**0.5, 0.5 * 0.5**0.5, -(0.5**0.5)])


def test_four_gauges() -> None:
    quarter = np.radians([0.0, 90.0, 180.0, 270.0])
    gauges = dataclasses.replace(quiet().gauges, azimuth=quarter, tilt=np.full(4, np.pi / 4))
    cell = Cell(quiet(gauges=gauges), EPOCH)
    cell.queue(plan(ANGLES))
    blocks, _ = run(cell)
    values = dwells(blocks, cell, len(ANGLES))
    assert values.shape == (len(ANGLES), 4)
    # Opposite gauges: their sum is -2 z sin 45 for either pair.
    assert values[:, 0] + values[:, 2] == pytest.approx(values[:, 1] + values[:, 3], abs=1e-12)


def test_runout_turns_with_the_spindle() -> None:
    given = quiet(errors=dataclasses.replace(TRUTH.errors, constants={}, terms={}))
    poses = follow(TRUTH.machine, np.zeros((5, 5)), SPHERE)
    spindle = np.radians([0.0, 90.0, 180.0, 270.0, 360.0])
    commands = np.column_stack([poses, spindle])
    cell = Cell(given, EPOCH)
    cell.queue(
        CyclePlan(
            EPOCH, 's', '1a-runout', Kind.SPINDLE_RUNOUT, '1a', SPHERE, (*LETTERS, 'S'),
            commands, 0.3,
        )
    )
    blocks, feedback = run(cell)
    centres = dwells(blocks, cell, 5) @ np.linalg.inv(given.gauges.directions.T)
    expected = np.array([[3, -2, 0], [2, 3, 0], [-3, 2, 0], [-2, -3, 0], [3, -2, 0]]) * 1e-6
    assert centres == pytest.approx(expected, abs=1e-12)
    assert feedback[-1].axes == (*LETTERS, 'S')
    assert feedback[-1].position[-1] == pytest.approx(np.radians(360.0))


def test_the_spindle_is_back_at_zero_in_ordinary_cycles() -> None:
    cell = Cell(quiet(), EPOCH)
    commands = np.column_stack([follow(TRUTH.machine, np.zeros((2, 5)), SPHERE), [0.0, 1.0]])
    cell.queue(
        CyclePlan(
            EPOCH, 's', 'r', Kind.SPINDLE_RUNOUT, '1a', SPHERE, (*LETTERS, 'S'), commands, 0.3
        )
    )
    cell.queue(plan(ANGLES))
    _, feedback = run(cell)
    assert feedback[-1].position[-1] == 0.0


def test_noise_has_the_size_it_was_given() -> None:
    cell = Cell(truth(drives=dataclasses.replace(TRUTH.drives, settle=0.0)), EPOCH)
    cell.queue(plan([(0.0, 0.0)] * 400))
    blocks, _ = run(cell)
    ends = [leg.start for leg in cell._timeline._legs[3:]]
    stamps = np.concatenate([block.stamps for block in blocks])
    values = np.concatenate([block.displacement for block in blocks])
    groups = [
        values[(stamps > end - 280_000_000) & (stamps <= end - 10_000_000)] for end in ends
    ]
    within = np.mean([group.var(axis=0, ddof=1) for group in groups]) ** 0.5
    between = np.std([group.mean(axis=0) for group in groups], axis=0)
    assert within == pytest.approx(0.1e-6, rel=0.05)
    # Each direction alike, so that every gauge sees the same whatever way it points.
    assert between == pytest.approx(np.full(3, 0.25e-6), rel=0.15)


def test_each_mounting_differs_and_takes_a_while() -> None:
    cell = Cell(TRUTH, EPOCH)
    cell.queue(plan(ANGLES[:2]))
    cell.queue(plan(ANGLES[:2], '1b-static', '1b', SPHERE + [0.0, 0.0, 0.1]))
    blocks, _ = run(cell)
    status = np.concatenate([block.status for block in blocks])
    lost = np.flatnonzero(np.diff((status[:, 0] == Status.NO_SIGNAL).astype(int)))
    # Mounting, readings, mounting, readings. 1 s at 50 Hz each.
    assert len(lost) == 3
    assert lost[2] - lost[1] in (49, 50, 51)
    first, second = cell._nests
    angle = np.degrees(np.arccos((first.directions * second.directions).sum(axis=1)))
    assert (angle > 0.05).all() and (angle < 6.0).all()


def test_readings_stop_at_the_range() -> None:
    cell = Cell(quiet(), EPOCH)
    poses = np.tile(plan(ANGLES[:1]).commands, (2, 1))
    poses[1, 2] += 0.02
    cell.queue(dataclasses.replace(plan(ANGLES[:2]), commands=poses))
    blocks, _ = run(cell)
    assert blocks[-1].displacement == pytest.approx(np.full((10, 3), -3e-3))
    assert (blocks[-1].status == Status.OUT_OF_RANGE).all()


def test_outliers() -> None:
    gauges = dataclasses.replace(TRUTH.gauges, outliers=0.02, outlier=50e-6)
    cell = Cell(truth(gauges=gauges), EPOCH)
    cell.queue(plan(ANGLES[:1] * 100))
    blocks, _ = run(cell)
    values = np.concatenate([block.displacement for block in blocks])[100:]
    off = np.abs(values - np.median(values, axis=0)) > 3e-6
    assert off.mean() == pytest.approx(0.02 * 47 / 50, rel=0.25)


# --- time ---


@pytest.mark.parametrize('steps', [[7_000_000], [1_000_000_001, 13_333_333], [400_000_000]])
def test_readings_do_not_depend_on_how_time_is_chopped(steps: list[int]) -> None:
    fault = Fault('gauge_silent', '1a-static', 2)
    plans = [plan(ANGLES), plan(ANGLES[:2], '1b-static', '1b', stamp=EPOCH + 9 * SECOND)]
    results = []
    for chop in ([SECOND], steps):
        cell = Cell(truth(faults=(fault,)), EPOCH)
        for item in plans:
            cell.queue(item)
        results.append(run(cell, chop))
    (blocks, feedback), (other_blocks, other_feedback) = results
    assert len(blocks) == len(other_blocks) > 30
    for block, other in zip(blocks, other_blocks, strict=True):
        assert (block.stamp, block.sequence) == (other.stamp, other.sequence)
        assert np.array_equal(block.displacement, other.displacement)
        assert np.array_equal(block.status, other.status)
    assert len(feedback) == len(other_feedback)
    for one, other in zip(feedback, other_feedback, strict=True):
        assert one.stamp == other.stamp
        # The arcs are solved for many instants at once: equal to the last bits.
        assert np.abs(one.position - other.position).max() < 1e-15


def test_the_seed_decides() -> None:
    readings = []
    for seed in (1, 1, 2):
        cell = Cell(truth(seed=seed), EPOCH)
        cell.queue(plan(ANGLES[:1]))
        readings.append(run(cell)[0][-1].displacement)
    assert np.array_equal(readings[0], readings[1])
    assert not np.array_equal(readings[0], readings[2])


def test_a_plan_waits_for_its_stamp_and_for_the_one_before() -> None:
    cell = Cell(TRUTH, EPOCH)
    cell.queue(plan(ANGLES[:1], stamp=EPOCH + 5 * SECOND))
    cell.queue(plan(ANGLES[:1], '1b-static'))
    cell.advance(EPOCH + 4 * SECOND)
    assert cell.run is None and cell.busy
    cell.advance(EPOCH + 30 * SECOND)
    assert not cell.busy
    assert cell.run.plan.cycle == '1b-static'
    assert cell.run.start > EPOCH + 5 * SECOND


def test_stamps_and_sequence_are_contiguous() -> None:
    cell = Cell(TRUTH, EPOCH)
    cell.queue(plan(ANGLES))
    blocks, feedback = run(cell, [123_456_789])
    assert [block.sequence for block in blocks] == list(range(0, 10 * len(blocks), 10))
    assert set(np.diff(np.concatenate([block.stamps for block in blocks]))) == {20_000_000}
    assert {b.stamp - a.stamp for a, b in itertools.pairwise(feedback)} == {20_000_000}


# --- dynamic cycles ---

SPEED = np.radians(60.0)
# Zero, 90 deg, zero at 60 deg/s: the steady part of each way is 1.5 s less the two ramps.
WAY = dataclasses.replace(
    plan([(0, 0), (0, 90), (0, 0)]), kind=Kind.DYNAMIC, dwell=0.0, feed=SPEED
)


def turning(gauges: dict | None = None, **drives: float) -> tuple[np.ndarray, ...]:
    """Times of readings, displacement in the table frame, times of feedback, positions."""
    still = quiet(errors=dataclasses.replace(TRUTH.errors, constants={}, terms={}),
                  runout=np.zeros(2))
    data = dataclasses.replace(still.gauges, period=2_000_000, **(gauges or {}))
    encoders = dataclasses.replace(still.encoders, period=2_000_000)
    cell = Cell(dataclasses.replace(
        still, gauges=data, encoders=encoders, drives=dataclasses.replace(still.drives, **drives)
    ), EPOCH)
    cell.queue(WAY)
    blocks, feedback = run(cell)
    mounted = [b for b in blocks if b.status.max() == Status.VALID]
    times = np.concatenate([b.stamps for b in mounted])
    values = np.concatenate([b.displacement for b in mounted])
    return (
        (times - EPOCH) * 1e-9, values @ np.linalg.inv(data.directions).T,
        np.array([(f.stamp - EPOCH) * 1e-9 for f in feedback]),
        np.array([f.position for f in feedback]),
    )


def test_a_dynamic_cycle_turns_at_its_feed_with_the_sphere_in_its_place() -> None:
    _, seen, logged, positions = turning(acceleration=4.0)
    speed = np.diff(positions[:, 4]) / np.diff(logged)
    # Ramps take speed / acceleration each, and the way is 90 deg.
    for sign in (1.0, -1.0):
        steady = np.isclose(speed, sign * SPEED, rtol=1e-6)
        assert steady.sum() * 0.002 == pytest.approx(1.5 - SPEED / 4.0, abs=0.01)
    assert np.abs(np.diff(speed)).max() / 0.002 == pytest.approx(4.0, rel=1e-3)
    np.testing.assert_allclose(seen, 0.0, atol=1e-12)


def test_axes_trail_their_commands_by_speed_over_gain() -> None:
    # 1/Kv of 3 ms in C and of 2 ms in X and Y: C is back by 1 ms more, the sphere is before.
    times, seen, logged, positions = turning(linear_lag=2e-3, rotary_lag=3e-3)
    on_time = turning()[3]
    middle = np.abs(logged - logged[np.argmax(on_time[:, 4] > np.radians(45))]) < 0.1
    np.testing.assert_allclose(
        (on_time - positions)[middle, 4], 3e-3 * SPEED, rtol=1e-6
    )
    moving = np.interp(times, logged, on_time[:, 4])
    rows = np.abs(moving - np.radians(45)) < np.radians(5)
    sign = np.sign(np.gradient(moving, times))[rows]
    # At C = 0 the sphere lies towards -Y; the table turns it towards +X.
    np.testing.assert_allclose(seen[rows, 0], sign * 1e-3 * SPEED * 0.09, rtol=1e-3)
    # The circle shrinks by (omega T)^2 R / 2, and turned by 1 ms of its way the sphere is nearer
    # by the arc's own height: both towards +Y.
    nearer = 0.5 * ((2e-3 * SPEED) ** 2 + (1e-3 * SPEED) ** 2) * 0.09
    np.testing.assert_allclose(seen[rows, 1], nearer, rtol=1e-3)


def test_friction_shows_in_the_readings_and_not_in_the_feedback() -> None:
    gauges = {'friction': 3e-6, 'friction_speed': 0.045, 'friction_power': 0.5, 'late': 0.25}
    times, seen, logged, positions = turning(gauges)
    np.testing.assert_array_equal(positions, turning()[3])
    where = np.interp(times - 0.25, logged, positions[:, 4])
    speed = np.gradient(where, times)
    rows = np.isclose(np.abs(speed), SPEED, rtol=1e-3)
    # 0.09 m at 60 deg/s: 2.09 times the speed of the statement.
    lag = 3e-6 * np.sqrt(0.09 * SPEED / 0.045)
    np.testing.assert_allclose(seen[rows, 0], -np.sign(speed[rows]) * lag, rtol=1e-3)
    np.testing.assert_allclose(seen[rows, 1:], 0.0, atol=1e-9)
    assert rows.sum() > 500


# --- plans the machine cannot do ---


@pytest.mark.parametrize(
    ('changes', 'expected'),
    [
        ({'axes': ('X', 'Y', 'Z', 'B', 'A')}, 'no axis A'),
        ({'commands': np.full((1, 5), 0.3)}, 'pose 0: X = 0.3 is outside'),
        ({'kind': Kind.DYNAMIC}, 'turns a rotary axis between all of its poses, with a feed'),
        ({'kind': Kind.DYNAMIC, 'commands': np.zeros((2, 5))}, 'has a feed'),
    ],
)
def test_impossible_plans_are_refused(changes: dict, expected: str) -> None:
    with pytest.raises(UserError, match=expected):
        Cell(TRUTH, EPOCH).queue(dataclasses.replace(plan(ANGLES), **changes))


# --- faults ---


def faulty(*faults: Fault) -> tuple[list[GaugeBlock], list[Feedback], Cell]:
    cell = Cell(quiet(faults=faults), EPOCH)
    cell.queue(plan(ANGLES))
    return *run(cell), cell


def pose_times(cell: Cell, pose: int) -> tuple[int, int]:
    # The first leg rests before everything, the second goes to pose 0, the third is its mounting.
    legs = cell._timeline._legs
    return legs[pose + 2].arrival, legs[pose + 3].start


def test_silent_gauges_leave_a_gap_in_time() -> None:
    blocks, feedback, _ = faulty(Fault('gauge_silent', start=2.0, duration=1.0))
    times = [(block.stamp - EPOCH) * 1e-9 for block in blocks]
    assert not [t for t in times if 2.0 <= t < 2.9]
    assert [b.sequence for b in blocks] == list(range(0, 10 * len(blocks), 10))
    assert max(b.stamp - a.stamp for a, b in itertools.pairwise(feedback)) == 20_000_000


def test_a_lost_block_jumps_the_sequence() -> None:
    blocks, _, _ = faulty(Fault('lost_block', start=2.05, duration=0.02))
    jumps = np.diff([block.sequence for block in blocks])
    assert sorted(set(jumps)) == [10, 20]
    assert (jumps == 20).sum() == 1


@pytest.mark.parametrize(
    ('kind', 'status', 'value'),
    [
        ('gauge_out_of_range', Status.OUT_OF_RANGE, 3e-3),
        ('gauge_error', Status.DEVICE_ERROR, 0.0),
        ('gauge_nan', Status.VALID, np.nan),
    ],
)
def test_bad_readings_of_one_gauge_at_one_pose(kind, status, value) -> None:
    blocks, _, cell = faulty(Fault(kind, '1a-static', 2, gauge=1))
    start, end = pose_times(cell, 2)
    stamps = np.concatenate([block.stamps for block in blocks])
    values = np.concatenate([block.displacement for block in blocks])
    states = np.concatenate([block.status for block in blocks])
    hit = (stamps >= start) & (stamps < end)
    assert hit.sum() in (14, 15)
    np.testing.assert_array_equal(values[hit, 1], value)
    assert (states[hit, 1] == status).all()
    mounted = states[:, 0] != Status.NO_SIGNAL
    assert (states[mounted & ~hit] == Status.VALID).all()
    assert np.isfinite(values[~hit]).all()
    assert (states[hit][:, [0, 2]] == Status.VALID).all()


def test_stale_feedback_repeats_the_last() -> None:
    _, feedback, _ = faulty(Fault('feedback_stale', start=2.0, duration=0.5))
    stamps = np.array([item.stamp for item in feedback])
    assert (np.diff(stamps) == 0).sum() == 25
    assert np.diff(stamps).max() == 520_000_000


def test_silent_feedback() -> None:
    blocks, feedback, _ = faulty(Fault('feedback_silent', start=2.0, duration=0.5))
    assert max(b.stamp - a.stamp for a, b in itertools.pairwise(feedback)) == 520_000_000
    assert {b.stamp - a.stamp for a, b in itertools.pairwise(blocks)} == {200_000_000}


def test_a_skipped_pose_is_never_reached() -> None:
    _, feedback, _ = faulty(Fault('pose_skipped', '1a-static', 3))
    b = np.array([item.position[3] for item in feedback])
    assert np.degrees(b.max()) < 1.0
    assert np.degrees(b.min()) == pytest.approx(-75.0)


def test_a_whole_cycle_can_be_silent() -> None:
    blocks, _, cell = faulty(Fault('gauge_silent', '1a-static'))
    assert cell.run is not None
    assert all(not cell.run.start <= block.stamps[-1] < cell.run.end for block in blocks)
