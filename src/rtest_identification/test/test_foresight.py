"""What is said before measuring, against what the fit says afterwards, and by hand."""

from dataclasses import replace

import numpy as np
import pytest
from independent import NMV, SETUPS, B, C

from rtest_estimation.errors import UserError
from rtest_identification.foresight import foresee, planned
from rtest_identification.location import fit
from rtest_identification.machine import parse_machine
from rtest_identification.moves import synchronous_path
from rtest_identification.plans import UNEVEN_DEG, diagnostic, nest_calibration, static
from rtest_identification.symbols import parameter

MACHINE = parse_machine(NMV)
NOISE = 0.3e-6
UNEVEN = np.radians(UNEVEN_DEG)


def plans(build=static, inner=C, setups=tuple(SETUPS)):
    made = [build(MACHINE, name, np.array(SETUPS[name]), B, inner) for name in setups]
    return made, [synchronous_path(MACHINE, plan) for plan in made]


@pytest.fixture(scope='module')
def even():
    return foresee(MACHINE, *plans(), NOISE)


@pytest.fixture(scope='module')
def uneven():
    return foresee(MACHINE, *plans(diagnostic, UNEVEN), NOISE)


def outlook(foresight, key):
    return next(o for o in foresight.outlooks if o.key == key)


def measured(observations, rng, with_map):
    """A session of a machine whose errors are those of Table 3-2, with noise."""
    errors = np.zeros((len(observations), 5, 6))
    value = {'X': -7.8e-6, 'Y': 12.1e-6, 'Z': -38e-6, 'A': 1.8e-5, 'B': 4.1e-5, 'C': 0.8e-5}
    outer = observations.axis('B')
    for letter, size in value.items():
        column = parameter(MACHINE, 'B', letter).column
        errors.reshape(len(outer), -1)[:, column] = size * (1 + with_map * np.sin(3 * outer))
    exact, _ = observations.predict(errors)
    return replace(
        observations,
        displacement=exact + NOISE * rng.normal(size=exact.shape),
        covariance=np.tile((5e-8) ** 2 * np.eye(3), (len(outer), 1, 1)),
    )


@pytest.mark.parametrize('with_map', [0, 1])
@pytest.mark.parametrize(('build', 'inner'), [(static, C), (diagnostic, UNEVEN)])
def test_predicted_standard_deviations_are_those_the_fit_states(build, inner, with_map):
    made, paths = plans(build, inner)
    seen = foresee(MACHINE, made, paths, NOISE)
    observations = planned(MACHINE, made, paths)
    rng = np.random.default_rng(31)
    predicted = seen.location.stddev_with_map if with_map else seen.location.stddev
    ratios, inner_ratios = [], []
    while len(ratios) < 5:
        result = fit(measured(observations, rng, with_map))
        if result.joint != bool(with_map) or len(result.outliers):
            continue
        assert result.location.symbols == tuple(p.symbol for p in seen.location.parameters)
        freedom = result.location.freedom
        ratio = result.location.stddev / predicted
        # One variance factor scales them all; chi-squared scatter, three standard deviations.
        assert np.ptp(ratio) < 1e-3
        assert abs(ratio.mean() - 1.0) < 3.0 / np.sqrt(2.0 * freedom)
        of_map = result.error_map.stddev / seen.outer_map.stddev
        assert np.ptp(of_map) < 1e-3 and abs(of_map.mean() - 1) < 3.0 / np.sqrt(2.0 * freedom)
        assert result.error_map.left_open == seen.outer_map.left_open
        of_inner = result.inner_map.stddev / seen.inner_map.stddev
        inner_ratios.append(np.nanmean(of_inner))
        assert np.nanmax(of_inner) - np.nanmin(of_inner) < 5e-3
        ratios.append(ratio.mean())
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.03)
    assert np.mean(inner_ratios) == pytest.approx(1.0, abs=0.04)


def test_the_fit_scatters_as_predicted(even):
    made, paths = plans()
    observations = planned(MACHINE, made, paths)
    rng = np.random.default_rng(32)
    found = np.array([fit(measured(observations, rng, 1)).location.value for _ in range(60)])
    ratio = found.std(axis=0, ddof=1) / even.location.stddev_with_map
    # 11 correlated ratios of 59 degrees of freedom each: one is 1 +- 0.09.
    assert np.all((ratio > 0.7) & (ratio < 1.3)) and ratio.mean() == pytest.approx(1.0, abs=0.1)


def test_noise_scales_and_repeats_average(even):
    made, paths = plans()
    twice = foresee(MACHINE, made, paths, 2 * NOISE)
    np.testing.assert_allclose(twice.location.stddev, 2 * even.location.stddev)
    again = foresee(MACHINE, [*made, *made], [*paths, *paths], NOISE)
    np.testing.assert_allclose(again.location.stddev, even.location.stddev / np.sqrt(2), rtol=1e-6)


def test_all_of_table_2_3_is_determined_by_four_setups_and_not_by_one(even):
    assert even.location.determined.all() and len(even.location.parameters) == 11
    one = foresee(MACHINE, *plans(setups=('2a',)), NOISE)
    lost = [p.symbol for p, d in zip(one.location.parameters, one.location.determined,
                                     strict=True) if not d]
    assert {'E_A(0Y)B', 'E_A(0B)C', 'E_A(0Y)Z'} <= set(lost)
    assert one.inner_map.undetermined and not even.inner_map.undetermined


@pytest.mark.parametrize('key', [
    'radial-turning/C', 'coning-turning/C', 'location/E_C(0X)Z', 'angle/CZ', 'gauge-gain',
    'location/E_C(0B)C', 'location/E_Y(0B)C',
])
@pytest.mark.parametrize('kind', ['even', 'uneven'])
def test_what_no_r_test_sees_is_invisible_and_what_takes_it_is_said(key, kind, request):
    one = outlook(request.getfixturevalue(kind), key)
    assert one.verdict == 'invisible' and one.left[1] < 1e-6 and one.taken_by


def test_a_run_out_that_turns_with_c_is_taken_by_the_offsets(even):
    assert outlook(even, 'radial-turning/C').taken_by == ('offsets of the cycles',)
    assert outlook(even, 'location/E_Y(0B)C').taken_by == ('E_Y(0Y)B',)
    assert outlook(even, 'angle/CZ').taken_by == ('no motion at these poses',)
    radial = outlook(even, 'radial/C.1')
    assert (radial.hidden, radial.shapes) == (2, 4) and radial.left[1] > 0.99


@pytest.mark.parametrize('family', ['radial', 'axial', 'coning', 'angular-cyclic'])
@pytest.mark.parametrize('order', [1, 2, 3, 4, 5])
def test_harmonic_n_looks_like_12_minus_n_with_even_stations_only(even, uneven, family, order):
    key, twin = f'{family}/C.{order}', f'{family}/C.{12 - order}'
    assert twin in outlook(even, key).like and key in outlook(even, twin).like
    assert twin not in outlook(uneven, key).like and key not in outlook(uneven, twin).like


@pytest.mark.parametrize(('key', 'twin'), [
    ('straightness/YX', 'angle/CX'), ('straightness/XZ', 'angle/BZ'),
    ('straightness/YZ', 'angle/AZ'), ('torque-twist/B', 'angular-cyclic/B.1'),
    ('angular-scale/B', 'angular-cyclic/B.1'),
])
def test_twins_of_any_r_test_are_named(even, uneven, key, twin):
    assert twin in outlook(even, key).like
    assert twin in outlook(uneven, key).like


def test_with_one_setup_cs_angular_error_looks_like_its_twice_per_turn_coning():
    one = foresee(MACHINE, *plans(diagnostic, UNEVEN, ('1a',)), NOISE)
    four = foresee(MACHINE, *plans(diagnostic, UNEVEN), NOISE)
    assert 'coning/C.2' in outlook(one, 'angular-cyclic/C.1').like
    assert 'coning/C.2' not in outlook(four, 'angular-cyclic/C.1').like


def test_the_second_pass_separates_backlash_and_drift_from_the_map_of_b(even, uneven):
    assert outlook(even, 'backlash/B').left_by_map[1] < 0.25
    assert outlook(uneven, 'backlash/B').left_by_map[0] > 0.95
    assert outlook(uneven, 'drift-cycle').left_by_map[0] > 2.5 * outlook(
        even, 'drift-cycle').left_by_map[1]


def test_errors_of_the_outer_axis_itself_go_into_its_map(even):
    one = outlook(even, 'axial/B.2')
    assert one.in_map and one.left[0] > 0.5 and 'goes into the map' in one.verdict


def test_nothing_static_is_nothing_to_foresee():
    plan = nest_calibration(MACHINE, '1a', np.array(SETUPS['1a']))
    with pytest.raises(UserError, match='no static cycle'):
        foresee(MACHINE, [plan], [synchronous_path(MACHINE, plan)])
