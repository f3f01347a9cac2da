"""Takes messages from callbacks that must not wait, and writes them to a recording.

One thread owns the `McapFile`. While the disk is slow, full or does not answer at all, messages
wait in memory, up to a number of bytes; what does not fit is counted by topic, told at once by
`SessionWriter.error`, and noted in the recording as soon as the disk can be written again.
"""

from __future__ import annotations

import errno
import sys
import threading
import time
from collections import Counter, deque
from pathlib import Path
from typing import NamedTuple

from rtest_drivers.mcap_file import McapFile
from rtest_drivers.message_types import Definition

# Everything received is on the disk after this time [s] and one write of the disk.
FLUSH_INTERVAL = 0.5
# What may wait for the disk [bytes]: a quarter of an hour of three gauges at 1 kHz.
MEMORY = 256_000_000
# A disk that takes longer than this for one write has stalled [s].
STALL = 2.0
NOT_WRITTEN = 'not written'


class _Topic(NamedTuple):
    name: str
    definition: Definition
    offered_qos: str


class _Message(NamedTuple):
    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


# What a message takes beside its data, with its place in the queue.
_OVERHEAD = sys.getsizeof(_Message('', 0, 0, 0, b'')) + 3 * sys.getsizeof(2**62) + 8


class _Close:
    """Asks the thread to close the file, and hands back what came of it."""

    def __init__(self) -> None:
        self.done = threading.Event()
        self.error: OSError | None = None


class SessionWriter:
    """Writes one session in a thread of its own.

    folder : the bag's directory, created here
    memory : what may wait for the disk [bytes]
    Attributes: `taken` messages, `dropped` per topic, `path` of the file, `size` on the disk
    [bytes].

    Raises FileExistsError where the directory exists, OSError where it cannot be written.
    """

    def __init__(self, folder: Path, memory: int = MEMORY) -> None:
        self._file = McapFile(folder)
        self.path = self._file.path
        self.taken = 0
        self.dropped: Counter[str] = Counter()
        self._memory = memory
        self._refused: str | None = None
        self._failure: BaseException | None = None
        # What other losses the owner knows of, noted with our own.
        self._losses: dict[str, int] = {}
        self._queue: deque[_Topic | _Message | _Close] = deque()
        self._queued = 0
        self._changed = threading.Condition()
        self._busy_since: float | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name='recording', daemon=True)
        self._thread.start()

    @property
    def size(self) -> int:
        """Bytes on the disk."""
        return self._file.size

    @property
    def waiting(self) -> int:
        """Bytes that wait for the disk, at most `memory` and one chunk."""
        return self._queued + self._file.waiting

    @property
    def written(self) -> int:
        """Messages that went into the file."""
        return self._file.count

    @property
    def stalled(self) -> float:
        """How long the disk has not answered [s], 0 where it does."""
        since = self._busy_since
        return 0.0 if since is None else max(0.0, time.monotonic() - since)

    @property
    def error(self) -> str | None:
        """What is wrong with the disk now, as a sentence; None where nothing is."""
        stalled = self.stalled
        if stalled > STALL:
            return self._explain(f'the disk has not answered for {stalled:.0f} s')
        return self._refused and self._explain(self._refused)

    def add_topic(self, name: str, definition: Definition, offered_qos: str) -> None:
        """Declare a topic before its first message; see `McapFile.add_topic`."""
        self._append(_Topic(name, definition, offered_qos))

    def put(
        self, topic: str, log_time: int, publish_time: int, sequence: int, data: bytes
    ) -> None:
        """Hand over one message; counted in `dropped` when there is no room, or after `close`."""
        size = len(data) + _OVERHEAD
        if self._closing or self.waiting + size > self._memory:
            self.dropped[topic] += 1
            return
        self._append(_Message(topic, log_time, publish_time, sequence, data), size)
        self.taken += 1

    def note_losses(self, losses: dict[str, int]) -> None:
        """What else never came into the file, all of it; see `McapFile.note_losses`."""
        self._losses = dict(losses)

    def check(self) -> None:
        """Raise what ended the thread, if a bug did."""
        if self._failure is not None:
            raise self._failure

    def close(self, patience: float | None = None) -> None:
        """Write everything that was handed over, and close the file.

        patience : how long to wait for the disk [s], None for as long as it takes

        Raises OSError where the disk refuses or does not answer; the call can be repeated then.
        """
        self._closing = True
        request = _Close()
        self._append(request)
        deadline = None if patience is None else time.monotonic() + patience
        # The thread may have ended: by a bug, or by an earlier request that came through late.
        while not request.done.wait(0.05) and self._thread.is_alive():
            if deadline is not None and time.monotonic() > deadline:
                self._refused = f'the disk has not answered for {self.stalled:.0f} s'
                raise OSError(errno.ETIMEDOUT, 'the disk does not answer')
        self.check()
        if request.error is not None:
            raise request.error

    def _append(self, item: _Topic | _Message | _Close, size: int = 0) -> None:
        with self._changed:
            self._queue.append(item)
            self._queued += size
            self._changed.notify()

    def _run(self) -> None:
        try:
            self._write_until_closed()
        # Handed to the owner's thread by check(), where it is not swallowed.
        except BaseException as failure:
            self._failure = failure

    def _write_until_closed(self) -> None:
        due = time.monotonic() + FLUSH_INTERVAL
        while True:
            with self._changed:
                if not self._queue:
                    self._changed.wait(max(0.0, due - time.monotonic()))
                item = self._queue.popleft() if self._queue else None
            if isinstance(item, _Close):
                closed = self._flush(close=True)
                item.error = closed
                item.done.set()
                if closed is None:
                    return
            elif item is not None:
                self._take(item)
            if time.monotonic() >= due:
                self._flush()
                due = time.monotonic() + FLUSH_INTERVAL

    def _take(self, item: _Topic | _Message) -> None:
        if isinstance(item, _Topic):
            definition = item.definition
            self._file.add_topic(
                item.name,
                definition.name,
                definition.text,
                definition.type_hash,
                item.offered_qos,
            )
            return
        self._file.write(*item)
        with self._changed:
            self._queued -= len(item.data) + _OVERHEAD

    def _flush(self, close: bool = False) -> OSError | None:
        """Put on the disk what the file holds; what the disk says where it refuses."""
        losses = {f'{NOT_WRITTEN} {topic}': count for topic, count in self.dropped.copy().items()}
        self._busy_since = time.monotonic()
        try:
            self._file.note_losses({**self._losses, **losses})
            if close:
                self._file.close()
            else:
                self._file.flush()
        except OSError as error:
            self._refused = error.strerror or str(error)
            return error
        finally:
            self._busy_since = None
        self._refused = None
        return None

    def _explain(self, reason: str) -> str:
        return (
            f'cannot write {self.path}: {reason}; {self.waiting / 1e6:.1f} MB wait in memory: '
            'free space or mend the disk'
        )
