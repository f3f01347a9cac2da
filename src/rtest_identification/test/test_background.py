"""A computation beside a node: taken once, where it is asked for, also when it fails."""

import os
import subprocess
import sys
import threading
import time

import pytest

from rtest_identification.nodes.background import Background


def test_a_result_is_taken_once_and_not_before_it_is_there() -> None:
    taken, go = [], threading.Event()
    background = Background(taken.append)
    background.wait()
    assert not background.busy

    def compute() -> int:
        go.wait()
        return 7

    background.start(compute)
    background.poll()
    assert taken == [] and background.busy
    with pytest.raises(RuntimeError, match='was not taken'):
        background.start(compute)
    go.set()
    background.wait()
    background.poll()
    assert taken == [7] and not background.busy
    background.start(lambda: 8)
    background.wait()
    assert taken == [7, 8]


def test_what_it_raises_is_raised_where_the_result_is_taken() -> None:
    background = Background(list)

    def compute() -> None:
        raise ZeroDivisionError('a bug')

    background.start(compute)
    with pytest.raises(ZeroDivisionError, match='a bug'):
        background.wait()
    assert not background.busy


def test_only_the_thread_gives_way() -> None:
    before, seen = os.nice(0), []
    background = Background(seen.append)
    background.start(lambda: os.getpriority(os.PRIO_PROCESS, threading.get_native_id()))
    background.wait()
    assert seen == [10] and os.nice(0) == before


def test_a_process_ends_without_waiting_for_it() -> None:
    begun = time.monotonic()
    code = (
        'import time; from rtest_identification.nodes.background import Background; '
        'Background(print).start(lambda: time.sleep(60))'
    )
    assert subprocess.run([sys.executable, '-c', code], timeout=30, check=False).returncode == 0
    assert time.monotonic() - begun < 20.0
