"""Files of `rtest frustum`: reports that open offline, JSON, commands, mistakes in one line."""

import argparse
import json

import numpy as np
import pytest
from independent import NMV, SETUPS, nest_cycle, static_cycle

from rtest_estimation.errors import UserError
from rtest_identification.frustum import figures
from rtest_identification.machine import parse_machine
from rtest_identification.output import as_dict
from rtest_identification.pipeline import identify

frustum = pytest.importorskip('rtest_drivers.commands.frustum')


@pytest.fixture(scope='module')
def machine_file(tmp_path_factory):
    path = tmp_path_factory.mktemp('machine') / 'nmv.yaml'
    path.write_text(NMV)
    return path


@pytest.fixture(scope='module')
def identification(tmp_path_factory):
    cycles = []
    for setup in SETUPS:
        cycle = static_cycle(
            setup, lambda b, c: {'C': {'A': 2e-5 + 3e-5 * abs(b) * np.cos(c), 'X': 5e-6}}
        )
        cycles += [nest_cycle(setup), cycle]
    path = tmp_path_factory.mktemp('id') / 'identification.json'
    path.write_text(json.dumps(as_dict(identify(parse_machine(NMV), cycles))))
    return path


def run(*words):
    parser = argparse.ArgumentParser()
    frustum.add_arguments(parser)
    return frustum.run(parser.parse_args([str(word) for word in words]))


def told(capsys, *words):
    assert run(*words) == 0
    return capsys.readouterr().out.splitlines()


def check(out, *figures):
    page = (out / 'frustum_report.html').read_text()
    assert page.count('data:image/png;base64') == len(figures)
    assert 'http://' not in page and 'https://' not in page
    for name in figures:
        assert (out / f'{name}.png').stat().st_size > 5000
        assert (out / f'{name}.svg').is_file()
    return page


def test_of_an_identification(tmp_path, capsys, machine_file, identification):
    last = told(capsys, '--machine', machine_file, '--identification', identification,
                '--out', tmp_path)[-1]  # fmt: skip
    data = json.loads((tmp_path / 'frustum.json').read_text())
    assert last.startswith(
        f'cone frustum, phi 15 deg, psi 30 deg: circularity {data["deviation"] * 1e6:.2f} ± '
        f'{2e6 * data["stddev"]:.2f} µm (k = 2)'
    )
    assert last.endswith('frustum_report.html')
    assert data['minimum_zone'] < data['deviation']
    assert data['constant_errors_alone']['deviation'] < data['deviation']
    # 20 µrad of it, 11.8 µm per 0.01 deg.
    first = data['ranking'][0]
    assert first['name'] == 'E_A(0B)C'
    assert first['alone'] == pytest.approx(11.77e-6 * 2e-5 / np.radians(0.01), rel=0.01)
    assert first['constant'] and not data['ranking'][1]['constant']
    assert len(data['profile']) == data['points'] == 360
    page = check(tmp_path, 'contour', 'ranking', 'setup', 'commands')
    assert 'E_A(B)C' in page and 'minimum-zone circle' in page
    rows = (tmp_path / 'commands.csv').read_text().splitlines()
    assert rows[0] == 'X_mm,Y_mm,Z_mm,B_deg,C_deg,nx,ny,nz' and len(rows) == 361


def test_of_a_model(tmp_path, capsys, machine_file):
    model = tmp_path / 'model.yaml'
    model.write_text(
        'name: a\nmachine: NMV\nvalues:\n  E_A(0B)C: {value: 1.745329e-4, stddev: 0, unit: rad}\n'
        'effects:\n- key: scale/X\n  parameters: {e: {value: 1.0e-5, stddev: 1.0e-6, unit: m/m}}\n'
    )
    lines = told(capsys, '--machine', machine_file, '--model', model, '--out', tmp_path / 'out')
    assert any('11.77  E_A(0B)C' in line for line in lines)
    data = json.loads((tmp_path / 'out/frustum.json').read_text())
    assert data['constant_errors_alone']['deviation'] == pytest.approx(11.77e-6, abs=0.01e-6)
    assert {one['name'] for one in data['ranking']} == {'E_A(0B)C', 'scale/X'}


def test_of_nothing_known_and_of_a_path(tmp_path, capsys, machine_file):
    lines = told(capsys, '--machine', machine_file, '--phi', 20, '--psi', 10, '--diameter', 60,
                 '--centre', 0, 10, 90, '--centre-of', 'path',
                 '--out', tmp_path / 'a')  # fmt: skip
    assert 'errors ranked, largest' in lines[-1]
    # A key is followed by what it stands for.
    formula = 'E_AC, E_BC = a cos 2C + b sin 2C each'
    assert any(f'coning/C.2 (0.01°): {formula}' in line for line in lines)
    assert formula in check(tmp_path / 'a', 'ranking', 'profiles', 'setup', 'commands')
    cone = json.loads((tmp_path / 'a/frustum.json').read_text())['cone']
    lever = 0.03 * np.tan(np.radians(10))
    np.testing.assert_allclose(
        cone['centre'],
        [lever * np.sin(np.radians(20)), 0.01, 0.09 - lever * np.cos(np.radians(20))],
    )
    last = told(capsys, '--machine', machine_file, '--path', tmp_path / 'a/commands.csv',
                '--out', tmp_path / 'b')[-1]  # fmt: skip
    assert last.startswith('commands.csv: ')
    check(tmp_path / 'b', 'ranking', 'commands')
    one, other = (
        {r['name']: r['alone'] for r in json.loads((tmp_path / f).read_text())['ranking']}
        for f in ('a/frustum.json', 'b/frustum.json')
    )
    # The same feature, along its normal instead of across its axis.
    assert other['E_A(0B)C'] == pytest.approx(one['E_A(0B)C'] * np.cos(np.radians(10)), rel=1e-3)


def test_the_tables(tmp_path, capsys):
    lines = told(capsys, '--tables', '--out', tmp_path)
    assert 'Table 6-2: 16 of 16 to 0.1 µm' in lines[-1]
    assert 'α⁰_CB' in '\n'.join(lines)
    check(tmp_path, 'tables', 'profiles_a', 'setup_a', 'commands_a', 'profiles_b', 'setup_b',
          'commands_b')  # fmt: skip
    assert len(json.loads((tmp_path / 'frustum.json').read_text())['tables']) == 56


@pytest.mark.parametrize(
    ('words', 'message'),
    [
        (['--tables', '--phi', 15], '--phi: --tables are of'),
        (['--path', 'a.csv', '--psi', 15], '--psi is of the cone'),
        (['--effects', 'a.yaml'], '--effects: give the --model'),
        (['--feed', 0], '--feed 0'),
        (['--points', 3], '--points 3'),
        (['--psi', 95], 'psi'),
        (['--diameter', -1], 'diameter'),
        (['--centre', 'nan', 0, 0], '--centre'),
        (['--machine', 'absent.yaml'], 'cannot read the machine file'),
        (['--identification', 'absent.json'], 'cannot read the identification'),
        (['--phi', 75], None),
        (['--centre', '1e308', 0, 0], '--centre: expected three numbers of mm'),
        (['--diameter', '1e308'], '--diameter'),
        (['--tables', '--solution', 'negative'], '--solution: --tables are of'),
        (['--surface', 'left'], '--surface is of a --path'),
    ],
)
def test_mistakes(tmp_path, words, message, identification, machine_file):
    if message is None:
        # B to -105 deg, measured to 75.
        words = [*words, '--machine', machine_file, '--identification', identification]
        message = 'outside the measured stations'
    with pytest.raises(UserError, match=message):
        run(*words, '--out', tmp_path / 'out')
    assert not (tmp_path / 'out').exists()


def test_older_results_are_not_mixed_with_new_ones(tmp_path):
    (tmp_path / 'contour.png').write_text('old')
    with pytest.raises(UserError, match='is not empty; choose another --out'):
        run('--tables', '--out', tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ['contour.png']


def changed(identification, tmp_path, change):
    data = json.loads(identification.read_text())
    change(data)
    path = tmp_path / 'changed.json'
    path.write_text(json.dumps(data))
    return path


def test_what_was_not_determined_is_in_the_last_line(
    tmp_path, capsys, machine_file, identification
):
    path = changed(identification, tmp_path,
                   lambda data: data['location_errors']['E_Y(0Y)B'].update(value=None))
    last = told(capsys, '--machine', machine_file, '--identification', path,
                '--out', tmp_path / 'o')[-1]  # fmt: skip
    assert '; without E_Y(0Y)B, not determined and in no value or U' in last
    assert json.loads((tmp_path / 'o/frustum.json').read_text())['not_determined'] == ['E_Y(0Y)B']


@pytest.mark.parametrize(
    ('change', 'match'),
    [
        (lambda d: d['location_errors']['E_Y(0Y)B'].update(value=float('nan')), 'value nan'),
        (lambda d: d['location_errors']['E_Y(0Y)B'].update(value='1e-5'), "value '1e-5', expect"),
        (lambda d: d['location_errors']['E_Y(0Y)B'].update(unit='um'), "unit 'um', expected 'm'"),
        (lambda d: d.update(error_maps=None), 'error_maps: expected maps by axis'),
        (lambda d: d['uncertainty']['covariance'][0].__setitem__(0, -1e-12), 'is negative'),
        (lambda d: d['error_maps']['B'].update({'E_X(Y)B': None}), 'not an identification.json'),
    ],
)
def test_a_broken_identification_is_told(tmp_path, machine_file, identification, change, match):
    path = changed(identification, tmp_path, change)
    with pytest.raises(UserError, match=match) as caught:
        run('--machine', machine_file, '--identification', path, '--out', tmp_path / 'o')
    assert str(path) in str(caught.value) and '\n' not in str(caught.value)


def test_outside_the_stations_a_path_names_its_line(tmp_path, machine_file, identification):
    path = tmp_path / 'out.ngc'
    path.write_text('G0 X0 Y0 Z50 B0 C0\n(then)\nG1 X50 B-90 F500\n')
    match = r'^out\.ngc:3: B = -75\.\d+, C = 0 deg is outside'
    with pytest.raises(UserError, match=match) as found:
        run('--machine', machine_file, '--identification', identification, '--path', path,
            '--out', tmp_path / 'o')
    # C is where it was measured.
    assert 'B (-75 to 75 deg): measure' in str(found.value)
    assert 'whole turn' not in str(found.value)


def test_a_ranking_of_nothing_says_so():
    assert 'no error' in figures.ranking([], 'form deviation').axes[0].texts[0].get_text()


def test_an_identification_of_another_machine_is_refused(tmp_path, identification):
    # The default machine has the same errors but another name.
    with pytest.raises(UserError, match="is of machine 'NMV', not 'NMV1500DCG'"):
        run('--identification', identification, '--out', tmp_path / 'out')
