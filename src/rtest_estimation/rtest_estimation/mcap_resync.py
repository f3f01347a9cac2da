"""Where the records of a damaged MCAP file are: which lengths to believe, where to go on.

One flipped bit in the length of a record hides everything after it, or jumps over chunks. So a
length is believed only where the fields of the record agree with it; otherwise the bytes after
are searched for the next chunk. The search goes forward only, and reads each byte about once
whatever the file holds.
"""

from __future__ import annotations

import re
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from rtest_estimation.mcap_chunk import CHUNK, FOOTER, FRAME, MAX_CHUNK, SIZE

# What the records are made of (MCAP specification, "Records"): so many bytes, or, where negative,
# a length of so many bytes and what it is the length of. Messages do not say how long they are.
_PARTS: dict[int, tuple[int, ...]] = {
    Opcode.HEADER: (-4, -4),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, -4, -4, -4),
    Opcode.CHANNEL: (4, -4, -4, -4),
    Opcode.CHUNK: (28, -4, -8),
    Opcode.MESSAGE_INDEX: (2, -4),
    Opcode.CHUNK_INDEX: (32, -4, 8, -4, 16),
    Opcode.ATTACHMENT: (16, -4, -4, -8, 4),
    Opcode.ATTACHMENT_INDEX: (40, -4, -4),
    Opcode.STATISTICS: (42, -4),
    Opcode.METADATA: (-4, -4),
    Opcode.METADATA_INDEX: (16, -4),
    Opcode.SUMMARY_OFFSET: (17,),
    Opcode.DATA_END: (4,),
}
# Those that can be damaged inside, and still end where the next record begins.
_LOOSE = frozenset((
    Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA
))
_PACKINGS = (b'', b'lz4', b'zstd')
# Frame and fields of a chunk up to its packed records.
_LONGEST = FRAME.size + CHUNK.size + max(map(len, _PACKINGS)) + SIZE.size
# The same as far as an expression can tell: every length is below 2^32, the packing is known.
_OPENING = re.compile(
    rb'\x06(?=.{4}\0{4}.{20}\0{4}.{4}(?:\0{4}|\x03\0{3}lz4|\x04\0{3}zstd).{4}\0{4})', re.DOTALL
)
_BLOCK = 1024 * 1024
# Records of unknown kinds that follow each other; that many in their places are no chance.
_UNKNOWN = 8


class Framing:
    """The records of one open file of `size` bytes by their places.

    Only ever asked about places further on.
    """

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file = file
        self._size = size
        self._block, self._base = b'', 0
        self._has_chunks = False
        self._data_ended = False
        # Up to where messages outside of chunks were followed, and whether that led on.
        self._followed, self._led_on = 0, False

    def believed(self, place: int) -> tuple[int, int] | None:
        """Opcode and length of the record at a place; None where they cannot be true."""
        if (frame := self._frame(place)) is None:
            return None
        opcode, length = frame
        start = place + FRAME.size
        if opcode == Opcode.MESSAGE:
            return frame if self._is_message(place, length) else None
        own = self._own_length(opcode, start) if opcode in _PARTS else None
        if own != length:
            # Unknown kinds are legal. What is a chunk but for its opcode is none of them.
            could_be = own is None or (opcode in _LOOSE and own > length)
            chunk = self.chunk_length(place) is not None
            return frame if could_be and not chunk and self.leads_on(start + length) else None
        if opcode == Opcode.FOOTER and not self._is_end(start + length):
            return None
        self._has_chunks |= opcode == Opcode.CHUNK
        self._data_ended |= opcode == Opcode.DATA_END
        return frame

    def chunk_length(self, place: int) -> int | None:
        """Length of the chunk at a place by its own fields; None where they are none of a chunk.

        Its frame is not looked at.
        """
        start = place + FRAME.size
        return _fields_length(self._read(start, _LONGEST - FRAME.size), self._size - start)

    def find(self, place: int) -> int | None:
        """Where the next chunk begins, or else the footer at the very end; None without both."""
        at = place
        while at < self._size:
            within = self._base <= at and at + _LONGEST <= self._base + len(self._block)
            if not within:
                self._base, self._block = at, self._read(at, _BLOCK)
            for match in _OPENING.finditer(self._block, at - self._base):
                begin = match.start()
                _, length = FRAME.unpack_from(self._block, begin)
                start = begin + FRAME.size
                fields = self._block[start : begin + _LONGEST]
                if _fields_length(fields, self._size - self._base - start) == length:
                    return self._base + begin
            end = self._base + len(self._block)
            # What begins in the last bytes of a block may go on in the next.
            at = end - _LONGEST + 1 if len(self._block) == _BLOCK else self._size
        footer = self._size - FOOTER.size
        is_end = footer >= place and self.believed(footer) == (Opcode.FOOTER, 20)
        return footer if is_end else None

    def _frame(self, place: int) -> tuple[int, int] | None:
        """Opcode and length at a place; None where they do not fit into the file."""
        frame = self._read(place, FRAME.size)
        if len(frame) < FRAME.size:
            return None
        opcode, length = FRAME.unpack(frame)
        # A file that grew but was not written, as after a power failure, reads as zeros.
        if opcode == 0 or place + FRAME.size + length > self._size:
            return None
        return opcode, length

    def _own_length(self, opcode: int, start: int) -> int:
        """Length of a record by its fields, as far as they lie within the file."""
        length = 0
        for part in _PARTS[opcode]:
            if part > 0:
                length += part
            elif start + length < self._size:
                length += int.from_bytes(self._read(start + length, -part), 'little') - part
            else:
                return self._size
        return length

    def leads_on(self, place: int) -> bool:
        """Whether a record that ends here is followed by another, or by the end of the file."""
        for _ in range(_UNKNOWN):
            if (frame := self._frame(place)) is None:
                return place == self._size
            opcode, length = frame
            if opcode == Opcode.MESSAGE:
                return self._is_message(place, length)
            if opcode in _PARTS:
                return self._own_length(opcode, place + FRAME.size) == length
            place += FRAME.size + length
        return True

    def _is_message(self, place: int, length: int) -> bool:
        """Whether a message outside of chunks can be believed: it has no fields to compare."""
        if not self._has_chunks:
            return True
        # An index whose opcode is damaged looks like one; after the data there is none.
        index = self._own_length(Opcode.MESSAGE_INDEX, place + FRAME.size)
        if self._data_ended or index == length:
            return False
        # Beside chunks it is rare, and mostly from within a damaged one: then it leads nowhere.
        if place >= self._followed:
            self._followed, self._led_on = self._follow_messages(place)
        return self._led_on

    def _follow_messages(self, place: int) -> tuple[int, bool]:
        """Where a row of messages ends, and whether another record is there."""
        while (frame := self._frame(place)) is not None and frame[0] == Opcode.MESSAGE:
            place += FRAME.size + frame[1]
        if frame is None or frame[0] not in _PARTS:
            return place, False
        return place, self._own_length(frame[0], place + FRAME.size) == frame[1]

    def _is_end(self, place: int) -> bool:
        """Whether the file ends here, behind its footer; otherwise it is one that was copied."""
        end = self._read(place, 2 * len(MCAP0_MAGIC))
        if not end.startswith(MCAP0_MAGIC):
            return False
        place += len(MCAP0_MAGIC)
        # Another file may follow; its topics have other numbers.
        return place == self._size or end.endswith(2 * MCAP0_MAGIC) or self.find(place) is None

    def _read(self, place: int, count: int) -> bytes:
        self._file.seek(place)
        return self._file.read(count)


def _fields_length(fields: bytes, room: int) -> int | None:
    """Length of a chunk record by its fields; None where they are none of a chunk.

    fields : as many bytes of them as there can be; room : bytes to the end of the file
    """
    if len(fields) < CHUNK.size + SIZE.size:
        return None
    start, end, size, _, named = CHUNK.unpack_from(fields)
    before = CHUNK.size + named + SIZE.size
    # Zeros are no chunk, though an empty one looks like them.
    if start > end or not 0 < size <= MAX_CHUNK or before > len(fields):
        return None
    packing = fields[CHUNK.size : CHUNK.size + named]
    (packed,) = SIZE.unpack_from(fields, CHUNK.size + named)
    if packing not in _PACKINGS or (not packing and packed != size):
        return None
    length = before + packed
    return length if length <= min(room, MAX_CHUNK) else None
