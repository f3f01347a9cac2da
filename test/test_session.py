"""Whole sessions over DDS: every node a process, the simulated cell as the hardware."""

from __future__ import annotations

import json
import os
import re
import select
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from rtest_drivers.config import config_path
from rtest_drivers.domain import free_domain
from rtest_drivers.info import describe
from rtest_drivers.processes import remove_leftovers
from rtest_drivers.sim.check import check
from rtest_estimation.recording import read_recording

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(
        not (find_spec('rclpy') and find_spec('rtest_msgs')), reason='needs ROS 2 and rtest_msgs'
    ),
]

CONFIG = """
machine: {machine}
cycle: {{b_deg: [-60, 0, 60], c_deg: [0, 90, 180, 270], dwell_s: 0.3}}
nest_calibration: {{step_mm: 1.0, dwell_s: 0.3}}
setups:
  1a: {{sphere_mm: [0, -90.0, 40.6]}}
"""
NODES = ('recorder', 'estimator', 'identifier', 'cell', 'gauges', 'cnc', 'session')


def children(pid: int) -> list[str]:
    return Path(f'/proc/{pid}/task/{pid}/children').read_text().split()


def command_of(pid: str) -> str:
    return Path(f'/proc/{pid}/cmdline').read_bytes().decode(errors='replace')


def socket_paths(pid: int) -> list[str]:
    """Sockets with a name that a process was told of."""
    return re.findall(r'/[^"\0]*rtest-cell-[^"\0]*\.sock', command_of(str(pid)))


class Session:
    """`rtest session` of one set-up, 3 B x 4 C, in a folder of its own."""

    def __init__(self, folder: Path, *more: str) -> None:
        self.out = folder / 'out'
        config = folder / 'short.yaml'
        config.write_text(CONFIG.format(machine=config_path('nmv1500dcg.yaml')))
        self.process = subprocess.Popen(
            [
                sys.executable, '-m', 'rtest_drivers.cli', 'session', '--config', str(config),
                '--simulate', str(config_path('cell_demo.yaml')), '--session', 'short',
                '--out', str(self.out), *more,
            ],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder,
            # A simulated session is in a domain of its own, whatever the user's.
            env={
                **os.environ, 'ROS_DOMAIN_ID': 'none', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF',
            },
        )

    def end(self, timeout: float = 90.0) -> tuple[int, str, str]:
        out, err = self.process.communicate(timeout=timeout)
        return self.process.returncode, out, err

    def wait_for_cycle(self) -> None:
        """Wait until the first cycle is finished."""
        self.wait_for('residual')

    def wait_for(self, words: str) -> None:
        """Wait until these words are said."""
        for line in self.process.stdout:
            if words in line:
                return
        pytest.fail(self.process.stderr.read())

    def pids(self) -> dict[str, int]:
        """Process ids of the nodes by name: those that run in the folder of the test."""
        found = {}
        for entry in Path('/proc').glob('[0-9]*'):
            try:
                words = (entry / 'cmdline').read_bytes().decode(errors='replace').split('\0')
                here = Path(os.readlink(entry / 'cwd')) == self.out.parent
            except OSError:
                continue
            for name in (word.rpartition('.nodes.')[2] for word in words if '.nodes.' in word):
                if here and name in NODES:
                    found[name] = int(entry.name)
        return found

    def shared_memory(self) -> set[Path]:
        """Fast DDS segments and ports that belong to the nodes, and their mutexes."""
        found = set()
        for pid in self.pids().values():
            maps = Path(f'/proc/{pid}/maps').read_text()
            found |= set(re.findall(r'/dev/shm/\S*fastrtps_\S+', maps))
        assert any('_port' in name for name in found)
        return {Path(name) for name in found}

    def nothing_runs(self) -> bool:
        """Whether every process of the session ends within some seconds."""
        deadline = time.monotonic() + 15.0
        while self.pids():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.1)
        return True


@pytest.fixture
def start(tmp_path):
    """Starts a session; nothing of it is left after the test, whatever happens."""
    sessions = []

    def begin(*more: str) -> Session:
        sessions.append(Session(tmp_path, *more))
        return sessions[-1]

    yield begin
    for session in sessions:
        session.process.kill()
        session.process.communicate()
        session.nothing_runs()
        for pid in session.pids().values():
            os.kill(pid, signal.SIGKILL)


def test_a_session_from_calibration_to_identification(start, tmp_path):
    session = start()
    status, out, err = session.end()
    assert status == 0, out + err
    assert '1/2 1a-nest: ' in out and out.count('1a-static: 14 of 14 poses') == 1
    assert out.splitlines()[-1].startswith('short: ')
    assert session.nothing_runs()

    recording = read_recording(session.out / 'short')
    assert recording.closed and recording.lost == 0
    assert {'/rtest/machine', '/rtest/plan', '/rtest/gauges', '/rtest/cnc/feedback', '/rtest/nest',
            '/rtest/cycle', '/rtest/location_errors', '/rtest/error_map', '/diagnostics'} <= set(
        recording.topics
    )
    # Only with --frames.
    assert not {'/tf', '/tf_static', '/robot_description'} & set(recording.topics)
    assert recording.gauges[0].sequence == 0, 'the first reading is in the recording'

    # The command finds in the recording what the node published, bit for bit.
    path = session.out / 'short' / 'identification' / 'identification.json'
    found = json.loads(path.read_text())
    offline = {**found['location_errors'], **found['squareness']}
    live = recording.location_errors[-1]
    published = dict(zip(live.symbols, live.values.tolist(), strict=True))
    assert offline and all(published[s] == entry['value'] for s, entry in offline.items())

    # One set-up does not tell everything; what it does tell agrees with the truth.
    rows = check(config_path('cell_demo.yaml'), path).constants
    lengths = [row for row in rows if row.symbol in ('E_X(0Y)B', 'E_Y(0Y)B')]
    assert lengths and all(abs(row.value - row.given) < 20e-6 for row in lengths)


def test_a_node_that_dies_ends_the_session_and_the_recording_opens(start):
    session = start()
    session.wait_for_cycle()
    segments = session.shared_memory()
    os.kill(session.pids()['estimator'], signal.SIGKILL)
    status, _, err = session.end()
    assert status == 1
    assert 'node estimator was killed by SIGKILL' in err and 'short.mcap' in err
    assert session.nothing_runs()
    assert segments and not any(segment.exists() for segment in segments)
    assert read_recording(session.out / 'short').closed


@pytest.mark.parametrize('signum', [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_session_is_closed_properly(start, signum):
    session = start()
    session.wait_for_cycle()
    session.process.send_signal(signum)
    status, _, err = session.end()
    assert status == 128 + signum and signum.name in err and 'Traceback' not in err
    assert session.nothing_runs()
    recording = read_recording(session.out / 'short')
    assert recording.closed and len(recording.cycles) >= 1


def test_a_killed_runner_leaves_no_process_and_a_recording_that_opens(start):
    session = start()
    session.wait_for_cycle()
    segments = session.shared_memory()
    session.process.kill()
    session.process.communicate()
    assert session.nothing_runs()
    assert segments and not any(segment.exists() for segment in segments)
    assert read_recording(session.out / 'short').closed


def test_what_a_session_left_that_was_killed_altogether_goes_with_the_next(start):
    session = start()
    session.wait_for_cycle()
    files = session.shared_memory()
    # With their locks and mutexes, which nobody maps for long.
    files |= {other for path in files for other in path.parent.glob(f'*{path.name}_*')}
    files |= {Path(path) for path in socket_paths(session.pids()['cell'])}
    guards = [int(pid) for pid in children(session.process.pid) if 'guard' in command_of(pid)]
    # The guards first: they would end the nodes properly.
    pids = [*guards, session.process.pid, *session.pids().values()]
    # A process has no command line any more while its last threads still hold their locks; its
    # descriptor tells when all have ended.
    descriptors = [os.pidfd_open(pid) for pid in pids]
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    for descriptor in descriptors:
        assert select.select([descriptor], [], [], 15.0)[0]
        os.close(descriptor)
    session.process.communicate()
    assert session.nothing_runs()
    # What came between the listing and the end belongs to the same segments.
    files |= {other for path in files for other in path.parent.glob(f'*{path.name}_*')}
    left = {path for path in files if path.exists()}
    assert any(path.suffix == '.sock' for path in left) and len(left) > 10
    for path in left:
        # As if it had happened a while ago: what is young may belong to a node that starts.
        os.utime(path, (time.time() - 60.0,) * 2)
    remove_leftovers()
    assert not [path for path in left if path.exists()]


def test_a_session_in_a_namespace_with_a_remapped_topic(start):
    session = start('--namespace', 'hall/cell_1', '--remap', 'rtest/gauges:=probe/readings')
    status, out, err = session.end()
    assert status == 0, out + err
    topics = read_recording(session.out / 'short').topics
    assert '/hall/cell_1/probe/readings' in topics and '/hall/cell_1/rtest/cycle' in topics


def with_faults(folder: Path, faults: str) -> str:
    """Path of a truth file with these faults."""
    text = config_path('cell_demo.yaml').read_text()
    text = text.replace('machine: nmv', f'machine: {config_path("nmv1500dcg.yaml").parent}/nmv')
    path = folder / 'truth.yaml'
    path.write_text(f'{text}\nfaults: {faults}\n')
    return str(path)


def test_a_last_pose_that_never_comes_does_not_hold_the_session_up(start, tmp_path):
    truth = with_faults(tmp_path, """
  - {kind: lost_block, cycle: 1a-nest, pose: 5}
  - {kind: pose_skipped, cycle: 1a-static, pose: 13}""")
    session = start('--simulate', truth)
    status, out, err = session.end()
    assert status == 0, out + err
    assert '2/2 1a-static: 13 of 14 poses, no other pose for ' in out
    assert '2/2 1a-static: 13 of 14 poses, 1 missing (13: never reached)' in out
    assert '  missing: 1a-static 13: never reached' in out
    # What was lost in the first cycle is not told again in the second.
    assert 'lost' in out and out.count('did not arrive') <= 1
    assert out.count('readings or messages lost') == 1
    assert out.splitlines()[-1].startswith('short: ') and '13 of 14 poses' in out.splitlines()[-1]
    values = [
        line for line in describe(session.out / 'short') if line.startswith('missing')
    ]
    assert values[0] == 'missing   2 of 42 poses'
    assert values[1:] == [
        'missing   1a-nest 5: no gauge readings', 'missing   1a-static 13: never reached',
    ]


def test_a_cycle_without_a_point_makes_the_session_incomplete(start, tmp_path):
    truth = with_faults(tmp_path, '[{kind: gauge_silent, cycle: 1a-static}]')
    session = start('--simulate', truth)
    status, out, err = session.end()
    assert status == 1 and 'Traceback' not in err
    assert '1a-static: 0 of 14 poses, 14 missing (0-13: no gauge readings)' in out
    assert 'incomplete: nothing was measured in 1a-static' in out
    assert '1a-static 0-13: no gauge readings' in err, 'why it could not be identified'
    recording = read_recording(session.out / 'short')
    assert recording.closed and len(recording.cycles) == 2


def test_a_second_session_in_a_domain_is_refused_and_the_first_goes_on(start, tmp_path):
    domain = str(free_domain())
    session = start('--domain', domain)
    session.wait_for_cycle()
    other = start('--domain', domain, '--session', 'other')
    status, out, err = other.end()
    assert status == 2 and not out and err.count('\n') == 1
    assert f'a session runs in ROS domain {domain} already' in err
    assert not (session.out / 'other').exists()
    status, out, err = session.end()
    assert status == 0, out + err


def test_the_session_node_itself_finds_another_one_in_the_graph(start, tmp_path):
    """As under ros2 launch, before it wakes the drivers."""
    domain = str(free_domain())
    session = start('--domain', domain, '--rate', '2')
    session.wait_for(' cycles, ')
    node = run_session_node(tmp_path, domain, 20.0)
    assert node.returncode == 2 and 'another session runs in this ROS domain' in node.stderr
    status, out, err = session.end()
    assert status == 0, out + err


def test_a_mistake_in_the_truth_file_is_one_line(start, tmp_path):
    truth = tmp_path / 'truth.yaml'
    truth.write_text('machine: nowhere.yaml\n')
    session = start('--simulate', str(truth))
    status, _, err = session.end()
    assert status == 2 and err.startswith('rtest: ') and err.count('\n') == 1
    assert session.nothing_runs()


def run_session_node(folder: Path, domain: str, timeout: float) -> subprocess.CompletedProcess:
    """The node alone, without the runner."""
    config = folder / 'short.yaml'
    config.write_text(CONFIG.format(machine=config_path('nmv1500dcg.yaml')))
    return subprocess.run(
        [
            sys.executable, '-m', 'rtest_drivers.nodes.session', '--ros-args',
            '-p', f'config:={config}', '-p', f'ready_timeout:={timeout}',
        ],
        capture_output=True, text=True, timeout=60,
        env={
            **os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_DOMAIN_ID': domain,
        },
    )


def test_missing_drivers_are_named(tmp_path):
    """Without a cell and without drivers in the graph."""
    done = run_session_node(tmp_path, str(free_domain()), 3.0)
    assert done.returncode == 1
    assert 'gauges, cnc, estimator, identifier, recorder' in done.stderr
    assert 'Traceback' not in done.stderr
