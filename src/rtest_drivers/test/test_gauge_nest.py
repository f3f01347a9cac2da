"""Nests of simulated controllers on pseudo-terminals and networks: readings, faults, reconnect."""

import math
import select
import socket
import termios
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import serial.rfc2217

from rtest_drivers.gauges import controller
from rtest_drivers.gauges.check import check_controllers
from rtest_drivers.gauges.config import load_nest
from rtest_drivers.gauges.frames import Line
from rtest_drivers.gauges.nest import SerialNest
from rtest_drivers.gauges.transport import Port
from rtest_drivers.sim.gauge_devices import (
    FAULTS,
    Digimatic,
    Emulator,
    GaugeDevice,
    Lkg,
    Lkg5000,
    Mux10,
    Nd287,
)
from rtest_estimation.records import GaugeBlock, Status

pytestmark = pytest.mark.alone

NAMES = {
    Lkg: 'keyence-lkg',
    Lkg5000: 'keyence-lkg5000',
    Nd287: 'heidenhain-nd287',
    Mux10: 'mitutoyo-mux10',
    Digimatic: 'mitutoyo-digimatic',
}
# Displacement tells the time, so that a reading with a stamp of another one is found: at 4 mm/s
# four decimals are 0.025 ms, three are 0.25 ms, and the range of the devices is 20 s.
SPEED = 0.004
_start = [time.time()]


def ramp() -> list[float]:
    """Three gauges that move with SPEED, -SPEED and SPEED / 2."""
    metres = SPEED * (time.time() - _start[0])
    return [metres, -metres, metres / 2.0]


def lateness(block: GaugeBlock, channel: int = 0) -> float:
    """How much later than the reading its stamp is [s]."""
    return block.stamp * 1e-9 - _start[0] - block.displacement[0, channel] / SPEED


class Cell:
    """Simulated controllers and the device file for them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.devices: list[GaugeDevice] = []
        self._entries: list[str] = []
        self._stack = ExitStack()
        self._channels = 0

    def add(self, emulator: Emulator, channels: int, keys: str = '') -> GaugeDevice:
        device = GaugeDevice(emulator, self.folder / f'gauge{len(self.devices)}')
        self._stack.callback(device.close)
        self.devices.append(device)
        self.entry(NAMES[type(emulator)], device.port, channels, keys)
        return device

    def entry(self, name: str, port: str, channels: int, keys: str = '') -> None:
        numbers = list(range(self._channels + 1, self._channels + channels + 1))
        self._channels += channels
        self._entries.append(
            f'{{protocol: {name}, port: "{port}", channels: {numbers}, unit: mm, '
            f'timeout_s: 0.1 {keys}}}'
        )

    @property
    def path(self) -> str:
        path = self.folder / 'nest.yaml'
        path.write_text(f'controllers: [{", ".join(self._entries)}]')
        return str(path)

    def nest(self) -> SerialNest:
        found = SerialNest(self.path)
        self._stack.callback(found.close)
        found.open()
        return found

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def cell(tmp_path: Path):
    _start[0] = time.time()
    cell = Cell(tmp_path)
    yield cell
    cell.close()


@pytest.fixture(autouse=True)
def impatience(monkeypatch) -> None:
    """Simulated devices need less patience than real ones."""
    monkeypatch.setattr(controller, '_SETUP_S', 0.3)
    monkeypatch.setattr(controller, '_QUIET_S', 0.2)


def blocks(found: SerialNest, count: int) -> list[GaugeBlock]:
    """At least `count` blocks, within 5 s."""
    limit, read = time.monotonic() + 5.0, []
    while len(read) < count:
        assert time.monotonic() < limit
        read += found.read(0.2)
    return read


def until(found: SerialNest, condition, seconds: float = 5.0) -> list[GaugeBlock]:
    """Blocks up to the first that meets a condition, which is in them."""
    limit, read = time.monotonic() + seconds, []
    while time.monotonic() < limit:
        for block in found.read(0.2):
            read.append(block)
            if condition(block):
                return read
    raise AssertionError(f'nothing in {seconds} s')


def valid(channel: int = 0):
    return lambda block: block.status[0, channel] == Status.VALID


def not_valid(channel: int = 0):
    return lambda block: block.status[0, channel] != Status.VALID


# --- readings ---


@pytest.mark.parametrize(
    ('emulator', 'channels', 'keys', 'factors'),
    [
        (Lkg, 1, '', [1.0]),
        (Lkg, 2, ', rate_hz: 200, sampling_us: 500', [1.0, -1.0]),
        (Lkg5000, 3, ', rate_hz: 200, sign: [-1, -1, 1]', [-1.0, 1.0, 0.5]),
        (Nd287, 1, ', rate_hz: 50', [1.0]),
        (Nd287, 1, ', rate_hz: 50, command: A0200, decimals: 4, sign: -1', [-1.0]),
        (Mux10, 3, ', rate_hz: 10', [1.0, -1.0, 0.5]),
        (Digimatic, 1, ', rate_hz: 50', [1.0]),
    ],
)
def test_readings_of_every_device(cell, emulator, channels, keys, factors) -> None:
    device = cell.add(emulator(ramp), channels, keys)
    device.delay = 0.02 if emulator is Mux10 else 0.0
    found = cell.nest()
    until(found, lambda block: (block.status == Status.VALID).all())
    read = blocks(found, 10)
    for block in read:
        assert block.displacement.shape == block.status.shape == (1, channels)
        assert block.displacement.dtype == np.float64
        assert block.status.dtype == np.uint8
        assert (block.status == Status.VALID).all()
        assert factors[0] < 0.0 or abs(lateness(block)) < 0.05
    # Gauges of one answer are of one time; those of a multiplexer, 20 and 40 ms apart, are
    # brought to the first's.
    apart = [np.ptp(block.displacement / factors) for block in read]
    assert np.median(apart) < (8e-3 * SPEED if emulator is Mux10 else 2e-7)
    assert [block.sequence for block in read] == list(
        range(read[0].sequence, read[0].sequence + len(read))
    )
    assert np.all(np.diff([block.stamp for block in read]) > 0)
    if 'sampling_us' in keys:
        assert (device.emulator.sampling, device.emulator.measuring) == (4, True)


def test_status_of_what_has_no_value(cell) -> None:
    values = [0.2e-3, 0.0]
    cell.add(Lkg(lambda: values), 2, ', range_mm: [-0.5, 0.5], sign: -1')
    found = cell.nest()
    for first, second, expected in [
        (0.2e-3, -0.1e-3, [Status.VALID, Status.VALID]),
        (math.inf, -math.inf, [Status.OUT_OF_RANGE, Status.OUT_OF_RANGE]),
        (math.nan, 0.5e-3, [Status.NO_SIGNAL, Status.VALID]),
        (0.5001e-3, -0.5001e-3, [Status.OUT_OF_RANGE, Status.OUT_OF_RANGE]),
    ]:
        values[:] = [first, second]
        # What was asked before the change may still come.
        block = blocks(found, len(found.read(0.2)) + 10)[-1]
        assert list(block.status[0]) == expected
        good = np.array(expected) == Status.VALID
        assert block.displacement[0][good] == pytest.approx(-np.array(values)[good])
        assert np.isnan(block.displacement[0][~good]).all()


def test_three_displays_on_a_moving_signal(cell) -> None:
    for index in range(3):
        cell.add(Nd287(lambda: ramp()[:1]), 1, f', rate_hz: {(20, 50, 31)[index]}')
    found = cell.nest()
    until(found, lambda block: (block.status == Status.VALID).all())
    read = blocks(found, 15)
    assert all((block.status == Status.VALID).all() for block in read)
    # All read one signal: brought to one time they agree, but for what moves while they answer. As
    # they were read they are up to 16 ms apart. The median is not bothered by a busy computer.
    apart = [np.ptp(block.displacement) / SPEED for block in read]
    assert np.median(apart) < 1.5e-3
    assert abs(np.median([lateness(block) for block in read])) < 3e-3
    # 20 a second: those of the slowest.
    assert np.diff([block.stamp for block in read]).mean() * 1e-9 == pytest.approx(0.05, rel=0.1)
    warning, values = found.health()
    assert warning == ''
    assert 0.0 < float(values['skew_mean_ms']) <= float(values['skew_max_ms']) < 20.0
    assert float(values[f'{cell.devices[1].port} rate_hz']) == pytest.approx(50.0, rel=0.2)


def test_stamp_is_within_its_uncertainty(cell) -> None:
    device = cell.add(Lkg(lambda: ramp()[:2]), 2, ', rate_hz: 20')
    device.delay = 0.03
    found = cell.nest()
    late = [lateness(block) for block in blocks(found, 9)]
    # The reading is taken at the question, the stamp in the middle of the 30 ms to the answer.
    assert np.median(late) == pytest.approx(0.015, abs=3e-3)
    assert float(found.health()[1][f'{device.port} stamp_uncertainty_ms']) >= max(late) * 1e3 - 0.5


def test_stamp_of_a_device_that_takes_the_reading_at_the_question(cell) -> None:
    device = cell.add(Nd287(lambda: ramp()[:1]), 1)
    device.delay = 0.04
    late = [lateness(block) for block in blocks(cell.nest(), 9)]
    assert np.median(late) == pytest.approx(0.001, abs=3e-3)


# --- faults ---


@pytest.mark.parametrize(
    ('emulator', 'fault'),
    [
        *((Lkg, fault) for fault in FAULTS),
        *((Nd287, fault) for fault in FAULTS),
        # Without a fence, and every answer looks alike.
        *((Digimatic, fault) for fault in ('late', 'half', 'garbage')),
        (Mux10, 'wrong'),
    ],
)
def test_fault_of_one_controller(cell, emulator, fault) -> None:
    faulty = cell.add(emulator(lambda: ramp()[:1]), 1, ', rate_hz: 50')
    cell.add(Lkg5000(lambda: ramp()[:2]), 2, ', rate_hz: 100')
    found = cell.nest()
    until(found, lambda block: (block.status == Status.VALID).all())
    faulty.late = 0.15
    faulty.fault, start = fault, time.monotonic()
    read = until(found, not_valid(0))
    assert time.monotonic() - start < 1.0
    # Nothing of the other one is lost, nothing wrong comes through.
    end = time.monotonic() + 0.6
    while time.monotonic() < end:
        read += found.read(0.1)
    text, values = found.health()
    assert faulty.port in text
    assert '\n' not in text
    assert values[f'{cell.devices[1].port} state'] == 'answers'
    faulty.fault = ''
    read += until(found, valid(0))
    read += blocks(found, 10)
    for block in read:
        assert (block.status[0, 1:] == Status.VALID).all()
        assert np.isnan(block.displacement[0, 0]) == (block.status[0, 0] != Status.VALID)
        # An answer to an earlier question would be more than the time-out of 0.1 s late.
        if block.status[0, 0] == Status.VALID and fault != 'flip':
            assert abs(lateness(block, 0)) < 0.08
        assert abs(lateness(block, 1)) < 0.08
    assert np.all(np.diff([block.stamp for block in read]) > 0)


def test_line_unplugged_and_back(cell) -> None:
    gone = cell.add(Nd287(lambda: ramp()[:1]), 1, ', rate_hz: 20')
    cell.add(Lkg(lambda: ramp()[:2]), 2, ', rate_hz: 100')
    found = cell.nest()
    until(found, lambda block: (block.status == Status.VALID).all())
    start = time.monotonic()
    gone.unplug()
    until(found, not_valid(0))
    assert time.monotonic() - start < 1.0
    read = blocks(found, 50)
    for block in read[10:]:
        assert list(block.status[0]) == [Status.NO_SIGNAL, Status.VALID, Status.VALID]
    text, values = found.health()
    assert gone.port in text
    assert 'check the cable' in text or 'plug it in again' in text
    assert values[f'{gone.port} state'] == 'lost'
    gone.plug()
    until(found, valid(0))
    assert found.health()[1][f'{gone.port} reconnects'] == 1
    assert found.health()[0] == ''


def test_all_lost_is_a_lost_nest_that_opens_again(cell) -> None:
    devices = [cell.add(Nd287(lambda: ramp()[:1]), 1) for _ in range(2)]
    found = cell.nest()
    blocks(found, 2)
    for device in devices:
        device.unplug()
    start = time.monotonic()
    with pytest.raises(ConnectionError) as caught:
        for _ in range(20):
            found.read(0.2)
    assert time.monotonic() - start < 1.0
    assert all(device.port in str(caught.value) for device in devices)
    assert '\n' not in str(caught.value)
    found.close()
    with pytest.raises(ConnectionError, match='cannot be opened .No such file or directory'):
        found.open()
    devices[0].plug()
    found.open()
    read = until(found, valid(0))
    assert read[0].sequence == 0
    assert read[-1].status[0, 1] == Status.NO_SIGNAL


@pytest.mark.parametrize('fault', ['silent', 'garbage'])
def test_no_controller_that_answers_is_told_at_opening(cell, fault) -> None:
    device = cell.add(Nd287(lambda: [0.0]), 1)
    device.fault = fault
    with pytest.raises(ConnectionError, match='no answer to .*; check power, cable, proto'):
        cell.nest()


def test_a_port_in_use(cell) -> None:
    cell.add(Lkg(lambda: [0.0]), 1)
    found = cell.nest()
    with pytest.raises(ConnectionError, match='another program uses it; close that one'):
        SerialNest(cell.path).open()
    assert blocks(found, 5)
    assert found.health()[0] == ''


def test_left_in_the_set_up_mode(cell) -> None:
    device = cell.add(Lkg(lambda: [0.0]), 1)
    device.emulator.measuring = False
    found = cell.nest()
    assert device.emulator.measuring
    assert found.read(0.5)[0].status[0, 0] == Status.VALID
    device.emulator.measuring = False
    until(found, lambda block: block.status[0, 0] == Status.DEVICE_ERROR)
    text, _ = found.health()
    assert 'error 01, status error: not in the measuring mode' in text


def test_wall_clock_set_back_and_forward(cell, monkeypatch) -> None:
    cell.add(Lkg(lambda: [0.0]), 1)
    found = cell.nest()
    last = blocks(found, 3)[-1].stamp
    for step in (-3.0, 5.0):
        real, change = time.time_ns, round(step * 1e9)
        with monkeypatch.context() as patch:
            patch.setattr(time, 'time_ns', lambda real=real, change=change: real() + change)
            stamps = [block.stamp for block in blocks(found, 20)]
            assert f'clock was set by {step:+.3g} s' in found.health()[0]
        assert np.all(np.diff([last, *stamps]) > 0)
        assert np.diff([last, *stamps]).max() < 1e9
        last = stamps[-1]
    assert found.health()[0] == ''


def test_a_bug_in_a_thread_is_not_swallowed(cell, monkeypatch) -> None:
    cell.add(Lkg(lambda: [0.0]), 1)
    found = cell.nest()
    monkeypatch.setattr(controller.Controller, '_physical', lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        for _ in range(20):
            found.read(0.2)


def test_closing(cell) -> None:
    cell.add(Lkg(lambda: [0.0]), 1)
    found = cell.nest()
    assert found.read(0.5)
    before = threading.active_count()
    found.close()
    found.close()
    assert threading.active_count() == before - 1
    with pytest.raises(ConnectionError, match='not open'):
        found.read(0.0)
    assert found.health() == ('', {})


def test_a_byte_of_wrong_parity_is_read_as_zero(cell) -> None:
    device = cell.add(Nd287(lambda: [0.0]), 1)
    port = Port(device.port, Line(9600, 7, 'even', 2))
    try:
        # With INPCK and neither IGNPAR nor PARMRK, termios(3).
        flags = termios.tcgetattr(port._port.fd)[0]
        assert flags & termios.INPCK
        assert not flags & (termios.IGNPAR | termios.PARMRK)
    finally:
        port.close()


# --- networks ---


class Server:
    """An emulator behind TCP, plain or with RFC 2217."""

    def __init__(self, emulator: Emulator, telnet: bool) -> None:
        self._emulator, self._telnet = emulator, telnet
        self._listener = socket.create_server(('127.0.0.1', 0))
        self.port = self._listener.getsockname()[1]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._listener.close()

    def _serve(self) -> None:
        while not self._stop.is_set():
            if select.select([self._listener], [], [], 0.05)[0]:
                with self._listener.accept()[0] as connection:
                    self._talk(connection)

    def _talk(self, connection: socket.socket) -> None:
        settings = SimpleNamespace(
            baudrate=9600, bytesize=8, parity='N', stopbits=1, rtscts=False, xonxoff=False,
            dtr=False, rts=False, cts=True, dsr=True, ri=False, cd=True,
            reset_input_buffer=lambda: None, reset_output_buffer=lambda: None,
        )
        client = SimpleNamespace(write=connection.sendall)
        manager = serial.rfc2217.PortManager(settings, client) if self._telnet else None
        rest = b''
        while not self._stop.is_set():
            if not select.select([connection], [], [], 0.05)[0]:
                continue
            data = connection.recv(1024)
            if not data:
                return
            if manager:
                data = b''.join(manager.filter(data))
            questions, rest = self._emulator.split(rest + data)
            for question in questions:
                answer = self._emulator.answer(question)
                connection.sendall(b''.join(manager.escape(answer)) if manager else answer)


# pyserial's RFC 2217 client.
@pytest.mark.filterwarnings('ignore:set(Daemon|Name):DeprecationWarning')
@pytest.mark.parametrize('telnet', [False, True], ids=['socket', 'rfc2217'])
def test_controller_on_a_network(cell, telnet) -> None:
    server = Server(Lkg5000(ramp), telnet)
    scheme = 'rfc2217' if telnet else 'socket'
    cell.entry('keyence-lkg5000', f'{scheme}://127.0.0.1:{server.port}', 3, ', rate_hz: 50')
    found = cell.nest()
    try:
        for block in blocks(found, 10):
            assert (block.status == Status.VALID).all()
            assert abs(lateness(block)) < 0.05
    finally:
        server.close()
    start = time.monotonic()
    with pytest.raises(ConnectionError, match='127.0.0.1'):
        for _ in range(20):
            found.read(0.2)
    assert time.monotonic() - start < 2.0


# --- the check before a session ---


def test_check_of_a_nest(cell) -> None:
    rng = np.random.default_rng(1)
    cell.add(Lkg(lambda: [1e-4 + 2e-6 * rng.standard_normal(), math.nan]), 2,
             ', rate_hz: 100, range_mm: [-1, 1]')
    cell.add(Nd287(lambda: [2.5e-4]), 1, ', rate_hz: 20, sign: -1')
    silent = cell.add(Nd287(lambda: [0.0]), 1)
    silent.fault = 'silent'
    laser, display, dead = check_controllers(load_nest(cell.path).controllers, 1.0)
    assert (laser.problem, display.problem) == ('', '')
    assert laser.rate == pytest.approx(100.0, rel=0.05)
    assert (laser.wanted_rate, display.unit, laser.limits) == (100.0, 'mm', (-1e-3, 1e-3))
    assert display.rate == pytest.approx(20.0, rel=0.05)
    assert laser.interval_std < 5e-3
    assert 0.01 <= laser.interval_max < 0.05
    assert (laser.skew_mean, laser.skew_max) == (0.0, 0.0)
    # Nearest of the readings that come every 10 ms.
    assert 0.0 < display.skew_mean <= display.skew_max < 0.02
    assert 0.0 < laser.stamp_uncertainty < 0.02
    one, two = laser.channels
    assert (one.channel, one.status) == (1, Status.VALID)
    assert one.last == pytest.approx(1e-4, abs=1e-5)
    assert one.noise == pytest.approx(2e-6, rel=0.4)
    assert two.status == Status.NO_SIGNAL
    assert np.isnan([two.last, two.noise]).all()
    assert laser.note == 'no measured value'
    assert display.channels[0].last == pytest.approx(-2.5e-4)
    assert display.channels[0].noise == 0.0
    assert 'check power, cable, protocol' in dead.problem
    assert math.isnan(dead.rate)
    assert dead.channels[0].status is None


def test_simulated_displays_without_a_reading_answer_all_the_same() -> None:
    for value in (math.nan, math.inf, -math.inf):
        display, gauge = Nd287(lambda value=value: [value]), Digimatic(lambda value=value: [value])
        assert display.answer(b'\x1bA0200') == b'\x15'
        assert b'?' in display.answer(b'\x02')
        assert gauge.answer(b'1') == gauge.error(b'1')
