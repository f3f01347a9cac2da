"""Motion, components, blocks and error motions of dynamic measurements, by hand-derived cases."""

from dataclasses import replace

import numpy as np
import pytest
from dynamic_machine import FAST, RADIUS, SLOW, SPHERE, Hidden, geometric, measurement
from independent import NMV, centre
from scipy import stats

from rtest_estimation.errors import UserError
from rtest_identification.dynamic.blocks import make_scene
from rtest_identification.dynamic.clocks import align
from rtest_identification.dynamic.effects import (
    REFERENCE_SPEED,
    clock_offset,
    decaying,
    encoder_library,
    friction_lag,
    gauge_library,
)
from rtest_identification.dynamic.error_motion import (
    STATIONS,
    centre_offset,
    lags,
    split,
    transients,
    turn_motions,
)
from rtest_identification.dynamic.motion import Readings, components, describe
from rtest_identification.dynamic.rows import cycle_shifts, encoder_rows, gauge_rows
from rtest_identification.machine import parse_machine

MACHINE = parse_machine(NMV)
FEEDS = ((5 * SLOW, 0.7), (FAST, 1.3))
QUIET = Hidden(noise=0.0, encoder=0.0)


def readings(hidden, feeds=FEEDS, seed=0, **options):
    return [
        Readings(f'cycle {k}', '1a', SPHERE, one['time'], one['centre'], one['feedback_time'],
                 one['feedback'])
        for k, one in enumerate(measurement(hidden, feeds, seed, **options))
    ]


def scene_of(hidden, feeds=FEEDS):
    cycles = readings(hidden, feeds)
    return make_scene(describe(MACHINE, cycles), cycles)


def test_components_of_the_c_axis():
    radius, frame = components(MACHINE, 'C', np.array([*SPHERE, 0.0, 0.0]))
    radial = SPHERE * [1, 1, 0] / RADIUS
    assert radius == pytest.approx(RADIUS, rel=1e-6)
    # The table turns counterclockwise and the sphere with it: tangential is z cross radial.
    np.testing.assert_allclose(frame, [radial, np.cross([0, 0, 1], radial), [0, 0, 1]], atol=1e-6)


def test_components_of_an_axis_that_carries_another():
    # B turned by hand: at C = 90 deg the table's +Y is the machine's -X.
    position = np.array([0.0, 0.0, 0.08, 0.0, np.pi / 2])
    radius, frame = components(MACHINE, 'B', position)
    assert radius == pytest.approx(0.08, rel=1e-6)
    # B turns +Z towards +X. In the machine: radial Z, tangential X, axial Y.
    np.testing.assert_allclose(frame, [[0, 0, 1], [0, -1, 0], [1, 0, 0]], atol=1e-6)


def test_a_table_that_turns_the_other_way():
    machine = parse_machine(NMV.replace('1, range_deg: [-360', '-1, range_deg: [-360'))
    _, frame = components(machine, 'C', np.array([*SPHERE, 0.0, 0.0]))
    radial = SPHERE * [1, 1, 0] / RADIUS
    np.testing.assert_allclose(frame, [radial, -np.cross([0, 0, 1], radial), [0, 0, 1]], atol=1e-6)


def test_a_sphere_on_the_axis_is_refused():
    with pytest.raises(UserError, match='nothing follows it'):
        components(MACHINE, 'C', np.array([0.0, 0.0, 0.04, 0.0, 0.0]))


def test_passes_are_found():
    motion = describe(MACHINE, readings(QUIET))
    assert motion.axis == 'C'
    assert [one.sign for one in motion.passes] == [1, -1, 1, -1]
    assert [one.reverses for one in motion.passes] == [False, True, False, True]
    np.testing.assert_allclose(motion.feeds, [5 * SLOW, FAST], rtol=1e-6)
    # The simulation rests for 0.5 s, then accelerates at 8 rad/s2; cycles are 5 s apart.
    assert motion.passes[0].start == pytest.approx(0.5, abs=0.004)
    first = motion.passes[2]
    length = 1.3 * 2 * np.pi / FAST + FAST / 8.0
    assert first.end - first.start == pytest.approx(length, abs=0.008)


def test_no_axis_or_two_axes_that_turn_are_refused():
    cycles = readings(QUIET)
    still = [replace(c, feedback=np.tile(c.feedback[:1], (len(c.feedback), 1))) for c in cycles]
    with pytest.raises(UserError, match='no rotary axis turns'):
        describe(MACHINE, still)
    both = cycles[0].feedback.copy()
    both[:, 3] = both[:, 4]
    with pytest.raises(UserError, match='B and C turns'):
        describe(MACHINE, [replace(cycles[0], feedback=both)])


def test_the_servo_part_is_what_the_encoders_say():
    # C late by m omega: the nest lies behind, the sphere before it by v m.
    scene = scene_of(replace(QUIET, mismatch=1e-4, start=0.0))
    steady = scene.steady
    # C turned back by m omega shows the sphere at w turned forward by it.
    np.testing.assert_allclose(
        scene.servo[steady, 1], RADIUS * np.sin(1e-4 * scene.omega[steady]), atol=2e-11
    )
    np.testing.assert_allclose(scene.servo[steady][:, [0, 2]], 0.0, atol=1e-9)


def test_an_offset_of_the_axis_is_once_a_turn_radial_and_tangential():
    # The axis 10 um towards +X: by the matrices, in the table frame, at every angle of C.
    scene = scene_of(QUIET)
    errors = {'C': {'X': 10e-6}}
    x, y, z = SPHERE
    shape = np.array([
        centre(x * np.cos(c) - y * np.sin(c), x * np.sin(c) + y * np.cos(c), z, 0.0, c, errors)
        - SPHERE
        for c in scene.angle
    ]) @ scene.motion.frame.T
    # Radial by hand: -10 um cos(where the sphere is), tangential a quarter turn apart.
    np.testing.assert_allclose(shape[:, 0], -10e-6 * np.cos(scene.machine_angle), atol=1e-9)
    np.testing.assert_allclose(shape[:, 1], 10e-6 * np.sin(scene.machine_angle), atol=1e-9)
    offset, circle = centre_offset(scene, shape)
    np.testing.assert_allclose(offset, [10e-6, 0.0], atol=1e-9)
    np.testing.assert_allclose(circle, shape, atol=1e-9)


def test_signatures_by_hand():
    scene = scene_of(QUIET)
    speed = scene.omega * RADIUS
    clock = clock_offset().columns(scene, ())[:, :, 0]
    np.testing.assert_allclose(clock, np.stack([0 * speed, speed, 0 * speed], axis=1), rtol=1e-6)
    sign = np.sign(scene.omega)
    steady = scene.steady
    lag = friction_lag().columns(scene, (0.0,))[:, 1, 0]
    np.testing.assert_allclose(lag[steady], -sign[steady])
    # At ten times the reference speed, with the square root, 3.16 times the lag.
    lag = friction_lag().columns(scene, (0.5,))[:, 1, 0]
    expected = -sign * np.sqrt(np.abs(speed) / REFERENCE_SPEED)
    np.testing.assert_allclose(lag[steady], expected[steady], rtol=1e-3)
    shrink = next(e for e in encoder_library(scene) if e.key == 'radius-shrink')
    np.testing.assert_allclose(
        shrink.columns(scene, ())[:, 0, 0], -0.5 * scene.omega**2 * RADIUS, rtol=1e-6
    )


def test_axes_reverse_where_the_sphere_is_at_their_ends():
    scene = scene_of(QUIET, ((FAST, 1.3),))
    # X reverses where the sphere is at the ends of its circle in X; from +X end it goes back.
    for when, sign in scene.reversals('X'):
        block = np.argmin(np.abs(scene.time - when))
        one = scene.motion.passes[scene.number[block]]
        if abs(when - one.start) < 0.05:
            continue
        angle = scene.machine_angle[block]
        assert abs(np.sin(angle)) < 0.04
        assert sign == -np.sign(np.cos(angle))
    assert scene.reversals('C') == [
        (pytest.approx(scene.motion.passes[1].start), -1.0)
    ]
    # From the -Y end after 90, 270 and 450 of 468 deg, each way, and where C itself turns round.
    assert len(scene.reversals('X')) == 2 * 3 + 1
    assert not scene.reversals('Z')


def test_a_spike_dies_away_by_its_time_constant():
    scene = scene_of(QUIET, ((FAST, 1.3),))
    (when, sign), = scene.reversals('C')
    decay = decaying(scene, [(when, sign)], 0.1)
    after = scene.time > when + 0.02
    # The mean of an exponential over a short block is nearly its value in the middle.
    expected = np.exp(-(scene.time[after] - when) / 0.1)
    np.testing.assert_allclose(decay[after, 1], expected, rtol=0.02, atol=1e-5)
    np.testing.assert_allclose(decay[:, 0], -decay[:, 1])
    assert not decay[scene.time < when - 0.1].any()


def test_late_features_by_finite_differences():
    hidden = replace(QUIET, start=0.0)
    scene = scene_of(hidden)
    rows = gauge_rows(scene)
    step = 1e-3
    shape = geometric(hidden)
    moved = (
        shape(np.mod(scene.angle - scene.omega * step, 2 * np.pi))
        - shape(np.mod(scene.angle + scene.omega * step, 2 * np.pi))
    ) @ scene.motion.frame.T / (2 * step)
    steady = scene.steady
    late = rows.base[:, :, 0]
    np.testing.assert_allclose(late[steady], moved[steady], atol=2e-8)
    assert np.abs(late[steady]).max() > 5e-6


def test_synchronous_and_asynchronous_error_motion_by_hand():
    scene = scene_of(QUIET, ((FAST, 2.5),))
    turn = np.floor((scene.angle - scene.angle[scene.steady][0]) / (2 * np.pi))
    values = np.zeros((len(scene), 3))
    # Three a turn with 2 um amplitude, and the second turn 1 um farther out.
    values[:, 0] = 2e-6 * np.cos(3 * scene.angle) + 1e-6 * (turn == 1)
    values[:, 2] = 0.5e-6 * np.sin(scene.angle)
    one = turn_motions(scene, values)[0]
    assert one.turns.shape == (2, STATIONS, 3)
    assert one.covered == 1.0
    # Means over 2 deg leave sinc(3 deg) of it.
    np.testing.assert_allclose(one.synchronous, [4e-6, 0.0, 1e-6], rtol=0.01, atol=1e-12)
    np.testing.assert_allclose(one.asynchronous[0], 1e-6, rtol=0.05)
    assert one.asynchronous[2] < 0.05e-6
    np.testing.assert_allclose(one.harmonics[[0, 1, 3], 0], [0.5e-6, 0.0, 2e-6], atol=3e-8)
    assert one.harmonics[1, 2] == pytest.approx(0.5e-6, rel=0.01)


def test_a_pass_of_less_than_a_turn_has_no_error_motion():
    scene = scene_of(QUIET, ((FAST, 0.7),))
    assert turn_motions(scene, scene.measured) == ()


def test_the_split_gives_back_what_was_put_in():
    hidden = Hidden(mismatch=5e-5, lag={round(FAST, 6): 4e-6})
    scene = scene_of(hidden, ((5 * SLOW, 1.2), (FAST, 2.2)))
    mismatch = next(e for e in encoder_library(scene) if e.key == 'servo-mismatch/C')
    parts = split(gauge_rows(scene), encoder_rows(scene, [(mismatch, ())]))
    steady = scene.steady
    whole = parts.servo + parts.geometric + parts.dynamic
    np.testing.assert_allclose(parts.measured[steady], whole[steady], atol=1e-9)
    servo = scene.omega * RADIUS * 5e-5
    assert np.abs(parts.servo[steady, 1] - servo[steady]).max() < 0.03e-6
    # Twice a turn 1.5 um radially, once a turn a tilt of 20 urad at the sphere's radius axially.
    assert np.ptp(parts.geometric[steady, 0]) == pytest.approx(3e-6, rel=0.03)
    assert np.ptp(parts.geometric[steady, 2]) == pytest.approx(4e-5 * RADIUS, rel=0.03)
    np.testing.assert_allclose(parts.centre_offset, [12e-6, -7e-6], atol=1e-6)


def test_the_spike_at_the_start_is_seen_by_both():
    scene = scene_of(Hidden())
    found = transients(scene, split(gauge_rows(scene), encoder_rows(scene)))
    assert [one.reverses for one in found] == [False, True, False, True]
    fast = found[2]
    # 5 um exp(-t/50 ms) sin(2 pi 15 Hz t): the first peak, after 14.5 ms, is 3.66 um; where C is
    # ahead the sphere is behind.
    assert fast.peak[0] == pytest.approx(-3.66e-6, abs=0.4e-6)
    assert fast.peak[1] == pytest.approx(-3.66e-6, abs=0.1e-6)
    assert 0.05 < fast.settled < 0.2


def test_the_stated_uncertainty_is_the_scatter():
    """Monte Carlo: time offset and lags of 6 measurements against their stated deviation."""
    drift, late = 2e-7, 2.5e-3
    lag = {round(5 * SLOW, 6): 1e-6, round(FAST, 6): 2e-6}
    feeds = ((5 * SLOW, 0.4), (FAST, 0.8))
    offsets, found = [], []
    for seed in range(6):
        cycles = readings(Hidden(late=late, lag=lag, drift=drift), feeds, seed)
        scene, offset = align(describe(MACHINE, cycles), cycles)
        offsets.append((offset.value - late) / offset.stddev)
        for one, truth in zip(lags(gauge_rows(scene), encoder_rows(scene)), lag.values(),
                              strict=True):
            found.append((one.beyond[0] - truth) / one.beyond[1])
    for normal in (offsets, found):
        low, high = stats.chi2.ppf([0.001, 0.999], len(normal))
        assert low < np.sum(np.square(normal)) < high


@pytest.mark.parametrize('drift', [0.0, 3e-7])
def test_the_strength_of_a_random_drift_is_found(drift):
    noise = gauge_rows(scene_of(Hidden(drift=drift), ((5 * SLOW, 1.2), (FAST, 2.2)))).noise
    assert noise.drift == pytest.approx(drift, rel=0.3)


def test_whitened_noise_is_white():
    cycles = readings(Hidden(drift=2e-7, errors={}, runout2=0.0, start=0.0))
    rows = gauge_rows(make_scene(describe(MACHINE, cycles), cycles))
    y = rows.white(rows.residual)
    freedom = len(y) - rows.basis.shape[1]
    # To within what the scale of the noise is uncertain by, which is itself estimated.
    assert (y @ y) / freedom == pytest.approx(1.0, abs=0.1)
    steps = y.reshape(-1, 3)
    # The drift is known at its knots; between them a little of it stays, of 0.9 before whitening.
    assert abs((steps[1:] * steps[:-1]).sum() / (steps**2).sum()) < 0.1
    raw = rows.value / rows.sigma[:, None]
    raw = raw - raw.mean(axis=0)
    assert (raw[1:] * raw[:-1]).sum() / (raw**2).sum() > 0.8


@pytest.mark.parametrize('late', [-0.2, 0.03])
def test_clocks_that_are_far_apart_are_found(late):
    cycles = readings(Hidden(late=late))
    _, offset = align(describe(MACHINE, cycles), cycles)
    assert abs(offset.value - late) < 5 * offset.stddev
    assert offset.stddev < 0.3e-3


def test_one_direction_at_constant_speed_does_not_show_the_clocks():
    cycles = readings(Hidden(start=0.0), ((FAST, 1.5),))
    one = cycles[0]
    # From well within the first pass to well before its end.
    length = 1.5 * 2 * np.pi / FAST
    chosen = (one.time > 1.0) & (one.time < length - 0.5)
    logged = (one.feedback_time > 0.9) & (one.feedback_time < length - 0.4)
    part = replace(one, time=one.time[chosen], centre=one.centre[chosen],
                   feedback_time=one.feedback_time[logged], feedback=one.feedback[logged])
    _, offset = align(describe(MACHINE, [part]), [part])
    assert not offset.determined
    assert 'no start, stop, reversal or second speed' in offset.why


def test_a_gap_in_the_readings_is_no_pass():
    cycles = readings(QUIET)
    one = cycles[0]
    none = replace(one, time=one.time[:20], centre=one.centre[:20])
    with pytest.raises(UserError, match='valid gauge readings while C turns'):
        make_scene(describe(MACHINE, [none]), [none])


def test_every_cycle_has_a_zero_of_its_own():
    """The nest a little elsewhere in the second cycle changes nothing but the zero."""
    lag = {round(5 * SLOW, 6): 1e-6, round(FAST, 6): 2e-6}
    cycles = readings(Hidden(lag=lag))
    moved = [cycles[0], replace(cycles[1], centre=cycles[1].centre + [3e-7, 2e-7, -4e-7])]
    one, other = (make_scene(describe(MACHINE, c), c) for c in (cycles, moved))
    rows, same = gauge_rows(one), gauge_rows(other)
    np.testing.assert_allclose(rows.residual, same.residual, atol=1e-11)
    for a, b in zip(
        lags(rows, encoder_rows(one)), lags(same, encoder_rows(other)), strict=True
    ):
        assert a.gauges[0] == pytest.approx(b.gauges[0], abs=1e-11)


def test_a_cycle_of_one_direction_keeps_its_lag():
    """Its tangential zero is not free: it would be the lag itself."""
    both = readings(Hidden(), ((FAST, 0.7),))[0]
    turns = np.argmax(both.feedback[:, 4])
    halves = [slice(0, turns), slice(turns, None)]
    single = []
    for number, half in enumerate(halves):
        logged = both.feedback_time[half]
        read = (both.time >= logged[0]) & (both.time <= logged[-1])
        single.append(replace(
            both, cycle=str(number), time=both.time[read], centre=both.centre[read],
            feedback_time=logged, feedback=both.feedback[half],
        ))
    for cycles, columns in (([both], 0), (single, 2)):
        scene = make_scene(describe(MACHINE, cycles), cycles)
        assert cycle_shifts(scene).shape[2] == columns
        (found,) = lags(gauge_rows(scene), encoder_rows(scene))
        assert found.gauges[1] < 0.1e-6


def test_touching_probes_alone_have_friction():
    scene = scene_of(QUIET)
    laser = replace(scene, contact=False)
    assert 'friction-lag' in {e.key for e in gauge_library(scene)}
    assert 'friction-lag' not in {e.key for e in gauge_library(laser)}
