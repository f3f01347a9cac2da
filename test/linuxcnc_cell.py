"""A LinuxCNC without a screen as the machine's controller, for tests.

Five axes X Y Z B C with xyzbc-trt kinematics, in identity mode until a program switches them. What
the controller believes and where the machine is differ: between command and feedback of every
joint HAL adds an offset that the controller does not see, and a lag. Where the machine is can be
read from the pins named in `TRUE_PINS`: one value with `Cell.true_position` (halcmd), every servo
cycle with `Cell.true_positions` (halsampler).

There can be one LinuxCNC on a host only: `running` waits for another test's to end.
"""

import contextlib
import fcntl
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import pytest

from rtest_drivers.cnc.linuxcnc import LinuxCnc, load_linuxcnc
from rtest_drivers.cnc.linuxcnc_control import Control

AXES = 'XYZBC'
LINEAR = 'XYZ'
TRUE_PINS = tuple(f'lag.{joint}.out' for joint in range(len(AXES)))
PASSWORD, ENABLE_PASSWORD = 'open', 'sesame'
# LinuxCNC refuses to be run by root.
NOBODY = 65534
_START_S, _STOP_S, _OTHERS_S = 30.0, 15.0, 300.0
_LOCK = Path(tempfile.gettempdir()) / 'rtest_linuxcnc.lock'


def missing() -> str:
    """Why LinuxCNC cannot be run here; '' where it can."""
    if shutil.which('linuxcncrsh') is None:
        return 'LinuxCNC is not installed (apt install linuxcnc-uspace)'
    if os.geteuid() == 0 and shutil.which('setpriv') is None:
        return 'LinuxCNC does not run as root, and setpriv is not installed (util-linux)'
    return ''


@dataclass
class Cell:
    """A running LinuxCNC, homed, with the machine on.

    folder : its configuration, where programs can be put
    device : device file of the CNC driver, for one that takes control; watch.yaml beside it is for
        one that only looks on
    """

    folder: Path
    device: Path

    def control(self) -> Control:
        """Control of it; to be closed."""
        control = Control(load_linuxcnc(str(self.device)))
        control.open()
        return control

    def watch(self) -> LinuxCnc:
        """The backend, which only looks on; to be closed."""
        backend = LinuxCnc(str(self.folder / 'watch.yaml'))
        backend.open()
        return backend

    def program(self, name: str, text: str) -> Path:
        """An NC program where LinuxCNC can read it."""
        path = self.folder / name
        path.write_text(text)
        path.chmod(0o644)
        return path

    def set_error(self, axis: str, offset: float) -> None:
        """Put the machine off by `offset` [mm] or [deg] without the controller's knowledge."""
        self._hal('setp', f'err.{AXES.index(axis)}.offset', f'{offset:.9f}')

    def true_position(self) -> list[float]:
        """Where the axes are, X Y Z B C in [mm] and [deg]; one after the other, 0.1 s in all."""
        return [float(self._hal('getp', pin)) for pin in TRUE_PINS]

    @contextlib.contextmanager
    def true_positions(self) -> Iterator['TruePositions']:
        """Where the axes are, every servo cycle (1 ms)."""
        process = subprocess.Popen(
            _as_nobody(['stdbuf', '-oL', 'halsampler', '-t']), cwd=self.folder,
            env=_environment(self.folder), stdout=subprocess.PIPE, text=True,
        )
        try:
            # What the FIFO holds from before comes first.
            time.sleep(0.3)
            yield TruePositions(process)
        finally:
            process.terminate()
            process.wait(5.0)
            process.stdout.close()

    def kill_task(self) -> None:
        """The task process dies, as by a bug of it."""
        for pid, command in _processes():
            if command[:1] == ['milltask'] and str(self.folder) in ' '.join(command):
                os.kill(pid, signal.SIGKILL)

    def end_server(self) -> None:
        """LinuxCNC ends."""
        _signal_server(self.folder)

    def _hal(self, *words: str) -> str:
        done = subprocess.run(
            _as_nobody(['halcmd', '-s', *words]), cwd=self.folder, env=_environment(self.folder),
            capture_output=True, text=True, check=True, timeout=10.0,
        )
        return done.stdout.strip()


class TruePositions:
    """Follows the output of halsampler in a thread."""

    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process
        self._last: tuple[int, list[float]] | None = None
        self.cycles = self.overruns = 0
        threading.Thread(target=self._follow, daemon=True).start()

    @property
    def latest(self) -> tuple[int, list[float]] | None:
        """Arrival [ns] and X Y Z B C [mm], [deg] of the last servo cycle."""
        return self._last

    def _follow(self) -> None:
        for line in self._process.stdout:
            words = line.split()
            if len(words) != 1 + len(AXES):
                self.overruns += 1
                continue
            self._last = time.time_ns(), [float(word) for word in words[1:]]
            self.cycles += 1


@contextlib.contextmanager
def running(errors: dict[str, float] | None = None, lag: float = 0.2) -> Iterator[Cell]:
    """Start LinuxCNC, switch on and home; stop it at the end and look that nothing is left.

    errors : offset of an axis that the controller does not see [mm], [deg]
    lag : gain of the low pass between command and machine, per servo cycle; 1 for none
    """
    folder = Path(tempfile.mkdtemp(prefix='rtest_linuxcnc_'))
    with open(_LOCK, 'a') as lock:
        _wait_for(lock)
        port = _free_port()
        _write(folder, port, errors or {}, lag)
        log = open(folder / 'log.txt', 'w')  # noqa: SIM115
        process = subprocess.Popen(
            _as_nobody(['linuxcnc', '-r', str(folder / 'cell.ini')]), cwd=folder,
            env=_environment(folder), stdin=subprocess.DEVNULL, stdout=log,
            stderr=subprocess.STDOUT, start_new_session=True,
        )
        try:
            cell = Cell(folder, folder / 'device.yaml')
            _switch_on(cell, process, folder)
            yield cell
        finally:
            left = _stop(process, folder)
            log.close()
            shutil.rmtree(folder)
        assert not left, f'left behind by LinuxCNC: {left}'


@pytest.fixture
def linuxcnc() -> Iterator[Cell]:
    """A LinuxCNC without injected errors."""
    if why := missing():
        pytest.skip(why)
    with running() as cell:
        yield cell


def _wait_for(lock: TextIO) -> None:
    limit = time.monotonic() + _OTHERS_S
    while True:
        try:
            return fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            assert time.monotonic() < limit, 'another test has LinuxCNC'
            time.sleep(0.2)


def _switch_on(cell: Cell, process: subprocess.Popen, folder: Path) -> None:
    limit = time.monotonic() + _START_S
    while True:
        try:
            control = cell.control()
            break
        except ConnectionError:
            ended = process.poll() is not None
            if ended or time.monotonic() > limit:
                text = (folder / 'log.txt').read_text()
                raise AssertionError(f'LinuxCNC did not start:\n{text}') from None
            time.sleep(0.1)
    control.machine_on()
    control.home()
    control.close()


def _stop(process: subprocess.Popen, folder: Path) -> list[str]:
    """SIGTERM to linuxcncrsh ends all of LinuxCNC; what is left is killed and returned."""
    _signal_server(folder)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(_STOP_S)
    limit = time.monotonic() + 5.0
    while (left := _ours(folder)) and time.monotonic() < limit:
        time.sleep(0.1)
    for pid in left:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.poll()
    return [f'{pid} {command}' for pid, command in left.items()]


def _signal_server(folder: Path) -> None:
    for pid, command in _processes():
        if command[0].endswith('linuxcncrsh') and str(folder) in ' '.join(command):
            os.kill(pid, signal.SIGTERM)


def _ours(folder: Path) -> dict[int, str]:
    """Processes of this LinuxCNC: those that name its folder, and those that work in it."""
    ours = {}
    for pid, command in _processes():
        with contextlib.suppress(OSError):
            if str(folder) in ' '.join(command) or os.readlink(f'/proc/{pid}/cwd') == str(folder):
                ours[pid] = ' '.join(command)
    return ours


def _processes() -> Iterator[tuple[int, list[str]]]:
    for entry in Path('/proc').iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                words = (entry / 'cmdline').read_bytes().decode(errors='replace').split('\0')
                if words[0]:
                    yield int(entry.name), words


def _as_nobody(command: list[str]) -> list[str]:
    if os.geteuid() != 0:
        return command
    return ['setpriv', f'--reuid={NOBODY}', f'--regid={NOBODY}', '--clear-groups', *command]


def _environment(folder: Path) -> dict[str, str]:
    # Without the tests' Python, which comes first in PATH: LinuxCNC's scripts want the system's.
    return {'HOME': str(folder), 'PATH': '/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin',
            'LANG': 'C.UTF-8'}


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(('127.0.0.1', 0))
        return one.getsockname()[1]


def _write(folder: Path, port: int, errors: dict[str, float], lag: float) -> None:
    (folder / 'cell.ini').write_text(_ini(port))
    (folder / 'cell.hal').write_text(_hal(errors, lag))
    (folder / 'cell.tbl').write_text('T1 P1 D25.4 ;sphere\n')
    axes = ''.join(
        f'  {name}: {{index: {joint}, unit: {"mm" if name in LINEAR else "deg"}}}\n'
        for joint, name in enumerate(AXES)
    )
    (folder / 'device.yaml').write_text(
        f'port: {port}\npassword: {PASSWORD}\nenable_password: {ENABLE_PASSWORD}\naxes:\n{axes}'
    )
    (folder / 'watch.yaml').write_text(f'port: {port}\npassword: {PASSWORD}\naxes:\n{axes}')
    folder.chmod(0o755)
    if os.geteuid() == 0:
        for path in (folder, *folder.iterdir()):
            os.chown(path, NOBODY, NOBODY)


def _ini(port: int) -> str:
    """Joints without switches home where they are; the task process runs at the servo rate."""
    axes = []
    for joint, name in enumerate(AXES):
        linear = name in LINEAR
        limit, speed, rate = (500, 250, 2000) if linear else (36000, 120, 1000)
        axes.append(f"""
[AXIS_{name}]
MIN_LIMIT = -{limit}
MAX_LIMIT = {limit}
MAX_VELOCITY = {speed}
MAX_ACCELERATION = {rate}

[JOINT_{joint}]
TYPE = {'LINEAR' if linear else 'ANGULAR'}
MIN_LIMIT = -{limit}
MAX_LIMIT = {limit}
MAX_VELOCITY = {speed}
MAX_ACCELERATION = {rate}
FERROR = 10
MIN_FERROR = 10
HOME = 0
HOME_SEARCH_VEL = 0
HOME_LATCH_VEL = 0
HOME_SEQUENCE = 0
""")
    return f"""
[EMC]
VERSION = 1.1
MACHINE = rtest

[DISPLAY]
DISPLAY = linuxcncrsh --port {port} --connectpw {PASSWORD} --enablepw {ENABLE_PASSWORD}

[RS274NGC]
PARAMETER_FILE = cell.var

[KINS]
KINEMATICS = xyzbc-trt-kins sparm=identityfirst
JOINTS = {len(AXES)}

[HAL]
HALFILE = cell.hal

[TRAJ]
COORDINATES = {AXES}
LINEAR_UNITS = mm
ANGULAR_UNITS = deg
DEFAULT_LINEAR_VELOCITY = 100
MAX_LINEAR_VELOCITY = 500
MAX_LINEAR_ACCELERATION = 2000
DEFAULT_ANGULAR_VELOCITY = 60
MAX_ANGULAR_VELOCITY = 120

[EMCMOT]
EMCMOT = motmod
SERVO_PERIOD = 1000000
COMM_TIMEOUT = 1

[TASK]
TASK = milltask
CYCLE_TIME = 0.001

[EMCIO]
EMCIO = io
CYCLE_TIME = 0.1
TOOL_TABLE = cell.tbl
{''.join(axes)}"""


def _hal(errors: dict[str, float], lag: float) -> str:
    """Command + offset -> lag -> machine (sampled); machine - offset -> feedback."""
    joints = range(len(AXES))
    lines = [
        'loadrt [KINS]KINEMATICS',
        'loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS',
        f'loadrt offset names={",".join(f"err.{joint}" for joint in joints)}',
        f'loadrt lowpass names={",".join(f"lag.{joint}" for joint in joints)}',
        f'loadrt sampler depth=4000 cfg={"f" * len(AXES)}',
        'addf motion-command-handler servo-thread',
        'addf motion-controller servo-thread',
    ]
    for joint, name in enumerate(AXES):
        lines += [
            f'addf err.{joint}.update-output servo-thread',
            f'addf lag.{joint} servo-thread',
            f'addf err.{joint}.update-feedback servo-thread',
            f'setp err.{joint}.offset {errors.get(name, 0.0):.9f}',
            f'setp lag.{joint}.gain {lag:.6f}',
            f'net command-{joint} joint.{joint}.motor-pos-cmd => err.{joint}.in',
            f'net moved-{joint} err.{joint}.out => lag.{joint}.in',
            f'net true-{joint} lag.{joint}.out => err.{joint}.fb-in sampler.0.pin.{joint}',
            f'net believed-{joint} err.{joint}.fb-out => joint.{joint}.motor-pos-fb',
        ]
    return '\n'.join([
        *lines,
        'addf sampler.0 servo-thread',
        # Which kinematics are on, as M68 E3 sets it.
        'net kinematics motion.analog-out-03 => motion.switchkins-type',
        'net estop iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in',
        'net tool-prepare iocontrol.0.tool-prepare => iocontrol.0.tool-prepared',
        'net tool-change iocontrol.0.tool-change => iocontrol.0.tool-changed',
        '',
    ])
