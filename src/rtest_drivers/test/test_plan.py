"""The command `rtest plan`, and plans of machines with rotary axes in the head."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

from rtest_drivers import cli
from rtest_drivers.cnc.programs import program_of
from rtest_drivers.config import config_path
from rtest_drivers.schedule import path_duration
from rtest_drivers.sim.kinematics import sphere_in_table
from rtest_estimation.records import Kind
from rtest_identification.foresight import foresee, planned
from rtest_identification.location import fit
from rtest_identification.machine import load_machine
from rtest_identification.moves import synchronous_path
from rtest_identification.nc_program import NcSettings
from rtest_identification.plan_check import duration
from rtest_identification.plan_output import check_session, write_plan
from rtest_identification.plans import UNEVEN_DEG
from rtest_identification.session_file import load_session

HEADS = ('head_table', 'head_head')


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    status = cli.main(['plan', *arguments])
    out, err = capsys.readouterr()
    return status, out, err


def head_session(tmp_path, name: str, kind: str = 'static'):
    data = {
        'machine': str(config_path(f'{name}.yaml')),
        'cycle': {'kind': kind, 'b_deg': [-60, -30, 0, 30, 60], 'dwell_s': 0.3},
        'setups': {
            'a': {'sphere_mm': [80, 0, 60]}, 'b': {'sphere_mm': [80, 0, 160]},
            'c': {'sphere_mm': [0, 0, 60]},
        },
    }
    if kind == 'static':
        data['cycle']['c_deg'] = list(range(0, 360, 45))
    path = tmp_path / f'{name}.yaml'
    path.write_text(yaml.safe_dump(data))
    return path


def test_the_demo_is_planned(capsys, tmp_path):
    status, out, err = run(capsys, '--out', str(tmp_path / 'plan'), '--tcp')
    assert status == 0 and not err
    last = out.splitlines()[-1]
    assert '344 poses' in last and '11 of 11 errors' in last and last.endswith('plan.json')
    data = json.loads((tmp_path / 'plan' / 'plan.json').read_text())
    assert data['kind'] == 'static' and data['noise'] == 0.25e-6
    assert list(data['location_errors']) == [
        'E_X(0Y)B', 'E_Y(0Y)B', 'E_Z(0Y)B', 'E_A(0Y)B', 'E_B(0Y)B', 'E_C(0Y)B', 'E_X(0B)C',
        'E_A(0B)C',
    ]
    assert set(data['error_maps']) == {'B', 'C'}
    assert data['duration'] == pytest.approx(sum(c['duration'] for c in data['cycles']))
    for cycle in data['cycles']:
        rows = (tmp_path / 'plan' / cycle['poses_file']).read_text().splitlines()
        assert len(rows) == cycle['poses'] + 1
        for key in ('nc', 'nc_tcp'):
            program = (tmp_path / 'plan' / cycle[key]).read_text()
            assert len(re.findall(r'\(POSE \d+\)', program)) == cycle['poses']


def test_a_plan_can_be_measured_as_it_was_written(capsys, tmp_path):
    out = tmp_path / 'plan'
    assert run(capsys, '--kind', 'diagnostic', '--out', str(out))[0] == 0
    again = load_session(out / 'session.yaml')
    first = load_session(config_path('demo.yaml'), 'diagnostic')
    assert again.kind == 'diagnostic'
    for one, other in zip(again.plans, first.plans, strict=True):
        assert one.cycle == other.cycle
        np.testing.assert_allclose(one.commands, other.commands, atol=1e-10)
    np.testing.assert_allclose(np.degrees(again.stations[1]), UNEVEN_DEG)


def test_a_thermal_session_has_one_program_for_all_its_cycles(capsys, tmp_path):
    out_dir = tmp_path / 'plan'
    status, out, err = run(
        capsys, '--config', str(config_path('thermal.yaml')), '--out', str(out_dir)
    )
    assert status == 0 and not err
    assert '13 times, every 15 min' in out
    assert 'thermal plan, 27 poses, ' in out.splitlines()[-1]
    assert ', 3 h 05 min, ' in out.splitlines()[-1]
    assert sorted(path.name for path in out_dir.glob('*.ngc')) == [
        'low-nest.ngc', 'low-runout.ngc', 'low-thermal.ngc',
    ]
    assert program_of('low-thermal-07', out_dir) == out_dir / 'low-thermal.ngc'
    assert 'low-thermal-' not in (out_dir / 'low-thermal.ngc').read_text()
    data = json.loads((out_dir / 'plan.json').read_text())
    assert data['repeated'] == {'every': 900.0, 'cycles': 13}
    again = load_session(out_dir / 'session.yaml')
    assert [plan.cycle for plan in again.plans] == [
        plan.cycle for plan in load_session(config_path('thermal.yaml')).plans
    ]


def test_a_cycle_that_takes_longer_than_its_turn_is_told_beforehand(tmp_path):
    path = tmp_path / 'session.yaml'
    text = config_path('thermal.yaml').read_text().replace('every_min: 15', 'every_min: 0.5')
    machine = str(config_path('nmv1500dcg.yaml'))
    path.write_text(text.replace('machine: nmv1500dcg.yaml', f'machine: {machine}'))
    checked = check_session(load_session(path), NcSettings())
    assert any('every 0.5 min: the cycles will be late' in w for w in checked.warnings)
    # As one static cycle the file is as good.
    once = load_session(path, 'static')
    assert once.every == 0.0 and once.plans[-1].cycle == 'low-static'
    write_plan(check_session(once, NcSettings()), tmp_path / 'once', 'once', NcSettings(), False)
    assert load_session(tmp_path / 'once' / 'session.yaml').kind == 'static'


def test_a_session_waits_longer_than_the_program_takes():
    for kind in ('static', 'diagnostic'):
        config = load_session(config_path('demo.yaml'), kind)
        for plan in config.plans:
            path = synchronous_path(config.machine, plan, config.speeds)
            assert duration(plan, path, config.approach) < path_duration(plan)


def test_noise_and_controller_are_taken(capsys, tmp_path):
    run(capsys, '--out', str(tmp_path / 'a'))
    run(capsys, '--out', str(tmp_path / 'b'), '--noise-um', '0.5', '--controller', 'iso',
        '--pause')
    one, other = (json.loads((tmp_path / n / 'plan.json').read_text()) for n in 'ab')
    stddev = [d['location_errors']['E_X(0Y)B']['stddev'] for d in (one, other)]
    assert stddev[1] == pytest.approx(2 * stddev[0])
    program = (tmp_path / 'b' / '1a-static.nc').read_text()
    assert program.startswith('%\nO00') and program.count('\nM0\n') == 87
    numbers = [
        (tmp_path / 'b' / c['nc']).read_text().splitlines()[1] for c in other['cycles']
    ]
    assert len(set(numbers)) == len(numbers)


@pytest.mark.parametrize(
    ('arguments', 'expected'),
    [
        (['--config', '/no/such.yaml'], '/no/such.yaml'),
        (['--kind', 'dynamic'], "invalid choice: 'dynamic'"),
        (['--noise-um', '0'], '--noise-um 0'),
        (['--noise-um', 'nan'], '--noise-um nan'),
        (['--tolerance-um', '-5'], '--tolerance-um -5'),
        (['--controller', 'heidenhain'], "invalid choice: 'heidenhain'"),
    ],
)
def test_a_users_mistake_is_one_line(capsys, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.chdir(tmp_path)
    status, out, err = run(capsys, *arguments)
    assert status == 2 and not out
    assert err.startswith('rtest: ') and err.count('\n') == 1 and expected in err
    assert not list(tmp_path.iterdir())


def test_old_programs_are_never_mixed_with_new_ones(capsys, tmp_path):
    (tmp_path / 'old.ngc').touch()
    status, out, err = run(capsys, '--out', str(tmp_path))
    assert status == 2 and not out and 'is not empty' in err
    assert [p.name for p in tmp_path.iterdir()] == ['old.ngc']


def test_a_collision_is_a_mistake_of_the_plan(capsys, tmp_path):
    data = yaml.safe_load(config_path('demo.yaml').read_text())
    data['machine'] = str(config_path('nmv1500dcg.yaml'))
    data |= {
        'table': {'radius_mm': 200, 'surface_mm': -20},
        'spindle': {'radius_mm': 100, 'distance_mm': 60},
    }
    (tmp_path / 'short.yaml').write_text(yaml.safe_dump(data))
    status, _, err = run(capsys, '--config', str(tmp_path / 'short.yaml'), '--out',
                         str(tmp_path / 'plan'))
    assert status == 2 and 'the spindle meets the table' in err
    assert not (tmp_path / 'plan').exists()


@pytest.mark.parametrize('name', HEADS)
@pytest.mark.parametrize('kind', ['static', 'diagnostic'])
def test_rotary_axes_in_the_head_are_planned_checked_and_written(tmp_path, name, kind):
    config = load_session(head_session(tmp_path, name, kind))
    settings = NcSettings(tolerance=50e-6)
    checked = check_session(config, settings)
    assert checked.foresight.location.determined.all()
    write_plan(checked, tmp_path / 'plan', 'head', settings, tcp=True)
    plan = next(p for p in config.plans if p.kind is Kind.STATIC)
    for suffix in ('', '-tcp'):
        text = (tmp_path / 'plan' / f'{plan.cycle}{suffix}.ngc').read_text()
        rows = [
            [float(v) for v in re.findall(r'[XYZBC](-?[\d.]+)', line)]
            for line in text.splitlines() if line.startswith('G1')
        ][:-1]
        rows = np.array(rows)
        rows[:, :3] *= 1e-3
        rows[:, 3:] = np.radians(rows[:, 3:])
        if suffix:
            np.testing.assert_allclose(rows[1:, :3], np.tile(plan.sphere, (len(rows) - 1, 1)),
                                       atol=1e-9)
            np.testing.assert_allclose(rows[1:, 3:], plan.commands[1:, 3:], atol=1e-7)
            continue
        # The machine of the simulated cell, which shares no code with the plan's kinematics.
        between = (rows[:-1] + rows[1:]) / 2.0
        off = sphere_in_table(config.machine, np.vstack([rows, between])) - plan.sphere
        assert 5e-6 < np.linalg.norm(off, axis=1).max() < 30e-6 + 2e-7


@pytest.mark.parametrize('name', HEADS)
def test_foresight_of_a_head_is_what_the_fit_states(tmp_path, name):
    config = load_session(head_session(tmp_path, name))
    paths = [synchronous_path(config.machine, p, config.speeds) for p in config.plans]
    seen = foresee(config.machine, config.plans, paths, 0.3e-6)
    observations = planned(config.machine, config.plans, paths)
    rng = np.random.default_rng(5)
    exact, _ = observations.predict()
    noise = 0.3e-6 * rng.normal(size=exact.shape)
    result = fit(replace(observations, displacement=exact + noise))
    assert not result.joint
    ratio = result.location.stddev / seen.location.stddev
    assert np.ptp(ratio) < 1e-3
    assert abs(ratio.mean() - 1.0) < 3.0 / np.sqrt(2.0 * result.location.freedom)
    # The sphere is always at the same place of the head: shift and tilt of B are not told apart.
    assert seen.inner_map.axis == 'B' and seen.inner_map.undetermined


@pytest.mark.parametrize('name', HEADS)
def test_ranges_of_a_head_are_checked(tmp_path, name):
    path = head_session(tmp_path, name)
    machine = load_machine(config_path(f'{name}.yaml'))
    assert machine.rotary == ('C', 'B') and machine.tool[2] < 0
    data = yaml.safe_load(path.read_text())
    data['cycle']['b_deg'] = [-120, -60, 0]
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(cli.UserError, match='b_deg: -120 is outside the range of B'):
        load_session(path)
