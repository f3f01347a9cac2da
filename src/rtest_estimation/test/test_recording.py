"""Recordings as they are found: whole, cut, damaged, renamed, made by others."""

import random
import sqlite3
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rtest_estimation.bagfile import read_bag
from rtest_estimation.errors import UserError
from rtest_estimation.recording import TYPES as READ
from rtest_estimation.recording import read_recording, recorded_machine, temperatures
from rtest_estimation.records import Kind

ROOT = Path(__file__).resolve().parents[3]
SHARED = ROOT.parent / 'shared' / 'sessions'
MESSAGES = ROOT / 'src' / 'rtest_msgs' / 'msg'
START = 1_700_000_000_000_000_000
MACHINE = 'name: test\nchain: [C, B, bed, Y, X, Z]\naxes:\n  B: {type: rotary}\n'

STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(
    {
        name: definition
        for path in MESSAGES.glob('*.msg')
        for name, definition in get_types_from_msg(
            path.read_text(), f'rtest_msgs/msg/{path.stem}'
        ).items()
    }
)
TYPES = STORE.types
needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason='the independent sessions are not beside the project'
)


def header(stamp, frame='nest'):
    time = TYPES['builtin_interfaces/msg/Time'](stamp // 10**9, stamp % 10**9)
    return TYPES['std_msgs/msg/Header'](time, frame)


def gauges(sequence, stamp=None, readings=10, channels=3, displacement=None):
    stamp = START + sequence * 20_000_000 if stamp is None else stamp
    values = np.full(readings * channels, sequence, float) * 1e-6
    return TYPES['rtest_msgs/msg/GaugeSamples'](
        header(stamp),
        sequence,
        0.02,
        channels,
        values if displacement is None else displacement,
        np.zeros(readings * channels, np.uint8),
    )


def feedback(stamp):
    return TYPES['sensor_msgs/msg/JointState'](
        header(stamp, ''), list('XYZBC'), np.arange(5.0), np.empty(0), np.empty(0)
    )


def plan(cycle='1a-static', stamp=START, session='test', kind=0, commands=None):
    return TYPES['rtest_msgs/msg/CyclePlan'](
        header(stamp, 'machine'),
        session,
        cycle,
        kind,
        '1a',
        TYPES['geometry_msgs/msg/Point'](0.0, -0.09, 0.0406),
        list('XYZBC'),
        np.zeros(10) if commands is None else commands,
        0.3,
        0.0,
    )


def temperature(sensor, value, stamp):
    return TYPES['sensor_msgs/msg/Temperature'](header(stamp, sensor), value, 0.0)


class BagMaker:
    """An MCAP file with a chunk on demand; `chunks` counts the messages before each byte."""

    def __init__(self, path, compression=CompressionType.ZSTD):
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self.file = path.open('wb')
        self.writer = Writer(self.file, chunk_size=10**9, compression=compression)
        self.writer.start('ros2')
        self.channels = {}
        self.count = Counter()
        self.chunks = []

    def add(self, topic, message, log_time=None, data=None):
        name = message.__msgtype__
        if topic not in self.channels:
            text, _ = STORE.generate_msgdef(name, ros_version=2)
            schema = self.writer.register_schema(name, 'ros2msg', text.encode())
            self.channels[topic] = self.writer.register_channel(topic, 'cdr', schema)
        data = bytes(STORE.serialize_cdr(message, name)) if data is None else data
        time = START + sum(self.count.values()) * 10**6 if log_time is None else log_time
        self.writer.add_message(self.channels[topic], time, data, time)
        self.count[topic] += 1

    def end_chunk(self):
        self.writer.flush()
        self.chunks.append((self.path.stat().st_size, Counter(self.count)))

    def close(self, index=True):
        if index:
            self.writer.finish()
        else:
            self.writer.flush()
        self.file.close()
        return self.path


def make_session(path, names=None, blocks=20, finish=True, compression=CompressionType.ZSTD):
    names = names or {}
    bag = BagMaker(path, compression)
    bag.add(names.get('machine', '/rtest/machine'), TYPES['std_msgs/msg/String'](MACHINE))
    bag.add(names.get('plan', '/rtest/plan'), plan())
    for block in range(blocks):
        message = gauges(10 * block)
        bag.add(names.get('gauges', '/rtest/gauges'), message)
        stamp = START + 10 * block * 20_000_000
        bag.add(names.get('feedback', '/rtest/cnc/feedback'), feedback(stamp))
        if block % 2:
            bag.end_chunk()
    bag.close(finish)
    return bag


@needs_shared
@pytest.mark.parametrize('name', ['open/open-00', 'open/open-07', 'blind/blind-00'])
def test_reads_independent_sessions(name):
    recording = read_recording(SHARED / name)
    assert recording.session == name.partition('/')[2]
    assert recording.warnings == ()
    assert recording.closed and recording.lost == 0
    assert 'chain' in recording.machine_text
    assert [plan.kind for plan in recording.plans[:2]] == [Kind.NEST_CALIBRATION, Kind.STATIC]
    stamps = np.concatenate([block.stamps for block in recording.gauges])
    assert (np.diff(stamps) > 0).all()
    counts = {name: count for name, (_, count) in recording.topics.items()}
    listed = yaml.safe_load((SHARED / name / 'metadata.yaml').read_text())
    for entry in listed['rosbag2_bagfile_information']['topics_with_message_count']:
        assert counts[entry['topic_metadata']['name']] == entry['message_count']
    assert len(recording.gauges) == counts['/rtest/gauges']
    assert len(recording.feedback) == counts['/rtest/cnc/feedback']


@needs_shared
def test_independent_session_cut_in_half(tmp_path):
    source = SHARED / 'open/open-00/open-00.mcap'
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(source.read_bytes()[: source.stat().st_size // 2])
    # Its messages are in one chunk: half of it is nothing, and that is said.
    with pytest.raises(UserError, match='no gauge readings .*cut.mcap is cut or damaged at byte'):
        read_recording(cut)


def test_values_arrive_unchanged(tmp_path):
    recording = read_recording(make_session(tmp_path / 's' / 's.mcap').path)
    assert recording.session == 'test'
    assert recording.machine_text == MACHINE
    assert len(recording.gauges) == len(recording.feedback) == 20
    block = recording.gauges[3]
    assert block.sequence == 30
    assert block.displacement.shape == (10, 3)
    np.testing.assert_allclose(block.displacement, 30e-6)
    assert block.stamp == START + 600_000_000
    assert recording.feedback[3].axes == tuple('XYZBC')
    np.testing.assert_array_equal(recording.feedback[3].position, np.arange(5.0))
    assert recording.plans[0].sphere.tolist() == [0.0, -0.09, 0.0406]
    assert recording.start == START
    assert recording.size == (tmp_path / 's' / 's.mcap').stat().st_size


@pytest.mark.parametrize(
    'compression', [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE]
)
def test_cut_anywhere_keeps_every_complete_chunk(tmp_path, compression):
    bag = make_session(tmp_path / 'whole.mcap', blocks=12, compression=compression)
    data = bag.path.read_bytes()
    chance = random.Random(7)
    places = [size + extra for size, _ in bag.chunks for extra in (-1, 0, 1)]
    places += [chance.randrange(len(data)) for _ in range(40)]
    for place in places:
        cut = tmp_path / 'cut.mcap'
        cut.write_bytes(data[:place])
        expected = Counter()
        for size, count in bag.chunks:
            # The chunk's message index follows it and may be cut: the chunk is whole then.
            expected = count if size <= place else expected
        if not expected:
            try:
                read_recording(cut)
            except UserError as error:
                assert 'cut.mcap' in str(error)
            continue
        recording = read_recording(cut)
        assert len(recording.gauges) >= expected['/rtest/gauges']
        assert len(recording.feedback) >= expected['/rtest/cnc/feedback']
        if place < bag.chunks[-1][0]:
            assert not recording.closed
            assert any('cut or damaged' in warning for warning in recording.warnings)
        assert recording.lost == 0


def test_damaged_chunk_is_left_out_and_the_rest_is_read(tmp_path):
    bag = make_session(tmp_path / 'bag.mcap')
    data = bytearray(bag.path.read_bytes())
    (before, first), (after, second) = bag.chunks[3], bag.chunks[4]
    # Chunk header: opcode, length, two times, size, CRC, compression; then the data.
    data[before + 70] ^= 0xFF
    assert before + 70 < after
    bag.path.write_bytes(data)
    recording = read_recording(bag.path)
    assert any('chunks or records left out: 1' in warning for warning in recording.warnings)
    missing = second['/rtest/gauges'] - first['/rtest/gauges']
    assert len(recording.gauges) == 20 - missing
    assert recording.lost == 10 * missing
    assert any('20 readings lost in 1 gap' in warning for warning in recording.warnings)


def test_flipped_bytes_never_end_in_anything_but_a_user_error(tmp_path):
    bag = make_session(tmp_path / 'bag.mcap', compression=CompressionType.NONE)
    whole = bag.path.read_bytes()
    chance = random.Random(11)
    damaged = tmp_path / 'damaged.mcap'
    read = 0
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(chance.choice([1, 3, 20])):
            data[chance.randrange(len(data))] = chance.randrange(256)
        damaged.write_bytes(data)
        try:
            recording = read_recording(damaged)
        except UserError as error:
            assert '\n' not in str(error)
        else:
            read += 1
            assert recording.gauges
    # The others lost the plan, or the definitions, which are in the first chunk.
    assert read > 100


def test_damaged_messages_are_counted_not_fatal(tmp_path):
    bag = BagMaker(tmp_path / 'bag.mcap')
    bag.add('/rtest/plan', plan())
    good = gauges(0)
    serialised = bytes(STORE.serialize_cdr(good, good.__msgtype__))
    chance = random.Random(3)
    damaged = 0
    for length in (0, 3, 4, 11, len(serialised) // 2, len(serialised) - 1):
        bag.add('/rtest/gauges', good, data=serialised[:length])
        damaged += 1
    for _ in range(50):
        data = serialised[:4] + bytes(chance.randrange(256) for _ in serialised[4:])
        bag.add('/rtest/gauges', good, data=data)
        damaged += 1
    bag.add('/rtest/gauges', gauges(0, displacement=np.zeros(7)))
    bag.add('/rtest/gauges', gauges(0, stamp=0))
    for block in range(5):
        bag.add('/rtest/gauges', gauges(10 * block))
    bag.add('/rtest/cnc/feedback', feedback(START))
    recording = read_recording(bag.close())
    assert len(recording.gauges) == 5
    assert any(
        f'/rtest/gauges: {damaged + 2} messages left out' in text for text in recording.warnings
    )


def test_lost_readings_are_counted_and_located(tmp_path):
    bag = BagMaker(tmp_path / 'bag.mcap')
    bag.add('/rtest/plan', plan())
    bag.add('/rtest/cnc/feedback', feedback(START))
    for sequence in (20, 30, 70, 80, 90):
        bag.add('/rtest/gauges', gauges(sequence))
    # The driver was started again: its index begins at 0.
    for sequence in (0, 10, 30):
        bag.add('/rtest/gauges', gauges(sequence, stamp=START + (100 + sequence) * 20_000_000))
    recording = read_recording(bag.close())
    assert recording.lost == 20 + 30 + 10
    text = next(text for text in recording.warnings if 'lost' in text)
    assert '60 readings lost in 3 gaps' in text
    assert '20 before 0.400 s, 30 before 1.400 s, 10 before 2.600 s' in text
    assert any('restarted 1 time' in text for text in recording.warnings)


def test_stamps_that_step_back_are_sorted_and_named(tmp_path):
    bag = BagMaker(tmp_path / 'bag.mcap')
    bag.add('/rtest/plan', plan('late', START + 5))
    bag.add('/rtest/plan', plan('early', START))
    bag.add('/rtest/plan', plan('early', START))
    bag.add('/rtest/gauges', gauges(0))
    for stamp in (START, START + 30, START + 10, START + 40):
        bag.add('/rtest/cnc/feedback', feedback(stamp))
    recording = read_recording(bag.close())
    assert [entry.stamp - START for entry in recording.feedback] == [0, 10, 30, 40]
    assert [entry.cycle for entry in recording.plans] == ['early', 'late']
    assert any(
        '/rtest/cnc/feedback: stamps step back 1 time' in text for text in recording.warnings
    )


def test_topics_are_found_by_type_when_renamed(tmp_path):
    names = {
        'gauges': '/table/probes',
        'feedback': '/mill/joint_states',
        'plan': '/plans',
        'machine': '/about',
    }
    bag = make_session(tmp_path / 'bag.mcap', names)
    recording = read_recording(bag.path)
    assert len(recording.gauges) == 20
    assert recording.machine_text == MACHINE


def test_namespaced_topics_go_before_others_of_their_type(tmp_path):
    bag = BagMaker(tmp_path / 'bag.mcap')
    bag.add('/cell/rtest/plan', plan())
    bag.add('/cell/rtest/gauges', gauges(0))
    bag.add('/joint_states', feedback(START + 1))
    bag.add('/cell/rtest/cnc/feedback', feedback(START))
    bag.add('/log', TYPES['std_msgs/msg/String']('hello'))
    recording = read_recording(bag.close())
    assert [entry.stamp for entry in recording.feedback] == [START]
    assert recording.machine_text is None


def test_ambiguous_topics_are_named_and_can_be_chosen(tmp_path):
    bag = BagMaker(tmp_path / 'bag.mcap')
    bag.add('/rtest/plan', plan())
    bag.add('/rtest/gauges', gauges(0))
    bag.add('/mill/joints', feedback(START))
    bag.add('/robot/joints', feedback(START + 1))
    path = bag.close()
    with pytest.raises(UserError, match='feedback could be any of /mill/joints, /robot/joints'):
        read_recording(path)
    recording = read_recording(path, {'feedback': '/robot/joints'})
    assert recording.feedback[0].stamp == START + 1
    with pytest.raises(UserError, match='no topic /joints .* there is /mill/joints'):
        read_recording(path, {'feedback': '/joints'})


@pytest.mark.parametrize(
    ('left_out', 'message'),
    [
        ('gauges', 'no gauge readings .*rtest/gauges.*GaugeSamples'),
        ('feedback', 'no encoder feedback .*rtest/cnc/feedback.*JointState'),
        ('plan', 'no plan of a cycle .*rtest/plan.*CyclePlan'),
    ],
)
def test_missing_topics_are_named(tmp_path, left_out, message):
    bag = BagMaker(tmp_path / 'bag.mcap')
    for role, topic, content in (
        ('gauges', '/rtest/gauges', gauges(0)),
        ('feedback', '/rtest/cnc/feedback', feedback(START)),
        ('plan', '/rtest/plan', plan()),
    ):
        if role != left_out:
            bag.add(topic, content)
    path = bag.close()
    with pytest.raises(UserError, match=message):
        read_recording(path)


def test_unusable_plan_is_named(tmp_path):
    bag = BagMaker(tmp_path / 'bag.mcap')
    bag.add('/rtest/gauges', gauges(0))
    bag.add('/rtest/cnc/feedback', feedback(START))
    bag.add('/rtest/plan', plan(commands=np.zeros(7)))
    path = bag.close()
    with pytest.raises(UserError, match='no usable plan .*7 commands, expected poses x 5 axes'):
        read_recording(path)


def test_directory_with_any_metadata(tmp_path):
    folder = tmp_path / 'session'
    make_session(folder / 'session.mcap')
    assert len(read_recording(folder).gauges) == 20
    metadata = folder / 'metadata.yaml'
    metadata.write_text('rosbag2_bagfile_information: {relative_file_paths: [session.mcap]}')
    assert read_recording(folder).warnings == ()
    assert len(read_recording(metadata).gauges) == 20
    metadata.write_text('{ not yaml')
    assert len(read_recording(folder).gauges) == 20
    metadata.write_text('rosbag2_bagfile_information: {relative_file_paths: [../old.mcap]}')
    recording = read_recording(folder)
    assert len(recording.gauges) == 20
    assert 'names old.mcap, which is not there' in recording.warnings[0]


def test_split_bag_is_read_in_order(tmp_path):
    folder = tmp_path / 'split'
    first = BagMaker(folder / 'split_0.mcap')
    first.add('/rtest/plan', plan())
    first.add('/rtest/gauges', gauges(0))
    first.close()
    second = BagMaker(folder / 'split_1.mcap')
    second.add('/rtest/gauges', gauges(10))
    second.add('/rtest/cnc/feedback', feedback(START))
    second.close()
    recording = read_recording(folder)
    assert [block.sequence for block in recording.gauges] == [0, 10]
    assert recording.closed and recording.warnings == ()


@pytest.mark.parametrize('plugin', [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_bag_written_by_rosbags(tmp_path, plugin):
    folder = tmp_path / 'bag'
    with RosbagsWriter(folder, version=9, storage_plugin=plugin) as writer:
        for topic, message in (
            ('/rtest/plan', plan()),
            ('/rtest/gauges', gauges(0)),
            ('/rtest/cnc/feedback', feedback(START)),
        ):
            name = message.__msgtype__
            connection = writer.add_connection(topic, name, typestore=STORE)
            writer.write(connection, START, STORE.serialize_cdr(message, name))
    recording = read_recording(folder)
    assert recording.warnings == ()
    np.testing.assert_array_equal(recording.gauges[0].displacement, np.zeros((10, 3)))


def test_what_is_not_a_recording(tmp_path):
    with pytest.raises(UserError, match='no such file'):
        read_recording(tmp_path / 'nothing')
    with pytest.raises(UserError, match='no recording in this directory'):
        read_recording(tmp_path)
    text = tmp_path / 'notes.mcap'
    text.write_text('not a recording, but longer than the magic of one')
    with pytest.raises(UserError, match='not an MCAP file'):
        read_recording(text)
    text.write_bytes(b'')
    with pytest.raises(UserError, match='not an MCAP file'):
        read_recording(text)
    sqlite3.connect(tmp_path / 'bag.db3').close()
    with pytest.raises(UserError, match='needs'):
        read_recording(tmp_path / 'bag.db3')
    (tmp_path / 'metadata.yaml').write_text('[1, 2]')
    with pytest.raises(UserError, match='cannot be read'):
        read_recording(tmp_path / 'bag.db3')
    (tmp_path / 'metadata.yaml').unlink()
    make_session(tmp_path / 'out' / 'monday' / 'monday.mcap')
    with pytest.raises(UserError, match='name one of its recordings: monday'):
        read_recording(tmp_path / 'out')


def test_file_without_index_is_read_with_a_warning(tmp_path):
    bag = make_session(tmp_path / 'bag.mcap', finish=False)
    recording = read_recording(bag.path)
    assert len(recording.gauges) == 20
    assert not recording.closed
    assert len(recording.warnings) == 1


def test_huge_lengths_ask_for_no_memory(tmp_path):
    bag = make_session(tmp_path / 'bag.mcap')
    data = bytearray(bag.path.read_bytes())
    place = bag.chunks[2][0]
    assert data[place] == 6  # opcode of a chunk
    # Its length is damaged: it says itself how long it is. Then its unpacked size: it is left out.
    data[place + 1 : place + 9] = (2**50).to_bytes(8, 'little')
    bag.path.write_bytes(data)
    recording = read_recording(bag.path)
    assert any(f'is damaged at byte {place}: the kind or' in text for text in recording.warnings)
    assert len(recording.gauges) == 20
    data = bytearray(make_session(tmp_path / 'bag.mcap').path.read_bytes())
    data[place + 25 : place + 33] = (2**50).to_bytes(8, 'little')
    bag.path.write_bytes(data)
    recording = read_recording(bag.path)
    assert any('damaged chunks or records left out: 1' in text for text in recording.warnings)
    assert len(recording.gauges) == 18


def test_the_maker_of_these_files_makes_many_chunks(tmp_path):
    bag = make_session(tmp_path / 'bag.mcap')
    with bag.path.open('rb') as file:
        records = list(StreamReader(file, emit_chunks=True).records)
    assert sum(type(record).__name__ == 'Chunk' for record in records) == 10


def test_two_recordings_in_one_directory_are_refused(tmp_path):
    for name in ('monday.mcap', 'tuesday.mcap'):
        bag = BagMaker(tmp_path / name)
        bag.add('/rtest/gauges', gauges(0))
        bag.close()
    with pytest.raises(UserError, match=r'2 recordings .*monday\.mcap, tuesday\.mcap'):
        read_recording(tmp_path)


def test_parts_of_a_split_bag_may_be_listed(tmp_path):
    """Whatever their names, where metadata.yaml says that they belong together."""
    for number, name in enumerate(('b.mcap', 'a.mcap')):
        bag = BagMaker(tmp_path / name)
        bag.add('/rtest/plan', plan())
        bag.add('/rtest/cnc/feedback', feedback(START))
        bag.add('/rtest/gauges', gauges(10 * number))
        bag.close()
    listed = {'rosbag2_bagfile_information': {'relative_file_paths': ['b.mcap', 'a.mcap']}}
    (tmp_path / 'metadata.yaml').write_text(yaml.safe_dump(listed))
    assert [block.sequence for block in read_recording(tmp_path).gauges] == [0, 10]


def test_what_is_no_recording_at_all(tmp_path):
    with pytest.raises(UserError, match='neither a file nor a directory'):
        read_recording('/dev/null')
    (tmp_path / 'x.mcap').mkdir()
    with pytest.raises(UserError, match='no recording in this directory'):
        read_recording(tmp_path)
    (tmp_path / 'bare.db3').touch()
    with pytest.raises(UserError, match=r'bare\.db3: .*metadata\.yaml'):
        read_recording(tmp_path / 'bare.db3')


def test_the_machine_alone_is_that_of_the_recording(tmp_path):
    bag = read_bag(make_session(tmp_path / 'bag.mcap', {'machine': '/about'}).path, READ)
    assert recorded_machine(bag) == MACHINE
    bag = BagMaker(tmp_path / 'none.mcap')
    bag.add('/rtest/plan', plan())
    bag.add('/rtest/gauges', gauges(0))
    with pytest.raises(UserError, match='no encoder feedback'):
        recorded_machine(read_bag(bag.close(), READ))


def test_temperatures_by_sensor_in_order(tmp_path):
    bag = BagMaker(tmp_path / 'bag.mcap')
    bag.add('/rtest/temperature', temperature('oil', 21.5, START + 20))
    bag.add('/rtest/temperature', temperature('bed', 19.0, START + 15))
    bag.add('/rtest/temperature', temperature('oil', 21.0, START + 10))
    # Another driver's topic, the same sensor.
    bag.add('/hall/temperature', temperature('oil', 22.0, START + 30))
    for sensor, value, stamp in (
        ('', 20.0, START), ('a/b', 20.0, START), ('oil', np.nan, START), ('oil', 20.0, 0),
    ):
        bag.add('/rtest/temperature', temperature(sensor, value, stamp))
    warnings = []
    found = temperatures(read_bag(bag.close(), READ), warnings)
    assert set(found) == {'oil', 'bed'}
    stamps, values = found['oil']
    assert (stamps - START).tolist() == [10, 20, 30] and values.tolist() == [21.0, 21.5, 22.0]
    (text,) = warnings
    assert text.startswith('/rtest/temperature: 4 messages left out (Temperature.header.frame_id')


def test_a_recording_without_temperatures_has_none(tmp_path):
    warnings = []
    assert temperatures(read_bag(make_session(tmp_path / 's.mcap').path, READ), warnings) == {}
    assert warnings == []
