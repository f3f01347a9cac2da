"""Writes a session as one MCAP file that opens whenever the writer was stopped.

The format is the work of the ``mcap`` library. This module adds what a recording beside a
machine needs: at every `McapFile.flush` all messages so far become a finished chunk, on the disk,
followed by the end of an MCAP file without an index. The next chunk overwrites that end. A
recorder that is killed therefore leaves a complete file that every reader scans instead of
seeking in; `McapFile.close` puts the index there. Only a cut through the one write of a chunk
(power failure, disk full) leaves a file without an end, whole up to that chunk.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType, IndexType, Writer

# Messages wait in memory while the disk refuses them, up to this much.
MAX_WAITING = 256 * 1024 * 1024
CHUNK_SIZE = 1024 * 1024
METADATA_VERSION = 9
ROS_DISTRO = 'jazzy'
NO_START = 2**63 - 1


class RecordingFullError(OSError):
    """The disk refuses what is written and the memory to wait in is used up."""


@dataclass
class _Topic:
    """One recorded topic, as metadata.yaml lists it."""

    name: str
    type_name: str
    type_hash: str
    qos: str
    channel: int
    count: int = 0


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
        self._waiting = _Waiting()
        self._provisional_end = _end_without_index()
        self._writer = Writer(
            self._waiting,  # type: ignore[arg-type]  # the writer needs write, tell and flush
            chunk_size=CHUNK_SIZE,
            compression=CompressionType.ZSTD,
        )
        self._writer.start(profile='ros2', library='rtest')
        self.flush()
        _sync_folder(folder)
        _sync_folder(folder.parent)

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
        self._topics[name] = _Topic(name, type_name, type_hash, offered_qos, channel)
        self._unwritten = True

    def write(
        self, topic: str, log_time: int, publish_time: int, sequence: int, data: bytes
    ) -> None:
        """Take one serialised message.

        log_time : reception [ns]; publish_time [ns], 0 where it is not known
        sequence : the publisher's counter, 0 where there is none
        data : CDR with its encapsulation header

        Raises ValueError for a log time of 0 or before: a single one makes viewers lay out
        fifty years. Raises RecordingFullError where the disk has refused messages for so long
        that no more can wait; the message is not taken.
        """
        if log_time <= 0:
            raise ValueError(f'{topic}: log time {log_time} ns, expected the time of reception')
        if self.waiting > MAX_WAITING:
            raise RecordingFullError(
                f'{self.path}: {self.waiting} bytes wait for the disk, no more fit into memory'
            )
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

    def flush(self) -> None:
        """Put everything received so far on the disk, as an MCAP file that opens.

        Raises OSError where the disk refuses; nothing is lost then, the next call tries again.
        """
        if not self._unwritten:
            return
        self._writer.flush()
        self._store()
        self._write_metadata()
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
        self._write_metadata()
        self._closed = True
        os.close(self._file)

    def _store(self) -> None:
        """Write what waits, and an end, over the previous end, through to the disk."""
        data = self._waiting.data
        end = b'' if self._index_built else self._provisional_end
        block = memoryview(bytes(data) + end)
        place = self._waiting.base
        written = 0
        while written < len(block):
            written += os.pwrite(self._file, block[written:], place + written)
        os.ftruncate(self._file, place + len(block))
        os.fsync(self._file)
        self.size = place + len(block)
        self._waiting.base += len(data)
        data.clear()

    def _metadata(self) -> dict[str, Any]:
        """Contents of metadata.yaml below its one key, version 9."""
        # rosbag2 says the end of time for the start of an empty bag.
        start = {'nanoseconds_since_epoch': NO_START if self.start is None else self.start}
        duration = {'nanoseconds': (self.end or 0) - (self.start or 0)}
        return {
            'version': METADATA_VERSION,
            'storage_identifier': 'mcap',
            'duration': duration,
            'starting_time': start,
            'message_count': self.count,
            'topics_with_message_count': [
                {
                    'topic_metadata': {
                        'name': topic.name,
                        'type': topic.type_name,
                        'serialization_format': 'cdr',
                        'offered_qos_profiles': yaml.safe_load(topic.qos) or [],
                        'type_description_hash': topic.type_hash,
                    },
                    'message_count': topic.count,
                }
                for topic in self._topics.values()
            ],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [self.path.name],
            'files': [
                {
                    'path': self.path.name,
                    'starting_time': dict(start),
                    'duration': dict(duration),
                    'message_count': self.count,
                }
            ],
            'custom_data': None,
            'ros_distro': ROS_DISTRO,
        }

    def _write_metadata(self) -> None:
        """Replace metadata.yaml as a whole, so that it is never half written."""
        path = self.path.with_name('metadata.yaml')
        draft = path.with_name('metadata.yaml.tmp')
        content = {'rosbag2_bagfile_information': self._metadata()}
        with draft.open('w', encoding='utf-8') as file:
            yaml.safe_dump(content, file, sort_keys=False)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)


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


def _sync_folder(folder: Path) -> None:
    """Make the entries of a directory survive a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
