"""The backend 'linuxcnc': the language, and faults of a server of our own."""

import contextlib
import math
import random
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from rtest_drivers.cnc.check import check
from rtest_drivers.cnc.linuxcnc import LinuxCnc, load_linuxcnc
from rtest_drivers.cnc.linuxcnc_control import Control
from rtest_drivers.cnc.linuxcnc_protocol import (
    Refused,
    ReplyError,
    answer,
    positions,
    state,
    take_line,
)
from rtest_drivers.sim.cnc_devices import LinuxCncServer
from rtest_estimation.errors import UserError

pytestmark = pytest.mark.alone

# As a LinuxCNC 2.9.0 sent them.
POSITION = b'JOINT_POS 4.968391 -10.125581 -60.603529 30.000000 40.000000 0.000000\r\n'
FILE = """
port: {port}
rate_hz: 200
still_s: 0.4
axes:
  X: {{index: 0, unit: mm}}
  Z: {{index: 2, unit: mm, sign: -1}}
  B: {{index: 3, unit: deg}}
"""


def lines(data: bytes) -> list[str]:
    buffer, found = bytearray(data), []
    while (line := take_line(buffer)) is not None:
        found.append(line)
    return found


def test_replies_of_both_line_ends_and_an_empty_line() -> None:
    data = POSITION + b'SET ENABLE ACK\n\rGET BLA NAK\r\n\r\nESTOP OFF\r\nhalf'
    assert lines(data) == [
        POSITION.decode().strip(), 'SET ENABLE ACK', 'GET BLA NAK', 'ESTOP OFF',
    ]


def test_a_reply_in_pieces_is_the_same() -> None:
    buffer, found = bytearray(), []
    for byte in POSITION + b'SET MODE ACK\n\rMODE MDI\r\n':
        buffer.append(byte)
        if (line := take_line(buffer)) is not None:
            found.append(line)
    assert found == [POSITION.decode().strip(), 'SET MODE ACK', 'MODE MDI']


def test_answers() -> None:
    assert answer('get program_status', 'PROGRAM_STATUS IDLE') == 'IDLE'
    assert answer('set debug x 0', 'SET DEBUG ACK') == 'ACK'
    for request, reply in (('set run', 'SET RUN NAK'), ('get bla', 'GET BLA NAK'),
                           ('set home -1', 'SET NAK')):
        with pytest.raises(Refused):
            answer(request, reply)
    # The answer to another request.
    with pytest.raises(ReplyError, match='answered by'):
        answer('get estop', 'MACHINE ON')
    values = positions(answer('get joint_pos', POSITION.decode().strip()))
    assert values == pytest.approx([4.968391, -10.125581, -60.603529, 30.0, 40.0, 0.0], abs=0)
    now = state(['OFF', 'ON', 'YES YES NO', 'PAUSED', '12'])
    assert (now.estop, now.machine_on, now.program, now.line) == (False, True, 'PAUSED', '12')
    assert now.homed == (True, True, False)


@pytest.mark.parametrize('words', ['', 'nan 1.0', '1.0 inf', '1.0 2', '0x1 1.0', '1.0 -', '1e3',
                                   '٣.0'])
def test_bad_numbers_are_no_numbers(words: str) -> None:
    with pytest.raises(ReplyError):
        positions(words)


def test_damaged_replies_never_become_positions() -> None:
    """A number that differs must come from a reply that is still well formed, digit for digit."""
    rng, text = random.Random(5), POSITION.decode().strip()
    for _ in range(5000):
        bad = list(text)
        for _ in range(rng.randint(1, 3)):
            kind, at = rng.randrange(3), rng.randrange(len(bad))
            if kind == 0:
                bad[at] = chr(rng.randrange(32, 256))
            elif kind == 1:
                del bad[at]
            else:
                bad.insert(at, chr(rng.randrange(32, 256)))
        said = ''.join(bad)
        try:
            values = positions(answer('get joint_pos', said))
        except ReplyError:
            continue
        assert np.isfinite(values).all()
        assert said == 'JOINT_POS ' + said[10:] and len(said[10:].split()) == len(values)


def test_bytes_without_an_end_are_refused() -> None:
    with pytest.raises(ReplyError, match='without an end of line'):
        take_line(bytearray(b'x' * 5000))


@pytest.fixture
def server():
    server = LinuxCncServer()
    yield server
    server.close()


def device(tmp_path: Path, server: LinuxCncServer, more: str = '') -> str:
    path = tmp_path / 'cnc.yaml'
    path.write_text(FILE.format(port=server.port) + more)
    return str(path)


@pytest.fixture
def backend(tmp_path: Path, server: LinuxCncServer):
    backend = LinuxCnc(device(tmp_path, server))
    backend.open()
    yield backend
    backend.close()


def follow(backend: LinuxCnc, seconds: float) -> list:
    limit, feedback = time.monotonic() + seconds, []
    while time.monotonic() < limit:
        feedback += backend.read(0.1)
    return feedback


def within(seconds: float, backend: LinuxCnc, word: str) -> list:
    """Read until the problem says `word`; what was read meanwhile."""
    limit, feedback = time.monotonic() + seconds, []
    while word not in backend.problem():
        assert time.monotonic() < limit, backend.problem()
        feedback += backend.read(0.1)
    return feedback


def test_feedback_is_in_si_and_stamped_at_the_read(
    backend: LinuxCnc, server: LinuxCncServer
) -> None:
    server.position = [1.0, 2.0, 3.0, 180.0, 5.0, 0.0]
    before = time.time_ns()
    feedback = follow(backend, 1.0)
    after = time.time_ns()
    last = feedback[-1]
    assert last.axes == ('X', 'Z', 'B')
    assert last.position == pytest.approx([1e-3, -3e-3, math.pi], abs=0)
    stamps = np.array([one.stamp for one in feedback])
    assert (np.diff(stamps) > 0).all() and before < stamps[0] and stamps[-1] < after
    assert len(feedback) == pytest.approx(200, rel=0.1)
    assert 0.0 < backend.uncertainty() < 0.02
    assert backend.problem() == ''
    # It only looks on.
    assert not any('enable' in request for request in server.requests)


@pytest.mark.parametrize('value', [1e300, -1e6, math.inf])
def test_a_number_that_is_no_position_is_refused(
    backend: LinuxCnc, server: LinuxCncServer, value: float
) -> None:
    server.position = [1.0, 1e300, value, 0.0, 0.0, 0.0]  # The second joint is no axis.
    with pytest.raises(ConnectionError, match='no position|told as'):
        follow(backend, 0.5)


def test_an_answer_with_fewer_joints_is_refused(
    backend: LinuxCnc, server: LinuxCncServer
) -> None:
    server.position = [0.0] * 2
    with pytest.raises(ConnectionError, match='2 joints instead of 6'):
        follow(backend, 0.5)


def test_stamp_is_midway_through_a_slow_answer(
    backend: LinuxCnc, server: LinuxCncServer
) -> None:
    server.late = 0.03
    before = time.time_ns()
    (one,) = backend.read(0.1)
    assert 14e6 < one.stamp - before < 25e6
    follow(backend, 0.3)
    assert backend.uncertainty() == pytest.approx(0.015, abs=0.008)


def test_late_answers_are_thrown_away_and_told(
    backend: LinuxCnc, server: LinuxCncServer
) -> None:
    server.late = 0.08
    assert follow(backend, 0.5) == []
    assert 'more than 50 ms' in backend.problem()


def test_states_are_told_while_feedback_goes_on(
    backend: LinuxCnc, server: LinuxCncServer
) -> None:
    follow(backend, 0.3)
    for change, word in (('estop', 'E-stop is on'), ('machine_on', 'machine is off'),
                         ('homed', 'X, Z, B not homed')):
        good = getattr(server, change)
        setattr(server, change, not good)
        assert within(1.0, backend, word)
        setattr(server, change, good)
        within(1.0, backend, '')
        follow(backend, 0.3)
        assert backend.problem() == ''


def test_a_program_that_runs_and_stands_still_is_suspicious(
    backend: LinuxCnc, server: LinuxCncServer
) -> None:
    server.program = 'RUNNING'
    within(1.0, backend, 'nothing has changed for')
    server.position = [0.1] * 6
    follow(backend, 0.1)
    assert backend.problem() == ''


def test_watchdog_notices_a_dead_task_within_a_second(
    tmp_path: Path, server: LinuxCncServer
) -> None:
    backend = LinuxCnc(device(tmp_path, server, 'enable_password: EMCTOO'))
    backend.open()
    assert follow(backend, 0.8)
    assert backend.told()['watchdog'] == 'on'
    server.dead, died, feedback = True, time.time_ns(), []
    with pytest.raises(ConnectionError, match='task process does not answer'):
        while True:
            feedback += backend.read(0.1)
    assert time.time_ns() - died < 1e9
    assert all(one.stamp < died for one in feedback)
    server.dead = False
    backend.open()
    assert follow(backend, 0.5)
    backend.close()


def test_control_that_another_client_takes_is_not_taken_back(
    tmp_path: Path, server: LinuxCncServer
) -> None:
    path = device(tmp_path, server, 'enable_password: EMCTOO')
    backend, other = LinuxCnc(path), Control(load_linuxcnc(path))
    backend.open()
    follow(backend, 0.4)
    other.open()
    feedback = follow(backend, 0.8)
    assert backend.told()['watchdog'] == 'off: another client took control'
    assert len(feedback) > 100 and time.time_ns() - feedback[-1].stamp < 50e6
    assert sum(request == 'set enable EMCTOO' for request in server.requests) == 2
    other.close()
    backend.close()


def test_requests_mixed_with_those_of_another_client_are_made_again(
    tmp_path: Path, server: LinuxCncServer
) -> None:
    path = device(tmp_path, server, 'enable_password: EMCTOO')
    server.mixed = 1
    backend, control = LinuxCnc(path), Control(load_linuxcnc(path))
    backend.open()
    for _ in range(5):
        server.mixed = 2
        assert follow(backend, 0.8)
    # The watchdog's control is still its own.
    assert backend.told()['watchdog'] == 'on'
    control.open()
    server.mixed = 3
    control.pause()
    # Taken by the driver when it connected again.
    backend.close()
    backend.open()
    control.resume()
    server.mixed = 100
    with pytest.raises(ConnectionError):
        control.pause()
    server.mixed = 0
    control.close()
    backend.close()


def test_wrong_passwords_say_what_to_do(tmp_path: Path, server: LinuxCncServer) -> None:
    for more, word in (('password: wrong', 'set password'),
                       ('enable_password: wrong', 'set enable_password')):
        with pytest.raises(ConnectionError, match=word):
            LinuxCnc(device(tmp_path, server, more)).open()


def test_units_and_joints_are_held_to_the_controller(
    tmp_path: Path, server: LinuxCncServer
) -> None:
    path = device(tmp_path, server)
    server.units = 'INCH INCH INCH DEG DEG INCH'
    with pytest.raises(ConnectionError, match='X: unit: LinuxCNC says inch, the device file mm'):
        LinuxCnc(path).open()
    for word in ('CM', 'CUSTOM'):
        server.units = f'{word} MM MM DEG'
        with pytest.raises(ConnectionError, match=f'X: unit: LinuxCNC says {word}, expected one'):
            LinuxCnc(path).open()
    server.units = 'MM'
    with pytest.raises(ConnectionError, match='Z: unit: LinuxCNC says nothing, expected one of'):
        LinuxCnc(path).open()
    server.units = 'MM MM MM DEG'
    server.position = [0.0] * 3
    with pytest.raises(ConnectionError, match='B: index 3: LinuxCNC tells joints 0 to 2 only'):
        LinuxCnc(path).open()


def test_half_an_answer_hanging_up_and_coming_back(
    backend: LinuxCnc, server: LinuxCncServer
) -> None:
    server.half = True
    with pytest.raises(ConnectionError, match='did not answer'):
        follow(backend, 3.0)
    server.half = False
    with pytest.raises(ConnectionError, match='not open'):
        backend.read(0.1)
    backend.open()
    assert follow(backend, 0.2)
    server.hang_up()
    with pytest.raises(ConnectionError, match='lost linuxcncrsh'):
        follow(backend, 1.0)
    backend.open()
    assert follow(backend, 0.2)


def test_nobody_listens(tmp_path: Path, server: LinuxCncServer) -> None:
    path = device(tmp_path, server)
    text = Path(path).read_text()
    with socket.socket() as one:
        one.bind(('127.0.0.1', 0))
        Path(path).write_text(text.replace(str(server.port), str(one.getsockname()[1])))
        with pytest.raises(ConnectionError, match='start LinuxCNC with'):
            LinuxCnc(path).open()


def test_a_server_that_says_something_else(tmp_path: Path) -> None:
    """A mail server, say: no traceback, no positions."""
    with socket.create_server(('127.0.0.1', 0)) as listener:
        def serve() -> None:
            client, _ = listener.accept()
            with client:
                client.sendall(b'220 mail.example.com ESMTP\r\n')
                client.recv(1000)

        thread = threading.Thread(target=serve)
        thread.start()
        path = tmp_path / 'cnc.yaml'
        path.write_text(FILE.format(port=listener.getsockname()[1]))
        with pytest.raises(ConnectionError, match='is none, it says .*set host and port'):
            LinuxCnc(str(path)).open()
        thread.join()


@pytest.mark.parametrize('noise', [b'NOISE 1\r\n', b'\r\n'])
def test_a_server_that_never_stops_talking(tmp_path: Path, noise: bytes) -> None:
    """It says hello as it should; then something comes every few milliseconds."""
    stop = threading.Event()
    answers = {b'hello': b'HELLO ACK EMCNETSVR 1.1\r\n', b'set': b'set echo off\r\n',
               b'get': b'ECHO OFF\r\n'}

    def serve() -> None:
        client, _ = listener.accept()
        with client, client.makefile('rb') as lines, contextlib.suppress(OSError):
            for line in lines:
                if b'echo' in line or b'hello' in line:
                    client.sendall(answers[line.split()[0]])
                    continue
                while not stop.wait(0.005):
                    client.sendall(noise)

    with socket.create_server(('127.0.0.1', 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        path = tmp_path / 'cnc.yaml'
        path.write_text(FILE.format(port=listener.getsockname()[1]))
        with pytest.raises(ConnectionError, match='talks without being asked|answer'):
            LinuxCnc(str(path)).open()
        stop.set()
        thread.join()


def test_check_of_a_moving_a_standing_and_no_controller(
    tmp_path: Path, server: LinuxCncServer
) -> None:
    path = device(tmp_path, server)
    found = check(LinuxCnc(path), 0.5)
    assert found.answers and found.frozen and found.problem == ''
    assert found.rate == pytest.approx(200, rel=0.1)
    assert found.jitter < 0.005 and found.uncertainty < 0.02
    assert set(found.position) == {'X', 'Z', 'B'}
    stop = threading.Event()

    def move() -> None:
        while not stop.wait(0.01):
            server.position = [value + 0.1 for value in server.position]

    thread = threading.Thread(target=move)
    thread.start()
    found = check(LinuxCnc(path), 0.3)
    stop.set()
    thread.join()
    assert found.answers and not found.frozen
    server.password = 'other'
    found = check(LinuxCnc(path), 0.3)
    assert not found.answers and 'set password' in found.problem


def test_control_needs_its_password(tmp_path: Path, server: LinuxCncServer) -> None:
    with pytest.raises(UserError, match='enable_password: missing'):
        Control(load_linuxcnc(device(tmp_path, server)))
    control = Control(load_linuxcnc(device(tmp_path, server, 'enable_password: wrong')))
    with pytest.raises(UserError, match='set enable_password of the device file'):
        control.open()
    control.close()
