"""Recordings that nobody's recorder wrote: a good one, changed at random, and how it is read.

`mutated` makes one from a seed; `read` takes it through everything that reads recordings. Used by
the tests with few seeds and by bench/fuzz_recordings.py with many.
"""

import copy
import random
from pathlib import Path

import numpy as np
import synthetic
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rtest_drivers.info import describe
from rtest_estimation.errors import UserError
from rtest_estimation.records import Kind
from rtest_identification.offline import identify_recording

ROOT = Path(__file__).resolve().parents[3]
STORE = get_typestore(Stores.ROS2_JAZZY)
for _path in sorted((ROOT / 'src/rtest_msgs/msg').glob('*.msg')):
    STORE.register(get_types_from_msg(_path.read_text(), f'rtest_msgs/msg/{_path.stem}'))
TYPES = STORE.types
MACHINE = (ROOT / 'src/rtest_drivers/config/nmv1500dcg.yaml').read_text()
# What could follow a key in somebody's YAML.
YAML = (
    '.nan', '.inf', '-.inf', '1e400', '9' * 400, '0x' + 'f' * 400, '2001-99-99', '!!python/none',
    '!!binary x', '&a [*a]', '*a', '[' * 200, '{' * 200, '"\\x1b[2J"', '', '~', '1:2:3',
    '"\\uD800"', '[1, 2, 3]', '<<: *a', '- - - -', '\t', 'x' * 5000, '!!set {a, b}', 'yes', '0o9',
)
TEXTS = (
    '', 'x' * 3000, '\x1b[2J\x07', '../../etc/passwd', '/dev/zero', 'a\nb', '\u202e', 'NaN', '{}'
)
FLOATS = (
    float('nan'), float('inf'), float('-inf'), 1e308, -1e308, 5e-324, 0.0, -1.0, 1e-6, 2.0**63
)
WORDS = (
    'float64', 'string', 'uint64', 'int8', 'bool', 'float64[]', 'string[]', 'uint8[3]', 'Header'
)


def header(stamp, frame=''):
    """A std_msgs/Header."""
    time = TYPES['builtin_interfaces/msg/Time'](int(stamp // 10**9), int(stamp % 10**9))
    return TYPES['std_msgs/msg/Header'](time, frame)


def good_session():
    """(topic, message, log time) of a small session: a nest calibration and a static cycle."""
    plans = [synthetic.nest_plan()]
    plans.append(synthetic.static_plan(synthetic.T0 + 40_000_000_000))
    feedback, blocks = synthetic.run(plans, hz=20)
    point = TYPES['geometry_msgs/msg/Point']
    entries = [('/rtest/machine', TYPES['std_msgs/msg/String'](MACHINE), synthetic.T0)]
    for plan in plans:
        entries.append((
            '/rtest/plan',
            TYPES['rtest_msgs/msg/CyclePlan'](
                header(plan.stamp, 'machine'), plan.session, plan.cycle,
                0 if plan.kind is Kind.STATIC else plan.kind.value, plan.setup,
                point(*plan.sphere), list(plan.axes), plan.commands.reshape(-1), plan.dwell, 0.0,
            ),
            plan.stamp,
        ))
    for block in blocks:
        entries.append((
            '/rtest/gauges',
            TYPES['rtest_msgs/msg/GaugeSamples'](
                header(block.stamp, 'nest'), block.sequence, block.period,
                block.displacement.shape[1], block.displacement.reshape(-1),
                block.status.reshape(-1).astype(np.uint8),
            ),
            block.stamp,
        ))
    for sample in feedback:
        entries.append((
            '/rtest/cnc/feedback',
            TYPES['sensor_msgs/msg/JointState'](
                header(sample.stamp), list(sample.axes), sample.position, np.empty(0), np.empty(0)
            ),
            sample.stamp,
        ))
    temperature = TYPES['sensor_msgs/msg/Temperature'](header(synthetic.T0, 'air'), 20.0, 0.0)
    entries.append(('/rtest/temperature', temperature, synthetic.T0))
    return sorted(entries, key=lambda entry: entry[2])


def definition(name):
    """Definition of a type as recorders write it."""
    return STORE.generate_msgdef(name, ros_version=2)[0]


def write(path, entries, definitions=None, compression=CompressionType.NONE, chunk=20_000):
    """Write entries as an MCAP file; `definitions` instead of the true ones, by type."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=chunk, compression=compression)
        writer.start('ros2')
        channels = {}
        for topic, message, time in entries:
            name = message.__msgtype__
            if (topic, name) not in channels:
                text = (definitions or {}).get(name) or definition(name)
                schema = writer.register_schema(name, 'ros2msg', text.encode())
                channels[topic, name] = writer.register_channel(topic, 'cdr', schema)
            data = bytes(STORE.serialize_cdr(message, name))
            writer.add_message(channels[topic, name], time, data, time)
        writer.finish()
    return path


class Mutator:
    """Makes one hostile recording after the other from a good one."""

    def __init__(self, folder):
        self.entries = good_session()
        self.whole = {
            kind: write(folder / 'good.mcap', self.entries, compression=kind).read_bytes()
            for kind in CompressionType
        }
        self.kinds = (self._bytes, self._fields, self._definition, self._machine, self._order)

    def mutated(self, seed, path):
        """Write the hostile recording of a seed to `path`."""
        chance = random.Random(seed)
        chance.choice(self.kinds)(chance, path)
        return path

    def _bytes(self, chance, path):
        data = bytearray(self.whole[chance.choice(list(CompressionType))])
        for _ in range(chance.choice((1, 2, 5, 30))):
            # Definitions and topics are at the beginning, the index at the end.
            place = chance.choice((
                chance.randrange(len(data)), chance.randrange(min(6000, len(data))),
                len(data) - 1 - chance.randrange(min(3000, len(data))),
            ))
            length = chance.choice((1, 2, 4, 8, 40, 1000))
            match chance.randrange(7):
                case 0:
                    data[place] = chance.randrange(256)
                case 1:
                    data[place : place + 4] = b'\xff\xff\xff\x7f'
                case 2:
                    data[place : place + 8] = b'\xff' * 7 + b'\x7f'
                case 3:
                    del data[place : place + length]
                case 4:
                    data[place:place] = bytes(length)
                case 5:
                    data[place:place] = data[place : place + length]
                case 6:
                    del data[place:]
            if len(data) < 10:
                break
        path.write_bytes(data)

    def _fields(self, chance, path):
        entries = list(self.entries)
        topics = ['/rtest/plan', '/rtest/gauges', '/rtest/cnc/feedback', '/rtest/temperature']
        for _ in range(chance.choice((1, 1, 2, 4))):
            topic = chance.choice(topics)
            rows = [row for row, entry in enumerate(entries) if entry[0] == topic]
            half = chance.sample(rows, len(rows) // 2)
            some = chance.choice((rows[:1], [chance.choice(rows)], rows, half))
            seed = chance.random()
            for row in some:
                _, message, time = entries[row]
                message = copy.deepcopy(message)
                _spoil(message, random.Random(seed))
                entries[row] = (topic, message, time)
        write(path, entries)

    def _definition(self, chance, path):
        name = chance.choice([message.__msgtype__ for _, message, _ in self.entries[:40]])
        lines = definition(name).split('\n')
        for _ in range(chance.choice((1, 2, 3))):
            row = chance.randrange(len(lines))
            words = lines[row].split(' ')
            match chance.randrange(7):
                case 0:
                    del lines[row]
                case 1:
                    lines.insert(row, chance.choice(lines))
                case 2:
                    lines[row] = ' '.join([chance.choice(WORDS), *words[1:]])
                case 3:
                    lines[row] = f'{words[0]}[{chance.choice((0, 3, 10**6))}] x{row}'
                case 4:
                    lines[row] = f'{words[0]} class'
                case 5:
                    lines.insert(row, f'{name} itself')
                case 6:
                    chance.shuffle(lines)
            if not lines:
                break
        write(path, self.entries, {name: '\n'.join(lines)})

    def _machine(self, chance, path):
        lines = MACHINE.split('\n')
        for _ in range(chance.choice((1, 2, 5))):
            row = chance.randrange(len(lines))
            key, colon, _ = lines[row].partition(':')
            lines[row] = chance.choice((
                f'{key}{colon} {chance.choice(YAML)}', chance.choice(YAML), lines[row] * 2, '',
                lines[row].replace('1', chance.choice(YAML)),
            ))
        text = '\n'.join(lines).encode('utf-8', 'replace').decode()
        spoiled = TYPES['std_msgs/msg/String'](text)
        entries = [
            (topic, spoiled if topic == '/rtest/machine' else message, time)
            for topic, message, time in self.entries
        ]
        write(path, entries)

    def _order(self, chance, path):
        entries = list(self.entries)
        for _ in range(chance.choice((1, 2))):
            first = chance.randrange(len(entries))
            last = min(len(entries), first + chance.choice((5, 100, 1000)))
            shift = chance.choice((1, -1, 10**9, -(10**12), 10**18))
            match chance.randrange(5):
                case 0:
                    chance.shuffle(entries)
                case 1:
                    del entries[first:last]
                case 2:
                    entries += entries[first:last]
                case 3:
                    entries.reverse()
                case 4:
                    entries[first:last] = [
                        (topic, _moved(message, shift), min(max(time + shift, 0), 2**63))
                        for topic, message, time in entries[first:last]
                    ]
            if not entries:
                break
        write(path, entries, compression=chance.choice(list(CompressionType)))


def _moved(message, shift):
    if not hasattr(message, 'header'):
        return message
    message = copy.deepcopy(message)
    stamp = message.header.stamp
    seconds = stamp.sec + shift // 10**9
    stamp.sec = int(min(max(seconds, -(2**31)), 2**31 - 1))
    stamp.nanosec = int(min(stamp.nanosec + shift % 10**9, 2**32 - 1))
    return message


def _spoil(message, chance):
    """Change one field of a message, at any depth."""
    fields = STORE.fielddefs[message.__msgtype__][1]
    name, (kind, detail) = chance.choice(fields)
    value = getattr(message, name)
    if kind.name == 'NAME':
        _spoil(value, chance)
    elif kind.name == 'BASE':
        setattr(message, name, _value(detail[0], chance))
    elif isinstance(value, np.ndarray):
        setattr(message, name, _array(value, detail[0][1][0], chance))
    else:
        texts = [chance.choice((*value, *TEXTS)) for _ in range(chance.choice((0, 1, 5, 7, 300)))]
        setattr(message, name, texts)


def _value(base, chance):
    if base == 'string':
        return chance.choice(TEXTS)
    if base.startswith('float'):
        return chance.choice(FLOATS)
    if base == 'bool':
        return chance.random() < 0.5
    bits = int(base.strip('uint') or 8) if base not in ('byte', 'char') else 8
    half = 2 ** (bits - 1)
    low, high = (0, 2 * half - 1) if base.startswith('u') else (-half, half - 1)
    return chance.choice((low, high, 0, 1, 3, high // 2, chance.randint(low, high)))


def _array(value, base, chance):
    choice = chance.randrange(6)
    if choice == 0:
        return value[:0]
    if choice == 1:
        return value[: chance.randrange(len(value) + 1)]
    if choice == 2:
        return np.tile(value, chance.choice((2, 7, 200)))
    if choice == 3:
        return np.full_like(value, _value(base, chance))
    changed = value.copy()
    for _ in range(chance.choice((1, 5))):
        if len(changed):
            changed[chance.randrange(len(changed))] = _value(base, chance)
    return changed


def read(path, identify=True):
    """Take a recording through everything that reads one; how it ended.

    Returns 'read' or the UserError's text; anything else that is raised is a bug, as is a text of
    several lines or one that would command a terminal.
    """
    try:
        for line in describe(path):
            assert line.isprintable(), repr(line)
        if identify:
            identify_recording(path)
    except UserError as error:
        text = str(error)
        # The command folds white space, nothing else.
        text = ' '.join(text.split())
        assert text.isprintable(), repr(text)
        assert len(text) < 3000
        return text
    return 'read'
