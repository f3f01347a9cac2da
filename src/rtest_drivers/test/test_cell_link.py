"""The wire between cell and drivers, and what counts readings."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from rtest_drivers.backends import CNC_BACKENDS, GAUGE_BACKENDS, make
from rtest_drivers.cell_link import (
    CNC,
    GAUGES,
    THERMOMETERS,
    CellCnc,
    CellGauges,
    CellServer,
    CellThermometers,
    LinkError,
    decode,
    encode,
)
from rtest_drivers.rate import Rate
from rtest_drivers.sequence import Sequence
from rtest_estimation.errors import UserError
from rtest_estimation.records import Feedback, GaugeBlock, Temperature


def block(sequence: int = 0, channels: int = 3) -> GaugeBlock:
    rng = np.random.default_rng(sequence)
    values = rng.standard_normal((10, channels))
    values[3, 1] = np.nan
    status = rng.integers(0, 4, (10, channels)).astype(np.uint8)
    return GaugeBlock(1_700_000_000_123_456_789 + sequence, sequence, 0.02, values, status)


def feedback(stamp: int = 5) -> Feedback:
    return Feedback(stamp, ('X', 'Y', 'Z', 'B', 'C', 'S'), np.arange(6) * 0.1)


def same(one: GaugeBlock, other: GaugeBlock) -> bool:
    return (
        (one.stamp, one.sequence, one.period) == (other.stamp, other.sequence, other.period)
        and np.array_equal(one.displacement, other.displacement, equal_nan=True)
        and np.array_equal(one.status, other.status)
    )


@pytest.fixture
def address(tmp_path: Path) -> str:
    return str(tmp_path / 'cell.sock')


@pytest.fixture
def server(address: str):
    server = CellServer(address)
    yield server
    server.close()


def wait_for(condition) -> None:
    limit = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.002)


def test_records_survive_the_wire() -> None:
    sent = [block(3), feedback(), block(4, channels=4)]
    first, second, third = decode(encode(sent))
    assert same(first, sent[0]) and same(third, sent[2])
    assert (second.stamp, second.axes) == (5, sent[1].axes)
    assert np.array_equal(second.position, sent[1].position)
    assert decode(b'') == []


def test_temperatures_come_over_a_channel_of_their_own(server, address) -> None:
    sent = [Temperature(7, 'B_cover', 23.25, 0.01), Temperature(8, 'ambient', -1.5)]
    data = encode([sent[0], feedback(), sent[1]])
    assert [r for r in decode(data) if isinstance(r, Temperature)] == sent
    for damaged in (data[:-1], data[:12]):
        with pytest.raises(LinkError, match='damaged'):
            decode(damaged)
    thermometers = CellThermometers(address)
    thermometers.open()
    wait_for(lambda: server.connected == (THERMOMETERS,))
    server.send(THERMOMETERS, sent)
    assert thermometers.read(1.0) == sent
    thermometers.close()


@pytest.mark.parametrize('cut', [1, 20, 60, 300])
def test_a_damaged_answer_is_refused(cut: int) -> None:
    data = encode([block()])
    for damaged in (data[:-cut], b'?' + data, data[:40] + b'\xff' * 8):
        with pytest.raises(LinkError, match='damaged'):
            decode(damaged)


def test_both_channels(server: CellServer, address: str) -> None:
    gauges, cnc = CellGauges(address), CellCnc(address)
    gauges.open()
    cnc.open()
    wait_for(lambda: server.connected == (GAUGES, CNC))
    server.send(GAUGES, [block(0), block(10)])
    server.send(CNC, [feedback()])
    received = gauges.read(1.0)
    assert len(received) == 2 and same(received[1], block(10))
    assert [item.stamp for item in cnc.read(1.0)] == [5]
    gauges.close()
    wait_for(lambda: server.connected == (CNC,))
    cnc.close()


def test_time_may_go_on_only_when_everything_is_dealt_with(server, address) -> None:
    assert server.taken
    server.send(GAUGES, [block(0)])
    assert server.taken  # nobody looks
    gauges = CellGauges(address)
    gauges.open()
    wait_for(lambda: GAUGES in server.connected)
    server.send(GAUGES, [block(10)])
    assert not server.taken
    assert [item.sequence for item in gauges.read(1.0)] == [10]
    # Handed over, perhaps not dealt with yet: that the next question says.
    assert not server.taken
    assert gauges.read(0.01) == []
    wait_for(lambda: server.taken)
    server.send(GAUGES, [block(20)])
    assert [item.sequence for item in gauges.read(1.0)] == [20]
    gauges.close()
    wait_for(lambda: server.taken)


def test_a_new_driver_replaces_one_that_hangs(server, address) -> None:
    first, second = CellGauges(address), CellGauges(address)
    first.open()
    wait_for(lambda: GAUGES in server.connected)
    server.send(GAUGES, [block(0)])
    second.open()
    wait_for(lambda: server.taken)
    server.send(GAUGES, [block(10)])
    assert [item.sequence for item in second.read(1.0)] == [10]
    with pytest.raises(LinkError, match='lost the simulated cell'):
        for _ in range(3):
            first.read(0.5)
    second.close()


def test_losing_the_cell_says_what_to_do(address: str) -> None:
    server = CellServer(address)
    gauges = CellGauges(address)
    gauges.open()
    threading.Timer(0.1, server.close).start()
    with pytest.raises(LinkError, match='lost the simulated cell at .*start the node cell again'):
        for _ in range(20):
            gauges.read(0.2)
    with pytest.raises(LinkError, match='no simulated cell at'):
        gauges.open()
    with pytest.raises(LinkError, match='not open'):
        gauges.read(0.1)
    assert not Path(address).exists()


def test_the_socket_of_a_dead_cell_is_taken_over(address: str) -> None:
    first = CellServer(address)
    with pytest.raises(UserError, match='another cell listens'):
        CellServer(address)
    # What a killed process leaves: a socket nobody listens at.
    first._listener._listener._unlink.cancel()
    first.close()
    assert Path(address).exists()
    CellServer(address).close()


def test_bad_addresses(tmp_path: Path) -> None:
    file = tmp_path / 'file'
    file.write_text('mine')
    for address, expected in (
        (str(file), 'no socket'),
        (str(tmp_path / 'none' / 'cell.sock'), 'cannot listen'),
        ('/tmp/' + 'x' * 120, 'longer than'),
    ):
        with pytest.raises(UserError, match=expected):
            CellServer(address)
    assert file.read_text() == 'mine'


def test_backends_by_name() -> None:
    assert isinstance(make(GAUGE_BACKENDS, 'cell', 'a'), CellGauges)
    known = r"expected one of \['cell', 'linuxcnc', 'mtconnect', 'opcua'\]"
    with pytest.raises(UserError, match=f'parameter backend: {known}'):
        make(CNC_BACKENDS, 'fanuc', 'a')
    with pytest.raises(UserError, match='address: missing'):
        make(CNC_BACKENDS, 'cell', '')


def test_sequence_counts_losses_and_restarts() -> None:
    counter = Sequence()
    assert [counter.number(device, 10) for device in (500, 510, 530)] == [0, 10, 30]
    assert counter.losses == 10
    # The device starts again at 0: how many were lost nobody knows, a jump of one shows it.
    assert counter.number(0, 10) == 41
    assert counter.number(10, 10) == 51
    assert (counter.losses, counter.restarts) == (11, 1)


def test_rate_is_that_of_the_stamps() -> None:
    rate = Rate()
    for index in range(5):
        rate.add(index * 200_000_000, 10)
    assert rate.take() == '50.0'
    assert rate.take() == ''
    rate.add(1_000_000_000, 10)
    assert rate.take() == '50.0'
