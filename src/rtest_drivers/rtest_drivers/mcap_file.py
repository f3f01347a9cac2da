"""Writes a session as one MCAP file that opens whenever the writer was stopped.

The format is the work of the ``mcap`` library. This module adds what a recording beside a
machine needs: at every `McapFile.flush` all messages so far become a finished chunk, on the disk,
followed by the end of an MCAP file without an index. The next chunk overwrites that end. A
recorder that is killed therefore leaves a complete file that every reader scans instead of
seeking in; `McapFile.close` puts the index there. Only a cut through the one write of a chunk
(power failure, disk full) leaves a file without an end, whole up to that chunk.

What never came into the file is in it as a number: metadata records named `LOSSES`, the last of
which counts.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import yaml
from mcap.writer import CompressionType, IndexType, Writer

from rtest_drivers.bag_metadata import RecordedTopic, bag_metadata, sync_folder, write_metadata
from rtest_estimation.mcap_scan import LOSSES

CHUNK_SIZE = 1024 * 1024


@dataclass
class _Topic(RecordedTopic):
    """One recorded topic and its channel in the file."""

    channel: int = 0


@dataclass
class _Waiting:
    """Output of the MCAP writer that is not on the disk yet; `base` is its place in the file."""

    base: int = 0
    data: bytearray = field(default_factory=bytearray)

    def write(self, data: bytes) -> int:
        self.data += data
        return len(data)

    def tell(self) -> int:
        return self.base + len(self.data)

    def flush(self) -> None:
        """Nothing: `McapFile.flush` decides when the disk is written."""


class McapFile:
    """A recording in the making.

    folder : the bag's directory, created here; it must not exist
    Attributes: `path` of the MCAP file, `count` of messages written, `size` on the disk [bytes],
    `counts` per topic, `end` the last log time [ns].

    Raises FileExistsError where the directory exists, OSError where it cannot be made.
    Not safe for use from several threads at a time.
    """

    def __init__(self, folder: Path) -> None:
        if not hasattr(Writer, 'flush'):
            raise RuntimeError(
                'this version of mcap cannot finish a chunk on demand; mcap 1.5 or newer is needed'
            )
        folder.mkdir(parents=True, exist_ok=False)
        self.path = folder / f'{folder.name}.mcap'
        self.count = 0
        self.size = 0
        self.start: int | None = None
        self.end: int | None = None
        self._topics: dict[str, _Topic] = {}
        self._schemas: dict[str, int] = {}
        self._file = os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        self._closed = False
        self._index_built = False
        self._unwritten = True
        self._losses: dict[str, str] = {}
        self._waiting = _Waiting()
        self._provisional_end = _end_without_index()
        self._writer = Writer(
            self._waiting,  # type: ignore[arg-type]  # the writer needs write, tell and flush
            chunk_size=CHUNK_SIZE,
            compression=CompressionType.ZSTD,
        )
        self._writer.start(profile='ros2', library='rtest')
        self.flush()
        sync_folder(folder)
        sync_folder(folder.parent)

    @property
    def counts(self) -> dict[str, int]:
        """Messages per topic."""
        return {topic.name: topic.count for topic in self._topics.values()}

    @property
    def waiting(self) -> int:
        """Bytes of finished chunks that are not on the disk."""
        return len(self._waiting.data)

    def add_topic(
        self, name: str, type_name: str, schema: str, type_hash: str, offered_qos: str = ''
    ) -> None:
        """Declare a topic before its first message.

        type_name : ``package/msg/Type``; schema : its definition, ``ros2msg``
        type_hash : ``RIHS01_...``
        offered_qos : YAML list of the publishers' profiles, as rosbag2 writes it; '' for none
        """
        if name in self._topics:
            raise ValueError(f'topic {name} is already recorded')
        if type_name not in self._schemas:
            self._schemas[type_name] = self._writer.register_schema(
                type_name, 'ros2msg', schema.encode()
            )
        channel = self._writer.register_channel(
            name,
            'cdr',
            self._schemas[type_name],
            {'offered_qos_profiles': offered_qos, 'topic_type_hash': type_hash},
        )
        self._topics[name] = _Topic(name, type_name, type_hash, offered_qos, channel=channel)
        self._unwritten = True

    def write(
        self, topic: str, log_time: int, publish_time: int, sequence: int, data: bytes
    ) -> None:
        """Take one serialised message.

        log_time : reception [ns]; publish_time [ns], 0 where it is not known
        sequence : the publisher's counter, 0 where there is none
        data : CDR with its encapsulation header

        Raises ValueError for a log time of 0 or before: a single one makes viewers lay out
        fifty years.
        """
        if log_time <= 0:
            raise ValueError(f'{topic}: log time {log_time} ns, expected the time of reception')
        entry = self._topics[topic]
        self._writer.add_message(
            entry.channel,
            log_time=log_time,
            publish_time=publish_time if publish_time > 0 else log_time,
            sequence=sequence & 0xFFFFFFFF,
            data=data,
        )
        entry.count += 1
        self.count += 1
        self.start = log_time if self.start is None else min(self.start, log_time)
        self.end = log_time if self.end is None else max(self.end, log_time)
        self._unwritten = True

    def note_losses(self, losses: Mapping[str, int]) -> None:
        """Say in the file what is not in it, each time with all that is known so far.

        losses : what is missing and where, such as ``not written /rtest/gauges``, to its number
        """
        noted = {what: str(count) for what, count in losses.items()}
        if noted != self._losses and not self._index_built:
            self._losses = noted
            self._writer.add_metadata(LOSSES, noted)
            self._unwritten = True

    def flush(self) -> None:
        """Put everything received so far on the disk, as an MCAP file that opens.

        Raises OSError where the disk refuses; nothing is lost then, the next call tries again.
        """
        if not self._unwritten:
            return
        self._writer.flush()
        self._store()
        write_metadata(self.path.parent, self._metadata())
        self._unwritten = False

    def close(self) -> None:
        """Write the index, the final metadata.yaml, and close.

        Raises OSError where the disk refuses; the file then stays as the last `flush` left it
        and the call can be repeated.
        """
        if self._closed:
            return
        if not self._index_built:
            self.flush()
            # As rosbag2: lets the .mcap alone say what metadata.yaml says.
            metadata = yaml.safe_dump(self._metadata(), sort_keys=False)
            self._writer.add_metadata('rosbag2', {'serialized_metadata': metadata})
            self._writer.finish()
            # Built once only: a second attempt stores what the first could not.
            self._index_built = True
        self._store()
        write_metadata(self.path.parent, self._metadata())
        self._closed = True
        os.close(self._file)

    def _store(self) -> None:
        """Write what waits, and an end, over the previous end, through to the disk."""
        waiting = self._waiting
        end = b'' if self._index_built else self._provisional_end
        place, size = waiting.base, len(waiting.data) + len(end)
        written = 0
        # Not copied together: what waits may be as large as the memory allows.
        with memoryview(waiting.data) as data:
            while written < size:
                end_left = end[max(0, written - len(data)) :]
                # Released at once: nothing can be added to what is still looked at.
                with data[written:] as data_left:
                    written += os.pwritev(self._file, [data_left, end_left], place + written)
        os.ftruncate(self._file, place + size)
        os.fsync(self._file)
        self.size = place + size
        waiting.base += len(waiting.data)
        waiting.data.clear()

    def _metadata(self) -> dict:
        return bag_metadata(self.path.name, self._topics.values(), self.start, self.end)


def _end_without_index() -> bytes:
    """End of an MCAP file without a summary: DataEnd, Footer, magic."""
    stream = BytesIO()
    Writer(
        stream,
        index_types=IndexType.NONE,
        repeat_channels=False,
        repeat_schemas=False,
        use_statistics=False,
        use_summary_offsets=False,
    ).finish()
    return stream.getvalue()

