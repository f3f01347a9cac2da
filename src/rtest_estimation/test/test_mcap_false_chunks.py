"""Files full of what looks like chunks: reading time grows with size, not with its square."""

import struct
import time

import pytest
from mcap.writer import MCAP0_MAGIC

from rtest_estimation.mcap_scan import McapScan

CHUNK, METADATA = 6, 12
FRAME = struct.Struct('<BQ')


def opening(length, size, checksum=1, opcode=CHUNK, agree=0):
    """Frame and fields of a chunk of so many bytes; `agree` is added to the length before it."""
    fields = struct.pack('<QQQII', 1, 2, size, checksum, 0) + struct.pack('<Q', length)
    return FRAME.pack(opcode, len(fields) + length + agree) + fields


def hostile(kind, total):
    """A file of so many bytes of false chunks."""
    if kind == 'tiny chunks':
        body = (opening(8, 8) + b'nonsense') * (total // 57)
    elif kind == 'lengths that disagree':
        body = opening(8, 8, agree=1) * (total // 49)
    elif kind == 'chunks to the end of the file':
        parts, place = [], 0
        while place < total:
            rest = total - place - 57 - 49
            # One that is found, and then one without a true frame that would have to be read.
            part = opening(8, 8) + b'nonsense' + opening(max(rest, 0), max(rest, 0), opcode=0x86)
            parts.append(part)
            place += len(part)
        body = b''.join(parts)
    elif kind == 'messages that hold chunks':
        part = FRAME.pack(5, 22 + 57) + bytes(22) + opening(8, 8) + b'nonsense'
        body = opening(8, 8) + b'nonsense' + part * (total // len(part)) + b'\0'
    elif kind == 'metadata to the end of the file':
        parts, place = [], 8
        while place + 100 < total:
            size = total - place - 57 - FRAME.size
            part = opening(8, 8) + b'nonsense' + FRAME.pack(METADATA, size)
            part += struct.pack('<II', 0, size - 8)
            parts.append(part)
            place += len(part)
        body = b''.join(parts)
    else:
        part = FRAME.pack(0x90, 57) + opening(8, 8) + b'nonsense'
        body = part * (total // len(part)) + b'\0'
    return (MCAP0_MAGIC + body)[:total].ljust(total, b'\0')


def seconds(path, data):
    """Processor time of reading the bytes as a file."""
    path.write_bytes(data)
    begun = time.process_time()
    scan = McapScan(path)
    assert list(scan.entries()) == []
    assert not scan.intact
    return time.process_time() - begun, scan


@pytest.mark.parametrize(
    ('kind', 'size'),
    [
        ('tiny chunks', 4), ('unknown records', 4), ('messages that hold chunks', 4),
        ('metadata to the end of the file', 4), ('lengths that disagree', 20),
        ('chunks to the end of the file', 20),
    ],
)
def test_a_file_of_false_chunks_is_read_in_linear_time(tmp_path, kind, size):
    path = tmp_path / 'a.mcap'
    # An intact file of as many records in 2 MB, each read and left out.
    each, _ = seconds(path, hostile('tiny chunks', 2_000_000))
    taken, scan = seconds(path, hostile(kind, size * 1_000_000))
    assert taken < 5 * size / 2 * each
    assert len(' '.join(scan.warnings)) < 1000
