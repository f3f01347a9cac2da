"""Effects hidden in the simulated machine, against the library that looks for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtest_drivers.config import config_path
from rtest_drivers.sim.blind import Noise, make, setting
from rtest_drivers.sim.hidden import Hidden, directions, families
from rtest_drivers.sim.kinematics import follow
from rtest_identification.gap.effects import library
from rtest_identification.gap.model_file import Model, Value
from rtest_identification.gap.offline import gap_session
from rtest_identification.gap.projection import Projection
from rtest_identification.gap.rows import make_rows
from rtest_identification.gap.workflow import analyse
from rtest_identification.machine import load_machine
from rtest_identification.observations import stack
from rtest_identification.plans import diagnostic, static

MACHINE = load_machine(config_path('nmv1500dcg.yaml'))
SPHERES = {'1a': (0, -0.09, 0.0406), '1b': (0, -0.09, 0.1406), '2a': (0, 0, 0.0406),
           '2b': (0, 0, 0.1406)}
LEVELS = np.radians([-75, -50, -25, 0, 25, 50, 75])
EVEN = np.radians(np.arange(12) * 30)
UNEVEN = np.radians([0, 21, 55, 84, 118, 143, 180, 214, 239, 277, 301, 338])
PLANS = {
    'static': [static(MACHINE, s, np.array(p), LEVELS, EVEN) for s, p in SPHERES.items()],
    'diagnostic': [
        diagnostic(MACHINE, s, np.array(SPHERES[s]), LEVELS, UNEVEN) for s in ('1a', '2b')
    ],
}
FAMILIES = families(MACHINE)


def session(kind, hidden=(), delta=(), seed=1, **noise):
    rng = np.random.default_rng(seed)
    where = setting(MACHINE, PLANS[kind], rng)
    effects = [FAMILIES[key](rng, where.poses) for key in hidden]
    return make(where, effects, delta, Noise(2.5e-7, **noise), rng)


def analysed(blind, model=None):
    return gap_session(blind.machine, blind.cycles, blind.directions, model).result


@pytest.mark.parametrize('kind', PLANS)
def test_what_is_hidden_is_what_the_library_means(kind):
    # The cell's formula and exact transforms on one side, the library's columns on the other.
    known = None
    seen = 0
    for key in FAMILIES:
        blind = session(kind, [key], [10.0])
        if blind is None:
            continue
        if known is None:
            observations = stack(MACHINE, blind.cycles)
            rows = make_rows(observations, blind.cycles[0].plan.stamp, blind.directions)
            known = {effect.key: effect for effect in library(rows.scene)}
        (effect, _), (left,) = blind.hidden[0], blind.left
        shape = tuple(effect.parameters[name] for name in effect.shape)
        offered = replace(known[key], grid=(shape,))
        (candidate,) = Projection(rows, [offered]).candidates
        cosine = np.linalg.norm(candidate.basis.T @ left) / np.linalg.norm(left)
        # Gauges turn what the machine's errors fit, and these differ from session to session.
        if not key.startswith('gauge'):
            assert cosine > 0.999, key
            seen += 1
    assert seen > 55


def test_directions_of_the_last_motion():
    # B rises, then falls; C goes to and fro; the first pose was not moved to.
    commands = np.zeros((4, 5))
    commands[:, MACHINE.letters.index('B')] = [0.0, 0.1, 0.1, -0.2]
    commands[:, MACHINE.letters.index('C')] = [0.0, 0.0, 1.0, 0.5]
    sphere = np.array([0.0, 0.0, 0.1])
    signs = directions(MACHINE, follow(MACHINE, commands, sphere), sphere)
    assert signs[:, MACHINE.letters.index('B')].tolist() == [0, 1, 1, -1]
    assert signs[:, MACHINE.letters.index('C')].tolist() == [0, 0, 1, -1]
    # B up by 0.1 rad carries a sphere at z = 0.1 m to +x.
    assert signs[1, MACHINE.letters.index('X')] == 1


def test_noise_is_what_was_asked_for():
    clean = session('static', seed=3)
    rows = make_rows(stack(MACHINE, clean.cycles), clean.cycles[0].plan.stamp, clean.directions)
    # 0.25 um per dwell, and 0.1 um per reading through three gauges at 45 deg, ten readings.
    reading = 1e-7 / np.sqrt(10) * np.sqrt(np.trace(np.linalg.inv(
        sum(np.outer(v, v) for v in clean.directions['1a']))) / 3)
    assert np.sqrt(np.mean(rows.sigma**2)) == pytest.approx(
        np.hypot(2.5e-7, reading), rel=0.08
    )
    assert rows.correlation == 0.0 and not rows.odd.any()


@pytest.mark.parametrize('kind', PLANS)
def test_correlated_noise_is_seen_and_is_no_effect(kind):
    result = analysed(session(kind, seed=5, correlation=0.6))
    assert result.rows.correlation == pytest.approx(0.6, abs=0.15)
    assert result.verdict == 'no gap'
    # Of the noise of a pose, not of what is new in it.
    assert result.gap.noise == pytest.approx(2.5e-7, rel=0.15)


def test_a_pose_that_contradicts_others_is_left_out_and_told():
    blind = session('static', seed=6)
    cycle = blind.cycles[3]
    points = list(cycle.points)
    points[40] = replace(points[40], displacement=points[40].displacement + [0, 0, 8e-6])
    blind.cycles[3] = replace(cycle, points=tuple(points))
    result = analysed(blind)
    assert result.odd == (('1b-static', 40),) and result.verdict == 'no gap'


def test_an_error_that_a_model_leaves_out_is_named_and_freed():
    blind = session('static', seed=7)
    symbols = [s for s in blind.constants if s != 'E_X(0B)C']
    model = Model('without', MACHINE.name, {s: Value(0.0, None, '') for s in symbols})
    found = gap_session(blind.machine, blind.cycles, blind.directions, model)
    assert [f.effect.key for f in found.result.found] == ['location/E_X(0B)C']
    value, stddev = found.result.found[0].value[0], found.result.found[0].stddev[0]
    assert abs(value - blind.constants['E_X(0B)C']) < 4.0 * stddev
    assert 'E_X(0B)C' in found.model.values and not found.model.effects
    again = gap_session(blind.machine, blind.cycles, blind.directions, found.model)
    assert again.result.verdict == 'no gap'


def test_what_the_data_leave_open_has_no_uncertainty():
    # Tilts of C once a turn: those that turn with C are constant on the table.
    blind = session('diagnostic', ['coning/C.1'], [20.0], seed=8)
    (found,) = analysed(blind).found
    assert found.effect.key == 'coning/C.1'
    assert not np.isfinite(found.stddev).any()


@pytest.mark.parametrize('key', ['backlash/B', 'drift', 'nest-slip', 'gauge-gain/2', 'sag/B',
                                 'linear-cyclic/Y', 'angular-two-slope/C'])
def test_each_kind_of_effect_is_found_with_its_size(key):
    blind = session('diagnostic', [key], [25.0], seed=11)
    result = analysed(blind)
    (found,) = result.found
    assert result.verdict == 'explained' and key in (found.effect.key, *found.rivals)
    if found.effect.key == key:
        (effect, amplitude), = blind.hidden
        names = [p.name for p in (*found.effect.parameters, *found.effect.shape)]
        for name, value, stddev in zip(names, found.value, found.stddev, strict=True):
            scale = 1.0 if name in effect.shape else amplitude
            assert abs(value - scale * effect.parameters[name]) < 4.0 * stddev, name


def test_two_that_look_the_same_are_not_hidden_together():
    assert session('static', ['straightness/YX', 'angle/CX'], [10.0, 10.0]) is None


def test_an_effect_that_does_nothing_is_not_hidden():
    rng = np.random.default_rng(1)
    where = setting(MACHINE, PLANS['static'], rng)
    nothing = Hidden('', {'E_XC': np.ones(len(where.poses))})
    assert make(where, [nothing], [10.0], Noise(2.5e-7), rng) is None


def test_two_effects_that_stand_in_for_another_are_not_named():
    # Without the scale of X those of Y and Z together come close to it.
    blind = session('static', ['scale/X'], [25.0], seed=12)
    observations = stack(MACHINE, blind.cycles)
    start = blind.cycles[0].plan.stamp
    result = analyse(observations, start, blind.directions, without=('scale/X',))
    assert result.verdict == 'unknown effect' and not result.found


def test_numbers_of_a_model_that_do_not_hold_are_told():
    blind = session('static', ['scale/Y'], [20.0], seed=13)
    first = gap_session(blind.machine, blind.cycles, blind.directions)
    (scale,) = first.result.found
    assert scale.effect.key == 'scale/Y'
    other = session('static', seed=13)
    again = gap_session(other.machine, other.cycles, other.directions, first.model)
    # The constants are the same, the scale is not there.
    assert [d.name for d in again.result.differs] == ['scale/Y: e']
    (carried,) = again.result.carried
    assert abs(carried.value[0]) < 4.0 * carried.stddev[0]
    (entry,) = again.model.effects
    assert entry.parameters['e'].value == carried.value[0]


def test_constants_that_the_poses_leave_open_have_no_uncertainty():
    blind = session('diagnostic', seed=14)
    cycle = blind.cycles[1]
    part = replace(cycle, points=cycle.points[:12])
    found = gap_session(blind.machine, [blind.cycles[0], part], blind.directions)
    assert not np.isfinite(found.result.constants.stddev).all()
    left = [s for s, v in found.model.values.items() if v.stddev is None]
    assert 'E_A(0B)C' in left
