"""Corrected commands: by hand, by finite differences, and measured again in the simulated cell."""

from dataclasses import replace

import numpy as np
import pytest
from correction_case import (
    ANGLE,
    B_ONLY,
    BACKLASH,
    MACHINE,
    PLANS,
    RIGHT,
    SCALE,
    TRUTH,
    VALUES,
    WITHOUT_RUNOUT,
    B,
    C,
    X,
    Y,
    Z,
    at_pose,
    effect,
    identified,
    known_errors,
    measure,
    model,
    random_poses,
)
from scipy import stats

from rtest_drivers.config import config_path
from rtest_drivers.sim.errors import GeometricErrors
from rtest_drivers.sim.kinematics import follow, sphere_in_table
from rtest_estimation.errors import UserError
from rtest_identification.correction.known import of_field, of_model
from rtest_identification.correction.session import correct_plan
from rtest_identification.correction.step import POLE, axis_slopes, correct, deviation, pose
from rtest_identification.error_field import ErrorField
from rtest_identification.frustum import model_errors, sources
from rtest_identification.frustum.commands import command as cone_commands
from rtest_identification.frustum.thesis import frustum
from rtest_identification.gap.model_file import Model, Value
from rtest_identification.gap.user_effects import load_effects
from rtest_identification.machine import load_machine, parse_machine
from rtest_identification.pipeline import identify

MACHINES = [load_machine(config_path(f'{name}.yaml'))
            for name in ('nmv1500dcg', 'head_table', 'head_head')]


def errors_of(axis, letter, value, machine=MACHINE):
    errors = np.zeros((1, len(machine.letters), 6))
    errors[0, machine.letters.index(axis), 'ABCXYZ'.index(letter)] = value
    return errors


# --- signs by hand: a point w of the table is at Ry(B) Rz(C) w ---


@pytest.mark.parametrize(('axis', 'letter', 'size', 'b', 'place', 'expected'), [
    # The table stands 10 um too far along +X: so must the tool, wherever B is.
    ('B', 'X', 1e-5, 0.0, (0, 0, 0.1), {X: 1e-5}),
    ('B', 'X', 1e-5, RIGHT, (0, 0, 0.1), {X: 1e-5}),
    # C's shift turns with B: at 90 deg X of B's table is -Z of the machine.
    ('C', 'X', 1e-5, 0.0, (0, 0, 0.1), {X: 1e-5}),
    ('C', 'X', 1e-5, RIGHT, (0, 0, 0.1), {Z: -1e-5}),
    # B turned too far, or C: turn it back, nothing else.
    ('B', 'B', 2e-5, 0.0, (0.05, 0.02, 0.1), {B: -2e-5}),
    ('B', 'B', 2e-5, RIGHT, (0.05, 0.02, 0.1), {B: -2e-5}),
    ('C', 'C', 2e-5, RIGHT, (0.05, 0.02, 0.1), {C: -2e-5}),
    # Table tilted about X at B = 0: no axis turns it back, the point follows by a x r.
    ('B', 'A', 2e-5, 0.0, (0, 0, 0.1), {Y: -2e-6}),
    ('B', 'A', 2e-5, 0.0, (0, 0.05, 0), {Z: 1e-6}),
    # At B = 90 deg C turns about +X of the machine: it takes the tilt of B back entirely.
    ('B', 'A', 2e-5, RIGHT, (0.05, 0.02, 0.1), {C: -2e-5}),
    # A tilt of C about its X is one about -Z of the machine there, which is the tool's axis: it
    # is left, and the point at (0.1, 0.02, -0.05) follows by -a z x r.
    ('C', 'A', 2e-5, RIGHT, (0.05, 0.02, 0.1), {X: 4e-7, Y: -2e-6}),
    # X goes too far, by its scale say; the spindle's slide stands 20 urad off about Y.
    ('X', 'X', 3e-6, RIGHT, (0.05, 0.02, 0.1), {X: -3e-6}),
])
def test_the_correction_is_what_the_hand_finds(axis, letter, size, b, place, expected):
    found = correct(MACHINE, at_pose(place, b, 0.0), errors_of(axis, letter, size))
    change = np.zeros(5)
    change[list(expected)] = list(expected.values())
    assert found.change[0] == pytest.approx(change, abs=1e-10)
    assert found.after.shift == pytest.approx(np.zeros((1, 3)), abs=1e-10)


def test_what_no_five_axes_correct_is_said_with_its_size():
    tilted = correct(MACHINE, at_pose((0, 0, 0.1), 0.0, 0.0), errors_of('B', 'A', 2e-5))
    # The table tilts about +X, the tool as seen from it the other way.
    assert tilted.near_pole.all()
    assert tilted.after.tilt[0] == pytest.approx([-2e-5, 0, 0], abs=1e-11)
    spun = correct(MACHINE, at_pose((0, 0, 0.1), RIGHT, 0.0), errors_of('C', 'A', 2e-5))
    # About -Z of the machine, the tool the other way, about its own axis.
    assert not spun.near_pole.any()
    assert spun.after.spin[0] == pytest.approx(2e-5, abs=1e-11)
    assert spun.after.tilt[0] == pytest.approx(np.zeros(3), abs=1e-11)


def test_an_axis_that_counts_the_other_way_is_corrected_the_other_way():
    text = MACHINE.text.replace('sense: 1', 'sense: -1')
    machine = parse_machine(text)
    found = correct(machine, at_pose((0, 0, 0.1), 0.5, 0.0, machine), errors_of('B', 'B', 2e-5))
    assert found.change[0] == pytest.approx([0, 0, 0, 2e-5, 0], abs=1e-10)


# --- against the simulation's own kinematics ---


def reached(machine, positions, errors=None):
    """Point (n, 3) and axis (n, 3) of the tool by the simulation's transforms."""
    known = GeometricErrors({}, {}, errors) if errors else GeometricErrors({}, {})
    up = replace(machine, tool=machine.tool + [0.0, 0.0, 1.0])
    point = sphere_in_table(machine, positions, known)
    return point, sphere_in_table(up, positions, known) - point


class Same:
    """Errors (k, 6) that are the same everywhere."""

    def __init__(self, machine, errors):
        self.machine, self.errors = machine, errors

    @property
    def axes(self):
        return set(self.machine.letters)

    def of_axis(self, axis, positions):
        count = len(next(iter(positions.values())))
        return np.tile(self.errors[self.machine.letters.index(axis)], (count, 1))


@pytest.mark.parametrize('machine', MACHINES, ids=lambda machine: machine.name)
def test_slopes_are_finite_differences(machine):
    positions = random_poses(machine, 8, 1)
    point, axis = axis_slopes(machine, positions)
    for column in range(len(machine.letters)):
        step = np.zeros(len(machine.letters))
        step[column] = 1e-5
        high, low = (reached(machine, positions + s * step) for s in (1, -1))
        for slope, up, down in zip((point, axis), high, low, strict=True):
            assert slope[:, :, column] == pytest.approx((up - down) / 2e-5, abs=1e-9)


@pytest.mark.parametrize('machine', MACHINES, ids=lambda machine: machine.name)
def test_what_is_left_is_of_second_order(machine):
    positions = random_poses(machine, 40, 2)
    rng = np.random.default_rng(3)
    errors = rng.normal(size=(len(machine.letters), 6)) * 1e-4
    wanted = reached(machine, positions)
    sizes = []
    for scale in (1.0, 0.5):
        known = np.broadcast_to(scale * errors, (len(positions), *errors.shape))
        found = correct(machine, positions, known)
        ends = reached(machine, found.positions, Same(machine, scale * errors))
        before = reached(machine, positions, Same(machine, scale * errors))
        left = [np.linalg.norm(a - b, axis=1) for a, b in zip(ends, wanted, strict=True)]
        assert left[0].max() < 2e-3 * np.linalg.norm(before[0] - wanted[0], axis=1).max()
        assert left[1].max() < 2e-3 * np.linalg.norm(before[1] - wanted[1], axis=1).max()
        assert left[0] == pytest.approx(np.linalg.norm(found.after.shift, axis=1), abs=1e-12)
        assert left[1] == pytest.approx(np.linalg.norm(found.after.tilt, axis=1), rel=1e-3,
                                        abs=1e-10)
        sizes.append([one.max() for one in left])
    assert np.divide(*sizes) == pytest.approx([4.0, 4.0], rel=0.05)


def test_towards_a_pole_the_correction_fades_without_a_step():
    b = np.radians(np.linspace(-12.0, 12.0, 2401))
    rows = np.zeros((len(b), 5))
    rows[:, B], rows[:, C] = b, 0.3
    positions = follow(MACHINE, rows, np.array([0.05, 0.02, 0.1]))
    errors = np.broadcast_to(errors_of('B', 'A', 2e-5), (len(b), 5, 6))
    found = correct(MACHINE, positions, errors)
    left = np.linalg.norm(found.after.tilt, axis=1)
    assert left[~found.near_pole].max() < 1e-8 and left.max() <= 2e-5 * (1 + 1e-6)
    assert np.flatnonzero(found.near_pole).size == (np.abs(np.sin(b)) < POLE).sum()
    # No axis is asked for more than the tilt over the sine of 5 deg, nor for a jump.
    assert np.abs(found.change[:, C]).max() <= 2e-5 / POLE * (1 + 1e-3)
    assert np.abs(np.diff(found.change[:, C])).max() < 1e-2 * 2e-5 / POLE
    assert np.linalg.norm(found.after.shift, axis=1).max() < 1e-8


# --- what is known ---


CONE = cone_commands(MACHINE, frustum(15.0, (-81.8, 0.0, 189.3)).feature(90), 'negative')
EFFECTS = (
    SCALE, ANGLE, BACKLASH,
    effect('runout-grows/C', **{'A cos z': (3e-6, 'm'), 'A sin z': (-2e-6, 'm')}),
    effect('drift', [('tau', (80.0, 's'))], d_X=(1e-5, 'm'), d_Y=(0.0, 'm'), d_Z=(0.0, 'm')),
)


def tip_error(known, commands):
    errors = known.at(commands.positions, commands.approach)
    wanted, found = pose(MACHINE, commands.positions), pose(MACHINE, commands.positions, errors)
    return deviation(wanted, found).shift


def test_a_model_means_what_it_means_to_a_part():
    known = of_model(model(*EFFECTS, **VALUES), MACHINE)
    part = model_errors.of_model(CONE, model(*EFFECTS, **VALUES))
    assert tip_error(known, CONE) == pytest.approx(part.error, abs=5e-9)
    assert np.abs(part.error).max() > 1e-5
    assert any(note.startswith('drift is left out') for note in known.notes)


def test_effects_of_the_users_own_count_where_they_move_an_axis(tmp_path):
    (tmp_path / 'own.yaml').write_text("""
effects:
  - key: worm/B
    name: worm
    motions: {E_BB: 'p * sin(9 * B)'}
    parameters: {p: {unit: urad}}
  - key: sinking
    name: the table sinks
    table: {Z: 'g * B**2'}
    parameters: {g: {unit: um}}
""")
    more = load_effects(tmp_path / 'own.yaml', MACHINE)
    has = model(effect('worm/B', p=(3e-5, 'rad')), effect('sinking', g=(1e-6, 'm')))
    known = of_model(has, MACHINE, more)
    assert 'sinking is left out: it moves the table, no axis' in known.notes
    found = correct(MACHINE, CONE.positions, known.at(CONE.positions, CONE.approach))
    expected = -3e-5 * np.sin(9.0 * CONE.axis('B'))
    assert found.change[:, B] == pytest.approx(expected, abs=1e-9)


def test_a_model_of_another_machine_is_refused():
    with pytest.raises(UserError, match='is of machine'):
        of_model(replace(model(), machine='other'), MACHINE)
    with pytest.raises(UserError, match='E_Q'):
        of_model(Model('m', MACHINE.name, {'E_Q(0Y)B': Value(0.0, None, 'm')}), MACHINE)


# --- measured again in the simulated cell ---


def measure_again(truth, known, cycles):
    """Cycles with corrected commands: as encoders read them, and by the nominal commands."""
    plans, nominal = [], {}
    for plan in cycles:
        corrected, _ = correct_plan(known, plan)
        plans.append(corrected)
        nominal[corrected.cycle] = plan, corrected.commands - plan.commands
    read, believed = measure(truth, plans), []
    for cycle in read:
        plan, change = nominal[cycle.plan.cycle]
        points = tuple(replace(p, feedback=p.feedback - change[p.index]) for p in cycle.points)
        plan = replace(plan, stamp=cycle.plan.stamp, session='again')
        believed.append(replace(cycle, plan=plan, points=points))
    return read, believed


def left(result):
    """(n, 3) displacement but for the run-out and an offset of each cycle."""
    seen = result.observations
    rest = seen.displacement - seen.predict()[0]
    for number in range(len(seen.cycles)):
        mine = seen.cycle == number
        rest[mine] -= rest[mine].mean(axis=0)
    return rest


def chi_squared(value, covariance):
    """Probability of values as large by the uncertainty alone."""
    size, axes = np.linalg.eigh(covariance)
    good = size > 1e-6 * size.max()
    return stats.chi2.sf(((axes.T @ value)[good] ** 2 / size[good]).sum(), good.sum())


DWELL = TRUTH.gauges.dwell_noise


@pytest.fixture(scope='module')
def second():
    """The same machine measured with corrected commands, identified in both ways."""
    read, believed = measure_again(replace(B_ONLY, seed=7), known_errors(), WITHOUT_RUNOUT)
    return identify(MACHINE, read), identify(MACHINE, believed)


def test_measured_again_only_noise_is_left(second):
    _, believed = second
    assert not believed.missing and not believed.outliers
    assert np.sqrt(np.mean(left(identified()) ** 2)) > 1.5e-5
    # Stated noise: of a dwell in each direction, and of the mean of twelve readings of gauges at
    # right angles. On top of it the first session's noise, in as many directions as it fitted.
    sigma = np.hypot(DWELL, TRUTH.gauges.noise / np.sqrt(12))
    offsets = 3 * len(believed.observations.cycles)
    fitted = identified().location.rank - offsets + identified().fit.error_map.rank
    free = left(believed).size - offsets
    size = (left(believed) ** 2).sum() / sigma**2
    mean, spread = free + fitted, np.sqrt(2.0 * (free - fitted) + 8.0 * fitted)
    assert abs(size - mean) < 3.0 * spread


def test_identified_again_the_machine_has_no_errors(second):
    _, believed = second
    location, before = believed.location, identified().location
    assert chi_squared(location.value, location.covariance + before.covariance) > 0.01
    assert chi_squared(before.value, before.covariance) < 1e-100
    again, once = believed.fit.error_map, identified().fit.error_map
    both = again.covariance + once.covariance
    scale = np.repeat([p.scale for p in once.parameters], once.value.shape[1])
    assert chi_squared(again.value.ravel() / scale, both / np.outer(scale, scale)) > 0.01
    assert once.significance < 1e-100


def test_by_the_positions_of_the_encoders_the_machine_is_what_it_was(second):
    read, _ = second
    change = read.location.value - identified().location.value
    assert chi_squared(change, read.location.covariance + identified().location.covariance) > 0.01


def test_the_map_of_c_is_removed_to_what_is_known_of_it():
    result = identify(MACHINE, measure(TRUTH, PLANS))
    assert result.inner_map.significance < 0.01
    found = of_field(ErrorField.from_identification(result))
    believed = identify(MACHINE, measure_again(replace(TRUTH, seed=9), found, PLANS)[1])
    rest = left(believed)
    stated = 3.0 * DWELL**2 + np.mean(found.spread(believed.observations.positions) ** 2)
    assert 0.9 * 3.0 * DWELL**2 < np.mean((rest**2).sum(axis=1)) < 1.1 * stated
    assert stated < 3.0 * (2.0 * DWELL) ** 2


def test_a_field_means_what_it_means_to_a_part():
    field = ErrorField.from_identification(identified())
    cone = cone_commands(MACHINE, frustum(10.0, (0.0, -20.0, 80.0), 30.0, 80.0).feature(90))
    part = sources.of_field(cone, field)
    assert tip_error(known_errors(), cone) == pytest.approx(part.error, abs=1e-15)
    with pytest.raises(UserError, match='outside the measured stations'):
        known_errors().at(at_pose((0, 0, 0.1), 1.5, 0.0), np.zeros((1, 5)))
