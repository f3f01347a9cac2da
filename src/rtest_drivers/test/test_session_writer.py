"""Handing messages to the writing thread: nothing is lost silently, nothing hangs."""

import os
import random
import threading
import time
import tracemalloc

import pytest
from mcap.reader import make_reader

from rtest_drivers import mcap_file, session_writer
from rtest_drivers.message_types import MessageTypes
from rtest_drivers.session_writer import SessionWriter
from rtest_estimation.bagfile import read_bag

START = 1_700_000_000_000_000_000


def make_writer(folder, **options):
    writer = SessionWriter(folder, **options)
    writer.add_topic('/a', MessageTypes().definition('std_msgs/msg/String'), '')
    return writer


def text(size):
    """A String of that many letters, serialised."""
    return b'\x00\x01\x00\x00' + (size + 1).to_bytes(4, 'little') + b'x' * size + b'\x00'


def count(path):
    with path.open('rb') as file:
        return sum(1 for _ in make_reader(file).iter_messages())


def until(condition, timeout=10.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.01)


def test_is_on_the_disk_within_a_second(tmp_path):
    writer = make_writer(tmp_path / 's')
    for index in range(100):
        writer.put('/a', START + index, 0, index, b'\x00\x01\x00\x00\x01\x00\x00\x00\x00')
    until(lambda: count(writer.path) == 100)
    writer.close()
    assert writer.taken == writer.written == 100
    assert not writer.dropped and writer.error is None


@pytest.fixture
def disk(monkeypatch):
    """A disk that does not answer from when `stuck` is set, until `mended` is."""
    disk = Disk()
    real = os.fsync

    def fsync(handle):
        if disk.stuck.is_set():
            disk.waited.set()
            assert disk.mended.wait(60)
        real(handle)

    monkeypatch.setattr(mcap_file.os, 'fsync', fsync)
    yield disk
    disk.mended.set()


class Disk:
    def __init__(self):
        self.stuck, self.waited, self.mended = (threading.Event() for _ in range(3))


def test_a_stalled_disk_takes_bounded_memory_and_what_does_not_fit_is_counted(
    tmp_path, disk, monkeypatch
):
    monkeypatch.setattr(session_writer, 'STALL', 0.2)
    writer = make_writer(tmp_path / 's', memory=100_000)
    disk.stuck.set()
    writer.put('/a', START, 0, 0, text(0))
    assert disk.waited.wait(10)
    tracemalloc.start()
    for index in range(1, 2001):
        writer.put('/a', START + index, 0, index, text(1000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert writer.waiting <= 100_000
    assert peak < 200_000
    assert writer.taken + writer.dropped['/a'] == 2001
    assert 50 < writer.taken < 100
    until(lambda: writer.error is not None)
    assert f'cannot write {writer.path}: the disk has not answered for 0 s' in writer.error
    with pytest.raises(OSError, match='does not answer'):
        writer.close(patience=0.1)
    disk.mended.set()
    writer.close()
    assert writer.error is None
    kept = writer.taken
    recording = read_bag(writer.path, ())
    assert recording.topics['/a'] == ('std_msgs/msg/String', kept)
    lost = f'the recorder counted: not written /a: {2001 - kept} messages'
    assert any(lost in warning for warning in recording.warnings)


def test_a_full_disk_is_said_and_survived(tmp_path, monkeypatch):
    writer = make_writer(tmp_path / 's', memory=2_000_000)

    def pwritev(handle, parts, offset):
        raise OSError(28, 'No space left on device')

    chance = random.Random(4)
    with monkeypatch.context() as patch:
        patch.setattr(mcap_file.os, 'pwritev', pwritev)
        begun = time.monotonic()
        # Packed for the disk they still count, and what cannot be packed cannot be made smaller.
        while not writer.dropped:
            writer.put('/a', START, 0, 0, text(0) + chance.randbytes(20_000))
            time.sleep(0.001)
            assert time.monotonic() < begun + 60
        until(lambda: writer.error is not None)
        assert f'cannot write {writer.path}: No space left on device' in writer.error
        assert writer.waiting < 2_000_000 + 1.1 * mcap_file.CHUNK_SIZE
        with pytest.raises(OSError, match='No space'):
            writer.close()
        writer.check()
        # Nothing is taken any more, and that is counted too.
        before = writer.dropped['/a']
        writer.put('/a', START, 0, 0, text(0))
        assert writer.dropped['/a'] == before + 1
    writer.close()
    assert writer.error is None
    assert count(writer.path) == writer.taken


def test_a_bug_in_the_thread_is_raised_in_the_owner(tmp_path):
    writer = make_writer(tmp_path / 's')
    writer.put('/not/declared', START, 0, 0, b'')
    until(lambda: writer._failure is not None)
    with pytest.raises(KeyError, match='/not/declared'):
        writer.check()
    with pytest.raises(KeyError, match='/not/declared'):
        writer.close()
