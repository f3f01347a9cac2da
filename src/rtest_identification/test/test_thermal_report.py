"""thermal.json, the report and its figures."""

import json
import re

import numpy as np
import pytest
from independent import NMV
from warming import MINUTE, readings, session, settling

from rtest_identification.machine import parse_machine
from rtest_identification.thermal import output, words
from rtest_identification.thermal.pipeline import identify_thermal
from rtest_identification.thermal.positions import present_cycles, shown_cycles
from rtest_identification.thermal.report import write_report
from rtest_identification.thermal.temperature import Thermometer

MACHINE = parse_machine(NMV)
TAU = 50 * MINUTE


def errors(time, b, c):
    f = settling(time, TAU)
    return {'B': {'X': 3e-5, 'Y': 2e-5 - 6e-6 * f, 'Z': -2e-6 * f}}


@pytest.fixture(scope='module')
def result():
    cycles = session(
        errors, np.arange(0, 181, 15), noise=0.25e-6, seed=1,
        keep=lambda c, pose: c != 5 or pose < 13,
    )
    sensors = [
        Thermometer.of('T1', *readings(lambda s: 22.0, 185, noise=0.05, seed=1)),
        Thermometer.of('T2', *readings(
            lambda s: 22.0 + 1.4 * settling(s, TAU), 185, noise=0.05, seed=2
        )),
    ]
    return identify_thermal(MACHINE, cycles, sensors)


def test_json_is_whole_and_si(result, tmp_path):
    path = output.write(result, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ['thermal.json']
    data = json.loads(path.read_text())
    assert data['drifting'] == ['E_Y(0Y)B', 'E_Z(0Y)B']
    y = data['errors']['E_Y(0Y)B']
    assert y['unit'] == 'm' and len(y['change']) == len(data['cycles']) == 13
    assert y['change'][0] == y['stddev'][0] == 0.0
    assert y['reference']['value'] == pytest.approx(2e-5, abs=1e-6)
    assert y['drift']['last']['value'] == pytest.approx(-5.8e-6, abs=0.4e-6)
    assert y['drift']['beyond_expanded_since_s'] == 900.0
    (constant,) = y['time_constants']
    assert constant['interval_s'][0] < TAU < constant['interval_s'][1]
    assert y['explained_by'] == {'sensor': 'T2', 'rivals': []}
    assert y['temperature']['T2']['lag']['undetermined'] and 'T1' not in y['temperature']
    cover = data['sensors']['T2']['celsius']
    assert cover[-1] - cover[0] == pytest.approx(1.4, abs=0.1)
    assert data['error_map_change']['change']['E_Y(Y)B'][5] == [None] * 5
    assert data['cycles'][5]['used'] == 13 and data['cycles'][5]['planned'] == 27
    assert [c['time_s'] for c in data['cycles']][:2] == [0.0, 900.0]


def test_report_opens_offline_and_says_it_all(result, tmp_path):
    page = write_report(result, tmp_path).read_text()
    markup = re.sub(r'<script>.*?</script>', '', page, flags=re.DOTALL)
    assert not re.search(r'(?:src|href)="(?!data:)', markup)
    for figure in ('temperatures', 'drift', 'positions_3d', 'positions', 'against_temperature',
                   'over_stations'):
        assert (tmp_path / f'thermal_{figure}.png').stat().st_size > 10_000
        assert (tmp_path / f'thermal_{figure}.svg').is_file()
        assert f'alt="{figure}"' in page
    assert 'Plotly.newPlot("turnable"' in page
    assert 'thermal-05 13-26: not reached' in page
    assert 'T2 explains' in page
    assert words.summary(result) in page


def test_report_of_one_cycle(tmp_path):
    one = identify_thermal(MACHINE, session(errors, [0], noise=0.25e-6))
    page = write_report(one, tmp_path).read_text()
    assert 'nothing can be said of changes yet' in page
    assert not list(tmp_path.glob('*.png'))
    json.loads(output.write(one, tmp_path).read_text())


def test_positions_move_as_the_machine_does(result):
    """Fig. 4-6: the circle of the nest goes where the axis goes."""
    chosen = shown_cycles(result)
    assert chosen[0] == 0 and chosen[-1] == 12 and len(chosen) == 3
    view = present_cycles(result, chosen)
    assert [setup.name for setup in view.setups] == ['0 h', '1.5 h', '3 h']
    error = view.error()
    means = [error[view.cycle == n].mean(axis=0) for n in range(3)]
    # The offsets of the reference are out of all cycles; what came since is in.
    np.testing.assert_allclose(means[0], 0.0, atol=0.3e-6)
    f = settling(180 * MINUTE, TAU)
    np.testing.assert_allclose(means[2] - means[0], [0.0, -6e-6 * f, -2e-6 * f], atol=0.4e-6)


def test_words():
    assert words.moment(5400.0, 9000.0) == '1.5 h'
    assert words.moment(5400.0, 6000.0) == '90 min'
    assert words.minutes(float('inf')) == '∞'
    assert words.with_uncertainty(-6.02e-6, 0.105e-6) == '-6.02 ± 0.21'
    assert words.probability(1e-9) == '< 1e-6'
