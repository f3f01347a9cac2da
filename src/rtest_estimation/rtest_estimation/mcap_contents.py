"""The pass over an MCAP file: the records that matter, chunks unpacked, damage stepped over."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Footer, Metadata
from mcap.writer import MCAP0_MAGIC

from rtest_estimation.errors import UserError
from rtest_estimation.mcap_chunk import (
    DAMAGE,
    FRAME,
    MAX_CHUNK,
    Unpacker,
    exact_stream,
    fits,
    read_chunk,
)
from rtest_estimation.mcap_damage import Damage
from rtest_estimation.mcap_resync import Framing

_USED = frozenset((
    Opcode.MESSAGE, Opcode.CHANNEL, Opcode.SCHEMA, Opcode.METADATA, Opcode.FOOTER
))


class _Open(NamedTuple):
    """The file while it is read."""

    file: BinaryIO
    framing: Framing
    unpacker: Unpacker

    def content(self, place: int, length: int) -> bytes:
        """Of the record at a place."""
        self.file.seek(place + FRAME.size)
        return self.file.read(length)


# What of a record may be messages or topics, and where to go on; None without either.
_Step = tuple[bytes | None, int | None]


class Contents:
    """Of the file at `path`; what is wrong is counted in `damage`.

    Attributes, complete after `stretches` was read to its end: `whole`, whether the file has an
    end; `closed`, whether it has an index too; `metadata`, the metadata records; `attachments`,
    place and length of each.
    """

    def __init__(self, path: Path, damage: Damage) -> None:
        self.whole = False
        self.closed = False
        self.metadata: list[Metadata] = []
        self.attachments: list[tuple[int, int]] = []
        self._path = path
        self._damage = damage
        # The record before, where it gave no messages; bytes could be missing in it.
        self._before: tuple[int, int, int] | None = None
        # Bytes that were read for a chunk where there was none.
        self._in_vain = 0

    def stretches(self) -> Iterator[bytes]:
        """Records that may be messages or topics: those of each chunk, and each one outside.

        Raises UserError where the file is no MCAP file or unpacks to more than a recording can.
        """
        with self._path.open('rb') as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise UserError(
                    f'{self._path}: not an MCAP file; expected a recording made by rtest or '
                    'ros2 bag'
                )
            size = self._path.stat().st_size
            source = _Open(file, Framing(file, size), Unpacker(self._path, size))
            place: int | None = len(MCAP0_MAGIC)
            while place is not None and not self.whole:
                frame = source.framing.believed(place)
                if frame is None:
                    records, place = self._unframed(source, place)
                elif frame[0] == Opcode.CHUNK:
                    records, place = self._chunk(source, place, frame[1])
                else:
                    self._before = None if frame[0] == Opcode.MESSAGE else (place, *frame)
                    records, place = self._other(source, place, *frame)
                if records:
                    yield records

    def _chunk(self, source: _Open, place: int, length: int) -> _Step:
        """A chunk whose length agrees with its fields."""
        end = place + FRAME.size + length
        if length > MAX_CHUNK:
            self._damage.leave_out(f'record of {length} bytes')
            return None, end
        self._before = None
        try:
            return self._unpack(source, place, length, self._damage.framing), end
        except UserError:
            raise
        except DAMAGE as error:
            # Half a chunk, with others behind it, does not end where another record begins.
            if not source.framing.leads_on(end) and self._may_try(source, length):
                return None, self._step_over(source, place, place)
            self._leave_out(error)
            return None, end

    def _unframed(self, source: _Open, place: int) -> _Step:
        """A place where a record should be and none can be believed."""
        length = source.framing.chunk_length(place)
        if length is not None and self._may_try(source, length):
            try:
                records = self._unpack(source, place, length, doubtful=True)
            except UserError:
                raise
            except DAMAGE:
                pass
            else:
                self._before = None
                self._damage.mend_frame(place)
                return records, place + FRAME.size + length
        begin, before = place, self._before
        self._before = None
        if before is not None and self._may_try(source, before[2]):
            begin = place if _is_whole_attachment(source, *before) else before[0]
        return None, self._step_over(source, begin, place)

    @staticmethod
    def _unpack(source: _Open, place: int, length: int, doubtful: bool) -> bytes:
        """Records of a chunk; an error of `DAMAGE` where they are damaged.

        doubtful : whether bytes that look like a chunk may be none; a checksum dispels that
        """
        chunk = read_chunk(source.content(place, length))
        records = source.unpacker.unpack(chunk)
        if not chunk.checksum:
            doubtful = doubtful or not source.framing.leads_on(place + FRAME.size + length)
            if doubtful and not fits(chunk, records):
                raise McapError('a chunk without checksum whose records do not fit it')
        return records

    def _may_try(self, source: _Open, length: int) -> bool:
        """Whether so many bytes may be read once more; in a hostile file each could be a chunk."""
        self._in_vain += length
        return self._in_vain - length <= source.unpacker.file_size

    def _step_over(self, source: _Open, begin: int, place: int) -> int | None:
        """The next chunk, or the end, after the first byte from `begin`; none is at `place`."""
        found = source.framing.find(begin + 1)
        if found is None:
            self._damage.cut = place
        else:
            place = place if found > place else begin
            self._damage.skip(place, found - place)
        return found

    def _other(self, source: _Open, place: int, opcode: int, length: int) -> _Step:
        """A record outside of chunks."""
        end = place + FRAME.size + length
        if opcode == Opcode.ATTACHMENT:
            self.attachments.append((place + FRAME.size, length))
        if opcode not in _USED:
            return None, end
        if length > MAX_CHUNK:
            self._damage.leave_out(f'record of {length} bytes')
            return None, end
        content = source.content(place, length)
        try:
            if opcode == Opcode.FOOTER:
                self.whole = True
                self.closed = Footer.read(exact_stream(content)).summary_start != 0
            elif opcode == Opcode.METADATA:
                self.metadata.append(Metadata.read(exact_stream(content)))
        except DAMAGE as error:
            self._leave_out(error)
            return None, end
        return FRAME.pack(opcode, length) + content, end

    def _leave_out(self, error: Exception) -> None:
        self._damage.leave_out(' '.join(str(error).split()) or type(error).__name__)


def _is_whole_attachment(source: _Open, place: int, opcode: int, length: int) -> bool:
    """Whether a record is an attachment as it was written; it could be a recording itself."""
    if opcode != Opcode.ATTACHMENT or not 4 < length <= MAX_CHUNK:
        return False
    content = source.content(place, length)
    return zlib.crc32(content[:-4]) == int.from_bytes(content[-4:], 'little')
