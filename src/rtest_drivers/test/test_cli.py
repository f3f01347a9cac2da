"""The command `rtest`: help, and a user's mistakes in one line."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rtest_drivers import cli
from rtest_drivers.commands.identify import default_output, recording_name
from rtest_drivers.config import config_path


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


def test_an_earlier_session_is_never_overwritten(capsys, tmp_path):
    (tmp_path / 'monday').mkdir()
    status, _, err = run(capsys, 'session', '--session', 'monday', '--out', str(tmp_path))
    assert status == 2 and 'exists already' in err


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
