"""Handing messages to the writing thread: nothing is lost silently, nothing hangs."""

import threading
import time

import pytest
from mcap.reader import make_reader

from rtest_drivers import mcap_file
from rtest_drivers.mcap_file import McapFile
from rtest_drivers.message_types import MessageTypes
from rtest_drivers.session_writer import FLUSH_INTERVAL, SessionWriter

START = 1_700_000_000_000_000_000


def make_writer(folder, **options):
    writer = SessionWriter(folder, **options)
    writer.add_topic('/a', MessageTypes().definition('std_msgs/msg/String'), '')
    return writer


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
    begun = time.monotonic()
    until(lambda: count(writer.path) == 100)
    assert time.monotonic() - begun < FLUSH_INTERVAL + 0.5
    writer.close()
    assert writer.taken == writer.written == 100
    assert not writer.dropped and writer.error is None


def test_a_full_queue_is_counted(tmp_path, monkeypatch):
    stuck = threading.Event()
    inside = threading.Event()
    real = McapFile.flush

    def flush(self):
        inside.set()
        assert stuck.wait(20)
        real(self)

    writer = make_writer(tmp_path / 's', queue_length=50)
    monkeypatch.setattr(McapFile, 'flush', flush)
    assert inside.wait(10)
    for index in range(80):
        writer.put('/a', START + index, 0, index, b'\x00\x01\x00\x00\x01\x00\x00\x00\x00')
    assert writer.taken == 50
    assert writer.dropped == {'/a': 30}
    stuck.set()
    writer.close()
    assert count(writer.path) == 50


def test_a_full_disk_is_said_and_survived(tmp_path, monkeypatch):
    writer = make_writer(tmp_path / 's')

    def pwrite(handle, data, offset):
        raise OSError(28, 'No space left on device')

    with monkeypatch.context() as patch:
        patch.setattr(mcap_file.os, 'pwrite', pwrite)
        writer.put('/a', START, 0, 0, b'\x00\x01\x00\x00\x01\x00\x00\x00\x00')
        until(lambda: writer.error is not None)
        assert f'cannot write {writer.path}: No space left on device' in writer.error
        with pytest.raises(OSError, match='No space'):
            writer.close()
        writer.check()
    writer.close()
    assert writer.error is None
    assert count(writer.path) == 1


def test_a_bug_in_the_thread_is_raised_in_the_owner(tmp_path):
    writer = make_writer(tmp_path / 's')
    writer.put('/not/declared', START, 0, 0, b'')
    until(lambda: writer._failure is not None)
    with pytest.raises(KeyError, match='/not/declared'):
        writer.check()
    with pytest.raises(KeyError, match='/not/declared'):
        writer.close()
