"""Reads an MCAP file from its beginning as far as it goes, without its index.

A file whose writer was killed has no index, and one way of reading for all files is one way to
test. Damage is stepped over where the file allows it, counted, and told in sentences. Nothing in
the file is believed: a length, or what a chunk unpacks to, is checked before memory is used.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from rtest_estimation.errors import UserError
from rtest_estimation.message_reader import Definition, full_name
from rtest_estimation.plain_text import printable

# Name of the metadata records in which a recorder counts what it could not record.
LOSSES = 'rtest_losses'
# Name of the one in a mended file that says what could not be mended.
MENDED = 'rtest_mended'
# Opcode and length, with which every record begins, and what a message record goes on with:
# channel, sequence, log time, publish time (MCAP specification, "Records").
FRAME = struct.Struct('<BQ')
_MESSAGE = struct.Struct('<HIQQ')
# Both at once.
_WHOLE = struct.Struct('<BQHIQQ')
# A chunk or record of more than this is damaged; writers make chunks of a few MB.
MAX_CHUNK = 256 * 1024 * 1024
# Measurements are packed to between a half and a twentieth of their size.
MAX_RATIO = 100
# What reading a damaged record or chunk ends with (mcap does not wrap the errors underneath).
_DAMAGE = (
    McapError, struct.error, ValueError, OverflowError, RuntimeError, zstandard.ZstdError
)
# Losses are listed by topic; more than this is no list of topics.
_MAX_LOSSES = 1000


@dataclass(frozen=True)
class Source:
    """A channel of the file: topic, definition of its messages, and both as they were written."""

    topic: str
    definition: Definition
    channel: Channel
    schema: Schema | None


class Entry(NamedTuple):
    """One message; times in ns."""

    source: Source
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


class McapScan:
    """One pass over the messages of a file.

    Attributes, complete after `entries` was read to its end: `closed`, whether the file has the
    index written at its closing; `warnings`, what is missing, one sentence each; `losses`, what
    the recorder itself says is missing, with its number; `metadata`, the metadata records;
    `intact`, whether the file is as its writer closed it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.closed = False
        self.warnings: list[str] = []
        self.losses: dict[str, int] = {}
        self.metadata: list[Metadata] = []
        self._attachments: list[tuple[int, int]] = []
        self._schemas: dict[int, Schema] = {}
        self._sources: dict[int, Source] = {}
        self._whole = False
        self._damaged: list[str] = []
        self._orphans = 0
        self._size = 0
        self._unpacked = 0

    @property
    def intact(self) -> bool:
        """Whether nothing is damaged and the index is there."""
        return self.closed and not self._damaged and not self._orphans

    @property
    def offered(self) -> dict[str, str]:
        """Topic to the profiles of its publishers as rosbag2 writes them (YAML)."""
        return {
            source.topic: source.channel.metadata.get('offered_qos_profiles', '')
            for source in self._sources.values()
        }

    def messages(
        self, topics: Container[str] | None = None
    ) -> Iterator[tuple[str, Definition, int, bytes]]:
        """Topic, definition, log time [ns] and data (CDR) of every message, in file order.

        topics : those whose messages are wanted; None for all

        Raises UserError as `entries` does.
        """
        yield from self._walk(partial(self._quick, topics, {}))

    def entries(self) -> Iterator[Entry]:
        """Every message in file order.

        Raises UserError where the file is no MCAP file or unpacks to more than a recording can.
        """
        yield from self._walk(self._inside)

    def _walk(self, inside: Callable[[bytes], Iterator[Any]]) -> Iterator[Any]:
        """What `inside` makes of the records of each chunk."""
        with self.path.open('rb') as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise UserError(
                    f'{self.path}: not an MCAP file; expected a recording made by rtest or '
                    'ros2 bag'
                )
            self._size = self.path.stat().st_size
            for opcode, content in self._records(file):
                yield from self._take(opcode, content, inside)
        self._conclude()

    def attachments(self) -> Iterator[Attachment | None]:
        """Attachments of the file, after `entries` was read; None for a damaged one."""
        with self.path.open('rb') as file:
            for place, length in self._attachments:
                file.seek(place)
                try:
                    yield Attachment.read(_stream(file.read(min(length, MAX_CHUNK))))
                except _DAMAGE:
                    yield None

    def _records(self, file: BinaryIO) -> Iterator[tuple[int, bytes]]:
        """Opcode and content of the records up to the footer that are of use here."""
        while True:
            place = file.tell()
            frame = file.read(FRAME.size)
            if len(frame) < FRAME.size:
                break
            opcode, length = FRAME.unpack(frame)
            # A file that grew but was not written, as after a power failure, reads as zeros.
            if opcode == 0 or place + FRAME.size + length > self._size:
                break
            if opcode not in _USED:
                if opcode == Opcode.ATTACHMENT:
                    self._attachments.append((file.tell(), length))
                file.seek(length, 1)
            elif length > MAX_CHUNK:
                self._damaged.append(f'record of {length} bytes')
                file.seek(length, 1)
            else:
                content = file.read(length)
                yield opcode, content
                if opcode == Opcode.FOOTER:
                    self._whole = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
                    break
        if not self._whole:
            self.warnings.append(
                f'{self.path.name} is cut or damaged at byte {place}: what was recorded before '
                'is used, nothing after'
            )

    def _take(
        self, opcode: int, content: bytes, inside: Callable[[bytes], Iterator[Any]]
    ) -> Iterator[Any]:
        """Messages of one record of the file."""
        try:
            if opcode == Opcode.CHUNK:
                content = self._unpack(Chunk.read(_stream(content)))
            elif opcode == Opcode.FOOTER:
                self.closed = Footer.read(_stream(content)).summary_start != 0
            elif opcode == Opcode.METADATA:
                self._note(Metadata.read(_stream(content)))
        except UserError:
            raise
        except _DAMAGE as error:
            self._damaged.append(' '.join(str(error).split()) or type(error).__name__)
            return
        if opcode == Opcode.CHUNK:
            yield from inside(content)
        else:
            yield from inside(FRAME.pack(opcode, len(content)) + content)

    def _quick(
        self,
        topics: Container[str] | None,
        known: dict[int, tuple[str, Definition] | None],
        data: bytes,
    ) -> Iterator[tuple[str, Definition, int, bytes]]:
        """As `_inside` in a third of the time, for readers of long recordings.

        known : topic and definition by channel, None of one that is not wanted; filled here
        """
        place, size = 0, len(data)
        while place < size:
            if place + _WHOLE.size <= size:
                opcode, length, channel, _, log_time, _ = _WHOLE.unpack_from(data, place)
                end = place + FRAME.size + length
                if opcode == Opcode.MESSAGE and length >= _MESSAGE.size and end <= size:
                    if channel in known:
                        if (found := known[channel]) is not None:
                            yield (*found, log_time, data[place + _WHOLE.size : end])
                        place = end
                        continue
                    if (source := self._sources.get(channel)) is not None:
                        wanted = topics is None or source.topic in topics
                        known[channel] = (source.topic, source.definition) if wanted else None
                        continue
            if (frame := self._frame(data, place)) is None:
                return
            opcode, start, place = frame
            self._record(opcode, data, start, place)

    def _inside(self, data: bytes) -> Iterator[Entry]:
        """Messages of an unpacked chunk, up to where it is damaged."""
        place = 0
        while place < len(data):
            if (frame := self._frame(data, place)) is None:
                return
            opcode, start, place = frame
            if (entry := self._record(opcode, data, start, place)) is not None:
                yield entry

    def _frame(self, data: bytes, place: int) -> tuple[int, int, int] | None:
        """Opcode, start and end of the record at a place; None where it is damaged."""
        if place + FRAME.size > len(data):
            self._damaged.append('half a record at the end of a chunk')
            return None
        opcode, length = FRAME.unpack_from(data, place)
        start = place + FRAME.size
        if start + length > len(data):
            self._damaged.append('a record that is longer than its chunk')
            return None
        return opcode, start, start + length

    def _record(self, opcode: int, data: bytes, start: int, end: int) -> Entry | None:
        """The message in a part of the file; topics are remembered, others passed over."""
        if opcode == Opcode.MESSAGE:
            if end - start < _MESSAGE.size:
                self._damaged.append('a message without times')
                return None
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, start)
            source = self._sources.get(channel)
            if source is None:
                self._orphans += 1
                return None
            return Entry(
                source, sequence, log_time, publish_time, data[start + _MESSAGE.size : end]
            )
        if opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            try:
                self._declare(opcode, _stream(data[start:end]))
            except _DAMAGE as error:
                self._damaged.append(f'a topic that cannot be read: {type(error).__name__}')
        return None

    def _declare(self, opcode: int, stream: ReadDataStream) -> None:
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas.setdefault(schema.id, schema)
            return
        channel = Channel.read(stream)
        if channel.id not in self._sources:
            schema = self._schemas.get(channel.schema_id)
            self._sources[channel.id] = Source(
                printable(channel.topic), _definition(channel, schema), channel, schema
            )

    def _unpack(self, chunk: Chunk) -> bytes:
        """Records of a chunk; all of them, or an error of `_DAMAGE`.

        Raises UserError where the file so far has become too large for what it is.
        """
        size = chunk.uncompressed_size
        if size > MAX_CHUNK:
            raise McapError(f'a chunk of {size} bytes')
        if chunk.compression:
            self._unpacked += size
            if self._unpacked > max(MAX_CHUNK, MAX_RATIO * self._size):
                raise UserError(
                    f'{self.path}: unpacks to more than {MAX_RATIO} times its size, which no '
                    'measurement does; if you trust it, unpack it with `mcap compress '
                    '--compression none` and read that'
                )
        data = _decompress(chunk)
        if len(data) != size:
            raise McapError(f'a chunk of {len(data)} bytes that says it has {size}')
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise McapError('a chunk with a wrong checksum')
        return data

    def _note(self, metadata: Metadata) -> None:
        self.metadata.append(metadata)
        if metadata.name == LOSSES:
            self.losses = {
                printable(what): int(count)
                for what, count in list(metadata.metadata.items())[:_MAX_LOSSES]
                if count.isascii() and count.isdecimal() and len(count) < 20
            }
        elif metadata.name == MENDED:
            self.warnings += [
                f'{self.path.name} was mended: {printable(text)}'
                for text in list(metadata.metadata.values())[:_MAX_LOSSES]
            ]

    def _conclude(self) -> None:
        name = self.path.name
        self.closed &= self._whole
        if self._whole and not self.closed:
            self.warnings.append(
                f'{name} was not closed: the recorder was stopped hard, its last second may be '
                'missing'
            )
        self.warnings += [
            f'{name}: the recorder counted: {what}: {count} messages'
            for what, count in self.losses.items()
        ]
        if self._damaged:
            self.warnings.append(
                f'{name}: damaged chunks or records left out: {len(self._damaged)} '
                f'({self._damaged[0]})'
            )
        if self._orphans:
            self.warnings.append(
                f'{name}: {self._orphans} messages left out whose topic was in a damaged chunk'
            )


_USED = frozenset((
    Opcode.CHUNK, Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA, Opcode.METADATA, Opcode.FOOTER
))


class _Exact:
    """Bytes that never give less than they are asked for, so that a damaged length is noticed."""

    def __init__(self, data: bytes) -> None:
        self._stream = BytesIO(data)

    def read(self, count: int) -> bytes:
        data = self._stream.read(count)
        if len(data) != count:
            raise EndOfFile
        return data


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(_Exact(data))  # type: ignore[arg-type]  # it needs read() only


def _decompress(chunk: Chunk) -> bytes:
    """Contents of a chunk, never much more than it says it has."""
    size = chunk.uncompressed_size
    if not chunk.compression:
        return chunk.data
    if chunk.compression == 'zstd':
        # zstandard believes the size in the frame, not the one it is given.
        if zstandard.frame_content_size(chunk.data) > size:
            raise McapError(f'a chunk of more than the {size} bytes that it says it has')
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    if chunk.compression == 'lz4':
        return lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    raise McapError(f'a chunk packed with {printable(chunk.compression)!r}')


def _definition(channel: Channel, schema: Schema | None) -> Definition:
    if schema is None or channel.message_encoding != 'cdr':
        return Definition('', printable(channel.message_encoding), '')
    text = schema.data.decode('utf-8', errors='replace')
    return Definition(full_name(printable(schema.name)), schema.encoding, text)

