"""Recordings open in the readers of others, and those of others are identified from."""

import dataclasses
import json
import shutil
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import yaml
from ament_index_python.packages import get_package_share_directory
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rtest_drivers.cli import main
from rtest_drivers.info import describe
from rtest_drivers.message_types import MessageTypes
from rtest_drivers.playlist import Playlist
from rtest_estimation.bagfile import read_bag
from rtest_identification.gap.offline import gap_recording
from rtest_identification.offline import identify_recording

SHORT = Path(__file__).resolve().parents[1] / 'bags' / 'short'
FILE = SHORT / 'short.mcap'
# Of tf2_msgs/msg/TFMessage in ROS 2 Jazzy.
TF_HASH = 'RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087'
SOURCES = {
    '/rtest/machine': '/about', '/rtest/plan': '/plans', '/rtest/gauges': '/nest/readings',
    '/rtest/cnc/feedback': '/axes',
}


def plain(value):
    """A message as nested lists, whichever library made its class."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, bytes | bytearray):
        return list(value)
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if dataclasses.is_dataclass(value):
        names = [one.name for one in dataclasses.fields(value)]
        # Without the constants of the type.
        names = [name for name in names if not (name.isupper() or name.startswith('__'))]
    else:
        names = getattr(value, '__slots__', [])
    return {name: plain(getattr(value, name)) for name in names} if names else value


def test_every_reader_gives_the_same_messages():
    with FILE.open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == 'ros2'
        decoded = [
            (channel.topic, message.log_time, message.data, plain(value))
            for _, channel, message, value in reader.iter_decoded_messages()
        ]
    bag = read_bag(FILE, ())
    assert len(decoded) == sum(count for _, count in bag.topics.values())
    with AnyReader([SHORT]) as reader:
        for (connection, time, raw), other in zip(reader.messages(), decoded, strict=True):
            assert (connection.topic, time, bytes(raw)) == other[:3]
            value = reader.deserialize(raw, connection.msgtype)
            # As text, in which NaN is itself.
            assert repr(plain(value)) == repr(other[3])
    ours = list(bag.stream(bag.topics))
    assert [(topic, time, data) for topic, _, time, data in ours] == [
        other[:3] for other in decoded
    ]


def test_metadata_is_what_rosbag2_needs():
    metadata = yaml.safe_load((SHORT / 'metadata.yaml').read_text())
    information = metadata['rosbag2_bagfile_information']
    assert information['relative_file_paths'] == ['short.mcap']
    topics = {
        entry['topic_metadata']['name']: entry['topic_metadata']
        for entry in information['topics_with_message_count']
    }
    with FILE.open('rb') as file:
        summary = make_reader(file).get_summary()
    for channel in summary.channels.values():
        entry = topics.pop(channel.topic)
        package, _, name = entry['type'].partition('/msg/')
        # What rosidl has generated where the package was built.
        share = Path(get_package_share_directory(package))
        generated = json.loads((share / 'msg' / f'{name}.json').read_text())
        hashes = {one['type_name']: one['hash_string'] for one in generated['type_hashes']}
        assert entry['type_description_hash'] == hashes[entry['type']]
        assert channel.metadata['topic_type_hash'] == hashes[entry['type']]
        assert summary.schemas[channel.schema_id].name == entry['type']
        profiles = entry['offered_qos_profiles']
        assert yaml.safe_load(channel.metadata['offered_qos_profiles']) == profiles
        latched = channel.topic.rpartition('/')[2] in (
            'machine', 'plan', 'nest', 'cycle', 'location_errors', 'error_map', 'model_gap'
        )
        assert {profile['durability'] for profile in profiles} == {
            'transient_local' if latched else 'volatile'
        }
        assert {profile['reliability'] for profile in profiles} == {'reliable'}
    assert not topics


@pytest.mark.skipif(find_spec('tf2_msgs') is None, reason='needs tf2_msgs (ros-jazzy-tf2-msgs)')
def test_the_message_of_tf_is_that_of_ros():
    name = 'tf2_msgs/msg/TFMessage'
    share = Path(get_package_share_directory('tf2_msgs'))
    generated = json.loads((share / 'msg' / 'TFMessage.json').read_text())
    hashes = {one['type_name']: one['hash_string'] for one in generated['type_hashes']}
    assert hashes[name] == MessageTypes().definition(name).type_hash == TF_HASH


@cache
def short_identified():
    return identify_recording(SHORT)


@cache
def short_gap():
    return gap_recording(SHORT).result


def same(one, other):
    np.testing.assert_array_equal(one.location.value, other.location.value)
    np.testing.assert_array_equal(one.location.covariance, other.location.covariance)
    assert one.fit.rms == other.fit.rms


def test_a_bare_file_is_enough(tmp_path, capsys):
    bare = Path(shutil.copy(FILE, tmp_path / 'alone.mcap'))
    same(identify_recording(bare), short_identified())
    gap, whole = gap_recording(bare).result, short_gap()
    assert (gap.verdict, gap.gap) == (whole.verdict, whole.gap)
    assert [m for b in Playlist(bare).batches() for m in b] == [
        m for b in Playlist(SHORT).batches() for m in b
    ]
    assert describe(bare)[3:] == describe(SHORT)[3:]
    # One session is no thermal one; that is said of the session, not of the file.
    messages = []
    for path in (bare, SHORT):
        main(['thermal', str(path), '--no-report', '--out', str(tmp_path / 'thermal')])
        messages.append(capsys.readouterr().err.replace(str(path), 'BAG'))
    assert messages[0] == messages[1] and 'metadata' not in messages[0]


def foreign(folder, plugin):
    """The drivers' topics of a session under other names, written by rosbags."""
    store = get_typestore(Stores.ROS2_JAZZY)
    share = Path(get_package_share_directory('rtest_msgs'))
    for kind in ('GaugeSamples', 'CyclePlan'):
        text = (share / 'msg' / f'{kind}.msg').read_text()
        store.register(get_types_from_msg(text, f'rtest_msgs/msg/{kind}'))
    bag = read_bag(FILE, ())
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections = {
            topic: writer.add_connection(name, bag.topics[topic][0], typestore=store)
            for topic, name in SOURCES.items()
        }
        # Somebody else's axes and texts are in it too.
        extra = {
            topic: writer.add_connection(f'/robot{name}', bag.topics[topic][0], typestore=store)
            for topic, name in SOURCES.items() if topic in ('/rtest/cnc/feedback',)
        }
        for topic, _, time, data in bag.stream(SOURCES):
            writer.write(connections[topic], time, data)
        for topic, _, time, data in list(bag.stream(extra))[:100]:
            writer.write(extra[topic], time + 7, data)
    return folder


@pytest.mark.parametrize('plugin', list(StoragePlugin))
def test_a_foreign_recording_with_other_names_gives_the_same(tmp_path, plugin, capsys):
    bag = foreign(tmp_path / 'foreign', plugin)
    option = ['--topic', 'feedback=/axes']
    same(identify_recording(bag, topics={'feedback': '/axes'}), short_identified())
    assert main(['info', str(bag), *option]) == 0
    assert 'missing   0 of' in capsys.readouterr().out
    assert main(['identify', str(bag), '--out', str(tmp_path / 'out')]) == 2
    assert 'choose with --topic feedback=NAME' in capsys.readouterr().err
    gap = gap_recording(bag, topics={'feedback': '/axes'}).result
    assert gap.gap == short_gap().gap
    messages = [m for b in Playlist(bag, {'feedback': '/axes'}).batches() for m in b]
    assert {(SOURCES[m.topic], m.time, m.data) for b in Playlist(SHORT).batches() for m in b} == {
        (m.topic, m.time, m.data) for m in messages
    }
    assert [m.time for m in messages] == sorted(m.time for m in messages)
