"""Faults of real devices in a running session: told within a second, and only what they hit lost.

The controller is a server that speaks as linuxcncrsh does, the gauges are emulated; what moves the
machine from pose to pose is the test, in the place of an NC program.
"""

import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from measured_sphere import MeasuredSphere

from rtest_drivers.cli import main
from rtest_drivers.config import config_path
from rtest_drivers.domain import free_domain
from rtest_drivers.sim.cnc_devices import LinuxCncServer
from rtest_drivers.sim.errors import GeometricErrors
from rtest_estimation.recording import read_recording
from rtest_estimation.records import CyclePlan
from rtest_identification.offline import estimate_recording
from rtest_identification.session_file import load_session

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(
        not (find_spec('rclpy') and find_spec('rtest_msgs')), reason='needs ROS 2 and rtest_msgs'
    ),
]

SESSION = """
machine: {machine}
cycle: {{b_deg: [-30, 0, 30], c_deg: [0, 90, 180], dwell_s: 0.2}}
nest_calibration: {{step_mm: 1.0, dwell_s: 0.2}}
setups:
  a: {{sphere_mm: [0, -60.0, 40.0]}}
devices:
  gauges: {{backend: serial, file: nest.yaml}}
  cnc: {{backend: linuxcnc, file: cnc.yaml}}
"""
CNC = """
port: {port}
rate_hz: 100
axes:
  X: {{index: 0, unit: mm}}
  Y: {{index: 1, unit: mm}}
  Z: {{index: 2, unit: mm}}
  B: {{index: 3, unit: deg}}
  C: {{index: 4, unit: deg}}
"""
ERRORS = GeometricErrors({'E_X(0Y)B': -8e-6, 'E_A(0Y)B': 18e-6}, {})
PARKED = (0.0, -60.0, 90.0, 0.0, 0.0)
SECOND = 1_000_000_000
# Lost, and a moment later not there to be opened again.
UNPLUGGED = 'gauges-b: .*(plug it in again|check the cable)'


class Machine:
    """Controller, gauges and the motion of a session; the files are in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.server = LinuxCncServer()
        self.server.position = PARKED
        self.config = folder / 'faults.yaml'
        self.config.write_text(SESSION.format(machine=config_path('nmv1500dcg.yaml')))
        (folder / 'cnc.yaml').write_text(CNC.format(port=self.server.port))
        loaded = load_session(self.config)
        self.plans = {plan.cycle: plan for plan in loaded.plans}
        spheres = {plan.setup: plan.sphere for plan in loaded.plans}
        self.sphere = MeasuredSphere(
            loaded.machine, ERRORS, list(spheres.values()), lambda: self.server.position[:5]
        )

    def play(self, cycle: str, stop: int | None = None) -> Iterator[int]:
        """Go from pose to pose; gives each one's number while the axes stand there.

        stop : the pose before which the program ends; else it leaves the nest after the last
        """
        plan = self.plans[cycle]
        self.server.program = 'RUNNING'
        for number, row in enumerate(joints(plan)[:stop]):
            self._move(row, 0.2)
            yield number
            time.sleep(plan.dwell + 0.06)
        if stop is None:
            self._move(np.array(PARKED), 0.3)
            self.server.program = 'IDLE'

    def _move(self, goal: np.ndarray, seconds: float) -> None:
        start, steps = np.array(self.server.position), round(seconds * 100)
        for step in range(1, steps + 1):
            self.server.position = tuple(start + step / steps * (goal - start))
            time.sleep(0.01)

    def restart(self, down: float) -> None:
        """The server of the controller ends, and is there again some seconds later."""
        old = self.server
        old.close()
        time.sleep(down)
        new = LinuxCncServer(port=old.port)
        new.position, new.program = old.position, old.program
        self.server = new


def joints(plan: CyclePlan) -> np.ndarray:
    """(poses, 5) commands in the order of the joints [mm], [deg]."""
    scale = [1e3 if axis in 'XYZ' else 180.0 / np.pi for axis in plan.axes]
    return (plan.commands * scale)[:, [plan.axes.index(axis) for axis in 'XYZBC']]


class Session:
    """A running `rtest session`, and what it says."""

    def __init__(self, machine: Machine) -> None:
        self.out, self.domain = machine.folder / 'out', str(free_domain())
        self._process = subprocess.Popen(
            [sys.executable, '-m', 'rtest_drivers.cli', 'session', '--config',
             str(machine.config), '--session', 'faults', '--out', str(self.out), '--domain',
             self.domain],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'},
        )
        self.said: list[str] = []
        self._lines: queue.Queue[str | None] = queue.Queue()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        for line in self._process.stdout:
            self._lines.put(line)
        self._lines.put(None)

    def until(self, words: str | None, timeout: float = 30.0) -> str:
        """The next line with these words; None for the end of the process."""
        limit = time.monotonic() + timeout
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, limit - time.monotonic()))
            except queue.Empty:
                pytest.fail(f'{words!r} was not said:\n{"".join(self.said)}')
            if line is None:
                assert words is None, f'{words!r} was not said:\n{"".join(self.said)}'
                return ''
            self.said.append(line)
            if words is not None and words in line:
                return line

    def end(self) -> int:
        """Wait for the end; returns the exit status."""
        self.until(None, 60.0)
        return self._process.wait(10.0)

    def close(self) -> None:
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            self._process.wait(30.0)
        self._thread.join()
        self._process.stdout.close()


def diagnostics(recording: Path, driver: str) -> list[tuple[int, int, str]]:
    """Time [ns], level and text of what a driver said."""
    from mcap_ros2.decoder import DecoderFactory

    found = []
    with recording.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, message, decoded in reader.iter_decoded_messages(topics=['/diagnostics']):
            for status in decoded.status:
                if status.name == f'{driver}: driver':
                    found.append((message.log_time, int(status.level), status.message))
    return found


def first_after(said: list[tuple[int, int, str]], when: int, words: str) -> float:
    """How long after a time something was said [s]."""
    times = [t for t, level, text in said if t >= when and level and re.search(words, text)]
    assert times, (words, [text for t, _, text in said if t >= when][:8])
    return (times[0] - when) / SECOND


def test_faults_of_a_session(tmp_path: Path) -> None:
    machine = Machine(tmp_path)
    happened: dict[str, int] = {}

    def note(name: str) -> None:
        happened[name] = time.time_ns()

    with machine.sphere.gauges(tmp_path) as (_, devices):
        session = Session(machine)
        try:
            session.until('start the NC program of a-nest: 28 poses')
            assert main(['ask', 'repeat', '--domain', session.domain]) == 0
            session.until('repeat, as was asked for')
            session.until('start the NC program of a-nest: 28 poses')
            for pose in machine.play('a-nest'):
                if pose == 10:
                    note('unplugged')
                    devices[1].unplug()
                elif pose == 12:
                    devices[1].plug()
            session.until('start the NC program of a-static: ')
            assert any(re.search(UNPLUGGED, line) for line in session.said), session.said
            for pose in machine.play('a-static', stop=5):
                stopped = pose
            note('e-stop')
            machine.server.estop, machine.server.machine_on = True, False
            machine.server.program = 'IDLE'
            line = session.until('the program has ended')
            assert f'{stopped + 1} of 11 poses' in line and 'E-stop is on' in line
            machine.server.estop, machine.server.machine_on = False, True
            session.until('start the NC program of a-static: ')
            for pose in machine.play('a-static'):
                if pose == 6:
                    note('restart')
                    machine.restart(down=1.0)
            assert session.end() == 0, ''.join(session.said)
        finally:
            session.close()
            machine.server.close()
    folder = session.out / 'faults'
    gauges, cnc = (diagnostics(folder / 'faults.mcap', name) for name in ('gauges', 'cnc'))
    took = {
        'unplugged': first_after(gauges, happened['unplugged'], UNPLUGGED),
        'e-stop': first_after(cnc, happened['e-stop'], 'E-stop is on; release it'),
        'restart': first_after(cnc, happened['restart'], 'linuxcncrsh.*start LinuxCNC'),
    }
    assert max(took.values()) < 1.0, took
    assert [level for _, level, _ in cnc][-1] == 0, 'it is well again'

    recording = read_recording(folder)
    assert recording.closed and len(recording.plans) == 4
    nest, static = (one.cycle for one in estimate_recording(recording))
    assert {m.index for m in nest.missing} <= {10, 11, 12, 13} and nest.missing
    assert all(m.reason.startswith('gauge 3 no signal') for m in nest.missing), nest.missing
    # Of the second attempt at the static cycle the pose is missing at which nobody answered.
    assert static.plan.stamp == recording.plans[3].stamp
    assert [m.index for m in static.missing] == [6]
    assert 'stale' in static.missing[0].reason
    assert len(static.points) == 10


def test_the_check_of_a_session_says_what_answers(tmp_path: Path, capsys) -> None:
    machine = Machine(tmp_path)
    try:
        with machine.sphere.gauges(tmp_path) as (_, devices):
            machine.server.position = tuple(joints(machine.plans['a-nest'])[0])
            command = ['session', '--config', str(machine.config), '--check']
            assert main(command) == 0
            out = capsys.readouterr().out
            assert out.count('keyence-lkg') == 2 and out.count('gauge ') == 3
            assert 'Y    -60.00000 mm' in out and out.strip().endswith('every device answers')
            devices[1].fault = 'silent'
            machine.server.estop = True
            assert main(command) == 1
            err = capsys.readouterr().err
            assert 'gauges-b' in err and 'check power, cable' in err and 'E-stop is on' in err
    finally:
        machine.server.close()
    (tmp_path / 'cnc.yaml').write_text('port: none\n')
    assert main(command) == 2
    assert 'cnc.yaml: port: expected a whole number' in capsys.readouterr().err
