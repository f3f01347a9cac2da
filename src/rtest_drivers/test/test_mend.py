"""Mending: the same messages in a file that every reader opens; the original stays as it is."""

import hashlib
import random
import shutil
from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from rtest_drivers.cli import main
from rtest_drivers.mcap_file import McapFile
from rtest_drivers.mend import mend
from rtest_drivers.message_types import MessageTypes
from rtest_estimation.bagfile import read_bag
from rtest_estimation.errors import UserError
from rtest_estimation.mcap_scan import McapScan
from rtest_estimation.recording import read_recording

SHORT = Path(__file__).resolve().parents[3] / 'bags' / 'short'
START = 1_700_000_000_000_000_000


def messages(path):
    """What the file holds, read by the project's own scan."""
    return [
        (e.source.topic, e.sequence, e.log_time, e.publish_time, e.data)
        for e in McapScan(path).entries()
    ]


def by_mcap(path):
    with path.open('rb') as file:
        reader = make_reader(file, validate_crcs=True)
        found = [
            (channel.topic, m.sequence, m.log_time, m.publish_time, m.data)
            for _, channel, m in reader.iter_messages(log_time_order=False)
        ]
        return found, reader.get_summary()


def test_a_cut_session_is_mended_for_every_reader(tmp_path):
    bag = tmp_path / 'bag'
    shutil.copytree(SHORT, bag)
    file = bag / 'short.mcap'
    file.write_bytes(file.read_bytes()[:200_000])
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    expected = messages(file)
    out = tmp_path / 'fixed'
    mended = mend(bag, out)
    assert {path.name: path.read_bytes() for path in bag.iterdir()} == before
    assert sum(mended.messages.values()) == len(expected) > 1000
    assert any('cut or damaged at byte' in text for text in mended.missing)
    # metadata.yaml knows how many there were.
    metadata = yaml.safe_load((SHORT / 'metadata.yaml').read_text())
    for topic in metadata['rosbag2_bagfile_information']['topics_with_message_count']:
        name, count = topic['topic_metadata']['name'], topic['message_count']
        lost = count - mended.messages.get(name, 0)
        line = f'{name}: {lost} of {count} messages are missing'
        assert any(text.startswith(line) for text in mended.missing) == (lost > 0)

    found, summary = by_mcap(out / 'fixed.mcap')
    assert found == expected
    assert summary.statistics.message_count == len(expected)
    assert summary.statistics.channel_message_counts.keys() == summary.channels.keys()
    by_topic = sorted((topic, time, data) for topic, _, time, _, data in expected)
    for path in (out, out / 'fixed.mcap'):
        with AnyReader([path]) as reader:
            read = sorted((c.topic, time, data) for c, time, data in reader.messages())
            assert read == by_topic
            for connection, _, data in reader.messages():
                reader.deserialize(data, connection.msgtype)
    with (out / 'fixed.mcap').open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert sum(1 for _ in reader.iter_decoded_messages()) == len(expected)

    # Quality of service and type hashes are those of the original.
    new = yaml.safe_load((out / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    old = {
        entry['topic_metadata']['name']: entry['topic_metadata']
        for entry in metadata['rosbag2_bagfile_information']['topics_with_message_count']
    }
    for entry in new['topics_with_message_count']:
        assert entry['topic_metadata'] == old[entry['topic_metadata']['name']]
    assert new['message_count'] == len(expected)
    # The copy identifies as the original does, and says that it was mended.
    again = read_recording(out)
    assert again.closed
    assert len(again.gauges) == len(read_recording(bag).gauges)
    assert any('fixed.mcap was mended: short.mcap is cut' in text for text in again.warnings)
    # What is mended is whole.
    assert mend(out, tmp_path / 'more').path is None
    assert not (tmp_path / 'more').exists()


def test_what_follows_a_damaged_length_is_mended_too(tmp_path):
    bag = tmp_path / 'bag'
    shutil.copytree(SHORT, bag)
    file = bag / 'short.mcap'
    before, summary = by_mcap(file)
    index = sorted(summary.chunk_indexes, key=lambda one: one.chunk_start_offset)[5]
    changed = bytearray(file.read_bytes())
    # Its length, to the end of a later chunk, and its contents.
    changed[index.chunk_start_offset + 3] ^= 1
    changed[index.chunk_start_offset + index.chunk_length - 100] ^= 1
    file.write_bytes(changed)
    mended = mend(bag, tmp_path / 'fixed')
    lost = sum(
        index.message_start_time <= time <= index.message_end_time for _, _, time, _, _ in before
    )
    found, _ = by_mcap(tmp_path / 'fixed' / 'fixed.mcap')
    rest = iter(before)
    assert all(message in rest for message in found)
    assert 0 < len(before) - len(found) <= lost
    assert found[-1] == before[-1]
    assert any(f'bytes at byte {index.chunk_start_offset}; what was recorded before and' in text
               for text in mended.missing)
    assert any('messages are missing' in text for text in mended.missing)


def test_one_file_is_enough(tmp_path, capsys):
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes((SHORT / 'short.mcap').read_bytes()[:123_456])
    out = tmp_path / 'fixed.mcap'
    assert main(['info', '--repair', str(cut), '--out', str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith('missing   cut.mcap is cut or damaged at byte')
    assert lines[-1].startswith(f'{cut}: mended, ')
    assert lines[-1].endswith(f' {out}')
    assert sorted(path.name for path in tmp_path.iterdir()) == ['cut.mcap', 'fixed.mcap']
    assert by_mcap(out)[0] == messages(cut)
    assert read_bag(out, ()).closed


def test_a_killed_recording_gets_its_index(tmp_path):
    file = McapFile(tmp_path / 'killed')
    definition = MessageTypes().definition('std_msgs/msg/String')
    file.add_topic('/a', definition.name, definition.text, definition.type_hash)
    for index in range(50):
        file.write('/a', START + index, 0, index, b'\0\1\0\0\2\0\0\0x\0')
    file.note_losses({'not written /a': 4})
    file.flush()
    mended = mend(file.path.parent, tmp_path / 'out')
    assert mended.messages == {'/a': 50}
    assert any('was not closed' in text for text in mended.missing)
    assert len(by_mcap(tmp_path / 'out' / 'out.mcap')[1].chunk_indexes) == 1
    # What the recorder itself had counted is not forgotten.
    assert any('not written /a: 4' in text for text in read_bag(tmp_path / 'out', ()).warnings)


def test_a_whole_recording_is_said_to_be_whole(tmp_path, capsys):
    before = hashlib.sha256((SHORT / 'short.mcap').read_bytes()).digest()
    for bag in (SHORT, SHORT / 'short.mcap'):
        assert main(['info', '--repair', str(bag), '--out', str(tmp_path / 'out')]) == 0
        assert 'whole, ' in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
    assert hashlib.sha256((SHORT / 'short.mcap').read_bytes()).digest() == before


def test_missing_or_wrong_metadata_is_mended(tmp_path):
    bag = tmp_path / 'bag'
    shutil.copytree(SHORT, bag)
    (bag / 'metadata.yaml').unlink()
    mended = mend(bag, tmp_path / 'out')
    assert mended.path is not None
    assert mended.missing == ()
    with AnyReader([tmp_path / 'out']) as reader:
        assert reader.message_count == sum(mended.messages.values())


@pytest.mark.parametrize('place', ['bag', 'bag/short.mcap', 'bag/new', 'bag/new.mcap', 'no/out'])
def test_the_original_is_never_written_to(tmp_path, place):
    bag = tmp_path / 'bag'
    shutil.copytree(SHORT, bag)
    file = bag / 'short.mcap'
    file.write_bytes(file.read_bytes()[:100_000])
    before = sorted((path.name, path.read_bytes()) for path in bag.iterdir())
    for source in (bag, file):
        with pytest.raises(UserError) as error:
            mend(source, tmp_path / place)
        assert '\n' not in str(error.value)
    link = tmp_path / 'link'
    link.symlink_to(bag)
    with pytest.raises(UserError):
        mend(bag, link / 'new')
    assert sorted((path.name, path.read_bytes()) for path in bag.iterdir()) == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ['bag', 'link']


def test_mistakes_are_one_line(tmp_path, capsys):
    (tmp_path / 'bag.db3').write_bytes(b'SQLite format 3\0')
    (tmp_path / 'text.mcap').write_text('text')
    for arguments, text in (
        ([tmp_path / 'none', '--repair', '--out', tmp_path / 'x'], 'no such file'),
        ([tmp_path / 'bag.db3', '--repair', '--out', tmp_path / 'x'], 'only MCAP'),
        ([tmp_path / 'text.mcap', '--repair', '--out', tmp_path / 'x'], 'not an MCAP file'),
        ([SHORT, '--repair'], '--repair: expected --out FILE'),
        ([SHORT, '--out', tmp_path / 'x'], '--out: expected together with --repair'),
    ):
        assert main(['info', *map(str, arguments)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert text in line


def test_everything_beside_messages_is_taken_over(tmp_path):
    """Two topics of one name, metadata, attachments, other encodings; as other writers make it."""
    path = tmp_path / 'other.mcap'
    with path.open('wb') as stream:
        writer = Writer(stream, compression=CompressionType.LZ4, index_types=IndexType.NONE)
        writer.start('', 'other')
        text = writer.register_schema('std_msgs/msg/String', 'ros2msg', b'string data')
        number = writer.register_schema('std_msgs/msg/Int8', 'ros2msg', b'int8 data')
        a = writer.register_channel('/a', 'cdr', text, {'offered_qos_profiles': '- history: 1\n'})
        b = writer.register_channel('/a', 'cdr', number)
        c = writer.register_channel('/json', 'json', 0)
        writer.add_attachment(1, 2, 'photo', 'image/png', b'pixels' * 100)
        writer.add_metadata('room', {'temperature': '20'})
        writer.add_message(a, START, b'\0\1\0\0\2\0\0\0x\0', START + 5, 1)
        writer.add_message(b, START - 5, b'\0\1\0\0\3', START, 2)
        writer.add_message(c, 0, b'{}', 0, 3)
        writer.finish()
    path.write_bytes(path.read_bytes()[:-8])
    mend(path, tmp_path / 'out')
    copy = tmp_path / 'out' / 'out.mcap'
    found, summary = by_mcap(copy)
    assert found == messages(path)
    assert len(found) == 3
    encodings = {(c.topic, c.message_encoding) for c in summary.channels.values()}
    assert encodings == {('/a', 'cdr'), ('/json', 'json')}
    with copy.open('rb') as stream:
        reader = make_reader(stream)
        (photo,) = reader.iter_attachments()
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert (photo.name, photo.data) == ('photo', b'pixels' * 100)
    assert metadata['room'] == {'temperature': '20'}
    assert 'cut or damaged' in metadata['rtest_mended']['1']


def test_cut_anywhere_is_mended_to_what_can_be_read(tmp_path):
    whole = (SHORT / 'short.mcap').read_bytes()
    chance = random.Random(8)
    cut = tmp_path / 'cut.mcap'
    for number, size in enumerate(chance.sample(range(8, len(whole)), 12)):
        cut.write_bytes(whole[:size])
        out = tmp_path / f'{number}.mcap'
        assert mend(cut, out).path == out
        assert by_mcap(out)[0] == messages(cut)
        out.unlink()
