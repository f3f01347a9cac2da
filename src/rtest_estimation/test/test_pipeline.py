"""Finished cycles: the right centres, whatever the interleaving; missing poses with a reason."""

import random
from dataclasses import replace

import numpy as np
import pytest
from synthetic import T0, displacement, nest_plan, run, session, static_plan

from rtest_estimation.attempts import counted
from rtest_estimation.pipeline import Estimator
from rtest_estimation.records import Kind


def estimate(plans, feedback, blocks, shuffle=None):
    """Feed the three topics in order within each topic, interleaved as `shuffle` says."""
    estimator = Estimator()
    queues = [
        [(estimator.add_plan, p) for p in plans],
        [(estimator.add_feedback, f) for f in feedback],
        [(estimator.add_gauges, b) for b in blocks],
    ]
    if shuffle is None:
        items = queues[0] + sorted(queues[1] + queues[2], key=lambda i: i[1].stamp)
    else:
        items = sorted(queues[0] + queues[1] + queues[2], key=lambda i: i[1].stamp)
        late = random.Random(shuffle)
        # Each topic is late by its own, changing amount, up to 1.5 s.
        lag = {q[0][0].__name__: 0.0 for q in queues}
        keyed = []
        for add, record in items:
            name = add.__name__
            lag[name] = max(lag[name], record.stamp + late.random() * 1.5e9)
            keyed.append((lag[name], add, record))
        items = [(add, record) for _, add, record in sorted(keyed, key=lambda k: k[0])]
    done = []
    for add, record in items:
        add(record)
        while (ready := estimator.finished()) is not None:
            done.append(ready)
    return done + estimator.finish()


def numbers(done):
    return [
        (c.cycle.plan.cycle, p.index, p.stamp, *p.feedback, *p.approach, *p.displacement,
         *p.covariance.ravel(), p.readings)
        for c in done
        for p in c.cycle.points
    ]


def test_centres_are_the_displacements_made():
    plans = session()
    done = estimate(plans, *run(plans))
    assert [d.cycle.plan.cycle for d in done] == ['1a-nest', '1a-static']
    assert done[0].nest is not None and done[0].nest.residual < 2e-7
    cycle = done[1].cycle
    assert not cycle.missing and cycle.calibration == 's/1a-nest'
    for point in cycle.points:
        wanted = displacement(plans[1], point.index)
        np.testing.assert_allclose(point.displacement, wanted, atol=2.5e-7)
        assert point.readings >= 10
        assert plans[1].stamp <= point.stamp <= cycle.stamp


@pytest.mark.parametrize('seed', range(5))
def test_the_interleaving_of_the_topics_changes_no_bit(seed):
    plans = session(('1a', '1b'))
    feedback, blocks = run(plans)
    assert numbers(estimate(plans, feedback, blocks, seed)) == numbers(
        estimate(plans, feedback, blocks)
    )


def test_waiting_at_the_last_pose_changes_no_bit():
    # The second run starts its next plan late; the machine stands at the last pose meanwhile.
    plans = session()
    short = estimate(plans, *run(plans, wait=1.0, noise=0.0))
    feedback, blocks = run(plans, wait=4.0, noise=0.0)
    assert [row[:3] for row in numbers(short)] == [
        row[:3] for row in numbers(estimate(plans, feedback, blocks))
    ]


def waited(plans, feedback, blocks, seconds):
    """The same session where the first cycle begins later than its plan, the axes elsewhere."""
    first, shift = feedback[0], int(seconds * 1e9)
    away = replace(first, position=first.position + [0.0, 0.0, 0.05, 0.0, 0.0])
    before = [
        replace(away, stamp=T0 + k * 20_000_000) for k in range(int(seconds * 50) - 25)
    ]
    later = [
        [replace(one, stamp=one.stamp + shift) for one in some] for some in (feedback, blocks)
    ]
    plans = [plans[0], *(replace(p, stamp=p.stamp + shift) for p in plans[1:])]
    return plans, [*before, *later[0]], later[1]


def test_a_machine_that_is_started_minutes_later_changes_nothing_but_the_time():
    plans = session()
    feedback, blocks = run(plans)
    done = estimate(plans, feedback, blocks)
    late = estimate(*waited(plans, feedback, blocks, 300.0))
    for one, other in zip(done, late, strict=True):
        assert not other.cycle.missing
        for point, same in zip(one.cycle.points, other.cycle.points, strict=True):
            assert same.stamp == point.stamp + 300_000_000_000
            assert np.array_equal(same.displacement, point.displacement)
            # It has come from elsewhere: axes that had not moved before have.
            known = point.approach != 0
            assert np.array_equal(same.approach[known], point.approach[known])
    assert late[0].cycle.points[0].approach.tolist() == [0, 0, -1, 0, 0]


def test_nothing_piles_up_while_a_machine_is_waited_for():
    plans = session()
    feedback, blocks = run(plans)
    plans, feedback, _ = waited(plans, feedback, blocks, 300.0)
    estimator, most = Estimator(), 0
    estimator.add_plan(plans[0])
    for number in range(299 * 50):
        estimator.add_feedback(feedback[number])
        estimator.add_gauges(replace(blocks[0], stamp=feedback[number].stamp))
        assert estimator.finished() is None
        readings = sum(len(block.times) for block in estimator._gauges.blocks)
        most = max(most, len(estimator._feedback), readings // 10)
    # Readings are forgotten some blocks at a time.
    assert most <= 21 * 50 + 256
    assert estimator.progress()[1] == 0


def test_a_machine_that_leaves_the_last_pose_after_its_dwell_has_finished():
    """As at the end of an NC program, which moves the sphere out of the nest."""
    plans = session()
    feedback, blocks = run(plans, wait=plans[0].dwell)
    estimator, done = Estimator(), []
    # At the end of the dwell of each cycle 50 mm away, and there until the next one begins.
    last = {p.stamp: max(f.stamp for f in feedback if f.stamp < q) for p, q in zip(
        plans, [plans[1].stamp, 2**63], strict=True
    )}
    away = [
        replace(f, stamp=f.stamp + k * 20_000_000,
                position=f.position + [0.0, 0.0, 0.05, 0.0, 0.0])
        for f in feedback if f.stamp in last.values() for k in range(1, 200)
    ]
    more = [replace(blocks[-1], stamp=f.stamp) for f in away[::10]]
    items = [(f.stamp, estimator.add_feedback, f) for f in feedback + away]
    items += [(b.stamp, estimator.add_gauges, b) for b in blocks + more]
    estimator.add_plan(plans[0])
    estimator.add_plan(plans[1])
    for stamp, add, record in sorted(items, key=lambda item: item[0]):
        add(record)
        while (ready := estimator.finished()) is not None:
            done.append((ready.cycle, stamp))
    assert [len(cycle.points) for cycle, _ in done] == [28, 6]
    for (cycle, stamp), plan in zip(done, plans, strict=True):
        assert not cycle.missing and stamp - last[plan.stamp] < 1_000_000_000


def test_readings_that_lag_behind_the_feedback_end_the_cycle_all_the_same():
    plans = session()
    feedback, blocks = run(plans)
    estimator, ready = Estimator(), []
    items = [(f.stamp, estimator.add_feedback, f) for f in feedback]
    # Half a second late, as a batch on its way is.
    items += [(b.stamp + 500_000_000, estimator.add_gauges, b) for b in blocks]
    for plan in plans:
        estimator.add_plan(plan)
    for _, add, record in sorted(items, key=lambda i: i[0]):
        add(record)
        one = estimator.finished()
        if one is not None:
            ready.append((one.cycle.plan.cycle, record.stamp))
    assert [name for name, _ in ready] == ['1a-nest', '1a-static']
    # The nest calibration was ready before the next plan began.
    assert ready[0][1] < plans[1].stamp


def test_four_gauges_and_one_that_fails():
    plans = session()
    feedback, blocks = run(plans, channels=4)
    start = plans[1].stamp
    blocks = [
        replace(b, status=np.where(np.arange(4) == 3, 2, b.status).astype(np.uint8))
        if b.stamp > start + 1_000_000_000 else b
        for b in blocks
    ]
    cycle = estimate(plans, feedback, blocks)[1].cycle
    assert not cycle.missing
    for point in cycle.points:
        np.testing.assert_allclose(
            point.displacement, displacement(plans[1], point.index), atol=3e-7
        )
    assert cycle.points[0].disagreement > 0.0
    assert cycle.points[-1].disagreement == 0.0


@pytest.mark.parametrize(
    ('spoil', 'words'),
    [
        (lambda b: replace(b, displacement=b.displacement * np.nan), 'not a finite number'),
        (lambda b: replace(b, status=b.status + np.uint8(1)), 'out of range'),
        (lambda b: None, 'no gauge readings'),
    ],
)
def test_bad_readings_at_one_pose_cost_that_pose_only(spoil, words):
    plans = session()
    feedback, blocks = run(plans)
    begin = plans[1].stamp + 600_000_000  # pose 1 is reached 0.6 s after the start
    spoilt = [spoil(b) if begin <= b.stamp < begin + 300_000_000 else b for b in blocks]
    cycle = estimate(plans, feedback, [b for b in spoilt if b is not None])[1].cycle
    assert [m.index for m in cycle.missing] == [1]
    assert words in cycle.missing[0].reason
    assert len(cycle.points) == 5


def test_silent_gauges_do_not_stop_the_session():
    plans = session(('1a', '1b'))
    feedback, blocks = run(plans)
    quiet = [b for b in blocks if not plans[1].stamp <= b.stamp < plans[2].stamp]
    done = estimate(plans, feedback, quiet)
    assert len(done) == 4
    assert {m.reason for m in done[1].cycle.missing} == {'no gauge readings'}
    assert not done[3].cycle.missing


def test_a_cycle_that_is_never_finished_ends_when_the_next_begins():
    plans = session(('1a', '1b'))
    feedback, blocks = run(plans)
    cut = plans[1].stamp + 1_700_000_000
    keep = [f for f in feedback if not cut <= f.stamp < plans[2].stamp]
    done = estimate(plans, keep, blocks)
    assert [d.cycle.plan.cycle for d in done] == ['1a-nest', '1a-static', '1b-nest', '1b-static']
    assert [p.index for p in done[1].cycle.points] == [0, 1, 2]
    assert {m.index for m in done[1].cycle.missing} == {3, 4, 5}
    assert not done[3].cycle.missing


def standing_at_the_end(plan):
    """A session whose last cycle carries out `plan` and stays where it ends for 20 s."""
    nest = run([session()[0]])
    static = run([plan], wait=20.0, seed=1)
    return [*nest[0], *static[0]], [*nest[1], *static[1]]


@pytest.mark.parametrize('gauges_s', [-2.0, -0.4, 0.0])
@pytest.mark.parametrize('feedback_s', [-2.0, -0.4, 0.0])
def test_drivers_that_stop_one_after_the_other_cost_no_pose(gauges_s, feedback_s):
    """The last pose never comes; the machine stands at the one before until the session ends."""
    plans = session()
    driven = replace(plans[1], commands=plans[1].commands[:-1])
    feedback, blocks = standing_at_the_end(driven)
    end = feedback[-1].stamp
    feedback = [f for f in feedback if f.stamp <= end + feedback_s * 1e9]
    blocks = [b for b in blocks if b.stamp <= end + gauges_s * 1e9]
    cycle = estimate(plans, feedback, blocks)[1].cycle
    assert [p.index for p in cycle.points] == [0, 1, 2, 3, 4]
    assert [(m.index, m.reason) for m in cycle.missing] == [(5, 'never reached')]
    assert cycle.points[-1].readings >= 10


def test_gauges_that_fail_before_a_pose_are_its_reason_also_at_the_end():
    plans = session()
    driven = replace(plans[1], commands=plans[1].commands[:-1])
    feedback, blocks = standing_at_the_end(driven)
    # Pose 4 is reached after four dwells and moves of 0.3 s each, and a reading is missing.
    blocks = [b for b in blocks if b.stamp < plans[1].stamp + 2_300_000_000]
    cycle = estimate(plans, feedback, blocks)[1].cycle
    reasons = {m.index: m.reason for m in cycle.missing}
    assert reasons[4] == 'no gauge readings' and reasons[5] == 'never reached'


def test_feedback_that_fails_long_before_the_readings_is_stale():
    plans = session()
    feedback, blocks = standing_at_the_end(plans[1])
    feedback = [f for f in feedback if f.stamp < plans[1].stamp + 1_700_000_000]
    cycle = estimate(plans, feedback, blocks)[1].cycle
    assert all('stale' in m.reason for m in cycle.missing)
    assert {m.index for m in cycle.missing} == {3, 4, 5}


def test_without_a_calibration_every_pose_is_missing_for_that_reason():
    plan = static_plan(T0)
    done = estimate([plan], *run([plan]))
    assert not done[0].cycle.points
    assert {m.reason for m in done[0].cycle.missing} == {'no nest calibration of set-up 1a'}


def test_a_failed_calibration_is_said():
    plans = session()
    feedback, blocks = run(plans)
    dead = [replace(b, displacement=b.displacement * [1, 1, 0] + 1e-6) for b in blocks]
    done = estimate(plans, feedback, dead)
    assert done[0].nest is None and 'gauge 3' in done[0].problem
    assert not done[1].cycle.points


def test_frozen_feedback_is_stale_not_settled():
    plans = session()
    feedback, blocks = run(plans)
    frozen = plans[1].stamp + 400_000_000
    still = next(f for f in feedback if f.stamp >= frozen)
    stopped = [
        replace(f, stamp=still.stamp, position=still.position)
        if frozen <= f.stamp < frozen + 1_500_000_000 else f
        for f in feedback
    ]
    cycle = estimate(plans, stopped, blocks)[1].cycle
    assert 1 in {m.index for m in cycle.missing}
    assert all('stale' in m.reason for m in cycle.missing)


def test_memory_stays_bounded_without_a_plan():
    estimator = Estimator()
    feedback, blocks = run([replace(nest_plan(), dwell=5.0)])
    assert feedback[-1].stamp - feedback[0].stamp > 100e9
    for sample in feedback:
        estimator.add_feedback(sample)
    for block in blocks:
        estimator.add_gauges(block)
    assert len(estimator._feedback) < 25 * 50
    assert len(estimator._gauges.blocks) < 25 * 5


def test_a_dynamic_cycle_ends_at_the_last_of_its_poses():
    """The first and the last pose are one and the same: it does not end before it began."""
    plan = replace(static_plan(T0), kind=Kind.DYNAMIC, dwell=0.0)
    feedback, blocks = run([replace(plan, dwell=0.6)])
    (done,) = estimate([plan], feedback, blocks)
    assert (done.cycle.points, done.cycle.missing, done.problem) == ((), (), '')
    there = [np.abs(one.position - plan.commands[-1]).max() < 1e-4 for one in feedback]
    arrived = feedback[len(there) - there[::-1].index(False)].stamp
    assert 0.4e9 < done.cycle.stamp - arrived < 0.6e9


def test_a_dynamic_cycle_that_was_cut_short_says_what_it_never_reached():
    plan = replace(static_plan(T0), kind=Kind.DYNAMIC, dwell=0.0)
    feedback, blocks = run([replace(plan, dwell=0.6, commands=plan.commands[:-2])])
    (done,) = estimate([plan], feedback, blocks)
    rows = len(plan.commands)
    assert [(m.index, m.reason) for m in done.cycle.missing] == [
        (rows - 2, 'never reached'), (rows - 1, 'never reached')]


def test_of_a_cycle_measured_again_the_attempt_with_more_poses_counts():
    """The program was stopped after half of the nest, and started again from its beginning."""
    plans = session()
    feedback, blocks = run(plans)
    middle = plans[0].stamp + 8_000_000_000
    shift = 10_000_000_000
    early = [[one for one in some if one.stamp < middle] for some in (feedback, blocks)]
    stop = early[0][-1]
    early[0] += [replace(stop, stamp=stop.stamp + k * 20_000_000) for k in range(1, 100)]
    again = [
        [replace(one, stamp=one.stamp + shift) for one in some] for some in (feedback, blocks)
    ]
    repeated = [replace(plan, stamp=plan.stamp + shift) for plan in plans]
    done = estimate([plans[0], *repeated], early[0] + again[0], early[1] + again[1])
    assert [d.cycle.plan.cycle for d in done] == ['1a-nest', '1a-nest', '1a-static']
    assert 5 < len(done[0].cycle.points) < 28 == len(done[1].cycle.points)
    reasons = {m.reason for m in done[0].cycle.missing[1:]}
    assert reasons == {'never reached'}
    cycles = [d.cycle for d in done]
    assert counted(cycles) == cycles[1:] == counted([cycles[2], cycles[1], cycles[0]])
    worse = replace(cycles[2], points=cycles[2].points[:2],
                    plan=replace(cycles[2].plan, stamp=cycles[2].plan.stamp + shift))
    assert counted([*cycles, worse]) == cycles[1:]
