"""Mends recordings that were cut or not closed: a copy with index, summary and metadata.yaml.

Every message that can be read is in the copy, unchanged and in its order, with what the file says
beside messages (definitions, quality of service, metadata records, attachments). What cannot be
read is said, in the copy too. The original is only read.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import yaml
from mcap.writer import CompressionType, Writer

from rtest_drivers.bag_metadata import RecordedTopic, bag_metadata, sync_folder, write_metadata
from rtest_estimation.bagfile import FILE_NAME, find_files, missing_counts, recorded_counts
from rtest_estimation.errors import UserError
from rtest_estimation.mcap_scan import MENDED, Entry, McapScan, Source

# Written anew, because it says what the file says.
_ROSBAG2 = 'rosbag2'


@dataclass(frozen=True)
class Mended:
    """What came of mending.

    path : of the copy, None where the recording is whole and there is none
    messages : by topic; missing : one sentence each
    """

    path: Path | None
    messages: dict[str, int]
    missing: tuple[str, ...]


def mend(source: Path, out: Path) -> Mended:
    """Write a mended copy of an MCAP recording; nothing is written where it is whole.

    source : a folder with its files or one .mcap file
    out : what is to be made: a folder as the recorder makes it, or one file where it ends in .mcap

    Raises UserError where `source` is no MCAP recording, or `out` is there already or would change
    the folder of the original.
    """
    if not source.exists():
        raise UserError(f'{source}: no such file or directory; expected a recording')
    warnings: list[str] = []
    try:
        files, storage = find_files(source, warnings)
        if storage != 'mcap':
            raise UserError(f'{files[0]}: only MCAP recordings can be mended')
        _check_out(out, source, files)
        whole, counts, missing = _look_through(source, files)
        missing = warnings + missing
        if whole and not missing:
            return Mended(None, counts, ())
        with _draft(out) as folder:
            counts = _write(files, folder, out, missing)
        return Mended(out, counts, tuple(missing))
    except OSError as error:
        where = error.filename or out
        raise UserError(f'{where}: cannot be mended: {error.strerror or error}') from error


def _check_out(out: Path, source: Path, files: Iterable[Path]) -> None:
    if out.exists() or out.is_symlink():
        raise UserError(f'{out}: exists already; name a file or folder that is to be made')
    if not out.parent.is_dir():
        raise UserError(f'{out}: cannot be made: {out.parent} is not a directory')
    parent = out.parent.resolve()
    for file in files:
        folder = file.resolve().parent
        bag = source.is_dir() or (folder / FILE_NAME).exists()
        if bag and parent.is_relative_to(folder):
            raise UserError(f'{out}: is in the folder of the original; name another place')


def _look_through(
    source: Path, files: Iterable[Path]
) -> tuple[bool, dict[str, int], list[str]]:
    """Whether a recording is whole, its messages by topic, and what is missing in it."""
    counts: Counter[str] = Counter()
    whole = True
    missing: list[str] = []
    for file in files:
        scan = McapScan(file)
        for entry in scan.entries():
            counts[entry.source.topic] += 1
        whole &= scan.intact
        # A recording that is whole may say what it has never had.
        missing += scan.warnings if not scan.intact else []
    if source.is_dir():
        whole &= recorded_counts(source) == counts
        missing += missing_counts(source, counts)
    return whole, dict(counts), missing


@contextmanager
def _draft(out: Path) -> Iterator[Path]:
    """A folder to write in; an interrupted mending leaves nothing that looks like a recording."""
    folder = Path(tempfile.mkdtemp(prefix=f'.{out.name}-', dir=out.parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write(
    files: Iterable[Path], folder: Path, out: Path, missing: list[str]
) -> dict[str, int]:
    """Write the copy in `folder`, then move it to `out`; messages by topic."""
    single = out.suffix == '.mcap'
    name = out.name if single else f'{out.name}.mcap'
    with (folder / name).open('wb') as stream:
        copy = _Copy(stream)
        for file in files:
            copy.add(file, missing)
        copy.say_missing(missing)
        metadata = copy.finish(name)
        stream.flush()
        os.fsync(stream.fileno())
    if single:
        (folder / name).rename(out)
    else:
        write_metadata(folder, metadata)
        sync_folder(folder)
        folder.chmod(0o755)
        folder.rename(out)
    sync_folder(out.parent)
    return {topic.name: topic.count for topic in copy.topics.values()}


@dataclass
class _Copy:
    """The file being written; topics by name."""

    stream: BinaryIO
    topics: dict[str, RecordedTopic] = field(default_factory=dict)
    start: int | None = None
    end: int | None = None
    schemas: dict[tuple[str, str, bytes], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.writer = Writer(self.stream, compression=CompressionType.ZSTD)
        self.writer.start(profile='ros2', library='rtest')

    def add(self, file: Path, missing: list[str]) -> None:
        """Take over everything that can be read of a file; what else is damaged is added."""
        scan = McapScan(file)
        channels: dict[int, int] = {}
        for entry in scan.entries():
            key = entry.source.channel.id
            if key not in channels:
                channels[key] = self._declare(entry.source)
            self._message(channels[key], entry)
        for record in scan.metadata:
            if record.name != _ROSBAG2:
                self.writer.add_metadata(record.name, record.metadata)
        for one in scan.attachments():
            if one is None:
                missing.append(f'{file.name}: a damaged attachment is left out')
            else:
                self.writer.add_attachment(
                    one.create_time, one.log_time, one.name, one.media_type, one.data
                )

    def say_missing(self, missing: Iterable[str]) -> None:
        """Say in the copy what could not be mended."""
        self.writer.add_metadata(MENDED, {str(n): text for n, text in enumerate(missing, 1)})

    def finish(self, name: str) -> dict:
        """Write index and summary; returns what metadata.yaml is to say."""
        metadata = bag_metadata(name, self.topics.values(), self.start, self.end)
        text = yaml.safe_dump(metadata, sort_keys=False)
        self.writer.add_metadata(_ROSBAG2, {'serialized_metadata': text})
        self.writer.finish()
        return metadata

    def _declare(self, source: Source) -> int:
        channel, schema = source.channel, source.schema
        number = 0
        if schema is not None:
            key = (schema.name, schema.encoding, schema.data)
            if key not in self.schemas:
                self.schemas[key] = self.writer.register_schema(*key)
            number = self.schemas[key]
        said = channel.metadata
        if source.topic not in self.topics:
            self.topics[source.topic] = RecordedTopic(
                source.topic,
                source.definition.type_name,
                said.get('topic_type_hash', ''),
                said.get('offered_qos_profiles', ''),
            )
        return self.writer.register_channel(
            channel.topic, channel.message_encoding, number, said
        )

    def _message(self, channel: int, entry: Entry) -> None:
        self.writer.add_message(
            channel, entry.log_time, entry.data, entry.publish_time, entry.sequence
        )
        self.topics[entry.source.topic].count += 1
        time = entry.log_time
        self.start = time if self.start is None else min(self.start, time)
        self.end = time if self.end is None else max(self.end, time)
