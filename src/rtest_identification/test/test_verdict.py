"""Pass, fail or undecided: the decision rules by hand, extremes of maps by Monte Carlo."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from independent import NMV, SETUPS, B, noisy, static_cycle

from rtest_estimation.errors import UserError
from rtest_identification.interpolation import Stations
from rtest_identification.machine import parse_machine
from rtest_identification.output import as_dict
from rtest_identification.pipeline import identify
from rtest_identification.tolerance import LARGEST, PEAK, VALUE, Limits, load_tolerances
from rtest_identification.verdict import Judgement, Verdict, decide, extremes, judge
from rtest_identification.verdict_table import lines, rows

MACHINE = parse_machine(NMV)
ARCSEC = math.pi / 648000


def errors_at(b, c):
    return {
        'B': {'X': -7.8e-6, 'E': 0.0, 'A': 10 * ARCSEC, 'B': 3e-5 * np.sin(2 * b)},
        'C': {'X': 5e-6, 'Z': 1e-6 * np.cos(2 * c)},
        'Z': {'A': -2e-5},
    }


RNG = np.random.default_rng(4)
CYCLES = [noisy(static_cycle(setup, errors_at), 2.5e-7, RNG) for setup in SETUPS]
RESULT = identify(MACHINE, CYCLES)


def tolerances(tmp_path, text):
    path = tmp_path / 'limits.yaml'
    path.write_text(text)
    return load_tolerances(path)


@pytest.mark.parametrize(
    ('value', 'expected'),
    [
        # Tolerance +-10, U = 2: conformance zone +-8, non-conformance beyond +-12.
        (0.0, 'pass'), (8.0, 'pass'), (-8.0, 'pass'), (8.01, 'undecided'), (10.0, 'undecided'),
        (12.0, 'undecided'), (12.01, 'fail'), (-8.01, 'undecided'), (-12.01, 'fail'),
    ],
)
def test_zones_of_a_symmetrical_tolerance(value, expected):
    limits = Limits(VALUE, -10.0, 10.0, 'um', 2.0)
    assert decide(limits, value - 2.0, value + 2.0) == expected


@pytest.mark.parametrize(
    ('value', 'expected'),
    [
        # Tolerance -2 to 8, U = 1.
        (-3.01, 'fail'), (-3.0, 'undecided'), (-1.01, 'undecided'), (-1.0, 'pass'),
        (7.0, 'pass'), (7.01, 'undecided'), (9.0, 'undecided'), (9.01, 'fail'),
    ],
)
def test_zones_of_an_asymmetrical_tolerance(value, expected):
    assert decide(Limits(VALUE, -2.0, 8.0, 'um', 2.0), value - 1.0, value + 1.0) == expected


def test_one_limit_alone_and_a_tolerance_narrower_than_the_uncertainty():
    assert decide(Limits(VALUE, -math.inf, 8.0, 'um', 2.0), -100.0, 7.0) == 'pass'
    assert decide(Limits(VALUE, 3.0, math.inf, 'um', 2.0), -1.0, 2.0) == 'fail'
    # U = 2 against a tolerance of +-1: undecided at best, however good the value.
    assert decide(Limits(VALUE, -1.0, 1.0, 'um', 2.0), -2.0, 2.0) == 'undecided'
    assert decide(Limits(VALUE, -1.0, 1.0, 'um', 2.0), math.nan, math.nan) == 'undecided'


def test_the_overall_verdict_is_the_worst():
    limits = Limits(VALUE, -1.0, 1.0, 'um', 2.0)

    def overall(*found):
        return Verdict('f', tuple(Judgement('E', limits, 0, 0, 0, v) for v in found)).overall

    assert overall('pass', 'pass') == 'pass'
    assert overall('pass', 'undecided') == 'undecided'
    assert overall('undecided', 'fail', 'pass') == 'fail'
    assert overall() == 'undecided'


def by_key(verdict):
    return {item.key: item for item in verdict.judgements}


def test_an_identification_is_judged(tmp_path):
    verdict = judge(RESULT, tolerances(tmp_path, """
location_errors: {limit_um: 2, limit_arcsec: 5}
E_X(0Y)B: {lower_um: -10, upper_um: 1}
E_X(0B)C: {limit_um: 5}
squareness: {limit_urad: 10}
E_B(Y)B: {peak_to_peak_urad: 80, max_urad: 40}
residual: {max_um: 2}
"""))  # fmt: skip
    found = by_key(verdict)
    assert {s for s in found if s.startswith('E_') and '(0' in s} == set(RESULT.location.symbols)
    assert found['E_X(0Y)B'].verdict == 'pass'
    assert found['E_A(0Y)B'].verdict == 'fail'
    # Truth and limit are both 5 µm: undecided at this noise.
    assert found['E_X(0B)C'].verdict == 'undecided'
    assert found['E_X(0B)C'].reason == 'a limit lies within the uncertainty'
    assert found['E_A(0Y)Z'].verdict == 'fail' and found['E_B(0X)Z'].verdict == 'pass'
    assert found['residual'].verdict == 'pass'
    assert verdict.overall == 'fail' and verdict.summary.startswith('fail (2 fail, 1 undecided')
    item, place = found['E_X(0B)C'], RESULT.location.symbols.index('E_X(0B)C')
    assert item.value == RESULT.location.value[place]
    assert item.high - item.value == pytest.approx(2 * RESULT.location.stddev[place])
    of_map = [item for item in verdict.judgements if item.key == 'E_B(Y)B']
    assert [item.limits.quantity for item in of_map] == [PEAK, LARGEST]
    assert all(item.verdict == 'pass' for item in of_map)
    # 60 µrad between -45 and 45 degrees, which are no stations.
    assert of_map[0].low < 60e-6 < of_map[0].high < 65e-6


def test_a_coverage_factor_of_the_file_and_of_an_entry(tmp_path):
    verdict = judge(RESULT, tolerances(tmp_path, """
coverage_factor: 3
squareness: {limit_urad: 10}
E_C(0Y)X: {limit_urad: 10, coverage_factor: 1.65}
"""))  # fmt: skip
    stddev = dict(zip(RESULT.location.symbols, RESULT.location.stddev, strict=True))
    for key, factor in (('E_B(0X)Z', 3.0), ('E_C(0Y)X', 1.65)):
        item = by_key(verdict)[key]
        assert item.high - item.value == pytest.approx(factor * stddev[key])


def test_what_is_not_determined_never_passes(tmp_path):
    text = 'location_errors: {limit_urad: 1.0e+9, limit_um: 1.0e+9}\nmaps: {max_um: 1.0e+9, ' \
        'max_urad: 1.0e+9}\nvolumetric: {max_um: 1.0e+9}\n'
    verdict = judge(identify(MACHINE, [CYCLES[2]]), tolerances(tmp_path, text))
    found = by_key(verdict)
    lost = {'E_A(0Y)B', 'E_A(0B)C', 'volumetric', 'E_A(Y)B', 'E_A(B)C'}
    assert lost <= set(found)
    for key in lost:
        assert (found[key].verdict, found[key].reason) == ('undecided', 'not determined'), key
    assert verdict.overall == 'undecided'
    # With four set-ups the same limits pass all of them.
    assert judge(RESULT, tolerances(tmp_path, text)).overall == 'pass'


def test_a_map_that_was_not_identified_is_undecided(tmp_path):
    without = replace(RESULT, fit=replace(RESULT.fit, inner_map=None))
    item = judge(without, tolerances(tmp_path, 'E_X(B)C: {max_um: 100}')).judgements[0]
    assert (item.verdict, item.reason) == ('undecided', 'not determined')


def test_the_volumetric_error_is_the_largest_predicted(tmp_path):
    item = judge(RESULT, tolerances(tmp_path, 'volumetric: {max_um: 60}')).judgements[0]
    measured = max(
        np.linalg.norm(p.displacement - c.points[0].displacement)
        for c in CYCLES for p in c.points
    )
    assert item.low < measured < item.high + 4 * 2.5e-7
    assert item.value == pytest.approx(measured, rel=0.05)


@pytest.mark.parametrize('quantity', [PEAK, LARGEST])
@pytest.mark.parametrize('size', [0.0, 0.5, 3.0, 30.0])
def test_intervals_of_extremes_hold_the_truth(quantity, size):
    rng = np.random.default_rng(31)
    stations = Stations.of(B)
    fine = np.linspace(B[0], B[-1], 37)
    weights = stations.weights(fine)
    root = np.tril(0.3 * rng.normal(size=(7, 7)), -1) + np.diag(rng.uniform(0.5, 1.5, 7))
    covariance = root @ root.T
    nodes = size * np.sin(2 * B + 0.2)
    curve = weights @ nodes
    truth = np.ptp(curve) if quantity == PEAK else np.abs(curve).max()
    trials = 400
    found = np.array([
        extremes(
            nodes + root @ rng.normal(size=7), covariance, weights, np.zeros(37), quantity, 2.0
        )
        for _ in range(trials)
    ])  # fmt: skip
    low, high = found[:, 1], found[:, 2]
    # Each end holds with 97.7 % or more; three standard deviations of the Monte Carlo below.
    margin = 3 * np.sqrt(0.0228 * 0.9772 / trials)
    assert np.mean(low <= truth) > 0.9772 - margin
    assert np.mean(high >= truth) > 0.9772 - margin
    # And not by being useless: a large map is known to a few of the noise's standard deviations.
    if size == 30.0:
        assert np.mean(high - low) < 12.0


def test_u_of_a_clear_peak_to_peak_is_that_of_the_difference_of_two_stations():
    covariance = np.diag([1.0, 4.0, 1.0])
    nodes = np.array([0.0, 50.0, -50.0])
    value, low, high = extremes(nodes, covariance, np.eye(3), np.zeros(3), PEAK, 2.0)
    assert value == 100.0 and high == pytest.approx(100.0 + 2.0 * math.sqrt(5.0))
    assert 100.0 - 3.5 * math.sqrt(5.0) < low < 100.0 - 2.0 * math.sqrt(5.0)
    value, low, high = extremes(nodes, covariance, np.eye(3), np.zeros(3), LARGEST, 2.0)
    assert value == 50.0 and high == pytest.approx(54.0) and 44.0 < low < 46.0


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('E_X(0Y)C: {limit_um: 5}', r'E_X\(0Y\)C: .*nearest: E_X\(0'),
        ('E_Q(0Y)B: {limit_um: 5}', r'nearest: E_'),
        ('squarenes: {limit_urad: 5}', 'nearest: squareness'),
        ('maps_D: {max_um: 5}', 'maps_D: .*nearest: maps'),
        ('E_X(0Y)B: {limit_urad: 5}', r'E_X\(0Y\)B: _urad is for angles; expected .* in _um'),
        ('E_A(0Y)B: {limit_um: 5}', 'expected a limit in _urad or _arcsec'),
        ('squareness: {limit_um: 5}', 'squareness: _um is for lengths; expected .* _arcsec'),
        ('squareness: {limit_urad: 5, limit_um: 5}', 'squareness: _um is for lengths'),
        ('E_A(0Y)B: {max_urad: 5}', r'E_A\(0Y\)B: expected limit_'),
        ('E_A(Y)B: {limit_urad: 5}', r'E_A\(Y\)B: expected peak_to_peak_'),
        ('maps: {limit_urad: 5}', 'maps: expected peak_to_peak_'),
        ('squareness: {max_urad: 5}', 'squareness: expected limit_'),
        ('residual: {limit_um: 5}', 'residual: expected the one limit max_um'),
        ('E_X(0Y)B: {limit_mm: 5}', "unknown key 'limit_mm'"),
        ('E_X(0Y)B: {limit_um: five}', 'limit_um: expected a number'),
        ('E_X(0Y)B: {limit_um: 0}', 'above 0'),
        ('E_X(0Y)B: {lower_um: 5, upper_um: 2}', 'lower_um 5 is not below upper_um 2'),
        ('E_X(0Y)B: {limit_um: 5, upper_um: 2}', 'give one kind'),
        ('squareness: {limit_urad: 5, limit_arcsec: 2}', 'give one of them'),
        ('squareness: {}', 'no limit in it'),
        ('squareness: 5', 'expected a mapping of limits'),
        ('coverage_factor: 2', 'no limits in it'),
        ('coverage_factor: two\nsquareness: {limit_urad: 5}', 'coverage_factor: expected'),
        ('squareness: {limit_urad: 5, coverage_factor: -1}', 'coverage_factor: expected'),
        ('[1, 2]', 'expected a mapping'),
        ('a: [', 'not valid YAML'),
    ],
)
def test_a_mistake_in_the_file_is_one_line(tmp_path, text, expected):
    with pytest.raises(UserError, match=expected) as caught:
        judge(RESULT, tolerances(tmp_path, text))
    assert '\n' not in str(caught.value) and 'limits.yaml' in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r'none\.yaml: cannot read'):
        load_tolerances(tmp_path / 'none.yaml')


def test_table_and_json(tmp_path):
    verdict = judge(RESULT, tolerances(tmp_path, """
E_X(0Y)B: {lower_um: -10, upper_um: 1}
E_A(0Y)B: {limit_arcsec: 5}
E_B(Y)B: {peak_to_peak_urad: 80}
"""))  # fmt: skip
    table = rows(verdict)
    assert [row['tolerance'] for row in table] == ['-10 to 1', '±5', '≤ 80']
    assert [row['unit'] for row in table] == ['µm', 'arcsec', 'µrad']
    assert table[0]['value'] == '-7.80' or table[0]['value'].startswith('-7.')
    assert abs(float(table[1]['value']) - 10.0) < 0.3
    text = lines(verdict)
    assert len(text) == 4 and all('  ' in line for line in text)
    data = json.loads(json.dumps(as_dict(RESULT, verdict), allow_nan=False))['verdict']
    assert data['overall'] == 'fail' and data['tolerance_file'] == 'limits.yaml'
    assert [e['verdict'] for e in data['errors']] == ['pass', 'fail', 'pass']
    assert data['errors'][2]['lower'] is None
    assert data['errors'][0]['upper'] == pytest.approx(1e-6)
    assert 'verdict' not in as_dict(RESULT)
