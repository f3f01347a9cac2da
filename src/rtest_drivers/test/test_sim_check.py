"""The comparison with the truth finds what is wrong, and blames nobody for what cannot be seen."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rtest_drivers.config import config_path
from rtest_drivers.sim.check import check, split_visible
from rtest_drivers.sim.truth import load_truth

STATIONS = np.radians([-75.0, -50.0, -25.0, 0.0, 25.0, 50.0, 75.0])
MAP = ('E_X(Y)B', 'E_Y(Y)B', 'E_Z(Y)B', 'E_A(Y)B', 'E_B(Y)B', 'E_C(Y)B')


@pytest.fixture(scope='module')
def cell():
    return load_truth(config_path('cell_demo.yaml'))


def perfect(cell) -> dict:
    """What an identification without noise would give; standard uncertainty 1e-7 throughout."""
    visible, own, inner = split_visible(cell, 'B', STATIONS)
    shift = {'B': own, 'C': inner}
    constants = {
        text: {
            'value': value + (shift[text[-1]]['XYZABC'.index(text[2])] if text[-1] in 'BC' else 0),
            'stddev': 1e-7,
            'unit': 'm' if text[2] in 'XYZ' else 'rad',
        }
        for text, value in cell.errors.constants.items()
    }
    return {
        'location_errors': {t: e for t, e in constants.items() if t[-1] in 'BC'},
        'squareness': {t: e for t, e in constants.items() if t[-1] not in 'BC'},
        'error_maps': {
            'B': {
                'b_rad': STATIONS.tolist(),
                **dict(zip(MAP, visible.tolist(), strict=True)),
                'stddev': {symbol: [1e-7] * len(STATIONS) for symbol in MAP},
            }
        },
    }


def compare(tmp_path, result):
    path = tmp_path / 'identification.json'
    path.write_text(json.dumps(result))
    return check(config_path('cell_demo.yaml'), path)


def test_a_perfect_result_agrees(cell, tmp_path):
    result = compare(tmp_path, perfect(cell))
    assert result.ok and len(result.constants) == 11 and len(result.maps) == 6
    assert result.map_rms < 1e-6
    assert 'OFF' not in result.table()


def test_a_wrong_constant_is_found(cell, tmp_path):
    data = perfect(cell)
    data['location_errors']['E_X(0B)C']['value'] += 3.6e-7
    result = compare(tmp_path, data)
    assert not result.ok and [row.symbol for row in result.constants if not row.ok] == ['E_X(0B)C']
    assert 'DOES NOT AGREE' in result.verdict()


def test_a_wrong_sign_of_a_map_is_found(cell, tmp_path):
    data = perfect(cell)
    data['error_maps']['B']['E_B(Y)B'] = [-v for v in data['error_maps']['B']['E_B(Y)B']]
    result = compare(tmp_path, data)
    assert [row.symbol for row in result.maps if not row.ok] == ['E_B(Y)B']


def test_uncertainties_that_are_too_small_are_found(cell, tmp_path):
    data = perfect(cell)
    rng = np.random.default_rng(3)
    for symbol in MAP:
        noisy = np.array(data['error_maps']['B'][symbol]) + rng.normal(0.0, 2e-7, len(STATIONS))
        data['error_maps']['B'][symbol] = noisy.tolist()
    assert compare(tmp_path, data).map_rms > 1.5


def test_what_is_missing_is_named(cell, tmp_path):
    data = perfect(cell)
    del data['squareness']['E_C(0Y)X']
    data['error_maps'] = {}
    result = compare(tmp_path, data)
    assert not result.ok and result.missing == ('E_C(0Y)X', 'error map')


def test_constant_errors_of_the_table_are_not_visible_as_a_map(cell):
    """The split gives back a constant error of C that is written as an error of B."""
    turned = cell.errors.terms
    offset = np.array([2e-6, 0.0, -3e-6])
    c, s = np.cos(STATIONS), np.sin(STATIONS)
    shape = np.array([offset[0] * c + offset[2] * s, 0.0 * c, offset[2] * c - offset[0] * s])

    class Errors:
        terms = turned

        def dependent(self, text, positions):
            value = cell.errors.dependent(text, positions)
            if text in MAP[:3]:
                value = value + shape[MAP.index(text)][:, np.newaxis]
            return value

    class Cell:
        machine, errors = cell.machine, Errors()

    plain, own, inner = split_visible(cell, 'B', STATIONS)
    visible, own_2, inner_2 = split_visible(Cell(), 'B', STATIONS)
    np.testing.assert_allclose(visible, plain, atol=1e-15)
    np.testing.assert_allclose(inner_2[:3] - inner[:3], offset, atol=1e-15)
    np.testing.assert_allclose(own_2, own, atol=1e-15)
