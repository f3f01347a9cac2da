"""The topics of an MCAP file as it declares them; those of a damaged chunk from its summary."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.writer import MCAP0_MAGIC

from rtest_estimation.mcap_chunk import DAMAGE, FOOTER, FRAME, MAX_CHUNK, exact_stream
from rtest_estimation.mcap_damage import Damage
from rtest_estimation.message_reader import Definition, full_name
from rtest_estimation.plain_text import printable

# Of the footer, what is in its checksum: frame and both places.
_CHECKED = FRAME.size + 16


@dataclass(frozen=True)
class Source:
    """A channel of the file: topic, definition of its messages, and both as they were written."""

    topic: str
    definition: Definition
    channel: Channel
    schema: Schema | None


class Topics:
    """Of the file at `path`; what cannot be read is counted in `damage`.

    sources : by the number of their channel
    """

    def __init__(self, path: Path, damage: Damage) -> None:
        self.sources: dict[int, Source] = {}
        self._path = path
        self._damage = damage
        self._schemas: dict[int, Schema] = {}
        self._recalled = False

    def find(self, channel: int) -> Source | None:
        """The source of a message; None where the file does not say what it is."""
        if channel not in self.sources:
            self._recall()
        return self.sources.get(channel)

    def declare(self, opcode: int, content: bytes) -> None:
        """Take a channel or schema; the first one of each number counts."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(exact_stream(content))
                self._schemas.setdefault(schema.id, schema)
            else:
                self._add(Channel.read(exact_stream(content)))
        except DAMAGE as error:
            self._damage.leave_out(f'a topic that cannot be read: {type(error).__name__}')

    def _add(self, channel: Channel) -> None:
        if channel.schema_id and channel.schema_id not in self._schemas:
            self._recall()
        if channel.id not in self.sources:
            schema = self._schemas.get(channel.schema_id)
            self.sources[channel.id] = Source(
                printable(channel.topic), _definition(channel, schema), channel, schema
            )

    def _recall(self) -> None:
        """Take what a closed file repeats at its end, once."""
        if self._recalled:
            return
        self._recalled = True
        with self._path.open('rb') as file:
            try:
                for opcode, content in _summary(file, self._path.stat().st_size):
                    if opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
                        self.declare(opcode, content)
            except McapError as error:
                self._damage.leave_out(str(error))


def _definition(channel: Channel, schema: Schema | None) -> Definition:
    if schema is None or channel.message_encoding != 'cdr':
        return Definition('', printable(channel.message_encoding), '')
    text = schema.data.decode('utf-8', errors='replace')
    return Definition(full_name(printable(schema.name)), schema.encoding, text)



def _summary(file: BinaryIO, size: int) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of the records between the data of a file and its footer.

    None where the file was not closed. Raises McapError where they are damaged.
    """
    place = max(0, size - FOOTER.size)
    file.seek(place)
    end = file.read(FOOTER.size)
    if len(end) < FOOTER.size:
        return
    opcode, length, begin, _, checksum, magic = FOOTER.unpack(end)
    if (opcode, length, magic) != (Opcode.FOOTER, 20, MCAP0_MAGIC):
        return
    if not 0 < begin < place or place - begin > MAX_CHUNK:
        return
    file.seek(begin)
    data = file.read(place - begin)
    # Of the summary and the footer up to the checksum itself.
    if checksum and zlib.crc32(end[:_CHECKED], zlib.crc32(data)) != checksum:
        raise McapError('a summary with a wrong checksum')
    place = 0
    while place + FRAME.size <= len(data):
        opcode, length = FRAME.unpack_from(data, place)
        place += FRAME.size
        yield opcode, data[place : place + length]
        place += length
