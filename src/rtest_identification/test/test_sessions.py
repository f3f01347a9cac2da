"""Recordings of an independent simulation with known truth."""

import json
from pathlib import Path

import numpy as np
import pytest

from rtest_identification.offline import identify_recording
from rtest_identification.output import as_dict

SESSIONS = Path(__file__).resolve().parents[4] / 'shared' / 'sessions' / 'open'
KEYS = dict(
    zip(
        ['xBY', 'yBY', 'zBY', 'aBY', 'bBY', 'cBY', 'xCB', 'aCB', 'aYZ', 'bXZ', 'cYX'],
        ['E_X(0Y)B', 'E_Y(0Y)B', 'E_Z(0Y)B', 'E_A(0Y)B', 'E_B(0Y)B', 'E_C(0Y)B', 'E_X(0B)C',
         'E_A(0B)C', 'E_A(0Y)Z', 'E_B(0X)Z', 'E_C(0Y)X'],
        strict=True,
    )
)
pytestmark = pytest.mark.skipif(
    not SESSIONS.is_dir(),
    reason='independent sessions are not there: they lie in shared/sessions beside the checkout',
)


def load(name):
    truth = json.loads((SESSIONS / 'truth.json').read_text())[name]
    values = {KEYS[k]: v for k, v in {**truth['location'], **truth['square']}.items()}
    return identify_recording(SESSIONS / name), values, truth


@pytest.mark.parametrize('name', ['open-00', 'open-01'])
def test_sessions_without_hidden_effect_give_their_truth(name):
    result, values, truth = load(name)
    data = as_dict(result)
    found = {**data['location_errors'], **data['squareness']}
    assert found.keys() == values.keys()
    z = {s: (e['value'] - values[s]) / e['stddev'] for s, e in found.items()}
    assert max(map(abs, z.values())) < 3.5, z
    # Believable: neither too small for the errors made nor larger than plain least squares gives.
    assert 0.5 < np.sqrt(np.mean(np.square(list(z.values())))) < 1.8
    for symbol, entry in found.items():
        assert entry['stddev'] < (0.031e-6 if entry['unit'] == 'm' else 0.43e-6), symbol
    assert data['residual_rms'] == pytest.approx(truth['noise'], rel=0.06)
    assert data['noise'] == pytest.approx(truth['noise'], rel=0.15)
    assert not data['missing'] and not data['outliers'] and not data['undetermined']
    assert not result.fit.joint


def test_a_hidden_effect_is_not_passed_over_in_silence():
    # Pitch of Y, which no map of the rotary axes can take.
    result, *_ = load('open-06')
    assert any('lacks an effect' in warning for warning in result.warnings)


def test_a_hidden_run_out_of_c_is_in_its_map():
    # Three waves a turn of 0.33 um in E_X and E_Y of C.
    result, _, truth = load('open-04')
    effect = truth['effects'][0]
    assert effect['key'] == 'radial/C' and effect['k'] == 3
    grid = result.inner_map
    assert grid.axis == 'C' and grid.significance < 1e-6
    assert result.fit.rms_location > 1.1 * truth['noise']
    assert grid.rms == pytest.approx(truth['noise'], rel=0.15)
    assert not any('lacks an effect' in warning for warning in result.warnings)
