"""Reads an MCAP file from its beginning as far as it goes, without its index.

A file whose writer was killed has no index, and one way of reading for all files is one way to
test. Damage is stepped over where the file allows it, counted, and told in sentences.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Footer, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from rtest_estimation.errors import UserError
from rtest_estimation.message_reader import Definition, full_name

# What every record begins with: opcode and length.
FRAME = struct.Struct('<BQ')
KNOWN = frozenset(opcode.value for opcode in Opcode)
# A chunk that claims to unpack to more than this is damaged; writers make chunks of a few MB.
MAX_CHUNK = 1024 * 1024 * 1024
# What reading a damaged record or chunk ends with (mcap does not wrap the errors underneath).
_DAMAGE = (McapError, struct.error, ValueError, RuntimeError, zstandard.ZstdError)


class McapScan:
    """One pass over the messages of a file.

    Attributes, complete after `messages` was read to its end: `closed`, whether the file has the
    index written at its closing; `warnings`, what is missing, one sentence each; `offered`, topic
    to the publishers' profiles as rosbag2 writes them (YAML).
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.closed = False
        self.warnings: list[str] = []
        self.offered: dict[str, str] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, tuple[str, Definition]] = {}
        self._whole = False
        self._damaged = 0
        self._orphans = 0

    def messages(self) -> Iterator[tuple[str, Definition, int, bytes]]:
        """Topic, definition, log time [ns] and data (CDR) of every message, in file order.

        Raises UserError where the file is no MCAP file.
        """
        with self.path.open('rb') as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise UserError(
                    f'{self.path}: not an MCAP file; expected a recording made by rtest or '
                    'ros2 bag'
                )
            for record in self._records(file):
                yield from self._take(record)
        self._conclude()

    def _records(self, file: BinaryIO) -> Iterator[Any]:
        """Records up to the footer; the frames are read here, so that damage stays in one."""
        size = self.path.stat().st_size
        while True:
            place = file.tell()
            frame = file.read(FRAME.size)
            if len(frame) < FRAME.size:
                break
            opcode, length = FRAME.unpack(frame)
            if place + FRAME.size + length > size:
                break
            content = file.read(length)
            if opcode not in KNOWN:
                # Other opcodes are free for others to use.
                continue
            data = _Exact(frame + content)
            reader = StreamReader(
                data,  # type: ignore[arg-type]  # the reader needs read() only
                skip_magic=True,
                emit_chunks=True,
            )
            try:
                record = next(reader.records)
            except _DAMAGE:
                self._damaged += 1
                continue
            yield record
            if isinstance(record, Footer):
                self.closed = record.summary_start != 0
                self._whole = file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC
                break
        if not self._whole:
            self.warnings.append(
                f'{self.path.name} is cut or damaged at byte {place}: what was recorded before '
                'is used, nothing after'
            )

    def _take(self, record: Any) -> Iterator[tuple[str, Definition, int, bytes]]:
        """One record of the file."""
        if isinstance(record, Message):
            channel = self._channels.get(record.channel_id)
            if channel is None:
                self._orphans += 1
            else:
                yield (*channel, record.log_time, record.data)
        elif isinstance(record, Chunk):
            try:
                inside = _unpack(record)
            except _DAMAGE:
                self._damaged += 1
            else:
                for inner in inside:
                    yield from self._take(inner)
        elif isinstance(record, Channel):
            if record.id not in self._channels:
                self._channels[record.id] = (record.topic, self._definition(record))
                self.offered[record.topic] = record.metadata.get('offered_qos_profiles', '')
        elif isinstance(record, Schema):
            self._schemas.setdefault(record.id, record)

    def _definition(self, channel: Channel) -> Definition:
        schema = self._schemas.get(channel.schema_id)
        if schema is None or channel.message_encoding != 'cdr':
            return Definition('', channel.message_encoding, '')
        text = schema.data.decode('utf-8', errors='replace')
        return Definition(full_name(schema.name), schema.encoding, text)

    def _conclude(self) -> None:
        self.closed &= self._whole
        if self._whole and not self.closed:
            self.warnings.append(
                f'{self.path.name} was not closed: the recorder was stopped hard, its last '
                'second may be missing'
            )
        if self._damaged:
            self.warnings.append(f'{self.path.name}: damaged chunks left out: {self._damaged}')
        if self._orphans:
            self.warnings.append(
                f'{self.path.name}: {self._orphans} messages left out whose topic was in a '
                'damaged chunk'
            )


class _Exact:
    """Bytes that never give less than they are asked for, so that a damaged length is noticed."""

    def __init__(self, data: bytes) -> None:
        self._stream = BytesIO(data)

    def read(self, count: int) -> bytes:
        data = self._stream.read(count)
        if len(data) != count:
            raise EndOfFile
        return data


def _unpack(chunk: Chunk) -> list[Any]:
    """Records of a chunk; all of them, or an error of `_DAMAGE`."""
    if chunk.uncompressed_size > MAX_CHUNK:
        raise McapError(f'chunk of {chunk.uncompressed_size} bytes')
    # zstandard believes the size in the frame, not the one it is given.
    if chunk.compression == 'zstd' and zstandard.frame_content_size(chunk.data) > MAX_CHUNK:
        raise McapError('zstd frame too large')
    return breakup_chunk(chunk, validate_crc=True)
