"""The backend 'opcua' at a server of asyncua on this host."""

import math
import threading
import time
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from asyncua import ua

from rtest_drivers.cnc.axes import AxisSource
from rtest_drivers.cnc.check import check
from rtest_drivers.cnc.opcua import OpcUa, estop_state, position, source_time
from rtest_drivers.sim.cnc_devices import OpcUaServer

pytestmark = pytest.mark.alone

# In the style of a SINUMERIK: position of the first encoder of machine axes 1 and 4.
X = AxisSource('X', 'ns=2;s=x', 'mm')
NODES = {
    'X': '/Channel/MachineAxis/measPos1[u1,1]', 'B': '/Channel/MachineAxis/measPos1[u1,4]',
    'E': '/Plc/E10.0',
}
FILE = """
url: {url}
period_ms: 20
axes:
  X: {{node: 'ns=2;s=/Channel/MachineAxis/measPos1[u1,1]', unit: mm}}
  B: {{node: 'ns=2;s=/Channel/MachineAxis/measPos1[u1,4]', unit: deg, sign: -1}}
estop: {{node: 'ns=2;s=/Plc/E10.0', value: 1.0}}
"""


@pytest.mark.parametrize(
    ('value', 'number', 'why'),
    [
        (1.5, 1.5, ''), (3, 3.0, ''), (True, None, 'bool'), ('1.5', None, 'str'),
        (None, None, 'no value'), (1e300, None, '1e+300 mm'),
        ([1.0, 2.0], None, 'list'), (math.nan, None, 'not finite'),
        (-math.inf, None, 'not finite'),
    ],
)
def test_positions(value: object, number: float | None, why: str) -> None:
    found, said = position(ua.DataValue(ua.Variant(value)), X)
    assert found == number and why in said


def test_only_good_values_are_positions() -> None:
    for name in ('BadSensorFailure', 'UncertainLastUsableValue', 'BadOutOfService'):
        status = ua.StatusCode(getattr(ua.StatusCodes, name))
        assert position(ua.DataValue(ua.Variant(1.0), StatusCode=status), X) == (None, name)


@pytest.mark.parametrize(
    ('said', 'on', 'state', 'why'),
    [
        (True, True, True, ''), (False, True, False, ''), (1, True, True, ''), (0.0, 1, False, ''),
        ('stop', 'stop', True, ''), ('run', 'stop', False, ''),
        # Could never be the value of the device file.
        (1.0, '1', None, "float 1.0 is never '1'"), ('true', True, None, 'is never True'),
        ([True], True, None, 'list'), (None, True, None, 'no value'),
    ],
)
def test_estop_is_on_off_or_not_known(
    said: object, on: bool | float | str, state: bool | None, why: str
) -> None:
    found, reason = estop_state(ua.DataValue(ua.Variant(said)), on)
    assert found is state and why in reason and bool(reason) == (state is None)
    bad = ua.StatusCode(ua.StatusCodes.BadNoCommunication)
    value = ua.DataValue(ua.Variant(said), StatusCode=bad)
    assert estop_state(value, on) == (None, 'BadNoCommunication')
    assert estop_state(ua.DataValue(Value=None), on) == (None, 'no value')


def test_source_times() -> None:
    when = datetime(2024, 2, 29, 12, 0, 0, 123457, timezone.utc)
    ns = 1_709_208_000_123_457_000
    assert source_time(ua.DataValue(SourceTimestamp=when)) == ns
    # asyncua before 1.1 leaves the zone out; it is UTC.
    assert source_time(ua.DataValue(SourceTimestamp=when.replace(tzinfo=None))) == ns
    east = when.astimezone(timezone(timedelta(hours=2)))
    assert source_time(ua.DataValue(SourceTimestamp=east)) == ns
    assert source_time(ua.DataValue()) is None


@pytest.fixture(scope='module')
def running():
    """It takes two seconds to start."""
    server = OpcUaServer(NODES)
    yield server
    server.close()


@pytest.fixture
def server(running: OpcUaServer) -> OpcUaServer:
    running.write({'X': 1.0, 'B': 90.0, 'E': 0.0}, time.time() - 3600.0)
    return running


def device(tmp_path: Path, server: OpcUaServer, more: str = '') -> str:
    path = tmp_path / 'cnc.yaml'
    path.write_text(FILE.format(url=server.url) + more)
    return str(path)


@pytest.fixture
def backend(tmp_path: Path, server: OpcUaServer):
    backend = OpcUa(device(tmp_path, server))
    backend.open()
    yield backend
    backend.close()


def follow(backend: OpcUa, seconds: float) -> list:
    limit, feedback = time.monotonic() + seconds, []
    while time.monotonic() < limit:
        feedback += backend.read(0.05)
    return feedback


def test_standing_axes_give_feedback_for_as_long_as_the_server_answers(
    backend: OpcUa,
) -> None:
    """Their values were sampled an hour ago and never change."""
    before = time.time_ns()
    feedback = follow(backend, 1.0)
    stamps = np.array([one.stamp for one in feedback])
    assert (np.diff(stamps) > 0).all() and before - 0.2e9 < stamps[0] < stamps[-1] < time.time_ns()
    assert len(feedback) == pytest.approx(45, abs=12)
    assert feedback[0].axes == ('X', 'B')
    assert feedback[-1].position == pytest.approx([1e-3, -math.pi / 2])
    assert backend.problem() == '' and 0.0 < backend.uncertainty() < 0.05


@pytest.mark.parametrize('offset', [0.0, 3600.0, -7.25])
def test_source_stamps_are_brought_to_the_hosts_clock(
    backend: OpcUa, server: OpcUaServer, offset: float
) -> None:
    """Every value is its own true time [ms since the start]."""
    follow(backend, 0.2)
    rng = np.random.default_rng(2)
    start, feedback = time.time(), []
    for step in range(60):
        now = time.time()
        server.write({'X': (now - start) * 1e3, 'B': float(step)}, now + offset)
        feedback += follow(backend, 0.005 + 0.02 * rng.random())
    moved = [one for one in feedback if one.position[0] > 0.0][10:]
    new = {one.position[1]: one for one in reversed(moved)}.values()
    late = np.array([one.stamp * 1e-9 - start - one.position[0] for one in new])
    # It was published up to 20 ms later: that is taken out but for the shortest.
    assert late.min() > -0.002 and np.median(late) < 0.006
    assert float(backend.told()['clock_offset_ms']) == pytest.approx(-offset * 1e3, abs=20)
    assert float(backend.told()['under_way_ms']) > 5.0


def test_arrival_stamps_do_not_need_the_controllers_clock(
    tmp_path: Path, server: OpcUaServer
) -> None:
    backend = OpcUa(device(tmp_path, server, 'stamp: arrival'))
    backend.open()
    follow(backend, 0.2)
    written = time.time_ns()
    server.write({'X': 5.0}, 0.0)
    first = next(one for one in follow(backend, 0.2) if one.position[0] == 5e-3)
    assert 0 < first.stamp - written < 100e6
    backend.close()


def test_axes_with_different_stamps(backend: OpcUa, server: OpcUaServer) -> None:
    follow(backend, 0.2)
    # Twice, because the first time the clock's offset is not known.
    for value in (2.0, 3.0):
        now = time.time()
        server.write({'X': value}, now - 0.003)
        server.write({'B': value}, now)
        feedback = follow(backend, 0.1)
    assert feedback[-1].position == pytest.approx([3e-3, -math.radians(3.0)])
    assert float(backend.told()['skew_ms']) == pytest.approx(3.0, abs=0.1)


def test_bad_value_stops_feedback_and_is_told(backend: OpcUa, server: OpcUaServer) -> None:
    follow(backend, 0.2)
    server.write({'B': 90.0}, bad='BadSensorFailure')
    follow(backend, 0.1)
    assert follow(backend, 0.2) == []
    assert 'axis B: the controller has no good value (BadSensorFailure)' in backend.problem()
    server.write({'B': 91.0})
    assert follow(backend, 0.2)[-1].position[1] == pytest.approx(-math.radians(91.0))
    assert backend.problem() == ''


def test_estop_is_told_while_feedback_goes_on(backend: OpcUa, server: OpcUaServer) -> None:
    follow(backend, 0.2)
    server.write({'E': 1.0})
    assert follow(backend, 0.3)
    assert 'E-stop is on' in backend.problem()
    server.write({'E': 0.0})
    follow(backend, 0.2)
    assert backend.problem() == ''


def test_estop_without_a_good_value_is_not_off(backend: OpcUa, server: OpcUaServer) -> None:
    assert backend.told()['estop'] == 'unknown'
    follow(backend, 0.2)
    assert backend.told()['estop'] == 'off'
    server.write({'E': 0.0}, bad='BadNoCommunication')
    assert follow(backend, 0.3)
    assert backend.told()['estop'] == 'unknown'
    assert backend.problem() == (
        'estop: the controller has no good value (BadNoCommunication), so an E-stop would not be '
        'seen; look at the node in the server'
    )


@pytest.mark.parametrize('fault', ['end_subscriptions', 'stop_publishing'])
def test_a_dead_subscription_is_a_lost_connection(
    backend: OpcUa, server: OpcUaServer, fault: str
) -> None:
    """The server still answers every question."""
    assert follow(backend, 0.3)
    getattr(server, fault)()
    died, feedback = time.time_ns(), []
    server.write({'X': 99.0})
    with pytest.raises(ConnectionError, match='subscription nothing has come for'):
        while time.time_ns() - died < 5e9:
            feedback += backend.read(0.1)
    assert all(one.stamp < died for one in feedback)
    with pytest.raises(ConnectionError):
        backend.read(0.1)
    backend.close()
    backend.open()
    assert follow(backend, 0.5)[-1].position[0] == pytest.approx(0.099)


def test_a_server_that_is_not_running(backend: OpcUa, server: OpcUaServer) -> None:
    assert follow(backend, 0.3)
    server.state(3)
    with pytest.raises(ConnectionError, match='is not running, its state is'):
        follow(backend, 2.0)
    server.state(0)


def test_a_frozen_server_is_told_before_it_comes_back(
    backend: OpcUa, server: OpcUaServer
) -> None:
    assert follow(backend, 0.3)
    back = threading.Event()
    server.freeze(back)
    try:
        with pytest.raises(ConnectionError, match='lost OPC UA server'):
            follow(backend, 30.0)
    finally:
        back.set()


def test_clock_of_the_controller_set_back(backend: OpcUa, server: OpcUaServer) -> None:
    follow(backend, 0.2)
    stamps = []
    for step in range(10):
        server.write({'X': float(step)}, time.time() - 60.0 * (step > 4))
        stamps += [one.stamp for one in follow(backend, 0.05)]
    assert (np.diff(stamps) > 0).all() and abs(stamps[-1] - time.time_ns()) < 0.2e9
    assert 'was set back' in backend.problem()


def test_server_that_restarts(tmp_path: Path) -> None:
    server = OpcUaServer(NODES)
    server.write({'X': 1.0, 'B': 90.0, 'E': 0.0})
    backend = OpcUa(device(tmp_path, server))
    backend.open()
    assert follow(backend, 0.3)
    server.close()
    stopped = time.monotonic()
    with pytest.raises(ConnectionError, match='OPC UA server opc.tcp://127'):
        follow(backend, 5.0)
    assert time.monotonic() - stopped < 1.5
    with pytest.raises(ConnectionError, match='start it, or set url'):
        backend.open()
    again = OpcUaServer(NODES, server.port)
    again.write({'X': 2.0, 'B': 90.0, 'E': 0.0})
    backend.open()
    assert follow(backend, 0.3)[-1].position[0] == pytest.approx(2e-3)
    backend.close()
    again.close()


def test_wrong_node_and_wrong_url(tmp_path: Path, server: OpcUaServer) -> None:
    path = device(tmp_path, server)
    text = Path(path).read_text()
    for old, new, said in (
        ('[u1,4]', '[U1,4]', "B: node 'ns=2;s=/Channel/MachineAxis/measPos1.*correct the device"),
        ("'ns=2;s=/Channel/MachineAxis/measPos1[u1,1]'", 'nonsense', "X: node 'nonsense'"),
        (server.url, 'opc.tcp://127.0.0.1:9', 'no OPC UA server opc.tcp://127.0.0.1:9'),
    ):
        assert old in text
        Path(path).write_text(text.replace(old, new))
        with pytest.raises(ConnectionError, match=said):
            OpcUa(path).open()


def test_nothing_in_time_is_no_feedback(backend: OpcUa) -> None:
    follow(backend, 0.2)
    assert any(backend.read(0.0) == [] for _ in range(100))


def test_check(tmp_path: Path, server: OpcUaServer) -> None:
    found = check(OpcUa(device(tmp_path, server)), 1.0)
    assert found.answers and found.frozen and found.rate == pytest.approx(45, abs=12)
    assert found.position == pytest.approx({'X': 1e-3, 'B': -math.pi / 2})
