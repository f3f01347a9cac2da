"""A laser nest through the estimator, with readings by bisection, which share no code with it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from laser_case import RADIUS, bisect, directions, spots
from synthetic import AXES, SPHERE, T0

from rtest_estimation.pipeline import EstimationRules, Estimator
from rtest_estimation.records import CyclePlan, Feedback, GaugeBlock, Kind, NestKind, Status

RULES = EstimationRules(sphere_radius=RADIUS, nest=NestKind.LASER)
HZ, BATCH, DWELL, MOVE = 100, 20, 0.3, 0.2


def cube_plan(stamp=T0):
    side = np.array([-5e-4, 0.0, 5e-4])
    grid = np.stack(np.meshgrid(side, side, side, indexing='ij'), axis=-1).reshape(-1, 3)
    return plan(stamp, '1a-nest', Kind.NEST_CALIBRATION, [np.zeros(3), *grid, np.zeros(3)])


def plan(stamp, name, kind, offsets, turn=0.0):
    rows = np.zeros((len(offsets), 5))
    rows[:, :3] = SPHERE + np.array(offsets)
    rows[1:-1, 4] = turn * np.arange(1, len(offsets) - 1)
    return CyclePlan(stamp, 's', name, kind, '1a', SPHERE, AXES, rows, DWELL)


def measured(plans, count=3, move_sphere=lambda plan, offset: offset, seed=0):
    """Feedback and blocks of plans carried out one after the other; sphere moved as commanded."""
    rng = np.random.default_rng(seed)
    stamps, positions, centres = [], [], []
    for one in plans:
        clock = one.stamp
        for row, command in enumerate(one.commands):
            before = one.commands[max(row - 1, 0)]
            still = DWELL if row < len(one.commands) - 1 else 1.2
            steps = int((MOVE + still) * HZ)
            for step in range(steps):
                share = min(step / (MOVE * HZ), 1.0)
                position = before + share * (command - before)
                stamps.append(clock)
                positions.append(position)
                centres.append(move_sphere(one, position[:3] - SPHERE))
                clock += 1_000_000_000 // HZ
    readings = bisect(spots(count), directions(count), np.array(centres))
    readings += 1e-4 * np.arange(1, count + 1) + 2e-7 * rng.normal(size=readings.shape)
    feedback = [
        Feedback(t, AXES, p + 1e-8 * rng.normal(size=5))
        for t, p in zip(stamps, positions, strict=True)
    ]
    blocks = [
        GaugeBlock(stamps[n], n, 1.0 / HZ, readings[n : n + BATCH],
                   np.zeros(readings[n : n + BATCH].shape, np.uint8))
        for n in range(0, len(stamps), BATCH)
    ]
    return feedback, blocks


def estimate(plans, feedback, blocks, rules=RULES):
    estimator = Estimator(rules)
    for one in plans:
        estimator.add_plan(one)
    for record in sorted([*feedback, *blocks], key=lambda record: record.stamp):
        add = estimator.add_feedback if isinstance(record, Feedback) else estimator.add_gauges
        add(record)
    return estimator.finish()


OFFSETS = 1e-6 * np.array([[0, 0, 0], [100, -200, 50], [-300, 20, 400], [7, 7, 7], [0, 0, 0]])


def session(offsets=OFFSETS):
    static = plan(T0 + 40_000_000_000, '1a-static', Kind.STATIC, offsets, turn=0.3)
    return [cube_plan(), static]


@pytest.mark.parametrize('count', [3, 4])
def test_centres_are_the_displacements_made(count):
    plans = session()
    calibrated, static = estimate(plans, *measured(plans, count))
    assert calibrated.nest.kind is NestKind.LASER and not calibrated.problem
    assert calibrated.nest.residual < 5e-7
    assert len(calibrated.nest.correction_nodes) == 27 == len(plans[0].commands) - 2
    assert not static.cycle.missing
    for point in static.cycle.points:
        # 0.2 um of 25 readings: 0.04 um; the nest's own calibration adds as much again.
        np.testing.assert_allclose(point.displacement, OFFSETS[point.index], atol=4e-7)
        assert 1e-9 < np.sqrt(np.trace(point.covariance)) < 2e-7
    assert [dwell.index for dwell, _ in static.means] == [0, 1, 2, 3, 4]


def test_a_contact_nest_would_be_off_by_the_curvature():
    plans = session()
    static = estimate(plans, *measured(plans), replace(RULES, nest=NestKind.CONTACT))[1]
    error = max(
        np.linalg.norm(p.displacement - OFFSETS[p.index]) for p in static.cycle.points
    )
    assert error > 2e-6


def test_outside_of_the_calibrated_cube_a_pose_is_missing_with_its_place():
    beyond = np.array([*OFFSETS[:3], [8e-4, 0, 0], [0, 0, 0]])
    plans = session(beyond)
    static = estimate(plans, *measured(plans))[1]
    assert [p.index for p in static.cycle.points] == [0, 1, 2, 4]
    (missing,) = static.cycle.missing
    assert missing.index == 3
    assert missing.reason == 'sphere at (0.800, 0.000, 0.000) mm, outside the calibrated volume'
    # The readings are kept all the same.
    assert 3 in [dwell.index for dwell, _ in static.means]


def test_lost_signal_is_a_missing_pose_with_the_laser_named():
    plans = session()
    feedback, blocks = measured(plans)
    begin = plans[1].stamp + int((2 * MOVE + DWELL) * 1e9)
    end = begin + int(DWELL * 1e9)
    lost = [
        replace(b, status=np.where(np.arange(3) == 1, Status.NO_SIGNAL, b.status).astype(np.uint8))
        if begin - 200_000_000 <= b.stamp < end else b
        for b in blocks
    ]
    static = estimate(plans, feedback, lost)[1]
    (missing,) = static.cycle.missing
    assert missing.index == 1 and 'gauge 2 no signal' in missing.reason


def test_without_the_radius_nothing_is_measured_and_it_is_said():
    plans = session()
    calibrated, static = estimate(plans, *measured(plans), EstimationRules(nest=NestKind.LASER))
    assert calibrated.nest is None and 'radius of the sphere' in calibrated.problem
    assert not static.cycle.points


def test_the_mean_readings_of_every_pose_are_kept():
    plans = session()
    static = estimate(plans, *measured(plans))[1]
    mean = dict((dwell.index, mean) for dwell, mean in static.means)[2].mean
    expected = bisect(spots(3), directions(3), OFFSETS[2:3])[0] + 1e-4 * np.arange(1, 4)
    np.testing.assert_allclose(mean, expected, atol=2e-7)


def test_a_scan_ends_where_it_comes_to_rest_and_not_in_passing():
    """A dynamic cycle that goes through its last pose without a stop before it stands there."""
    ends = 1e-3 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [1, 1, 0], [0, 0, 0]])
    scan = replace(plan(T0, '1a-scan-1', Kind.DYNAMIC, ends), dwell=0.0, feed=2e-3)
    positions = [SPHERE] * HZ
    for before, after in pairwise(ends):
        steps = int(np.linalg.norm(after - before) / scan.feed * HZ)
        share = np.arange(1, steps + 1)[:, None] / steps
        positions += [*(SPHERE + before + share * (after - before))]
    arrival = T0 + (len(positions) - 1) * 10_000_000
    positions += [SPHERE] * (2 * HZ)
    estimator, done = Estimator(RULES), []
    estimator.add_plan(scan)
    for k, position in enumerate(positions):
        stamp = T0 + k * 10_000_000
        estimator.add_feedback(Feedback(stamp, AXES, np.r_[position, 0.0, 0.0]))
        estimator.add_gauges(
            GaugeBlock(stamp, k, 0.0, np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
        )
        while (ready := estimator.finished()) is not None:
            done.append((ready.cycle.stamp, stamp))
    ((end, told),) = done
    assert end == pytest.approx(arrival + 500_000_000, abs=100_000_000)
    assert told - end < 100_000_000
