"""The section `devices` of a session file, and what is started and checked for it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from rtest_drivers.cli import main
from rtest_drivers.cnc.programs import program_of
from rtest_drivers.config import config_path
from rtest_drivers.devices import check_devices
from rtest_drivers.gauges.config import load_nest
from rtest_drivers.graph import GraphSettings, session_nodes
from rtest_estimation.errors import UserError
from rtest_identification.session_file import load_session

SESSION = """
machine: {machine}
cycle: {{b_deg: [-30, 0, 30], c_deg: [0, 90, 180]}}
setups: {{a: {{sphere_mm: [0, -60, 40]}}}}
devices:
  gauges: {gauges}
  cnc: {cnc}
"""
GAUGES = '{backend: serial, file: nest.yaml}'
CNC = '{backend: linuxcnc, file: cnc.yaml}'
NEST = """
controllers: [{protocol: keyence-lkg5000, port: /dev/ttyUSB0, channels: [1, 2, 3], unit: mm}]
"""
LINUXCNC = """
axes: {X: {index: 0, unit: mm}, Y: {index: 1, unit: mm}, Z: {index: 2, unit: mm},
       B: {index: 3, unit: deg}, C: {index: 4, unit: deg}}
"""


@pytest.fixture
def written(tmp_path: Path):
    """Writes a session file with its device files; the caller says what is different."""

    def write(gauges: str = GAUGES, cnc: str = CNC, linuxcnc: str = LINUXCNC) -> Path:
        path = tmp_path / 'session.yaml'
        path.write_text(
            SESSION.format(machine=config_path('nmv1500dcg.yaml'), gauges=gauges, cnc=cnc)
        )
        (tmp_path / 'nest.yaml').write_text(NEST)
        (tmp_path / 'cnc.yaml').write_text(linuxcnc)
        return path

    return write


def settings(path: Path, **more: object) -> GraphSettings:
    return GraphSettings(path, 'monday', path.parent, devices=load_session(path).devices, **more)


def test_drivers_are_started_with_their_devices_in_real_time(written, tmp_path: Path) -> None:
    nodes = {node.name: node for node in session_nodes(settings(written()))}
    assert set(nodes) == {'recorder', 'estimator', 'identifier', 'gauges', 'cnc', 'session'}
    assert nodes['gauges'].lifecycle and nodes['cnc'].lifecycle
    for name, backend in (('gauges', 'serial'), ('cnc', 'linuxcnc')):
        file = {'gauges': 'nest.yaml', 'cnc': 'cnc.yaml'}[name]
        assert nodes[name].parameters == {
            'backend': backend, 'address': str(tmp_path / file), 'use_sim_time': False,
        }
    assert nodes['session'].parameters['simulated'] is False


def test_a_driver_without_a_device_is_expected_elsewhere(written) -> None:
    path = written()
    path.write_text(path.read_text().replace(f'  cnc: {CNC}\n', ''))
    assert 'gauges' in {node.name for node in session_nodes(settings(path))}
    assert 'cnc' not in {node.name for node in session_nodes(settings(path))}


def test_thermometers_are_a_device_too(written, tmp_path: Path) -> None:
    path = written()
    path.write_text(
        path.read_text() + '  thermometers: {backend: serial, file: thermometers.yaml}\n'
    )
    shutil.copy(config_path('thermometers_example.yaml'), tmp_path / 'thermometers.yaml')
    config = load_session(path)
    check_devices(config, path)
    assert config.reads_temperatures(simulated=False)
    (node,) = (n for n in session_nodes(settings(path)) if n.name == 'thermometers')
    assert node.lifecycle and node.parameters['address'] == str(tmp_path / 'thermometers.yaml')
    (tmp_path / 'thermometers.yaml').write_text('controllers: []')
    with pytest.raises(UserError, match=r'thermometers.yaml: controllers: expected a list'):
        check_devices(config, path)


def test_a_thermal_session_has_its_own_node_and_simulated_thermometers() -> None:
    path, truth = config_path('thermal.yaml'), config_path('cell_thermal.yaml')
    session = load_session(path)
    chosen = GraphSettings(path, 'warm', Path('/out'), simulate=truth).of(session)
    nodes = {node.name: node for node in session_nodes(chosen)}
    assert 'identifier' not in nodes and nodes['thermal'].parameters['out'] == '/out/warm/thermal'
    assert nodes['thermometers'].parameters['backend'] == 'cell'
    # On a machine without them temperatures may come from elsewhere, or not at all.
    nodes = {node.name for node in session_nodes(replace(chosen, simulate=None))}
    assert 'thermal' in nodes and 'thermometers' not in nodes
    assert not session.reads_temperatures(simulated=False)


def test_a_simulated_session_does_not_touch_the_devices(written) -> None:
    simulated = settings(written(), simulate=config_path('cell_demo.yaml'))
    backends = {n.name: n.parameters.get('backend') for n in session_nodes(simulated)}
    assert backends['gauges'] == backends['cnc'] == 'cell'


@pytest.mark.parametrize(
    ('changed', 'expected'),
    [
        ({'gauges': '{backend: usb, file: nest.yaml}'},
         "devices: gauges: backend: expected one of ['serial'], got 'usb'"),
        ({'cnc': '{backend: cell, file: cnc.yaml}'}, 'devices: cnc: backend: expected one of'),
        ({'gauges': '{backend: serial}'}, 'devices: gauges: file: missing'),
        ({'gauges': '{backend: serial, file: none.yaml}'}, 'cannot read the device file'),
        ({'gauges': '{backend: serial, file: nest.yaml, rate: 3}'}, "unknown key 'rate'"),
        ({'cnc': '[linuxcnc]'}, 'devices: cnc: expected a mapping'),
        ({'cnc': CNC.replace('}', ', run_programs: maybe}')},
         'run_programs: expected true, false or unattended'),
        ({'cnc': CNC.replace('}', ', run_programs: true}')}, 'enable_password: missing'),
        ({'cnc': CNC.replace('}', ', run_programs: true}'),
          'linuxcnc': LINUXCNC + 'enable_password: sesame'}, 'no program a-nest.ngc beside'),
        ({'cnc': '{backend: opcua, file: cnc.yaml, run_programs: true}'}, 'unknown key'),
        ({'linuxcnc': LINUXCNC + 'baud: 9600'}, "cnc.yaml: unknown key 'baud'"),
    ],
)
def test_a_mistake_is_one_line(written, capsys, changed: dict, expected: str) -> None:
    path = written(**changed)
    for more in ([], ['--check']):
        assert main(['session', '--config', str(path), '--out', str(path.parent), *more]) == 2
        err = capsys.readouterr().err
        assert expected in err and err.count('\n') == 1


def test_check_needs_devices(written, capsys) -> None:
    path = written()
    path.write_text(path.read_text().partition('devices:')[0])
    assert main(['session', '--config', str(path), '--check']) == 2
    assert 'devices: missing' in capsys.readouterr().err
    assert main(['session', '--config', str(path), '--moves']) == 2
    assert '--moves: expected together with --check' in capsys.readouterr().err


def test_a_plan_keeps_the_device_files_and_has_the_programs(written, tmp_path: Path) -> None:
    path = written(
        cnc=CNC.replace('}', ', run_programs: unattended}'),
        linuxcnc=LINUXCNC + 'enable_password: sesame',
    )
    out = tmp_path / 'plan'
    assert main(['plan', '--config', str(path), '--out', str(out)]) == 0
    planned = load_session(out / 'session.yaml')
    assert planned.devices == load_session(path).devices
    assert planned.devices['cnc'].programs == 'unattended'
    check_devices(planned, out / 'session.yaml')
    assert program_of('a-static', out) == out / 'a-static.ngc'
    assert program_of('b-static', out) is None


def test_the_examples_are_right() -> None:
    path = config_path('real_session_example.yaml')
    config = load_session(path)
    assert {name: one.backend for name, one in config.devices.items()} == {
        'gauges': 'serial', 'cnc': 'linuxcnc',
    }
    check_devices(config, path)
    assert load_nest(config.devices['gauges'].file).channels == 3
    text = config_path('linuxcnc_example.yaml').read_text()
    assert set(yaml.safe_load(text)['axes']) == set('XYZBC')


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('C: {index: 4, unit: deg}', 'A: {index: 4, unit: deg}', 'axes: C: missing, the machine'),
        ('C: {', 'A: {index: 5, unit: deg}, C: {', 'axes: A: the machine has no such axis'),
    ],
)
def test_axes_of_the_controller_are_those_of_the_machine(written, old, new, words) -> None:
    path = written(linuxcnc=LINUXCNC.replace(old, new))
    with pytest.raises(UserError, match=words):
        check_devices(load_session(path), path)


def test_two_gauges_are_no_nest(written) -> None:
    path = written()
    nest = path.parent / 'nest.yaml'
    nest.write_text(NEST.replace('[1, 2, 3]', '[1, 2]'))
    with pytest.raises(UserError, match='2 gauges, a sphere centre needs three'):
        check_devices(load_session(path), path)


def test_moves_need_a_password_before_anything_is_tried(written, capsys) -> None:
    path = written()
    assert main(['session', '--config', str(path), '--check', '--moves']) == 2
    said = capsys.readouterr()
    assert said.out == '' and 'cnc.yaml: enable_password: missing, --moves needs it' in said.err
