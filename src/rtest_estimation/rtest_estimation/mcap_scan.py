"""Reads an MCAP file from its beginning as far as it goes, without its index.

A file whose writer was killed has no index, and one way of reading for all files is one way to
test. Damage is stepped over, counted, and told in sentences; nothing in the file is believed.
`mcap_contents` passes over its records, `mcap_resync` finds the next one where a length is wrong,
`mcap_chunk` unpacks chunks.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata

from rtest_estimation.mcap_chunk import DAMAGE, FRAME, MAX_CHUNK, MESSAGE, exact_stream
from rtest_estimation.mcap_contents import Contents
from rtest_estimation.mcap_damage import Damage
from rtest_estimation.mcap_topics import Source, Topics
from rtest_estimation.message_reader import Definition
from rtest_estimation.plain_text import printable

# Name of the metadata records in which a recorder counts what it could not record.
LOSSES = 'rtest_losses'
# Name of the one in a mended file that says what could not be mended.
MENDED = 'rtest_mended'
# Frame and times of a message record at once.
_WHOLE = struct.Struct('<BQHIQQ')
# Compared with for every message: looking up a member of an enumeration takes longer.
_MESSAGE = int(Opcode.MESSAGE)
# Losses are listed by topic; more than this is no list of topics.
_MAX_LOSSES = 1000


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
        self._damage = Damage()
        self._topics = Topics(path, self._damage)
        self._sources = self._topics.sources
        self._contents = Contents(path, self._damage)
        self.metadata = self._contents.metadata

    @property
    def intact(self) -> bool:
        """Whether nothing is damaged and the index is there."""
        return self.closed and not self._damage

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
        for records in self._contents.stretches():
            yield from inside(records)
        self._conclude()

    def attachments(self) -> Iterator[Attachment | None]:
        """Attachments of the file, after `entries` was read; None for a damaged one."""
        with self.path.open('rb') as file:
            for place, length in self._contents.attachments:
                file.seek(place)
                try:
                    yield Attachment.read(exact_stream(file.read(min(length, MAX_CHUNK))))
                except DAMAGE:
                    yield None

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
                if opcode == _MESSAGE and length >= MESSAGE.size and end <= size:
                    if channel in known:
                        if (found := known[channel]) is not None:
                            yield (*found, log_time, data[place + _WHOLE.size : end])
                        place = end
                        continue
                    if (source := self._topics.find(channel)) is not None:
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
            self._damage.leave_out('half a record at the end of a chunk')
            return None
        opcode, length = FRAME.unpack_from(data, place)
        start = place + FRAME.size
        if start + length > len(data):
            self._damage.leave_out('a record that is longer than its chunk')
            return None
        return opcode, start, start + length

    def _record(self, opcode: int, data: bytes, start: int, end: int) -> Entry | None:
        """The message in a part of the file; topics are remembered, others passed over."""
        if opcode == _MESSAGE:
            if end - start < MESSAGE.size:
                self._damage.leave_out('a message without times')
                return None
            channel, sequence, log_time, publish_time = MESSAGE.unpack_from(data, start)
            # The call is for those that are not known yet.
            source = self._sources.get(channel) or self._topics.find(channel)
            if source is None:
                self._damage.orphans += 1
                return None
            return Entry(
                source, sequence, log_time, publish_time, data[start + MESSAGE.size : end]
            )
        if opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            self._topics.declare(opcode, data[start:end])
        return None

    def _conclude(self) -> None:
        name = self.path.name
        self.closed = self._contents.closed
        for record in self.metadata:
            self._note(record)
        self.warnings += self._damage.of_framing(name)
        if self._contents.whole and not self.closed:
            self.warnings.append(
                f'{name} was not closed: the recorder was stopped hard, its last second may be '
                'missing'
            )
        self.warnings += [
            f'{name}: the recorder counted: {what}: {count} messages'
            for what, count in self.losses.items()
        ]
        self.warnings += self._damage.of_records(name)

    def _note(self, metadata: Metadata) -> None:
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
