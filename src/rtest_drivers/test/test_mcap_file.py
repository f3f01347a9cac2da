"""The recording file: opens at every moment, says what rosbag2 says, survives a full disk."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from rtest_drivers import mcap_file
from rtest_drivers.mcap_file import McapFile
from rtest_drivers.message_types import MessageTypes
from rtest_estimation.mcap_scan import McapScan

START = 1_700_000_000_000_000_000
QOS = """\
- history: unknown
  depth: 0
  reliability: reliable
  durability: transient_local
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: automatic
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
STORE = get_typestore(Stores.ROS2_JAZZY)
JOINTS = 'sensor_msgs/msg/JointState'


def joints(index):
    types = STORE.types
    stamp = types['builtin_interfaces/msg/Time'](START // 10**9, index)
    message = types[JOINTS](
        types['std_msgs/msg/Header'](stamp, ''),
        list('XYZBC'),
        np.arange(5.0) + index,
        np.empty(0),
        np.empty(0),
    )
    return bytes(STORE.serialize_cdr(message, JOINTS))


def add_joints(file, name='/rtest/cnc/feedback'):
    definition = MessageTypes().definition(JOINTS)
    file.add_topic(name, definition.name, definition.text, definition.type_hash, QOS)


def fill(file, count, first=0):
    for index in range(first, first + count):
        file.write('/rtest/cnc/feedback', START + index * 10**6, 0, index, joints(index))


def positions(path):
    """X of every message, read by rosbags."""
    with AnyReader([path]) as reader:
        return [
            reader.deserialize(data, connection.msgtype).position[0]
            for connection, _, data in reader.messages()
        ]


def mcap_count(path):
    with path.open('rb') as file:
        return sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages())


@pytest.fixture
def recording(tmp_path):
    file = McapFile(tmp_path / 'session')
    add_joints(file)
    return file


def test_opens_after_every_flush_without_close(recording):
    assert mcap_count(recording.path) == 0
    for round_ in range(4):
        fill(recording, 50, 50 * round_)
        recording.flush()
        expected = list(np.arange(50.0 * (round_ + 1)))
        assert positions(recording.path) == expected
        assert positions(recording.path.parent) == expected
        assert mcap_count(recording.path) == len(expected)
    # What came after the last flush is all that a killed recorder loses.
    fill(recording, 10, 200)
    assert mcap_count(recording.path) == 200


def test_closed_file_has_an_index_and_the_metadata_of_rosbag2(recording):
    fill(recording, 30)
    recording.flush()
    fill(recording, 30, 30)
    recording.close()
    recording.close()
    with recording.path.open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        header = reader.get_header()
        (metadata,) = reader.iter_metadata()
    assert header.profile == 'ros2'
    assert summary.statistics.message_count == 60
    assert {chunk.compression for chunk in summary.chunk_indexes} == {'zstd'}
    (channel,) = summary.channels.values()
    assert channel.message_encoding == 'cdr'
    assert yaml.safe_load(channel.metadata['offered_qos_profiles']) == yaml.safe_load(QOS)
    assert channel.metadata['topic_type_hash'] == STORE.hash_rihs01(JOINTS)
    (schema,) = summary.schemas.values()
    assert (schema.name, schema.encoding) == (JOINTS, 'ros2msg')

    text = (recording.path.parent / 'metadata.yaml').read_text()
    bag = yaml.safe_load(text)['rosbag2_bagfile_information']
    assert yaml.safe_load(metadata.metadata['serialized_metadata']) == bag
    assert (bag['version'], bag['storage_identifier'], bag['ros_distro']) == (9, 'mcap', 'jazzy')
    assert bag['message_count'] == 60
    assert bag['starting_time']['nanoseconds_since_epoch'] == START
    assert bag['duration']['nanoseconds'] == 59 * 10**6
    (topic,) = bag['topics_with_message_count']
    assert topic['message_count'] == 60
    assert topic['topic_metadata']['type_description_hash'].startswith('RIHS01_')
    with Reader(recording.path.parent) as reader:
        assert reader.ros_distro == 'jazzy'
        (qos,) = reader.connections[0].ext.offered_qos_profiles
        assert qos.durability.name == 'TRANSIENT_LOCAL'
        assert reader.message_count == 60
    assert positions(recording.path.parent) == list(np.arange(60.0))


def test_decoded_by_the_library_of_foxglove(recording):
    factory = pytest.importorskip('mcap_ros2.decoder').DecoderFactory()
    fill(recording, 3)
    recording.flush()
    with recording.path.open('rb') as file:
        reader = make_reader(file, decoder_factories=[factory])
        decoded = [entry.decoded_message for entry in reader.iter_decoded_messages()]
    assert [list(message.position) for message in decoded] == [
        [index + axis for axis in range(5)] for index in range(3)
    ]
    assert decoded[0].name == list('XYZBC')


def test_topics_can_be_added_late_and_types_are_shared(recording):
    fill(recording, 5)
    recording.flush()
    add_joints(recording, '/other')
    recording.write('/other', START, START + 7, 3, joints(9))
    recording.close()
    with recording.path.open('rb') as file:
        reader = make_reader(file)
        assert len(reader.get_summary().schemas) == 1
        ((_, _, message),) = reader.iter_messages(topics=['/other'])
    assert (message.log_time, message.publish_time, message.sequence) == (START, START + 7, 3)
    with pytest.raises(ValueError, match='already'):
        add_joints(recording, '/other')


def test_no_time_of_1970_gets_into_the_file(recording):
    with pytest.raises(ValueError, match='log time 0'):
        recording.write('/rtest/cnc/feedback', 0, START, 0, joints(0))
    fill(recording, 1)
    recording.close()
    with recording.path.open('rb') as file:
        ((_, _, message),) = make_reader(file).iter_messages()
    assert message.publish_time == message.log_time == START


def test_nothing_is_overwritten(recording):
    fill(recording, 3)
    recording.close()
    content = recording.path.read_bytes()
    with pytest.raises(FileExistsError):
        McapFile(recording.path.parent)
    assert recording.path.read_bytes() == content


def full_disk(monkeypatch, after):
    """Let `after` bytes through, then say that the disk is full."""
    left = [after]

    def pwritev(handle, parts, offset):
        if not left[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        data = b''.join(parts)[: left[0]]
        left[0] -= len(data)
        return real(handle, [data], offset)

    real = os.pwritev
    monkeypatch.setattr(mcap_file.os, 'pwritev', pwritev)


@pytest.mark.parametrize('after', [0, 10, 500])
def test_full_disk_loses_nothing_once_there_is_room(recording, monkeypatch, after):
    fill(recording, 50)
    recording.flush()
    with monkeypatch.context() as patch:
        full_disk(patch, after)
        fill(recording, 50, 50)
        with pytest.raises(OSError, match='No space left'):
            recording.flush()
        fill(recording, 50, 100)
        with pytest.raises(OSError, match='No space left'):
            recording.close()
    recording.close()
    assert positions(recording.path) == list(np.arange(150.0))
    with recording.path.open('rb') as file:
        assert make_reader(file).get_summary().statistics.message_count == 150


def test_full_disk_at_the_index(recording, monkeypatch):
    fill(recording, 50)
    recording.flush()
    with monkeypatch.context() as patch:
        full_disk(patch, 0)
        with pytest.raises(OSError, match='No space left'):
            recording.close()
    assert positions(recording.path) == list(np.arange(50.0))
    recording.close()
    assert mcap_count(recording.path) == 50


def test_losses_are_in_the_file_as_they_were_last_known(recording):
    fill(recording, 10)
    recording.note_losses({'not written /rtest/gauges': 3})
    recording.flush()
    fill(recording, 10, 10)
    recording.note_losses({'not written /rtest/gauges': 7, 'not received /x': 1})
    recording.note_losses({'not written /rtest/gauges': 7, 'not received /x': 1})
    recording.flush()
    for _ in ('open', 'closed'):
        scan = McapScan(recording.path)
        assert len(list(scan.entries())) == 20
        assert scan.losses == {'not written /rtest/gauges': 7, 'not received /x': 1}
        assert any('not written /rtest/gauges: 7' in warning for warning in scan.warnings)
        recording.close()
    with recording.path.open('rb') as file:
        names = [record.name for record in make_reader(file).iter_metadata()]
    assert names == ['rtest_losses', 'rtest_losses', 'rosbag2']


def test_metadata_is_there_from_the_start(tmp_path):
    file = McapFile(tmp_path / 'empty')
    with Reader(file.path.parent) as reader:
        assert reader.message_count == 0
    file.close()
    with Reader(file.path.parent) as reader:
        assert list(reader.messages()) == []
    assert sorted(path.name for path in Path(file.path.parent).iterdir()) == [
        'empty.mcap',
        'metadata.yaml',
    ]
