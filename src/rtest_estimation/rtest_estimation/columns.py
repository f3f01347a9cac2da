"""Readings and feedback of a recording, read from the file as they are used.

A recording of a day does not fit into memory. What is kept of its readings is where they are; they
are read again whenever somebody goes through them, many messages at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from rtest_estimation.bagfile import Bag
from rtest_estimation.layout import Layout, layout_of
from rtest_estimation.message_reader import (
    DamagedMessage,
    Definition,
    field_definitions,
    message_reader,
)
from rtest_estimation.messages import (
    MAX_PERIOD_S,
    MAX_POSITION,
    MessageError,
    feedback,
    gauge_block,
)
from rtest_estimation.records import Feedback, GaugeBlock

# Messages that are looked at together.
_BATCH = 1000
# What goes on in one piece is at most this long [ns].
_PIECE_NS = 1_000_000_000

Record = TypeVar('Record', GaugeBlock, Feedback)


@dataclass(frozen=True)
class GaugeColumns:
    """Messages with readings.

    stamps, sequence : (m,) of the first reading [ns]; period : (m,) [s]
    displacement [m], status : (m, readings, channels)
    """

    stamps: np.ndarray
    sequence: np.ndarray
    period: np.ndarray
    displacement: np.ndarray
    status: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps)

    def part(self, rows: Any) -> GaugeColumns:
        """Some of the messages."""
        return GaugeColumns(
            self.stamps[rows], self.sequence[rows], self.period[rows], self.displacement[rows],
            self.status[rows],
        )

    def records(self) -> Iterator[GaugeBlock]:
        """One record a message."""
        for row in zip(
            self.stamps.tolist(), self.sequence.tolist(), self.period.tolist(),
            self.displacement, self.status, strict=True,
        ):
            yield GaugeBlock(*row)

    def piece(self) -> GaugeBlock:
        """All messages as one record."""
        readings, channels = self.displacement.shape[1:]
        # As `GaugeBlock.stamps` computes them.
        steps = np.arange(readings) * (self.period[:, None] * 1e9)
        times = (self.stamps[:, None] + np.rint(steps).astype(np.int64)).ravel()
        return GaugeBlock(
            int(self.stamps[0]), int(self.sequence[0]), float(self.period[0]),
            self.displacement.reshape(-1, channels), self.status.reshape(-1, channels), times,
        )


@dataclass(frozen=True)
class FeedbackColumns:
    """Encoder positions: axes, stamps (m,) [ns], positions (m, axes) [m] or [rad]."""

    axes: tuple[str, ...]
    stamps: np.ndarray
    positions: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps)

    def part(self, rows: Any) -> FeedbackColumns:
        """Some of the messages."""
        return FeedbackColumns(self.axes, self.stamps[rows], self.positions[rows])

    def records(self) -> Iterator[Feedback]:
        """One record a message."""
        for stamp, position in zip(self.stamps.tolist(), self.positions, strict=True):
            yield Feedback(stamp, self.axes, position)

    def piece(self) -> FeedbackColumns:
        """All messages as one."""
        return self


Columns = TypeVar('Columns', GaugeColumns, FeedbackColumns)


class Stream(Sequence, Generic[Record]):
    """The good messages of one topic as records, in the order of their stamps.

    look : sees the columns in the order in which they were recorded, once

    Attributes: `left_out`, the reason of the first of them, and `damaged`, how many; `back`, the
    stamps with which they step back [ns].
    """

    def __init__(
        self, bag: Bag, topic: str, look: Callable[[Any], None] = lambda columns: None
    ) -> None:
        self.left_out = ''
        self.damaged = 0
        self.back: list[int] = []
        self._bag, self._topic = bag, topic
        self._count, last = 0, 0
        for columns in self.arrived():
            steps = np.append(last, columns.stamps)
            self.back += columns.stamps[steps[1:] < steps[:-1]].tolist()
            last = int(steps[-1])
            self._count += len(columns)
            look(columns)

    def arrived(self) -> Iterator[GaugeColumns | FeedbackColumns]:
        """Messages in the order in which they were recorded."""
        # Counted anew, so that going through them twice counts nothing twice.
        self.left_out, self.damaged = '', 0
        decoders: dict[Definition, Callable[[list[bytes]], Iterator[Any]]] = {}
        for definition, batch in _batches(self._bag, self._topic):
            if definition not in decoders:
                where = f'{self._bag.path}: topic {self._topic}'
                decoders[definition] = _decoder(definition, where)
            for found in decoders[definition](batch):
                if isinstance(found, str):
                    self.left_out = self.left_out or found
                    self.damaged += 1
                else:
                    yield found

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Record]:
        for columns in self._ordered():
            yield from columns.records()

    def __getitem__(self, index: Any) -> Any:
        return tuple(self)[index]

    def pieces(self) -> Iterator[GaugeBlock | FeedbackColumns]:
        """The same in fewer records, each of a second at most."""
        for columns in self._ordered():
            first = 0
            while first < len(columns):
                end = columns.stamps[first] + _PIECE_NS
                last = int(np.searchsorted(columns.stamps, end))
                yield columns.part(slice(first, last)).piece()
                first = last

    def _ordered(self) -> Iterator[GaugeColumns | FeedbackColumns]:
        if not self.back:
            return self.arrived()
        # One by one, in memory: the messages of a batch that is sorted may differ in size.
        rows = [part.part([k]) for part in self.arrived() for k in range(len(part))]
        return iter(sorted(rows, key=lambda row: row.stamps[0]))


def _batches(bag: Bag, topic: str) -> Iterator[tuple[Definition, list[bytes]]]:
    batch: list[bytes] = []
    current: Definition | None = None
    for _, definition, _, data in bag.stored((topic,)):
        if batch and (definition is not current or len(batch) == _BATCH):
            yield current, batch
            batch = []
        current = definition
        batch.append(data)
    if batch:
        yield current, batch


def _decoder(
    definition: Definition, where: str
) -> Callable[[list[bytes]], Iterator[GaugeColumns | FeedbackColumns | str]]:
    """Function from serialised messages to columns, and to reasons why some are left out."""
    read = message_reader(definition, where)
    one, many = _KINDS[definition.type_name]
    types = field_definitions(definition)
    layout: Layout | None = None

    def decode(batch: list[bytes]) -> Iterator[GaugeColumns | FeedbackColumns | str]:
        nonlocal layout
        for _ in range(2):
            numbers = layout.columns(batch) if layout else None
            found = many(numbers, read(bytes(layout.template))) if numbers else None
            if found is not None and found.stamps.min() > 0:
                yield found
                return
            layout = _layout(types, definition.type_name, batch[0], read(batch[0]))
        for data in batch:
            yield _one(read(data), one)

    return decode


def _layout(types: Mapping[str, Any], name: str, data: bytes, message: Any) -> Layout | None:
    """Layout of a message, where it gives what reading the message by itself does."""
    one, many = _KINDS[name]
    if isinstance(message, DamagedMessage):
        return None
    layout = layout_of(types, name, data)
    found = many(layout.columns([data]), message) if layout else None
    if found is None:
        return None
    pairs = zip(vars(found).values(), vars(one(message)).values(), strict=True)
    return layout if all(_same(got, expected) for got, expected in pairs) else None


def _same(got: Any, expected: Any) -> bool:
    if isinstance(got, tuple):
        return got == expected
    return np.array_equal(got, expected, equal_nan=got.dtype.kind == 'f')


def _one(
    message: Any, convert: Callable[[Any], GaugeColumns | FeedbackColumns]
) -> GaugeColumns | FeedbackColumns | str:
    if isinstance(message, DamagedMessage):
        return message.reason
    try:
        columns = convert(message)
    except MessageError as error:
        return str(error)
    return columns if columns.stamps[0] > 0 else 'its time stamp is 0'


def _stamps(numbers: dict[str, np.ndarray]) -> np.ndarray:
    seconds = numbers['header.stamp.sec'][:, 0].astype(np.int64)
    return seconds * 1_000_000_000 + numbers['header.stamp.nanosec'][:, 0]


def _gauges(numbers: dict[str, np.ndarray], first: Any) -> GaugeColumns | None:
    """Columns of messages like `first`; None where one of them cannot be used."""
    try:
        readings, channels = gauge_block(first).displacement.shape
    except MessageError:
        return None
    period = numbers['period'][:, 0].astype(float)
    good = (period >= 0.0) & (period <= MAX_PERIOD_S) & ((readings == 1) | (period > 0.0))
    if not (good & (numbers['channels'][:, 0] == channels)).all():
        return None
    shape = (-1, readings, channels)
    return GaugeColumns(
        _stamps(numbers), numbers['sequence'][:, 0], period,
        numbers['displacement'].astype(float, copy=False).reshape(shape),
        numbers['status'].reshape(shape),
    )


def _gauge(message: Any) -> GaugeColumns:
    block = gauge_block(message)
    return GaugeColumns(
        np.array([block.stamp]), np.array([block.sequence]), np.array([block.period]),
        block.displacement[None], block.status[None],
    )


def _encoders(numbers: dict[str, np.ndarray], first: Any) -> FeedbackColumns | None:
    """Columns of messages like `first`; None where one of them cannot be used."""
    try:
        axes = feedback(first).axes
    except MessageError:
        return None
    positions = numbers['position'].astype(float, copy=False)
    if (np.abs(positions) > MAX_POSITION).any():
        return None
    return FeedbackColumns(axes, _stamps(numbers), positions)


def _encoder(message: Any) -> FeedbackColumns:
    record = feedback(message)
    return FeedbackColumns(record.axes, np.array([record.stamp]), record.position[None])


_KINDS: dict[str, tuple[Any, Any]] = {
    'rtest_msgs/msg/GaugeSamples': (_gauge, _gauges),
    'sensor_msgs/msg/JointState': (_encoder, _encoders),
}
