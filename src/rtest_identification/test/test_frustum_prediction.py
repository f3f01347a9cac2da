"""What a machine does to a feature, from a session or a model, against plain matrices."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from independent import NMV, SETUPS, B, C, centre, nest_cycle, noisy, static_cycle

from rtest_estimation.errors import UserError
from rtest_estimation.recording import read_recording
from rtest_identification.error_field import ErrorField
from rtest_identification.field_maps import InnerMap, OuterMap
from rtest_identification.field_sources import Sources
from rtest_identification.frustum.commands import command
from rtest_identification.frustum.cone import Frustum
from rtest_identification.frustum.contour import response
from rtest_identification.frustum.feature import Feature
from rtest_identification.frustum.model_errors import of_model
from rtest_identification.frustum.prediction import diagnosis, form, predict_form, rank
from rtest_identification.frustum.sources import of_field, of_sizes
from rtest_identification.frustum.thesis import CASES, frustum
from rtest_identification.gap.model_file import Model, ModelEffect, Value
from rtest_identification.machine import parse_machine
from rtest_identification.offline import estimate_recording
from rtest_identification.output import as_dict
from rtest_identification.pipeline import identify
from rtest_identification.symbols import location_parameters, map_parameters

BAGS = Path(__file__).resolve().parents[3] / 'bags'
MACHINE = parse_machine(NMV)
CONE = CASES['a']
MADE = command(MACHINE, CONE.feature())
# Table 6-8, and coning of C that grows with B to 0.005 deg at 90 deg (6.6.3).
TABLE_6_8 = {
    'B': {'A': np.radians(0.0005), 'B': np.radians(0.0001), 'C': np.radians(0.0001)},
    'C': {'A': np.radians(-0.0006), 'X': 2.1e-6},
}


def coning(b, c):
    size = np.radians(0.005) * np.abs(b) / (np.pi / 2)
    errors = {axis: dict(values) for axis, values in TABLE_6_8.items()}
    errors['C']['A'] += size * np.cos(c)
    errors['C']['B'] = size * np.sin(c)
    return errors


def true_error(made, errors_at):
    """Error of the tool tip (n, 3) by plain matrices."""
    tips = [centre(*row, errors_at(row[3], row[4])) for row in made.positions]
    return np.array(tips) - made.feature.tip


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


@pytest.fixture(scope='module')
def session():
    rng = np.random.default_rng(1)
    cycles = []
    for setup in SETUPS:
        cycles += [nest_cycle(setup), noisy(static_cycle(setup, coning), 2.5e-7, rng)]
    return identify(MACHINE, cycles)


@pytest.fixture(scope='module')
def found(session, tmp_path_factory):
    folder = tmp_path_factory.mktemp('identification')
    path = folder / 'identification.json'
    path.write_text(json.dumps(as_dict(session)))
    field = ErrorField.from_json(path, MACHINE)
    return predict_form(MADE, of_field(MADE, field), CONE)


def test_the_map_explains_what_location_errors_do_not(found):
    true = form(MADE, true_error(MADE, coning), CONE)
    # Fig. 6-9: location errors do next to nothing, the map does nearly all.
    assert found.constant.deviation < 0.3 * true.deviation
    assert rms(true.profile - found.constant.profile) > 0.9 * rms(true.profile)
    assert rms(true.profile - found.form.profile) < 0.3 * rms(true.profile)
    # And within what it says of its own uncertainty.
    assert abs(found.form.deviation - true.deviation) < 2.0 * found.stddev
    assert abs(found.form.zone - true.zone) < 2.0 * found.zone_stddev
    assert np.mean(
        np.abs(true.profile - found.form.profile) < 2.0 * found.profile_stddev
    ) > 0.9
    assert found.stddev < 0.2 * true.deviation


def test_a_recorded_session_explains_it_too():
    """Section 6.6: the bag's cell has Table 6-8 and the coning, made by the simulated cell."""
    recording = read_recording(BAGS / 'coning')
    cycles = [one.cycle for one in estimate_recording(recording)]
    session = identify(MACHINE, cycles)
    assert not session.missing
    found = predict_form(MADE, of_field(MADE, ErrorField.from_identification(session)), CONE)
    true = form(MADE, true_error(MADE, coning), CONE)
    assert found.constant.deviation < 0.4 * true.deviation
    left = [rms(true.profile - one.profile) for one in (found.form, found.constant)]
    assert left[0] < 0.4 * left[1]
    assert abs(found.form.deviation - true.deviation) < 2.0 * found.stddev
    assert np.mean(
        np.abs(true.profile - found.form.profile) < 2.0 * found.profile_stddev
    ) > 0.9
    assert 'most of it tilt of C' in diagnosis(found)


def test_the_tilt_of_c_is_named(found):
    assert {one.name for one in found.ranking[:2]} == {'E_A(B)C', 'E_B(B)C'}
    assert 'most of it tilt of C' in diagnosis(found)
    # The two components of the motion partly cancel.
    tilt = found.motions['tilt of C']
    assert tilt == pytest.approx(found.varying.deviation, rel=0.3)
    assert tilt < found.ranking[0].alone
    # Without it the circle would be worse or better, not the same; it is no constant.
    assert all(not one.constant and one.standard is None for one in found.ranking[:2])
    by_name = {one.name: one for one in found.ranking}
    # 0.01 deg of it: Table 6-2.
    assert 1e6 * by_name['E_A(0B)C'].standard == pytest.approx(11.8, abs=0.05)


def test_parts_add_up(session):
    errors = of_field(MADE, ErrorField.from_identification(session))
    normal = MADE.feature.normal
    total = np.einsum('ni,ni->n', normal, errors.error)
    np.testing.assert_allclose(sum(p.deviation for p in errors.parts), total, atol=2e-8)
    constant = np.einsum('ni,ni->n', normal, errors.constant_error)
    alone = sum(p.deviation for p in errors.parts if p.constant)
    np.testing.assert_allclose(alone, constant, atol=2e-8)


def test_the_scatter_is_that_of_the_error_field(session):
    field = ErrorField.from_identification(session)
    errors = of_field(MADE, field, trials=4000)
    covariance = field.at(MADE.positions).covariance
    normal = MADE.feature.normal
    want = np.sqrt(np.einsum('ni,nij,nj->n', normal, covariance, normal))
    np.testing.assert_allclose(errors.draws.std(axis=0), want, rtol=0.08)


def exact_sources(constants, outer_z, covariance):
    """An identification without maps of C: constants, and a Z of B at its stations."""
    parameters = location_parameters(MACHINE)
    value = np.array([constants.get(p.symbol, 0.0) for p in parameters])
    outer = map_parameters(MACHINE, 'B')
    values = np.zeros((6, len(B)))
    values[2] = outer_z
    size = len(parameters) + values.size
    full = np.zeros((size, size))
    full[: len(parameters), : len(parameters)] = covariance
    return Sources(parameters, value, full, OuterMap('B', outer, B, values), None, ())


def test_an_exact_identification_is_predicted_exactly():
    constants = {'E_X(0B)C': 12e-6, 'E_A(0Y)B': 4e-5, 'E_B(0X)Z': -3e-5}
    field = ErrorField.of(MACHINE, exact_sources(constants, 5e-6 * B**2, np.zeros((11, 11))))

    def errors_at(b, c):
        return {
            'C': {'X': 12e-6}, 'B': {'A': 4e-5, 'Z': 5e-6 * b**2}, 'Z': {'B': -3e-5},
        }

    errors = of_field(MADE, field)
    want = true_error(MADE, errors_at)
    np.testing.assert_allclose(errors.error, want, atol=2e-10)
    predicted = predict_form(MADE, errors, CONE)
    assert predicted.stddev < 1e-12 and predicted.floor < 1e-12
    # Z of B is not felt by a cone at all (Table 6-3).
    by_name = {one.name: one.alone for one in predicted.ranking}
    assert by_name['E_Z(Y)B'] < 1e-12 < by_name['E_X(0B)C']


def test_uncertainty_of_one_error_by_hand():
    parameters = location_parameters(MACHINE)
    covariance = np.zeros((11, 11))
    place = [p.symbol for p in parameters].index('E_A(0B)C')
    covariance[place, place] = np.radians(0.001) ** 2
    field = ErrorField.of(
        MACHINE, exact_sources({'E_A(0B)C': np.radians(0.01)}, 0.0 * B, covariance)
    )
    found = predict_form(MADE, of_field(MADE, field), CONE)
    # Circularity is proportional to the one error: 11.8 µm per 0.01 deg.
    assert 1e6 * found.form.deviation == pytest.approx(11.77, abs=0.02)
    assert found.stddev == pytest.approx(0.1 * found.form.deviation, rel=0.06)
    # Half-normal mean of |N(0, 0.1 G)|.
    assert found.floor == pytest.approx(
        0.1 * found.form.deviation * np.sqrt(2 / np.pi), rel=0.08
    )


def test_what_is_not_determined_is_said_where_it_matters():
    sources = exact_sources({}, 0.0 * B, np.zeros((11, 11)))
    lost = ErrorField.of(MACHINE, replace(sources, undetermined=('E_X(0B)C', 'E_Z(0Y)B')))
    notes = of_field(MADE, lost).notes
    assert any('E_X(0B)C was not determined' in note and '1.71 µm' in note for note in notes)
    # A cone does not feel Z of B.
    assert not any('E_Z(0Y)B' in note for note in notes)


def test_outside_the_stations_is_refused():
    steep = command(MACHINE, CASES['b'].feature())
    field = ErrorField.of(MACHINE, exact_sources({}, 0.0 * B, np.zeros((11, 11))))
    with pytest.raises(UserError, match='outside the measured stations'):
        of_field(steep, field)


def test_a_map_not_determined_does_not_take_the_constant_with_it():
    sources = exact_sources({'E_X(0B)C': 1e-5}, 0.0 * B, np.zeros((11, 11)))
    shape = (6, len(B), len(C))
    value = np.zeros(shape)
    value[0] = np.nan
    inner = InnerMap('C', map_parameters(MACHINE, 'C'), B, C, value,
                     np.zeros((len(B), len(C), 6, 6)))
    errors = of_field(MADE, ErrorField.of(MACHINE, replace(sources, inner=inner)))
    want = true_error(MADE, lambda b, c: {'C': {'X': 1e-5}})
    np.testing.assert_allclose(errors.error, want, atol=1e-12)
    assert any('E_X(B)C was not determined' in note for note in errors.notes)


def model_of(key, parameters, values=None):
    values = {k: Value(v, 1e-7, u) for k, (v, u) in (values or {}).items()}
    given = {k: Value(v, 0.1 * abs(v), u) for k, (v, u) in parameters.items()}
    return Model('made', 'NMV', values, (ModelEffect(key, given),))


A, Z0 = 1e-5, 0.7
MODELS = {
    'run-out that grows': (
        model_of(
            'runout-grows/C',
            {'A cos z': (A * np.cos(Z0), 'm'), 'A sin z': (A * np.sin(Z0), 'm')},
            {'E_X(0B)C': (5e-6, 'm')},
        ),
        lambda b, c: {'C': {
            'X': 5e-6 + A * np.cos(c + Z0) * abs(b) / (np.pi / 2),
            'Y': A * np.sin(c + Z0) * abs(b) / (np.pi / 2),
        }},
    ),
    # An order that a path with C swinging by 62 deg would not offer.
    'three lobes of C': (
        model_of('radial/C.3', {
            'a_X': (4e-6, 'm'), 'b_X': (0.0, 'm'), 'a_Y': (0.0, 'm'), 'b_Y': (-2e-6, 'm'),
        }),
        lambda b, c: {'C': {'X': 4e-6 * np.cos(3 * c), 'Y': -2e-6 * np.sin(3 * c)}},
    ),
    'sag of B': (
        model_of('sag/B', {'g': (8e-6, 'm')}),
        lambda b, c: {'B': {'Z': 8e-6 * (np.cos(b) - 1)}},
    ),
    'scale of B': (
        model_of('angular-scale/B', {'s': (1e-4, 'rad/rad')}),
        lambda b, c: {'B': {'B': 1e-4 * b}},
    ),
}  # fmt: skip


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize('name', MODELS)
def test_a_model_file_is_predicted(name, case):
    model, errors_at = MODELS[name]
    made = command(MACHINE, CASES[case].feature(90))
    errors = of_model(made, model)
    np.testing.assert_allclose(errors.error, true_error(made, errors_at), atol=2e-8)
    # 10 % of the one effect is its own part's scatter.
    if not model.values and len(model.effects[0].parameters) == 1:
        spread = errors.draws.std(axis=0)
        np.testing.assert_allclose(
            spread, 0.1 * np.abs(errors.parts[0].deviation), rtol=0.08, atol=1e-12
        )


def test_backlash_follows_the_motion_along_the_path():
    error = of_model(MADE, model_of('backlash/B', {'h': (2e-5, 'rad')})).error
    # B rises from the start to the middle of the path and falls back.
    for row, sign in ((5, 1), (170, 1), (190, -1), (355, -1)):
        turned = centre(*MADE.positions[row], {'B': {'B': 1e-5 * sign}})
        np.testing.assert_allclose(error[row], turned - MADE.feature.tip[row], atol=2e-9)


def part(feature, rows):
    return Feature('part', feature.tip[rows], feature.axis[rows], feature.normal[rows])


def test_an_uncertain_shape_scatters():
    length = 0.03
    effect = ModelEffect(
        'linear-cyclic/X', {'p': Value(5e-6, None, 'm'), 'q': Value(0.0, None, 'm')},
        {'L': Value(length, 0.01 * length, 'm')},
    )
    spread = of_model(MADE, Model('made', 'NMV', {}, (effect,)), trials=4000).draws.std(axis=0)
    # d/dL of p cos(2 pi x / L), times 1 % of L.
    phase = 2 * np.pi * MADE.axis('X') / length
    slope = 5e-6 * np.sin(phase) * phase * 0.01
    column = response(MADE)[:, 6 * MACHINE.letters.index('X') + 3]
    np.testing.assert_allclose(spread, np.abs(slope * column), rtol=0.2, atol=2e-8)


@pytest.mark.parametrize(
    ('model', 'match'),
    [
        (Model('m', 'other'), 'is of machine'),
        (Model('m', 'NMV', {'E_Q(0Y)B': Value(0.0, None, 'm')}), 'no such error'),
        (Model('m', 'NMV', {'E_X(0B)C': Value(0.0, None, 'rad')}), 'unit'),
        (model_of('scale/Q', {'e': (1e-6, 'm/m')}), 'no effect'),
        (model_of('scale/X', {'f': (1e-6, 'm/m')}), 'no parameter'),
    ],
)
def test_models_of_something_else_are_refused(model, match):
    with pytest.raises(UserError, match=match):
        of_model(MADE, model)


@pytest.mark.parametrize('key', ['drift', 'nest-slip', 'gauge-gain/1', 'angular-two-slope/B'])
def test_what_says_nothing_of_a_part_is_left_out(key):
    errors = of_model(MADE, model_of(key, {}, {'E_X(0B)C': (1e-5, 'm')}))
    assert [part.name for part in errors.parts] == ['E_X(0B)C']
    assert any(note.startswith(f'{key} is left out') for note in errors.notes)


def test_every_error_in_one_size():
    ranked = rank(MADE, of_sizes(MADE))
    by_name = {one.name: one for one in ranked}
    assert [one.alone for one in ranked] == sorted((one.alone for one in ranked), reverse=True)
    # Table 6-2, and what it says is not felt.
    assert 1e6 * by_name['E_A(0B)C'].alone == pytest.approx(11.8, abs=0.05)
    assert by_name['E_C(0Y)B'].alone < 1e-12
    # 10 µm in 100 mm of X against plain matrices.
    want = form(MADE, true_error_with(lambda row: {'X': {'X': 1e-4 * row[0]}}), CONE)
    assert by_name['scale/X'].alone == pytest.approx(want.deviation, rel=1e-3)
    assert by_name['scale/X'].size == '10 µm per 100 mm'
    # Nothing of the instrument, and nothing faster than twice a turn.
    assert not [name for name in by_name if name.startswith('gauge') or name.endswith('.3')]
    assert all(one.without is None for one in ranked)


def true_error_with(errors_of):
    tips = [centre(*row, errors_of(row)) for row in MADE.positions]
    return np.array(tips) - MADE.feature.tip


def test_a_part_displaced_as_a_whole_has_no_form():
    rng = np.random.default_rng(2)
    shift, turn = 1e-5 * rng.normal(size=3), 1e-4 * rng.normal(size=3)
    for feature in (MADE.feature, part(MADE.feature, np.arange(100))):
        moved = shift + np.cross(turn, feature.tip)
        deviation = np.einsum('ni,ni->n', feature.normal, moved)
        assert feature.form_deviation(deviation) < 1e-12
        assert np.ptp(deviation) > 1e-6
    # A cone shows four of the six: size, two shifts; nothing of turns about where normals meet.
    assert MADE.feature.placements.shape[1] == 3


def test_section_and_ball_bar_by_hand():
    cone = Frustum(0.0, np.radians(30.0), 0.1, (0.0, 0.0, 0.0))
    tip = cone.feature(4).tip
    np.testing.assert_allclose(tip[0], [0.05, 0, 0.05 * np.tan(np.radians(30))])
    assert cone.bar_length == pytest.approx(0.05 / np.cos(np.radians(30)))
    np.testing.assert_allclose(cone.bar_reading(tip), 0.0, atol=1e-15)
    # A tip 10 µm out and one 10 µm up: e_r + e_z tan psi in the section, their part along the
    # bar in the reading.
    out, up = tip + [1e-5, 0, 0], tip + [0, 0, 1e-5]
    assert cone.section(out)[0, 0] == pytest.approx(0.05 + 1e-5, abs=1e-12)
    assert cone.section(up)[0, 0] == pytest.approx(0.05 + 1e-5 * np.tan(np.radians(30)), abs=1e-12)
    assert cone.bar_reading(out)[0] == pytest.approx(1e-5 * np.cos(np.radians(30)), abs=2e-9)
    assert cone.bar_reading(up)[0] == pytest.approx(1e-5 * np.sin(np.radians(30)), abs=2e-9)
    # Along the surface nothing changes; tilted by 90 deg the cone's axis is -X.
    along = tip[0] + 1e-3 * np.array([-np.sin(np.radians(30)), 0, np.cos(np.radians(30))])
    np.testing.assert_allclose(cone.section(along[None])[0], [0.05, 0], atol=1e-15)
    lying = frustum(90.0, (0.0, 0.0, 0.0), 30.0, 100.0)
    height = 0.05 * np.tan(np.radians(30))
    np.testing.assert_allclose(lying.circle_centre, [-height, 0, 0], atol=1e-15)


def test_ball_bar_and_part_see_the_same():
    deviation = true_error(MADE, lambda b, c: {'B': {'A': np.radians(0.01)}})
    found = form(MADE, deviation, CONE)
    assert 1e6 * found.deviation == pytest.approx(9.06, abs=0.01)
    assert found.bar == pytest.approx(found.deviation * np.cos(np.radians(30)), rel=1e-4)
    assert found.zone < found.deviation
    # The general feature has no circles, and its deviation counts along the normal.
    general = form(MADE, deviation)
    assert general.zone is None and general.bar is None
