"""The wire between the simulated cell and its drivers: an AF_UNIX socket, a channel for each.

The client asks, the server answers with everything it has by then, perhaps after a short wait, and
perhaps with nothing. The next question says that the answer was dealt with, so that the cell knows
what has been taken and can hold simulated time back.

An answer is a sequence of records, each a header and arrays in little endian; nothing is pickled.
"""

from __future__ import annotations

import contextlib
import os
import stat
import struct
import tempfile
import threading
from collections.abc import Sequence
from multiprocessing.connection import Client, Connection, Listener

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.records import Feedback, GaugeBlock, Temperature

GAUGES, CNC, THERMOMETERS = 'gauges', 'cnc', 'thermometers'
CHANNELS = (GAUGES, CNC, THERMOMETERS)
Record = GaugeBlock | Feedback | Temperature
DEFAULT_ADDRESS = os.path.join(tempfile.gettempdir(), 'rtest_cell.sock')
_ASK = b'?'
# Longest wait of the server for something to answer with; the client's time-out is longer.
_WAIT_S = 0.1
_BLOCK = struct.Struct('<cqQdIH')
_FEEDBACK = struct.Struct('<cqHH')
_TEMPERATURE = struct.Struct('<cqddH')
# sun_path holds 108 bytes on Linux, with a zero at the end.
_LONGEST_PATH = 107


class LinkError(ConnectionError):
    """The link is down or speaks another language; says what to do."""


def encode(records: Sequence[Record]) -> bytes:
    """Records to one answer."""
    parts = []
    for record in records:
        if isinstance(record, GaugeBlock):
            count, channels = record.displacement.shape
            parts += [
                _BLOCK.pack(
                    b'G', record.stamp, record.sequence, record.period, count, channels
                ),
                np.ascontiguousarray(record.displacement, dtype='<f8').tobytes(),
                np.ascontiguousarray(record.status, dtype=np.uint8).tobytes(),
            ]
        elif isinstance(record, Temperature):
            name = record.sensor.encode()
            parts += [
                _TEMPERATURE.pack(b'T', record.stamp, record.value, record.variance, len(name)),
                name,
            ]
        else:
            names = '\0'.join(record.axes).encode()
            parts += [
                _FEEDBACK.pack(b'F', record.stamp, len(record.axes), len(names)),
                names,
                np.ascontiguousarray(record.position, dtype='<f8').tobytes(),
            ]
    return b''.join(parts)


def decode(data: bytes) -> list[Record]:
    """One answer to records; raises LinkError where it is damaged."""
    records: list[Record] = []
    at = 0
    try:
        while at < len(data):
            kind = data[at : at + 1]
            if kind == b'G':
                _, stamp, sequence, period, count, channels = _BLOCK.unpack_from(data, at)
                at += _BLOCK.size
                values = np.frombuffer(data, '<f8', count * channels, at)
                at += values.nbytes
                status = np.frombuffer(data, np.uint8, count * channels, at)
                at += status.nbytes
                shape = (count, channels)
                records.append(
                    GaugeBlock(
                        stamp, sequence, period, values.reshape(shape), status.reshape(shape)
                    )
                )
            elif kind == b'F':
                _, stamp, count, length = _FEEDBACK.unpack_from(data, at)
                at += _FEEDBACK.size
                axes = tuple(data[at : at + length].decode().split('\0'))
                at += length
                position = np.frombuffer(data, '<f8', count, at)
                at += position.nbytes
                if len(axes) != count:
                    raise ValueError(f'{count} positions, names {axes}')
                records.append(Feedback(stamp, axes, position))
            elif kind == b'T':
                _, stamp, value, variance, length = _TEMPERATURE.unpack_from(data, at)
                at += _TEMPERATURE.size
                if at + length > len(data):
                    raise ValueError('the name of a sensor is cut off')
                name = data[at : at + length].decode()
                at += length
                records.append(Temperature(stamp, name, value, variance))
            else:
                raise ValueError(f'record of kind {kind!r}')
    except (struct.error, ValueError) as error:
        raise LinkError(f'the simulated cell sent a damaged answer: {error}') from None
    return records


class CellServer:
    """The cell's side: an outbox a channel; threads hand them to whoever connects.

    A channel nobody is connected to drops what it is sent: a device reads on when nobody looks.
    """

    def __init__(self, address: str) -> None:
        """Listen; raises UserError where the address cannot be used."""
        self.address = address
        self._outboxes = {name: _Outbox() for name in CHANNELS}
        _clear(address)
        try:
            self._listener = Listener(address, 'AF_UNIX')
        except OSError as error:
            raise UserError(
                f'parameter address: cannot listen at {address}: {error.strerror or error}; '
                'give the path of a socket in a directory that can be written to'
            ) from None
        self._closed = False
        self._acceptor = threading.Thread(target=self._accept, name='cell link', daemon=True)
        self._acceptor.start()

    def send(self, channel: str, records: Sequence[Record]) -> None:
        """Put records into a channel's outbox; they are dropped where nobody is connected."""
        self._outboxes[channel].put(records)

    @property
    def connected(self) -> tuple[str, ...]:
        """Channels with a driver at the other end."""
        return tuple(name for name, box in self._outboxes.items() if box.client is not None)

    @property
    def taken(self) -> bool:
        """Whether every connected driver has dealt with all it was sent."""
        return all(box.taken for box in self._outboxes.values())

    def close(self) -> None:
        """Stop listening, hang up, remove the socket."""
        if self._closed:
            return
        self._closed = True
        # accept() does not notice that its listener is closed; a caller wakes it.
        with contextlib.suppress(OSError):
            Client(self.address, 'AF_UNIX').close()
        self._acceptor.join(timeout=2.0)
        self._listener.close()
        for box in self._outboxes.values():
            box.attach(None)

    def _accept(self) -> None:
        while not self._closed:
            try:
                client = self._listener.accept()
            except (OSError, EOFError):
                continue
            if self._closed:
                client.close()
                return
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: Connection) -> None:
        box = None
        try:
            box = self._outboxes.get(client.recv_bytes(16).decode())
            if box is None:
                return
            box.attach(client)
            while client.recv_bytes(16) == _ASK:
                answer = box.take(client)
                if answer is None:
                    return
                client.send_bytes(encode(answer))
        except (OSError, EOFError, UnicodeDecodeError):
            pass  # The driver has gone: its outbox is let go below, and another may come.
        finally:
            client.close()
            if box is not None:
                box.detach(client)


class _Outbox:
    """Records on their way to one driver, and whether it has dealt with them."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._records: list[Record] = []
        self._handed = False
        self.client: Connection | None = None

    def attach(self, client: Connection | None) -> None:
        """A new driver; the one before is hung up on when it next asks."""
        with self._changed:
            self.client, self._records, self._handed = client, [], False
            self._changed.notify_all()

    def detach(self, client: Connection) -> None:
        with self._changed:
            if self.client is client:
                self.client, self._records, self._handed = None, [], False

    def put(self, records: Sequence[Record]) -> None:
        with self._changed:
            if self.client is not None and records:
                self._records += records
                self._changed.notify_all()

    def take(self, client: Connection) -> list[Record] | None:
        """The driver asks: what it was given before is dealt with. None for one replaced."""
        with self._changed:
            if self.client is not client:
                return None
            self._handed = False
            self._changed.wait_for(lambda: self._records or self.client is not client, _WAIT_S)
            if self.client is not client:
                return None
            records, self._records = self._records, []
            self._handed = bool(records)
            return records

    @property
    def taken(self) -> bool:
        with self._changed:
            return self.client is None or not (self._records or self._handed)


class CellClient:
    """A driver's side of one channel."""

    def __init__(self, address: str, channel: str) -> None:
        self._address, self._channel = address, channel
        self._link: Connection | None = None
        self._asked = False

    def open(self) -> None:
        """Connect; raises LinkError where no cell listens."""
        self.close()
        try:
            self._link = Client(self._address, 'AF_UNIX')
            self._link.send_bytes(self._channel.encode())
        except (OSError, EOFError) as error:
            self.close()
            raise LinkError(
                f'no simulated cell at {self._address} '
                f'({getattr(error, "strerror", None) or error}); start the node cell, '
                'or set the parameter address of both alike'
            ) from None

    def read(self, timeout: float) -> list[Record]:
        """Ask, and wait for the answer up to `timeout` [s]; raises LinkError when it is down.

        After a time-out the question still stands, and the next call waits for its answer.
        """
        if self._link is None:
            raise LinkError(f'the link to the simulated cell at {self._address} is not open')
        try:
            if not self._asked:
                self._link.send_bytes(_ASK)
                self._asked = True
            if not self._link.poll(timeout):
                return []
            data = self._link.recv_bytes()
        except (OSError, EOFError) as error:
            self.close()
            raise LinkError(
                f'lost the simulated cell at {self._address} '
                f'({getattr(error, "strerror", None) or "hung up"}); start the node cell again'
            ) from None
        self._asked = False
        return decode(data)

    def close(self) -> None:
        """Hang up; does nothing where it is not open."""
        self._asked = False
        if self._link is not None:
            self._link.close()
            self._link = None


class CellGauges(CellClient):
    """The simulated cell's gauges: backend 'cell' of the gauge driver."""

    def __init__(self, address: str) -> None:
        super().__init__(address, GAUGES)

    def read(self, timeout: float) -> list[GaugeBlock]:
        """Blocks since the last call; raises LinkError when the cell is gone."""
        return [record for record in super().read(timeout) if isinstance(record, GaugeBlock)]

    def health(self) -> tuple[str, dict[str, str]]:
        """The cell has nothing to tell of itself."""
        return '', {}


class CellCnc(CellClient):
    """The simulated cell's encoders: backend 'cell' of the CNC driver."""

    def __init__(self, address: str) -> None:
        super().__init__(address, CNC)

    def read(self, timeout: float) -> list[Feedback]:
        """Feedback since the last call; raises LinkError when the cell is gone."""
        return [record for record in super().read(timeout) if isinstance(record, Feedback)]

    def problem(self) -> str:
        """The cell has nothing to tell of itself."""
        return ''

    def uncertainty(self) -> float:
        """None: the cell's stamps are its time."""
        return 0.0

    def told(self) -> dict[str, str]:
        """The cell has nothing to tell of itself."""
        return {}


class CellThermometers(CellClient):
    """The simulated cell's thermometers: backend 'cell' of the thermometer driver."""

    def __init__(self, address: str) -> None:
        super().__init__(address, THERMOMETERS)

    def read(self, timeout: float) -> list[Temperature]:
        """Temperatures since the last call; raises LinkError when the cell is gone."""
        return [record for record in super().read(timeout) if isinstance(record, Temperature)]

    def health(self) -> tuple[str, dict[str, str]]:
        """The cell has nothing to tell of itself."""
        return '', {}


def _clear(address: str) -> None:
    """Remove the socket of a cell that died; refuse one that lives, and what is no socket."""
    if len(os.fsencode(address)) > _LONGEST_PATH:
        raise UserError(
            f'parameter address: {address} is longer than {_LONGEST_PATH} bytes, '
            'which a socket cannot be; choose a shorter path'
        )
    try:
        mode = os.stat(address).st_mode
    except FileNotFoundError:
        return
    except OSError as error:
        raise UserError(f'parameter address: {address}: {error.strerror}') from None
    if not stat.S_ISSOCK(mode):
        raise UserError(f'parameter address: {address} exists and is no socket; choose another')
    try:
        Client(address, 'AF_UNIX').close()
    except OSError:
        os.unlink(address)
        return
    raise UserError(f'parameter address: another cell listens at {address}; choose another')
