"""What `rtest info` says, on sessions from outside and on files that are hardly one."""

import re
import struct
from pathlib import Path

import pytest

from rtest_drivers.info import describe
from rtest_drivers.mcap_file import McapFile
from rtest_drivers.message_types import MessageTypes
from rtest_estimation.errors import UserError

SHORT = Path(__file__).resolve().parents[3] / 'bags' / 'short'
SHARED = Path(__file__).resolve().parents[3].parent / 'shared' / 'sessions'


@pytest.mark.skipif(
    not SHARED.is_dir(), reason='the independent sessions are not beside the project'
)
def test_independent_session():
    lines = describe(SHARED / 'open' / 'open-00')
    text = '\n'.join(lines)
    assert 'session   open-00' in lines
    assert 'closed    yes' in lines
    assert 'lost      0 readings' in lines
    assert 'duration  249.3 s' in lines
    assert sum(line.startswith('plan ') for line in lines) == 8
    assert '1a-static: static, 86 poses of X Y Z B C, sphere at (0, -90, 40.6) mm' in text
    assert any('/rtest/gauges' in line and '1816 messages' in line for line in lines)
    assert not any(line.startswith('warning') for line in lines)


def test_missing_poses_are_named_with_their_reasons(tmp_path):
    """Also in a recording that was cut, whose last poses nobody has reported as missing."""
    lines = describe(SHORT)
    assert 'missing   0 of 123 poses' in lines
    data = (SHORT / 'short.mcap').read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(data[: len(data) * 9 // 10])
    missing = [line for line in describe(cut) if line.startswith('missing')]
    assert re.fullmatch(r'missing   \d+ of 123 poses', missing[0])
    # How many the cut takes depends on where the file's chunks end.
    assert re.fullmatch(r'missing   centre-static (\d+-)?26: never reached', missing[-1])


def test_a_file_that_is_no_session_is_described_with_the_reason(tmp_path):
    file = McapFile(tmp_path / 'short')
    definition = MessageTypes().definition('std_msgs/msg/String')
    file.add_topic('/log', definition.name, definition.text, definition.type_hash)
    file.write('/log', 1_700_000_000_000_000_000, 0, 0, b'\0\1\0\0\1\0\0\0\0')
    file.flush()
    lines = describe(file.path)
    assert 'closed    no' in lines
    assert any('/log' in line and '1 messages' in line for line in lines)
    assert any('was not closed' in line for line in lines)
    assert any('no gauge readings' in line for line in lines)
    assert len(describe(McapFile(tmp_path / 'empty').path)) >= 4


def written(folder, topic, *texts):
    """A recording of texts, one a second."""
    file = McapFile(folder)
    definition = MessageTypes().definition('std_msgs/msg/String')
    file.add_topic(topic, definition.name, definition.text, definition.type_hash)
    for number, text in enumerate(texts):
        data = text if isinstance(text, bytes) else (
            b'\0\1\0\0' + struct.pack('<I', len(text.encode()) + 1) + text.encode() + b'\0'
        )
        file.write(topic, 1_700_000_000_000_000_000 + number * 1_000_000_000, 0, 0, data)
    file.flush()
    return file.path


def test_marks_are_listed_with_their_times(tmp_path):
    lines = describe(written(tmp_path / 'marks', '/cell/rtest/mark', 'door opened', 'coolant on'))
    assert [line for line in lines if line.startswith('mark ')] == [
        'mark      at 0.0 s: door opened', 'mark      at 1.0 s: coolant on',
    ]


def test_damaged_texts_are_told(tmp_path):
    cut = b'\0\1\0\0' + struct.pack('<I', 500) + b'door'
    lines = describe(written(tmp_path / 'marks', '/rtest/mark', cut))
    assert any(line.startswith('mark      at 0.0 s: (damaged') for line in lines)
    lines = describe(written(tmp_path / 'made', '/rtest/configuration', cut))
    (said,) = (line for line in lines if line.startswith('software'))
    assert 'rtest/configuration' in said


def test_nothing_there(tmp_path):
    with pytest.raises(UserError, match='no such file'):
        describe(tmp_path / 'absent')
