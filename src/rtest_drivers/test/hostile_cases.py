"""Small hostile recordings, one for each thing that could be wrong: the corpus.

    PYTHONPATH=src/rtest_estimation/test python src/rtest_drivers/test/hostile_cases.py

writes the files of `CASES` to the folder `corpus` beside this file, where also what a long run of
bench/fuzz_recordings.py has found is kept. `CASES` has for each file what is said of it.
"""

import struct
from pathlib import Path

import hostile
import lz4.frame
import numpy as np
import zstandard
from mcap.writer import MCAP0_MAGIC

CORPUS = Path(__file__).parent / 'corpus'
SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, ATTACHMENT, FOOTER = 3, 4, 5, 6, 12, 9, 2
STRING = 'std_msgs/msg/String'
GAUGES = 'rtest_msgs/msg/GaugeSamples'
# Everything a session needs, in ten messages or so.
_GOOD = hostile.good_session()
TINY = [
    next(entry for entry in _GOOD if entry[0] == topic)
    for topic in ('/rtest/machine', '/rtest/plan')
] + [
    entry
    for topic in ('/rtest/gauges', '/rtest/cnc/feedback')
    for entry in [one for one in _GOOD if one[0] == topic][:3]
]


def record(opcode, content, length=None):
    """One record; `length` instead of the true one."""
    size = len(content) if length is None else length
    return struct.pack('<BQ', opcode, size) + content


def text(value, length=None):
    """A text or map with its length before it."""
    data = value if isinstance(value, bytes) else value.encode()
    return struct.pack('<I', len(data) if length is None else length) + data


def schema(name=STRING, definition='string data', encoding='ros2msg', number=1):
    """A schema record."""
    texts = text(name) + text(encoding) + text(definition)
    return record(SCHEMA, struct.pack('<H', number) + texts)


def channel(topic='/a', number=1, schema_number=1):
    """A channel record of CDR messages."""
    ends = text(topic) + text('cdr') + text(b'')
    return record(CHANNEL, struct.pack('<HH', number, schema_number) + ends)


def message(data=b'\0\1\0\0\2\0\0\0x\0', number=1, time=1_700_000_000_000_000_000):
    """A message record."""
    return record(MESSAGE, struct.pack('<HIQQ', number, 0, time, time) + data)


def chunk(data, compression='', size=None, packed=None):
    """A chunk record; `size` instead of the true one, `packed` instead of the packed data."""
    pack = {'': bytes, 'zstd': zstandard.compress, 'lz4': lz4.frame.compress}
    packed = pack.get(compression, bytes)(data) if packed is None else packed
    size = len(data) if size is None else size
    head = struct.pack('<QQQI', 0, 0, size, 0) + text(compression)
    return record(CHUNK, head + struct.pack('<Q', len(packed)) + packed)


def file(*records, end=True):
    """An MCAP file."""
    footer = record(FOOTER, bytes(20)) + MCAP0_MAGIC if end else b''
    return MCAP0_MAGIC + record(1, text('ros2') + text('')) + b''.join(records) + footer


def session(change=None, definitions=None):
    """A tiny session; `change` gets topic and message of each, and may change it."""

    def make(path):
        entries = []
        for topic, one, time in TINY:
            copied = hostile.copy.deepcopy(one)
            if change is not None:
                copied = change(topic, copied) or copied
            entries.append((topic, copied, time))
        hostile.write(path, entries, definitions)

    return make


def of(*records, **options):
    """A file of these records after the declaration of one topic."""
    return lambda path: path.write_bytes(file(schema(), channel(), *records, **options))


def set_field(topic, **fields):
    """A session in which every message of a topic has other values; a.b is written a__b."""

    def change(name, one):
        if name == topic:
            for key, value in fields.items():
                *parents, last = key.split('__')
                part = one
                for parent in parents:
                    part = getattr(part, parent)
                setattr(part, last, value)

    return session(change)


def machine(text_):
    """A session with another machine text."""
    return set_field('/rtest/machine', data=text_)


def other_type(topic, one):
    """Temperatures on the topic of the readings."""
    if topic == '/rtest/gauges':
        return hostile.TYPES['sensor_msgs/msg/Temperature'](one.header, 20.0, 0.0)
    return None


def _swapped():
    lines = hostile.definition(GAUGES).split('\n')
    first, second = (
        next(row for row, line in enumerate(lines) if line.endswith(f' {name}'))
        for name in ('displacement', 'period')
    )
    lines[first], lines[second] = lines[second], lines[first]
    return '\n'.join(lines)


def _without(field):
    return '\n'.join(
        line for line in hostile.definition(GAUGES).split('\n') if not line.endswith(f' {field}')
    )


_ZEROS = bytes(4_000_000)
_ANCHORS = 'a: &a [x, x]\n' + ''.join(
    f'{key}: &{key} [*{before}, *{before}]\n'
    for before, key in zip('abcdefghijklmnopqrstuvwxy', 'bcdefghijklmnopqrstuvwxyz', strict=True)
)
_NESTED = 'a/E[] x\n' + '=' * 80 + '\nMSG: a/E\nuint8[0] y\n'

# File name to what makes it and what must be said of it.
CASES = {
    # Chunks that unpack to more than they say, or say more than there can be.
    'zstd_more_than_it_says': (
        of(chunk(b'', 'zstd', 1000, zstandard.compress(_ZEROS)), message()), 'more than the 1000'),
    'zstd_less_than_it_says': (
        of(chunk(message(), 'zstd', 200_000_000), message()), 'that says it has 200000000'),
    'zstd_no_size_in_the_frame': (
        of(chunk(b'', 'zstd', 1000, zstandard.ZstdCompressor(write_content_size=False).compress(
            _ZEROS)), message()), 'left out: 1'),
    'lz4_more_than_it_says': (
        of(chunk(b'', 'lz4', 1000, lz4.frame.compress(_ZEROS)), message()), 'left out: 1'),
    'chunk_of_a_terabyte': (
        of(chunk(message(), '', 2**40), message()), 'a chunk of 1099511627776'),
    'unknown_packing': (of(chunk(message(), '\x1b[2J'), message()), "packed with '?[2J'"),
    'chunk_in_a_chunk': (of(chunk(chunk(message()))), 'no gauge readings'),
    # Lengths.
    'record_longer_than_the_file': (
        of(message(), record(MESSAGE, b'', 2**62)), 'skipped 9 bytes at byte 160'),
    'message_without_times': (of(message(), record(MESSAGE, b'x')), 'without times'),
    'message_longer_than_its_chunk': (
        of(chunk(message() + record(MESSAGE, b'', 2**63)), message()), 'longer than its chunk'),
    'topic_longer_than_the_file': (
        of(message(), record(CHANNEL, struct.pack('<HHI', 2, 1, 2**32 - 1) + b'x')),
        'a topic that cannot be read'),
    'schema_longer_than_the_file': (
        of(message(), record(SCHEMA, struct.pack('<H', 2) + text('a', 2**32 - 1))),
        'a topic that cannot be read'),
    'metadata_longer_than_the_file': (
        of(message(), record(METADATA, text('a') + struct.pack('<I', 2**31))), 'left out: 1'),
    'zeros_to_the_end': (of(message(), bytes(5000), end=False), 'cut or damaged'),
    'messages_of_no_topic': (of(message(number=7), message()), '1 messages left out'),
    'losses_that_are_none': (
        of(message(), record(METADATA, text('rtest_losses') + text(
            text('not written \x1b[2J') + text('7') + text('b') + text('-1') + text('c')
            + text('9' * 50)))), 'not written ?[2J: 7 messages'),
    'topic_that_commands_a_terminal': (
        lambda path: path.write_bytes(file(schema(), channel('/\x1b[2J\n'), message())), '/?[2J?'),
    'end_of_time': (of(message(time=2**64 - 1), message(time=1)), '2 messages'),
    # Definitions.
    'readings_of_another_type': (session(other_type), 'no gauge readings'),
    'readings_without_a_field': (
        session(definitions={GAUGES: _without('displacement')}), 'displacement is missing'),
    'readings_in_another_order': (session(definitions={GAUGES: _swapped()}), 'left out'),
    'readings_of_texts': (
        session(definitions={GAUGES: hostile.definition(GAUGES).replace(
            'float64[] displacement', 'string[] displacement')}), 'displacement is texts'),
    'definition_of_itself': (
        session(definitions={GAUGES: 'GaugeSamples[] itself'}), 'is made of itself'),
    'definition_of_empty_arrays': (session(definitions={GAUGES: _NESTED}), 'has 0 elements'),
    'definition_of_a_million_texts': (
        session(definitions={GAUGES: 'string[1000000] x'}), 'has 1000000 elements'),
    'definition_that_is_none': (session(definitions={GAUGES: '(' * 3000}), 'does not define'),
    # Values.
    'readings_not_finite': (
        set_field('/rtest/gauges', displacement=np.full(30, np.nan)), 'missing   28 of 28'),
    'readings_at_no_time': (set_field('/rtest/gauges', header__stamp__sec=-5), 'time stamp'),
    'readings_of_no_period': (set_field('/rtest/gauges', period=float('nan')), 'period is nan'),
    'readings_of_no_channel': (set_field('/rtest/gauges', channels=0), 'channels is 0'),
    'feedback_infinite': (
        set_field('/rtest/cnc/feedback', position=np.full(5, np.inf)), 'position of inf'),
    'feedback_not_a_number': (
        set_field('/rtest/cnc/feedback', position=np.full(5, np.nan)), 'missing   28 of 28'),
    'feedback_of_too_many_axes': (
        set_field('/rtest/cnc/feedback', name=list('XYZBCXYZBC')), '10 names and 5 positions'),
    'plan_not_finite': (set_field('/rtest/plan', commands=np.full(140, np.inf)), 'not finite'),
    'plan_in_the_next_galaxy': (set_field('/rtest/plan', sphere__x=1e308), 'sphere position'),
    'plan_that_commands_a_terminal': (
        set_field('/rtest/plan', cycle='\x1b[2J\x07'), 'cannot be printed'),
    'plan_of_a_long_name': (set_field('/rtest/plan', setup='x' * 5000), 'cannot be printed'),
    'plan_of_one_axis_twice': (
        set_field('/rtest/plan', axes=list('XXZBC')), 'expected distinct letters'),
    'plan_of_no_kind': (set_field('/rtest/plan', kind=200), 'kind is 200'),
    'plan_of_no_feed': (set_field('/rtest/plan', feed=float('-inf')), 'feed is -inf'),
    # Machines; what is told of them is told by `rtest identify`.
    'machine_of_anchors': (machine(_ANCHORS), 'no anchors and aliases'),
    'machine_of_tags': (machine('name: !!python/object/apply:os.system [id]\n'), 'not valid YAML'),
    'machine_too_deep': (machine('[' * 3000), '20 levels at most'),
    'machine_not_finite': (
        machine(hostile.MACHINE.replace('[1, 0, 0]', '[.nan, 0, 0]')), 'expected three numbers'),
    'machine_of_a_giant_number': (
        machine(hostile.MACHINE.replace('[1, 0, 0]', f'[0x{"f" * 500}, 0, 0]')), '64 bits'),
    'machine_on_no_day': (machine('name: 2001-99-99\n'), 'not valid YAML'),
    'machine_with_a_key_twice': (machine('name: a\nname: b\n'), 'a key is there twice'),
    'machine_of_half_a_letter': (
        machine(hostile.MACHINE.replace('NMV1500DCG\n', '"\\uD800"\n', 1)), 'printed in a line'),
}


def main():
    """Write the corpus."""
    CORPUS.mkdir(exist_ok=True)
    for name, (make, _) in CASES.items():
        make(CORPUS / f'{name}.mcap')


if __name__ == '__main__':
    main()
