"""The command `rtest`: help, and a user's mistakes in one line."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from rtest_drivers import cli, graph
from rtest_drivers.commands import session
from rtest_drivers.commands.identify import _found, _missing, default_output, recording_name
from rtest_drivers.config import config_path
from rtest_drivers.domain import free_domain
from rtest_drivers.folders import writing
from rtest_drivers.runner import NodeFailed
from rtest_estimation.errors import UserError
from rtest_estimation.recording import read_recording
from rtest_estimation.records import Missing
from rtest_identification.machine import parse_machine
from rtest_identification.offline import estimate_recording
from rtest_identification.pipeline import identify

SHORT = Path(__file__).resolve().parents[3] / 'bags' / 'short'


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    try:
        status = cli.main(arguments)
    except SystemExit as end:  # argparse ends --help so
        status = end.code
    out, err = capsys.readouterr()
    return status, out, err


def test_help_names_every_command(capsys):
    status, out, err = run(capsys, '--help')
    assert status == 0 and not err
    assert all(f'    {name} ' in out for name in ('session', 'demo', 'plan', 'identify', 'info'))


@pytest.mark.parametrize('command', ['session', 'demo', 'plan', 'identify', 'info'])
def test_every_command_explains_itself(capsys, command):
    status, out, _ = run(capsys, command, '--help')
    assert status == 0 and len(out.splitlines()) > 5


@pytest.mark.parametrize(
    ('arguments', 'expected'),
    [
        ([], 'required: COMMAND'),
        (['measure'], "invalid choice: 'measure'"),
        (['info'], 'required: BAG'),
        (['info', '/no/such/bag'], '/no/such/bag'),
        (['identify', '/no/such/bag'], '/no/such/bag'),
        (['identify', __file__], 'test_cli.py'),
        (['session', '--config', '/no/such.yaml'], '/no/such.yaml'),
        (['session', '--simulate', '/no/truth.yaml'], '/no/truth.yaml'),
        (['session', '--session', 'a/b'], "'a/b'"),
        (['session', '--session', 'log'], "'log'"),
        (['session', '--rate', '-1'], 'rate'),
        (['demo', '--rate', '0'], 'at 10 two processor cores lose nothing'),
        (['identify', str(SHORT), '--out', '/dev/null'], 'not a directory'),
        (['identify', str(SHORT), '--out', '/etc/passwd/x'], '/etc/passwd/x'),
        (['gap', str(SHORT), '--out', '/etc/passwd/x'], '/etc/passwd/x'),
        (['plan', '--out', '/dev/null'], '/dev/null'),
        (['session', '--out', '/etc/passwd/x'], '/etc/passwd/x'),
        (['info', '/dev/null'], 'neither a file nor a directory'),
        (['session', '--rate', 'fast'], "'fast'"),
        (['session', '--domain', '300'], '300'),
        (['session', '--remap', 'a=b'], 'FROM:=TO'),
        (['session', '--namespace', 'my cell'], 'my cell'),
    ],
)
def test_a_users_mistake_is_one_line(capsys, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.chdir(tmp_path)
    status, out, err = run(capsys, *arguments)
    assert status == 2
    assert not out
    assert err.startswith('rtest: ') and err.count('\n') == 1
    assert expected in err
    assert not list(tmp_path.iterdir()), 'a mistake leaves nothing behind'


def test_frames_without_the_messages_of_tf_are_refused_in_one_line(
    capsys, tmp_path, monkeypatch
):
    monkeypatch.setattr(graph, 'find_spec', lambda name: None)
    status, out, err = run(capsys, 'session', '--frames', '--out', str(tmp_path / 'out'))
    assert status == 2 and not out and err.count('\n') == 1
    assert 'cannot import tf2_msgs' in err and 'ros-jazzy-tf2-msgs' in err
    assert not list(tmp_path.iterdir())


def test_an_earlier_session_is_never_overwritten(capsys, tmp_path):
    (tmp_path / 'monday').mkdir()
    status, _, err = run(capsys, 'session', '--session', 'monday', '--out', str(tmp_path))
    assert status == 2 and 'exists already' in err


def test_a_mistake_in_the_truth_file_is_found_before_anything_is_started(
    capsys, tmp_path, monkeypatch
):
    truth = tmp_path / 'truth.yaml'
    truth.write_text('machine: nowhere.yaml\n')
    command = ('session', '--simulate', str(truth), '--session', 'a', '--out', str(tmp_path / 'o'))
    status, out, err = run(capsys, *command)
    assert status == 2 and not out and 'nowhere.yaml' in err and err.count('\n') == 1
    assert [path.name for path in tmp_path.iterdir()] == ['truth.yaml'], 'it can be repeated'


def test_faults_that_never_occur_are_told(capfd, monkeypatch, tmp_path):
    """A cycle or a pose that the session does not have."""
    text = config_path('cell_demo.yaml').read_text()
    text = text.replace('machine: nmv', f'machine: {config_path("cell_demo.yaml").parent}/nmv')
    truth = tmp_path / 'truth.yaml'
    truth.write_text(f"""{text}
faults:
  - {{kind: gauge_nan, cycle: nowhere}}
  - {{kind: gauge_nan, cycle: 1a-static, pose: 85}}
  - {{kind: pose_skipped, cycle: 1a-static, pose: 86}}
""")

    def not_run(settings, domain):
        raise NodeFailed('not run')

    monkeypatch.setattr(session, 'run_session', not_run)
    status, out, _ = run(
        capfd, 'session', '--simulate', str(truth), '--out', str(tmp_path / 'out')
    )
    warnings = [line for line in out.splitlines() if line.startswith('warning')]
    assert status == 1 and len(warnings) == 2
    assert "no cycle 'nowhere' in this session" in warnings[0]
    assert 'no pose 86 in 1a-static, which has 86 poses' in warnings[1]


@pytest.mark.parametrize('identified', [True, False])
def test_an_incomplete_session_is_identified_and_fails(capsys, tmp_path, monkeypatch, identified):
    def measured(settings, domain):
        if identified:
            shutil.copytree(SHORT, settings.folder)
        else:
            settings.folder.mkdir()
        return False

    monkeypatch.setattr(session, 'run_session', measured)
    monkeypatch.chdir(tmp_path)
    truth = str(config_path('cell_demo.yaml'))
    status, _, err = run(capsys, 'session', '--simulate', truth, '--session', 'a')
    assert status == 1
    assert (tmp_path / 'out' / 'a' / 'identification' / 'report.html').is_file() is identified
    assert ('rtest identify out/a' if identified else 'no recording in this directory') in err


def test_two_sessions_of_the_same_second_have_two_names(tmp_path, monkeypatch, capsys):
    names = []

    def measured(settings, domain):
        names.append(settings.session)
        raise NodeFailed('not run')

    monkeypatch.setattr(session, 'run_session', measured)
    monkeypatch.setattr(session, 'session_name', lambda stem: f'{stem}-now')
    for _ in range(2):
        assert run(capsys, 'session', '--out', str(tmp_path))[0] == 1
    (tmp_path / 'log' / 'demo-now-2').rmdir()
    (tmp_path / 'demo-now-2').mkdir()
    assert run(capsys, 'session', '--out', str(tmp_path))[0] == 1
    assert names == ['demo-now', 'demo-now-2', 'demo-now-3']


def test_a_terminal_that_knows_ascii_only_gets_question_marks(tmp_path):
    done = subprocess.run(
        [sys.executable, '-m', 'rtest_drivers.cli', 'identify', str(SHORT), '--out', 'ä'],
        capture_output=True, cwd=tmp_path, env={**os.environ, 'PYTHONIOENCODING': 'ascii'},
    )
    assert done.returncode == 0 and not done.stderr
    last = done.stdout.decode('ascii').splitlines()[-1]
    assert '?m' in last and last.endswith('-> ?/identification.json')


def test_missing_poses_are_told_with_their_reasons_and_counted():
    """Also those of a cycle that was lost as a whole."""
    recording = read_recording(SHORT)
    done = estimate_recording(recording)
    cycles = []
    for item in done:
        cycle = item.cycle
        if cycle.plan.cycle == 'outer-static':
            lost = tuple(Missing(row, 'no gauge readings') for row in range(27))
            cycle = replace(cycle, points=(), missing=lost)
        cycles.append(cycle)
    result = identify(parse_machine(recording.machine_text), cycles)
    assert _missing(result) == ['outer-static 0-26: no gauge readings']
    assert _found(result).endswith('27 of 54 poses')


def test_what_the_system_refuses_while_writing_is_a_mistake_in_one_line(tmp_path):
    refused = pytest.raises(UserError, match='/proc/x: cannot be written: No such file')
    with refused, writing(Path('/proc/x')):
        Path('/proc/x').mkdir(parents=True)


def test_an_interrupt_is_one_line(capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.info, 'run', interrupted)
    assert run(capsys, 'info', 'bag') == (130, '', 'rtest: interrupted\n')


def test_an_unknown_error_keeps_its_traceback(monkeypatch):
    def broken(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(cli.info, 'run', broken)
    with pytest.raises(ZeroDivisionError):
        cli.main(['info', 'bag'])


def test_the_command_starts_without_ros_and_numerics():
    code = (
        'import sys, rtest_drivers.cli as cli; cli.parser(); '
        "print([m for m in ('rclpy', 'numpy', 'scipy', 'rosbags') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout == '[]\n'


def test_it_is_a_module_too():
    done = subprocess.run(
        [sys.executable, '-m', 'rtest_drivers.cli', 'info', '/no/such/bag'],
        capture_output=True, text=True,
    )
    assert done.returncode == 2 and 'Traceback' not in done.stderr


def test_results_lie_beside_the_recording(tmp_path, monkeypatch):
    bag = tmp_path / 'monday'
    bag.mkdir()
    assert default_output(bag) == bag / 'identification'
    (bag / 'metadata.yaml').touch()
    assert default_output(bag / 'monday.mcap') == bag / 'identification'
    assert recording_name(bag / 'monday.mcap') == 'monday'
    assert default_output(tmp_path / 'bare.mcap') == tmp_path / 'bare-identification'
    bag.chmod(0o555)
    assert default_output(bag) == Path('monday-identification')
    bag.chmod(0o755)


def test_configuration_is_found_in_sources_and_where_it_is_installed(tmp_path, monkeypatch):
    assert config_path('demo.yaml').is_file()
    installed = tmp_path / 'share' / 'rtest_drivers' / 'config'
    installed.mkdir(parents=True)
    shutil.copy(config_path('demo.yaml'), installed / 'other.yaml')
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path}')
    assert config_path('other.yaml') == installed / 'other.yaml'
    with pytest.raises(cli.UserError, match='none.yaml'):
        config_path('none.yaml')


def test_the_demo_measures_the_cycle_of_the_thesis():
    from rtest_estimation.records import Kind
    from rtest_identification.session_file import load_session

    config = load_session(config_path('demo.yaml'))
    static = [plan for plan in config.plans if plan.kind is Kind.STATIC]
    assert [plan.setup for plan in static] == ['1a', '1b', '2a', '2b']
    # 7 B x 12 C, and B = C = 0 before and after.
    assert [len(plan.commands) for plan in static] == [86] * 4
    assert json.dumps(config.sphere_radius) == '0.0127'


def test_asking_where_no_session_runs(capsys, monkeypatch):
    pytest.importorskip('rclpy')
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    assert cli.main(['ask', 'skip', '--domain', str(free_domain())]) == 2
    assert 'no session in ROS domain' in capsys.readouterr().err
    assert cli.main(['ask', 'skip', '--domain', '400']) == 2
    assert 'expected a number from 0 to 232' in capsys.readouterr().err
