"""Records and chunks of an MCAP file, read without believing what they say of themselves.

A length, or what a chunk unpacks to, is checked before memory is used.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode

from rtest_estimation.errors import UserError
from rtest_estimation.plain_text import printable

# Opcode and length, with which every record begins, and what a message record goes on with:
# channel, sequence, log time, publish time (MCAP specification, "Records").
FRAME = struct.Struct('<BQ')
MESSAGE = struct.Struct('<HIQQ')
# A chunk: first and last log time, size unpacked, checksum, length of the packing's name; after
# the name, the size of its records as they are packed.
CHUNK = struct.Struct('<QQQII')
SIZE = struct.Struct('<Q')
# The end of a file: frame of the footer, places of summary and summary offsets, checksum, magic.
FOOTER = struct.Struct('<BQQQI8s')
# A chunk or record of more than this is damaged; writers make chunks of a few MB.
MAX_CHUNK = 256 * 1024 * 1024
# Measurements are packed to between a half and a twentieth of their size.
MAX_RATIO = 100
# What reading a damaged record or chunk ends with (mcap does not wrap the errors underneath).
DAMAGE = (
    McapError, struct.error, ValueError, OverflowError, RuntimeError, zstandard.ZstdError
)


class Chunk(NamedTuple):
    """A chunk as it is in the file; times in ns, size unpacked, checksum 0 where there is none."""

    start: int
    end: int
    size: int
    checksum: int
    packing: str
    data: memoryview


def read_chunk(content: bytes) -> Chunk:
    """The chunk of a record; an error of `DAMAGE` where it is longer than the record."""
    start, end, size, checksum, length = CHUNK.unpack_from(content)
    place = CHUNK.size + length
    (packed,) = SIZE.unpack_from(content, place)
    place += SIZE.size
    if place + packed > len(content):
        raise EndOfFile
    packing = content[CHUNK.size : CHUNK.size + length].decode()
    data = memoryview(content)[place : place + packed]
    return Chunk(start, end, size, checksum, packing, data)


@dataclass
class Unpacker:
    """Unpacks the chunks of one file of `file_size` bytes; `unpacked` : bytes so far."""

    path: Path
    file_size: int
    unpacked: int = 0

    def unpack(self, chunk: Chunk) -> bytes:
        """Records of a chunk; all of them, or an error of `DAMAGE`.

        Raises UserError where the file so far has become too large for what it is.
        """
        size = chunk.size
        if size > MAX_CHUNK:
            raise McapError(f'a chunk of {size} bytes')
        if chunk.packing:
            self.unpacked += size
            if self.unpacked > max(MAX_CHUNK, MAX_RATIO * self.file_size):
                raise UserError(
                    f'{self.path}: unpacks to more than {MAX_RATIO} times its size, which no '
                    'measurement does; if you trust it, unpack it with `mcap compress '
                    '--compression none` and read that'
                )
        data = _decompress(chunk)
        if len(data) != size:
            raise McapError(f'a chunk of {len(data)} bytes that says it has {size}')
        if chunk.checksum and zlib.crc32(data) != chunk.checksum:
            raise McapError('a chunk with a wrong checksum')
        return data


def _decompress(chunk: Chunk) -> bytes:
    """Contents of a chunk, never much more than it says it has."""
    size = chunk.size
    if not chunk.packing:
        return bytes(chunk.data)
    if chunk.packing == 'zstd':
        # zstandard believes the size in the frame, not the one it is given.
        if zstandard.frame_content_size(chunk.data) > size:
            raise McapError(f'a chunk of more than the {size} bytes that it says it has')
        # A length that is too large would take in what follows the chunk.
        return zstandard.ZstdDecompressor().decompress(
            chunk.data, max_output_size=size, allow_extra_data=False
        )
    if chunk.packing == 'lz4':
        decompressor = lz4.frame.LZ4FrameDecompressor()
        data = decompressor.decompress(chunk.data, max_length=size + 1)
        if decompressor.unused_data:
            raise McapError('a chunk with more behind what is packed')
        return data
    raise McapError(f'a chunk packed with {printable(chunk.packing)!r}')


def fits(chunk: Chunk, data: bytes) -> bool:
    """Whether the records fill a chunk to its last byte, with log times within its own.

    What a chunk without checksum has instead of one.
    """
    place = 0
    while place + FRAME.size <= len(data):
        opcode, length = FRAME.unpack_from(data, place)
        start, place = place + FRAME.size, place + FRAME.size + length
        if opcode == 0:
            return False
        if opcode == Opcode.MESSAGE:
            if length < MESSAGE.size or place > len(data):
                return False
            log_time = MESSAGE.unpack_from(data, start)[2]
            if not chunk.start <= log_time <= chunk.end:
                return False
    return place == len(data)


class _Exact:
    """Bytes that never give less than they are asked for, so that a damaged length is noticed."""

    def __init__(self, data: bytes) -> None:
        self._stream = BytesIO(data)

    def read(self, count: int) -> bytes:
        data = self._stream.read(count)
        if len(data) != count:
            raise EndOfFile
        return data


def exact_stream(data: bytes) -> ReadDataStream:
    """The content of one record, to be read by the mcap library."""
    return ReadDataStream(_Exact(data))  # type: ignore[arg-type]  # it needs read() only
