"""The runner with small stand-ins for nodes: nothing outlives it, whatever happens."""

from __future__ import annotations

import fcntl
import mmap
import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from rtest_drivers.domain import chosen_domain, free_domain, held_domain, session_environment
from rtest_drivers.graph import (
    INCOMPLETE,
    GraphSettings,
    ros_arguments,
    session_name,
    session_nodes,
)
from rtest_drivers.processes import remove_dead_shared_memory, remove_dead_sockets, stop
from rtest_drivers.runner import Command, NodeFailed, run
from rtest_estimation.errors import UserError

pytestmark = pytest.mark.alone

# Says that it is there, and when it was asked to stop.
NODE = """
import os, signal, sys, time
def end(number, frame):
    print('end', time.monotonic(), flush=True)
    sys.exit(0)
signal.signal(signal.SIGINT, end)
print('pid', os.getpid(), flush=True)
while True:
    time.sleep(0.02)
"""
DEAF = """
import os, signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print('pid', os.getpid(), flush=True)
while True:
    time.sleep(0.1)
"""


def command(folder: Path, name: str, code: str) -> Command:
    return Command(name, (sys.executable, '-c', code), folder / f'{name}.log')


def wait_for(condition, timeout: float = 20.0):
    deadline = time.monotonic() + timeout
    while not (value := condition()):
        assert time.monotonic() < deadline, 'timed out'
        time.sleep(0.02)
    return value


def pid_in(log: Path) -> int:
    # A whole line.
    wait_for(lambda: log.exists() and re.match(r'pid \d+\n', log.read_text()))
    return int(log.read_text().split()[1])


def lives(pid: int) -> bool:
    """Whether a process still runs; one that only waits to be reaped does not."""
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != 'Z'


def test_normal_end_stops_the_others_and_the_recorder_last(tmp_path):
    leader = 'import time; time.sleep(1.0)'
    run([
        command(tmp_path, 'recorder', NODE),
        command(tmp_path, 'gauges', NODE),
        command(tmp_path, 'session', leader),
    ])
    ends = {
        name: float((tmp_path / f'{name}.log').read_text().split()[-1])
        for name in ('recorder', 'gauges')
    }
    assert ends['gauges'] < ends['recorder']
    assert not any(lives(pid_in(tmp_path / f'{name}.log')) for name in ends)


def test_a_node_that_dies_stops_all_and_is_named_with_its_last_words(tmp_path):
    dying = "import sys, time; time.sleep(0.5); sys.exit('the socket is gone')"
    with pytest.raises(NodeFailed, match=r'(?s)node cell ended with status 1.*the socket is gone'):
        run([
            command(tmp_path, 'recorder', NODE),
            command(tmp_path, 'cell', dying),
            command(tmp_path, 'session', NODE),
        ])
    for name in ('recorder', 'session'):
        assert not lives(pid_in(tmp_path / f'{name}.log'))


def test_a_session_goes_on_without_a_page(tmp_path, capsys):
    dying = command(tmp_path, 'view', "import sys; sys.exit('the port is taken')")
    leader = 'import time; time.sleep(1.0)'
    assert run([
        command(tmp_path, 'recorder', NODE),
        replace(dying, optional=True),
        command(tmp_path, 'session', leader),
    ])
    log = tmp_path / 'view.log'
    assert capsys.readouterr().out == (
        f'node view has ended, the session goes on; its log: {log}\n'
    )


def test_a_node_that_is_killed_is_named_with_the_signal(tmp_path):
    dying = 'import os, signal; os.kill(os.getpid(), signal.SIGKILL)'
    with pytest.raises(NodeFailed, match='node gauges was killed by SIGKILL'):
        run([
            command(tmp_path, 'recorder', NODE),
            command(tmp_path, 'gauges', dying),
            command(tmp_path, 'session', NODE),
        ])


def test_status_2_is_a_users_mistake_told_in_one_line(tmp_path):
    mistake = """
import sys
print('session: demo.yaml: setups: missing', file=sys.stderr)
sys.exit(2)
"""
    with pytest.raises(UserError) as error:
        run([command(tmp_path, 'recorder', NODE), command(tmp_path, 'session', mistake)])
    assert str(error.value) == 'demo.yaml: setups: missing'


def test_a_recorder_that_fails_at_the_end_fails_the_session(tmp_path):
    broken = NODE.replace('sys.exit(0)', "sys.exit('disk full')")
    with pytest.raises(NodeFailed, match=r'(?s)node recorder.*disk full'):
        run([
            command(tmp_path, 'recorder', broken),
            command(tmp_path, 'session', 'import time; time.sleep(0.7)'),
        ])


def test_a_node_that_does_not_end_is_killed_and_told(tmp_path):
    commands = [
        command(tmp_path, 'recorder', NODE),
        command(tmp_path, 'cell', DEAF),
        command(tmp_path, 'session', 'import time; time.sleep(1.0)'),
    ]
    with pytest.raises(NodeFailed, match='node cell did not end'):
        run(commands, patience=0.3)
    assert not lives(pid_in(tmp_path / 'cell.log'))


RUNNER = """
import sys
from pathlib import Path
from rtest_drivers.runner import Command, Stopped, run
folder = Path(sys.argv[1])
try:
    run(
        [
            Command(name, (sys.executable, '-c', sys.argv[2]), folder / f'{name}.log')
            for name in ('recorder', 'gauges', 'session')
        ],
        leftovers=(str(folder / 'cell.sock'),),
    )
except Stopped as stopped:
    print(stopped)
    sys.exit(128 + stopped.signum)
"""


def start_runner(folder: Path) -> tuple[subprocess.Popen, list[int]]:
    (folder / 'cell.sock').touch()
    runner = subprocess.Popen(
        [sys.executable, '-c', RUNNER, str(folder), NODE], stdout=subprocess.PIPE, text=True
    )
    return runner, [pid_in(folder / f'{n}.log') for n in ('recorder', 'gauges', 'session')]


@pytest.mark.parametrize('signum', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_to_the_runner_stops_all_in_order(tmp_path, signum):
    runner, pids = start_runner(tmp_path)
    runner.send_signal(signum)
    out, _ = runner.communicate(timeout=20)
    assert runner.returncode == 128 + signum
    assert signal.Signals(signum).name in out
    assert not any(map(lives, pids))
    ends = [(tmp_path / f'{n}.log').read_text().split()[-2:] for n in ('session', 'recorder')]
    assert ends[0][0] == ends[1][0] == 'end'
    assert float(ends[0][1]) < float(ends[1][1])
    assert not (tmp_path / 'cell.sock').exists()


def test_no_node_outlives_a_killed_runner(tmp_path):
    runner, pids = start_runner(tmp_path)
    runner.kill()
    runner.communicate(timeout=20)
    wait_for(lambda: not any(map(lives, pids)))
    # Each was asked first, so that a recording is closed.
    assert all('end' in (tmp_path / f'{n}.log').read_text() for n in ('recorder', 'gauges'))
    wait_for(lambda: not (tmp_path / 'cell.sock').exists())


def test_stop_kills_what_does_not_listen():
    process = subprocess.Popen(
        [sys.executable, '-c', DEAF], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    with process:
        process.stdout.readline()
        assert stop([process], patience=0.2) == [process]
        assert process.returncode == -signal.SIGKILL


def test_only_dead_shared_memory_of_this_run_is_removed(tmp_path):
    for name in ('fastrtps_dead', 'fastrtps_alive', 'fastrtps_shared', 'fastrtps_old', 'other'):
        for suffix in ('', '_el'):
            (tmp_path / f'{name}{suffix}').touch()
    (tmp_path / 'sem.fastrtps_dead_mutex').touch()
    (tmp_path / 'fastrtps_shared_sl').touch()
    os.utime(tmp_path / 'fastrtps_old_el', (1.0, 1.0))
    with (tmp_path / 'fastrtps_alive_el').open() as alive, (
        tmp_path / 'fastrtps_shared_sl'
    ).open() as shared:
        fcntl.flock(alive, fcntl.LOCK_EX)
        fcntl.flock(shared, fcntl.LOCK_SH)
        removed = remove_dead_shared_memory(time.time() - 60.0, tmp_path)
    assert set(removed) == {'fastrtps_dead', 'fastrtps_dead_el', 'sem.fastrtps_dead_mutex'}
    assert not (tmp_path / 'fastrtps_dead').exists()
    assert (tmp_path / 'fastrtps_old').exists() and (tmp_path / 'fastrtps_shared').exists()


def test_dead_ports_are_removed_too(tmp_path):
    """A port keeps its segment and mutex when a writer of it was killed."""
    dead = {'fastrtps_port7413', 'fastrtps_port7415', 'fastrtps_port7415_el'}
    alive = {'fastrtps_port7417', 'fastrtps_port7417_sl'}
    for name in dead | alive:
        (tmp_path / name).touch()
    dead |= {'sem.fastrtps_port7413_mutex', 'sem.fastrtps_port7499_mutex'}
    alive |= {'sem.fastrtps_port7417_mutex', 'other'}
    for name in dead | alive:
        (tmp_path / name).touch()
    mapped = tmp_path / 'fastrtps_port7421'
    mapped.write_bytes(bytes(4096))
    with (tmp_path / 'fastrtps_port7417_sl').open() as shared, mapped.open('r+b') as file:
        fcntl.flock(shared, fcntl.LOCK_SH)
        with mmap.mmap(file.fileno(), 4096):
            removed = remove_dead_shared_memory(0.0, tmp_path, until=time.time() - 60.0)
            assert not removed, 'too young'
            removed = remove_dead_shared_memory(0.0, tmp_path)
    assert set(removed) == dead
    assert {path.name for path in tmp_path.iterdir()} == alive | {mapped.name}


def test_the_socket_of_a_dead_cell_is_removed(tmp_path):
    paths = [tmp_path / f'rtest-cell-{name}.sock' for name in ('dead', 'alive', 'file')]
    with socket.socket(socket.AF_UNIX) as dead, socket.socket(socket.AF_UNIX) as alive:
        dead.bind(str(paths[0]))
        alive.bind(str(paths[1]))
        alive.listen()
        dead.close()
        paths[2].touch()
        assert remove_dead_sockets(tmp_path) == ['rtest-cell-dead.sock']
    assert paths[1].exists() and paths[2].exists()


def test_free_domain_avoids_a_domain_in_use():
    first = free_domain()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(('', 7400 + 250 * first + 10))
        assert free_domain() != first


def test_names_that_would_break_ros_arguments_are_refused(tmp_path):
    for wrong in (
        {'session': 'a/b'}, {'namespace': 'my cell'}, {'remaps': ('rtest/plan=plan',)},
        {'rate': -1.0}, {'rate': 0.0}, {'rate': float('nan')},
    ):
        with pytest.raises(UserError):
            GraphSettings(**{'config': tmp_path, 'session': 'a', 'out': tmp_path, **wrong})


def test_arguments_keep_their_types(tmp_path):
    truth = tmp_path / 'truth.yaml'
    settings = GraphSettings(tmp_path / 'a b.yaml', '12', tmp_path, truth, rate=10)
    nodes = {node.name: node for node in session_nodes(settings)}
    session = ros_arguments(nodes['session'], 'hall/cell_1', ('rtest/plan:=plan',))
    assert session[:6] == ['-r', '__node:=session', '-r', '__ns:=/hall/cell_1', '-r',
                           'rtest/plan:=plan']
    assert 'session:="12"' in session and 'use_sim_time:=true' in session
    assert f'config:="{tmp_path}/a b.yaml"' in session
    assert 'rate:=10.0' in ros_arguments(nodes['cell'])
    assert 'topics:=["rtest/.*", "/diagnostics"]' in ros_arguments(nodes['recorder'])
    assert not any('use_sim_time' in a for a in ros_arguments(nodes['cell']))


def test_without_a_simulated_cell_the_drivers_are_somebody_elses(tmp_path):
    nodes = session_nodes(GraphSettings(tmp_path / 'a.yaml', 'a', tmp_path))
    assert [n.name for n in nodes] == ['recorder', 'estimator', 'identifier', 'session']
    assert not any(n.parameters.get('use_sim_time') for n in nodes)


def test_a_simulated_session_ignores_the_domain_and_range_of_the_environment(monkeypatch):
    monkeypatch.setenv('ROS_DOMAIN_ID', '42')
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET')
    monkeypatch.setenv('ROS_STATIC_PEERS', '10.0.0.1')
    with held_domain(True, None) as domain, held_domain(True, None) as other:
        assert 42 not in (domain, other) and domain != other
    environment = session_environment(True, domain)
    assert environment['ROS_DOMAIN_ID'] == str(domain)
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    assert 'ROS_STATIC_PEERS' not in environment
    # A real machine is where the user's environment says.
    assert chosen_domain(False, None) == 42 and chosen_domain(True, 7) == 7
    assert session_environment(False, 42)['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SUBNET'
    assert 'FASTRTPS_DEFAULT_PROFILES_FILE' not in session_environment(False, 42)
    # Where it says nothing, nobody listens to other hosts.
    monkeypatch.delenv('ROS_STATIC_PEERS')
    monkeypatch.delenv('ROS_AUTOMATIC_DISCOVERY_RANGE')
    environment = session_environment(False, 42)
    assert environment['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
    profile = Path(environment['FASTRTPS_DEFAULT_PROFILES_FILE']).read_text()
    assert '<address>127.0.0.1</address>' in profile
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', 'mine.xml')
    environment = session_environment(True, domain)
    assert environment['FASTRTPS_DEFAULT_PROFILES_FILE'] == 'mine.xml'


def test_a_second_session_in_a_domain_is_refused():
    domain = free_domain()
    with held_domain(True, domain):
        assert free_domain() != domain
        with pytest.raises(UserError, match=f'a session runs in ROS domain {domain} already'), (
            held_domain(True, domain)
        ):
            pass
    with held_domain(False, domain, 'cell_1'), held_domain(False, domain, '/cell_2'):
        pass


@pytest.mark.parametrize('text', ['abc', '-1', '233', '1.5', '²'])
def test_a_domain_that_is_none_is_refused(monkeypatch, text):
    monkeypatch.setenv('ROS_DOMAIN_ID', text)
    with pytest.raises(UserError, match=f'ROS_DOMAIN_ID={text}: expected a number from 0 to 232'):
        chosen_domain(False, None)
    monkeypatch.setenv('ROS_DOMAIN_ID', '')
    assert chosen_domain(False, None) == 0 and chosen_domain(True, None) is None


def test_an_incomplete_session_is_no_failed_node(tmp_path):
    leader = f'import sys, time; time.sleep(0.5); sys.exit({INCOMPLETE})'
    for code, complete in ((leader, False), ('import time; time.sleep(0.5)', True)):
        commands = [command(tmp_path, 'recorder', NODE), command(tmp_path, 'session', code)]
        assert run(commands) is complete


def test_a_default_name_is_one_that_is_allowed(tmp_path):
    for stem in ('sp äö (2)', 'a/b', '..', 'ü', 'größe.v2'):
        name = session_name(stem)
        assert GraphSettings(tmp_path, name, tmp_path).session == name
    assert session_name('monday').startswith('monday-2')
