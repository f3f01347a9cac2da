"""Takes messages from callbacks that must not wait, and writes them to a recording.

One thread owns the `McapFile`. Messages reach it through a queue of bounded length: while the
disk is slow they wait there, and when it is full what is refused is counted, never silently lost.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from rtest_drivers.mcap_file import McapFile, RecordingFullError
from rtest_drivers.message_types import Definition

# Everything received is on the disk after this time [s] at the latest.
FLUSH_INTERVAL = 0.5
# At 3,000 messages a second, half a minute of a disk that does not answer.
QUEUE_LENGTH = 100_000


@dataclass(frozen=True)
class _Topic:
    name: str
    definition: Definition
    offered_qos: str


@dataclass(frozen=True)
class _Message:
    topic: str
    log_time: int
    publish_time: int
    sequence: int
    data: bytes


class SessionWriter:
    """Writes one session in a thread of its own.

    folder : the bag's directory, created here
    Attributes: `taken` messages, `dropped` per topic, `error` as a sentence while the disk
    refuses to be written (None otherwise), `path` of the file, `size` on the disk [bytes].

    Raises FileExistsError where the directory exists, OSError where it cannot be written.
    """

    def __init__(self, folder: Path, queue_length: int = QUEUE_LENGTH) -> None:
        self._file = McapFile(folder)
        self.path = self._file.path
        self.taken = 0
        self.dropped: Counter[str] = Counter()
        self.error: str | None = None
        self._failure: BaseException | None = None
        self._queue: queue.Queue[_Topic | _Message | None] = queue.Queue(queue_length)
        self._thread = threading.Thread(target=self._run, name='recording', daemon=True)
        self._thread.start()

    @property
    def size(self) -> int:
        """Bytes on the disk."""
        return self._file.size

    @property
    def queued(self) -> int:
        """Messages that wait for the thread."""
        return self._queue.qsize()

    @property
    def written(self) -> int:
        """Messages that went into the file."""
        return self._file.count

    def add_topic(self, name: str, definition: Definition, offered_qos: str) -> None:
        """Declare a topic before its first message; see `McapFile.add_topic`."""
        self._queue.put(_Topic(name, definition, offered_qos))

    def put(
        self, topic: str, log_time: int, publish_time: int, sequence: int, data: bytes
    ) -> None:
        """Hand over one message; counted in `dropped` when there is no room for it."""
        try:
            self._queue.put_nowait(_Message(topic, log_time, publish_time, sequence, data))
        except queue.Full:
            self.dropped[topic] += 1
        else:
            self.taken += 1

    def check(self) -> None:
        """Raise what ended the thread, if a bug did."""
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Write everything that was handed over, and close the file.

        Raises OSError where the disk refuses; the call can be repeated then.
        """
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        self.check()
        try:
            self._file.close()
        except OSError as error:
            self.error = self._explain(error)
            raise
        self.error = None

    def _run(self) -> None:
        try:
            self._write_until_told()
        # Handed to the owner's thread by check(), where it is not swallowed.
        except BaseException as failure:
            self._failure = failure

    def _write_until_told(self) -> None:
        due = time.monotonic() + FLUSH_INTERVAL
        while True:
            try:
                item = self._queue.get(timeout=max(0.0, due - time.monotonic()))
            except queue.Empty:
                pass
            else:
                if item is None:
                    return
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
        try:
            self._file.write(
                item.topic, item.log_time, item.publish_time, item.sequence, item.data
            )
        except RecordingFullError:
            self.dropped[item.topic] += 1

    def _flush(self) -> None:
        try:
            self._file.flush()
        except OSError as error:
            self.error = self._explain(error)
        else:
            self.error = None

    def _explain(self, error: OSError) -> str:
        return (
            f'cannot write {self.path}: {error.strerror or error}; '
            f'{self._file.waiting / 1e6:.1f} MB wait in memory: free space or mend the disk'
        )
