"""Recordings whose lengths are damaged: every other chunk is found again, once, and no other."""

import itertools
import random
import struct

import pytest
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType, Writer

from rtest_estimation.mcap_scan import McapScan

START = 1_700_000_000_000_000_000
CHUNKS, PER_CHUNK = 5, 6
CHUNK, MESSAGE_INDEX, METADATA = 6, 7, 12
ENDS = ('closed', 'killed', 'cut')
FRAME = struct.Struct('<BQ')


class Made:
    """A small recording; where its records are, and its messages by the library."""

    def __init__(self, path, compression=CompressionType.ZSTD, end='closed', checksums=True):
        chance = random.Random(4)
        index = {} if end == 'closed' else {
            'index_types': IndexType.MESSAGE, 'repeat_channels': False, 'repeat_schemas': False,
            'use_statistics': False, 'use_summary_offsets': False,
        }
        with path.open('wb') as stream:
            writer = Writer(stream, compression=compression, enable_crcs=checksums, **index)
            writer.start('ros2', 'test')
            schema = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
            channels = [writer.register_channel(name, 'cdr', schema) for name in ('/a', '/b')]
            for chunk in range(CHUNKS):
                for number in range(chunk * PER_CHUNK, (chunk + 1) * PER_CHUNK):
                    # Letters that can be packed, and bytes that cannot.
                    data = b'\0\1\0\0' + b'reading' * 5 + chance.randbytes(60)
                    stamp = START + number * 1000
                    writer.add_message(channels[number % 2], stamp, data, stamp + 1, number)
                writer.flush()
                if chunk == 2:
                    writer.add_metadata('room', {'temperature': '20'})
                    writer.add_attachment(1, 2, 'photo', 'image/png', chance.randbytes(300))
            writer.finish()
        with path.open('rb') as stream:
            self.messages = [
                (channel.topic, m.sequence, m.log_time, m.publish_time, m.data)
                for _, channel, m in make_reader(stream).iter_messages(log_time_order=False)
            ]
        assert len(self.messages) == CHUNKS * PER_CHUNK
        self.data = path.read_bytes()
        self.records, place = [], len(MCAP0_MAGIC)
        while place + FRAME.size < len(self.data):
            opcode, length = FRAME.unpack_from(self.data, place)
            self.records.append((opcode, place, FRAME.size + length))
            place += FRAME.size + length
        self.chunks = [(place, size) for opcode, place, size in self.records if opcode == CHUNK]
        if end == 'cut':
            # In the middle of what follows the last index.
            ends = [at + size for opcode, at, size in self.records if opcode == MESSAGE_INDEX]
            self.data = self.data[: max(ends) + 5]
            self.records = [record for record in self.records if record[1] < max(ends)]
        self.path = path

    def without(self, *chunks):
        """Messages of the other chunks."""
        return [m for row, m in enumerate(self.messages) if row // PER_CHUNK not in chunks]

    def read(self, data):
        """Messages of the changed file, and the scan that has read it."""
        self.path.write_bytes(data)
        scan = McapScan(self.path)
        return [
            (e.source.topic, e.sequence, e.log_time, e.publish_time, e.data)
            for e in scan.entries()
        ], scan

    def quick(self):
        """Topic, time and data of the messages of the file as it is, by the quick reading."""
        return [(topic, time_, data) for topic, _, time_, data in McapScan(self.path).messages()]


def flipped(data, *bits):
    """The bytes with single bits changed; each is a place in bits."""
    changed = bytearray(data)
    for bit in bits:
        changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


KINDS = list(CompressionType)


@pytest.mark.parametrize(
    ('end', 'checksums'), [*((end, True) for end in ENDS), ('closed', False)]
)
@pytest.mark.parametrize('compression', KINDS)
def test_every_bit_of_the_frame_of_a_chunk(tmp_path, compression, end, checksums):
    """The chunk says itself how long it is, so that it is there too."""
    made = Made(tmp_path / 'a.mcap', compression, end, checksums)
    assert made.read(made.data)[0] == made.messages
    for place, _ in made.chunks:
        for bit in range(8 * FRAME.size):
            found, scan = made.read(flipped(made.data, 8 * place + bit))
            assert found == made.messages
            assert scan.closed == (end == 'closed')
            assert not scan.intact
            assert f'is damaged at byte {place}: the kind or length' in scan.warnings[0]


@pytest.mark.parametrize('end', ENDS)
@pytest.mark.parametrize('compression', KINDS)
def test_a_chunk_damaged_inside_too_takes_no_other_with_it(tmp_path, compression, end):
    made = Made(tmp_path / 'a.mcap', compression, end)
    for number, (place, size) in enumerate(made.chunks):
        for bit in range(8 * FRAME.size):
            inside = 8 * (place + size - 20)
            found, scan = made.read(flipped(made.data, 8 * place + bit, inside))
            # Topics are declared in the first chunk, and again where a file is closed.
            unknown = number == 0 and end != 'closed'
            assert found == ([] if unknown else made.without(number))
            if bit % 9 == 0:
                assert made.quick() == [(m[0], m[2], m[4]) for m in found]
            assert scan.closed == (end == 'closed')
            assert not scan.intact
            text = ' '.join(scan.warnings)
            if number == CHUNKS - 1 and end == 'cut':
                assert f'cut or damaged at byte {place}' in text
            else:
                assert f'bytes at byte {place}; what was recorded before and after' in text


@pytest.mark.parametrize('end', ENDS)
def test_every_bit_of_the_frames_of_all_other_records(tmp_path, end):
    """Indexes, metadata, attachments, the summary: no message depends on them."""
    made = Made(tmp_path / 'a.mcap', CompressionType.NONE, end)
    for opcode, place, _ in made.records:
        if opcode != CHUNK:
            for bit in range(8 * FRAME.size):
                found, _ = made.read(flipped(made.data, 8 * place + bit))
                assert found == made.messages


@pytest.mark.parametrize('end', ENDS)
@pytest.mark.parametrize('compression', KINDS)
def test_stray_bytes_between_records(tmp_path, compression, end):
    made = Made(tmp_path / 'a.mcap', compression, end)
    first, size = made.chunks[1]
    chunk = made.data[first : first + size]
    stray = {
        'one': b'x', 'zeros': bytes(5000), 'random': random.Random(1).randbytes(3000),
        'half a chunk': chunk[: size // 2], 'the other half': chunk[size // 2 :],
        'the beginning of a chunk, twice': chunk[:60] * 2, 'an end': MCAP0_MAGIC,
        'the end of a block': bytes(1024 * 1024 - 20),
    }
    lasting = 0
    for _, place, _ in made.records[1:]:
        for bytes_ in stray.values():
            found, scan = made.read(made.data[:place] + bytes_ + made.data[place:])
            assert found == made.messages
            lasting += any(f'skipped {len(bytes_)} bytes at byte {place};' in text
                           for text in scan.warnings)
            assert not scan.intact
    assert lasting > len(made.chunks) * (len(stray) - 2)


def test_two_damages(tmp_path):
    """In every pair of chunks, one in its frame and one inside, or both in both."""
    made = Made(tmp_path / 'a.mcap')
    chance = random.Random(2)
    for one, other in itertools.permutations(range(1, CHUNKS), 2):
        (first, _), (second, size) = made.chunks[one], made.chunks[other]
        frames = [8 * place + chance.randrange(8 * FRAME.size) for place in (first, second)]
        found, scan = made.read(flipped(made.data, *frames))
        assert found == made.messages
        assert not scan.intact
        found, _ = made.read(flipped(made.data, frames[0], 8 * (second + size - 20)))
        assert found == made.without(other)
        inside = [8 * (sum(made.chunks[number]) - 20) for number in (one, other)]
        found, scan = made.read(flipped(made.data, *frames, *inside))
        assert found == made.without(one, other)
        assert scan.closed


def test_a_length_that_jumps_over_chunks_is_not_believed(tmp_path):
    """To the beginning of a later chunk, where all goes on as if nothing were missing."""
    made = Made(tmp_path / 'a.mcap')
    for opcode, place, _ in made.records:
        if opcode in (CHUNK, MESSAGE_INDEX, METADATA):
            for later, _ in made.chunks:
                if later > place + FRAME.size:
                    changed = bytearray(made.data)
                    FRAME.pack_into(changed, place, opcode, later - place - FRAME.size)
                    assert made.read(changed)[0] == made.messages


def test_records_of_private_kinds_are_passed_over(tmp_path):
    made = Made(tmp_path / 'a.mcap')
    for kind in (0x80, 0xFF):
        data = made.data
        for place, _ in reversed(made.chunks):
            private = FRAME.pack(kind, 500) + bytes(500) + FRAME.pack(kind, 3) + b'abc'
            data = data[:place] + private + data[place:]
        found, scan = made.read(data)
        assert found == made.messages
        assert scan.intact
        assert scan.warnings == []


def test_a_recording_in_an_attachment_stays_in_it(tmp_path):
    """Also where the record behind it is damaged, and the search begins."""
    other = Made(tmp_path / 'b.mcap', CompressionType.LZ4)
    made = Made(tmp_path / 'a.mcap')
    path = tmp_path / 'c.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2', 'test')
        writer.add_attachment(1, 2, 'b.mcap', 'application/mcap', other.data)
        place = stream.tell()
        writer.add_metadata('room', {'temperature': '20'})
        writer.finish()
    for bit in range(8 * FRAME.size):
        assert made.read(flipped(path.read_bytes(), 8 * place + bit))[0] == []


def test_an_end_in_the_middle_is_not_the_end(tmp_path):
    """What the recorder wrote behind every chunk may be there still, after a power failure."""
    made = Made(tmp_path / 'a.mcap', end='killed')
    end = made.data[-FRAME.size - 20 - 8 - 13 :]
    for place, _ in made.chunks[1:]:
        found, scan = made.read(made.data[:place] + end + made.data[place:])
        assert found == made.messages
        assert not scan.intact
        found, _ = made.read(made.data[:place] + end + made.data[place + len(end) :])
        assert len(found) == len(made.messages) - PER_CHUNK
    # A second recording behind the first is not mixed with it.
    found, _ = made.read(made.data * 2)
    assert found == made.messages


def test_messages_copied_out_of_a_chunk_are_not_taken_for_others(tmp_path):
    made = Made(tmp_path / 'a.mcap', CompressionType.NONE)
    first, _ = made.chunks[1]
    size = (made.chunks[1][1] - 49) // PER_CHUNK
    copied = made.data[first + 49 : first + 49 + 2 * size]
    assert copied[0] == copied[size] == 5
    for _, place, _ in made.records[1:]:
        found, scan = made.read(made.data[:place] + copied + b'x' + made.data[place:])
        assert found == made.messages or place <= made.chunks[0][0]
        assert not scan.intact


def test_a_wrong_size_within_a_chunk_takes_nothing_in(tmp_path):
    """What is packed ends before; what follows is no part of it."""
    for compression in KINDS:
        made = Made(tmp_path / f'{compression}.mcap', compression)
        for number, (place, _) in enumerate(made.chunks[1:], 1):
            size = 8 * (place + 9 + 32 + {1: 0, 2: 3, 3: 4}[compression.value])
            for bit in range(64):
                found, scan = made.read(flipped(made.data, size + bit))
                # Without the last bytes of its packing it can still have the right checksum.
                assert found in (made.without(number), made.messages)
                assert not scan.intact


def test_a_chunk_without_checksum_must_prove_itself(tmp_path):
    """Its records fill it and are of its time; otherwise it is none after damage."""
    made = Made(tmp_path / 'a.mcap', CompressionType.NONE, checksums=False)
    place, size = made.chunks[3]
    frame = 8 * place + 8
    # The frame is 9 bytes, the times 16, size, checksum and the packing 24; then a message.
    record = place + 9 + 16 + 24
    for damage in (record * 8 + 8, (record + 9 + 6 + 6) * 8):
        found, _ = made.read(flipped(made.data, frame, damage))
        assert found == made.without(3)
    # The same where it was found by a search.
    data = flipped(made.data, (record + 9 + 6 + 6) * 8)
    found, scan = made.read(data[:place] + b'stray' + data[place:])
    assert found == made.without(3)
    assert any('without checksum' in text for text in scan.warnings)
    assert size > 500


@pytest.mark.parametrize('compression', KINDS)
def test_random_damage_never_yields_what_was_not_recorded(tmp_path, compression):
    chance = random.Random(f'{compression}')
    made = {end: Made(tmp_path / f'{end}.mcap', compression, end) for end in ENDS}
    whole = 0
    for _ in range(300):
        one = made[chance.choice(ENDS)]
        data = bytearray(one.data)
        for _ in range(chance.choice((1, 1, 2, 4))):
            place, length = chance.randrange(8, len(data)), chance.choice((1, 8, 40, 300))
            match chance.randrange(5):
                case 0:
                    data[place] ^= 1 << chance.randrange(8)
                case 1:
                    data[place : place + length] = chance.randbytes(length)
                case 2:
                    data[place : place + length] = bytes(length)
                case 3:
                    del data[place : place + length]
                case 4:
                    start = chance.randrange(len(data))
                    data[place:place] = data[start : start + length]
        found, scan = one.read(bytes(data))
        # In the order of the recording, each one at most once.
        rest = iter(one.messages)
        assert all(message in rest for message in found)
        assert scan.warnings or found == one.messages
        # Every chunk that is there whole, where its topics are declared.
        left = [
            row for row, (place, size) in enumerate(one.chunks)
            if one.data[place : place + size] in bytes(data)
        ]
        if 0 in left:
            due = one.without(*set(range(CHUNKS)).difference(left))
            assert all(message in found for message in due)
            whole += len(left)
    assert 400 < whole < 300 * CHUNKS
