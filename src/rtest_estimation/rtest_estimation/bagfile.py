"""Finds and reads recordings as they are: closed, killed, cut, damaged, made by others.

Whatever can be read is; the rest is counted and named in `Bag.warnings`. MCAP files are read by
`McapScan`; other storages (sqlite3, files compressed as a whole) are left to rosbags.
"""

from __future__ import annotations

import sqlite3
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError

from rtest_estimation.errors import UserError
from rtest_estimation.mcap_scan import McapScan
from rtest_estimation.message_reader import Definition, full_name, message_reader
from rtest_estimation.yaml_text import load_yaml, read_yaml

FILE_NAME = 'metadata.yaml'


@dataclass(frozen=True)
class Bag:
    """What a recording holds, messages still serialised.

    topics : name to (type, number of messages)
    size : of the files [bytes]; start, end : first and last log time [ns], 0 in an empty bag
    closed : whether every file has the index that is written when a recording is closed
    raw : topic to its messages in file order, of the types that are kept, each with the definition
        to read it by
    latched : topic to whether a subscriber that came late got its last messages too; only of
        topics of which the file says it
    ordered : whether the log times never go back
    definitions : topic to the definition of its type
    """

    path: Path
    files: tuple[Path, ...]
    size: int
    start: int
    end: int
    closed: bool
    topics: dict[str, tuple[str, int]]
    warnings: tuple[str, ...]
    raw: dict[str, list[tuple[Definition, bytes]]]
    latched: dict[str, bool] = field(default_factory=dict)
    ordered: bool = True
    definitions: dict[str, Definition] = field(default_factory=dict)
    storage: str = 'mcap'

    def stored(self, topics: Collection[str]) -> Iterator[tuple[str, Definition, int, bytes]]:
        """Topic, definition, log time [ns] and data of every message, in file order.

        Reads the files again, and so needs little memory.
        """
        return _stored(self.files, self.storage, _Contents(()), topics)

    def stream(self, topics: Collection[str]) -> Iterator[tuple[str, Definition, int, bytes]]:
        """The same in the order of log time; in memory where they are stored in another."""
        found = self.stored(topics)
        return found if self.ordered else iter(sorted(found, key=lambda message: message[2]))

    def messages(self, topic: str) -> Iterator[Any]:
        """Deserialised messages of a topic, in file order; a `DamagedMessage` for a damaged one.

        Raises UserError where the file does not say what the type looks like.
        """
        readers: dict[Definition, Callable[[bytes], Any]] = {}
        found = self.raw.get(topic)
        if found is None:
            found = ((definition, data) for _, definition, _, data in self.stored((topic,)))
        for definition, data in found:
            if definition not in readers:
                readers[definition] = message_reader(definition, f'{self.path}: topic {topic}')
            yield readers[definition](data)


@dataclass
class _Contents:
    """What the files have yielded so far."""

    keep: Collection[str]
    start: int = 0
    end: int = 0
    closed: bool = True
    definitions: dict[str, Definition] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)
    latched: dict[str, bool] = field(default_factory=dict)
    ordered: bool = True
    last: int = 0
    raw: dict[str, list[tuple[Definition, bytes]]] = field(
        default_factory=lambda: defaultdict(list)
    )

    def add(self, topic: str, definition: Definition, log_time: int, data: bytes) -> None:
        if definition.type_name in self.keep:
            self.raw[topic].append((definition, data))
        self.definitions.setdefault(topic, definition)
        self.counts[topic] += 1
        self.ordered &= log_time >= self.last
        self.last = log_time
        self.start = log_time if not self.start else min(self.start, log_time)
        self.end = max(self.end, log_time)


def read_bag(path: str | Path, keep: Collection[str]) -> Bag:
    """Read a bag directory or one of its files.

    keep : message types (``package/msg/Type``) whose messages are kept, the others are counted

    Raises UserError where there is no recording at `path`.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f'{path}: no such file or directory; expected a recording')
    if not path.is_file() and not path.is_dir():
        raise UserError(f'{path}: neither a file nor a directory; expected a recording')
    contents = _Contents(keep)
    try:
        files, storage = find_files(path, contents.warnings)
        for message in _stored(files, storage, contents):
            contents.add(*message)
        if storage == 'mcap':
            contents.warnings += missing_counts(path, contents.counts)
        size = sum(file.stat().st_size for file in files)
    except OSError as error:
        where = error.filename or path
        raise UserError(f'{where}: cannot be read: {error.strerror or error}') from error
    return Bag(
        path,
        files,
        size,
        contents.start,
        contents.end,
        contents.closed,
        {
            name: (definition.type_name, contents.counts[name])
            for name, definition in contents.definitions.items()
        },
        tuple(contents.warnings),
        dict(contents.raw),
        contents.latched,
        contents.ordered,
        contents.definitions,
        storage,
    )


def _stored(
    files: tuple[Path, ...],
    storage: str,
    contents: _Contents,
    topics: Collection[str] | None = None,
) -> Iterator[tuple[str, Definition, int, bytes]]:
    """Messages of the files in the order in which they are stored.

    contents : takes what else the files say; topics : those that are wanted, None for all
    """
    if storage != 'mcap':
        found = _other(files[0], contents)
        yield from (m for m in found if topics is None or m[0] in topics)
        return
    for file in files:
        scan = McapScan(file)
        yield from scan.messages(topics)
        contents.closed &= scan.closed
        contents.warnings += scan.warnings
        for topic, profiles in scan.offered.items():
            if (latched := _latched(profiles)) is not None:
                contents.latched[topic] = latched


def _latched(profiles: str) -> bool | None:
    """Whether any of the publishers' profiles (YAML) is latched; None where there is none."""
    try:
        # Older versions of rosbag2 wrote numbers.
        found = [profile['durability'] for profile in load_yaml(profiles, 'offered profiles')]
    except (UserError, KeyError, TypeError):
        return None
    return any(durability in ('transient_local', 1) for durability in found)


def find_files(path: Path, warnings: list[str]) -> tuple[tuple[Path, ...], str]:
    """Files of a recording in order, and their storage: ``mcap`` or ``other``.

    warnings : to which is added what metadata.yaml names and what is not there

    Raises UserError where there is no recording, or where it is not in its folder.
    """
    if path.name == FILE_NAME:
        path = path.parent
    if path.is_file():
        return (path,), 'other' if path.suffix in ('.db3', '.zstd') else 'mcap'
    listed = _listed_files(path)
    missing = [name for name in listed if not (path / name).is_file()]
    if missing:
        warnings.append(f'{path}/metadata.yaml names {missing[0]}, which is not there')
    files = [path / name for name in listed if name not in missing]
    # metadata.yaml can be provisional, gone, or of a bag that was renamed.
    files = files or _unlisted_files(path)
    for file in files:
        # A link could lead to any file of this computer.
        if not file.resolve().is_relative_to(path.resolve()):
            raise UserError(f'{file}: leads out of the recording; name that file if it is meant')
    if not files:
        inside = sorted(entry.parent.name for entry in path.glob('*/*.mcap'))
        names = ', '.join([*inside[:9], *(['...'] if inside[9:] else [])])
        hint = f'; name one of its recordings: {names}' if inside else ''
        raise UserError(f'{path}: no recording in this directory{hint}')
    return tuple(files), 'mcap' if all(file.suffix == '.mcap' for file in files) else 'other'


def _unlisted_files(folder: Path) -> list[Path]:
    """Files of the one recording in a folder without metadata.yaml, in order.

    Raises UserError where there are several recordings.
    """
    found = sorted(p for p in folder.iterdir() if p.suffix in ('.mcap', '.db3') and p.is_file())
    if len(found) < 2:
        return found
    # One recording that rosbag2 has split is NAME_0, NAME_1 and so on.
    for first in found:
        stem = first.stem.removesuffix('_0')
        parts = [folder / f'{stem}_{number}{first.suffix}' for number in range(len(found))]
        if set(parts) == set(found):
            return parts
    names = ', '.join(file.name for file in found[:5])
    raise UserError(f'{folder}: {len(found)} recordings in one directory: {names}; name one')


def _listed_files(folder: Path) -> list[str]:
    """File names in metadata.yaml; none where it is missing or unreadable."""
    listed = _metadata(folder).get('relative_file_paths')
    # Older versions wrote the directory too; and nobody's metadata leads out of the bag.
    names = [Path(str(name)).name for name in listed] if isinstance(listed, list) else []
    return [name for name in names if name not in ('', '..')]


def _metadata(folder: Path) -> dict[str, Any]:
    """What metadata.yaml says; nothing where it is missing or unreadable."""
    try:
        content = read_yaml(folder / FILE_NAME, FILE_NAME)
    except UserError:
        return {}
    found = content.get('rosbag2_bagfile_information') if isinstance(content, dict) else None
    return found if isinstance(found, dict) else {}


def missing_counts(path: Path, counts: Mapping[str, int]) -> list[str]:
    """Topics with fewer messages than metadata.yaml says were recorded, one sentence each.

    path : as a user names a recording; of a single file nothing is known
    counts : messages that were found, by topic
    """
    folder = path.parent if path.name == FILE_NAME else path
    told = recorded_counts(folder) if folder.is_dir() else {}
    return [
        f'{topic}: {count - counts.get(topic, 0)} of {count} messages are missing, which were '
        'recorded before the file was cut or damaged'
        for topic, count in told.items()
        if counts.get(topic, 0) < count
    ]


def recorded_counts(folder: Path) -> dict[str, int]:
    """Messages by topic as the metadata.yaml of a folder says; nothing where it does not."""
    listed = _metadata(folder).get('topics_with_message_count')
    counts = {}
    for entry in listed if isinstance(listed, list) else ():
        topic = entry.get('topic_metadata') if isinstance(entry, dict) else None
        name = topic.get('name') if isinstance(topic, dict) else None
        count = entry.get('message_count') if isinstance(entry, dict) else None
        if isinstance(name, str) and isinstance(count, int):
            counts[name] = count
    return counts


def _other(file: Path, contents: _Contents) -> Iterator[tuple[str, Definition, int, bytes]]:
    """Messages of the bag directory of a file of another storage."""
    folder = file.parent
    if not (folder / 'metadata.yaml').is_file():
        raise UserError(
            f'{file}: there is no metadata.yaml beside it, which this kind of recording needs; '
            'make it with `ros2 bag reindex`'
        )
    forms = {MessageDefinitionFormat.MSG: 'ros2msg', MessageDefinitionFormat.IDL: 'ros2idl'}
    try:
        with Reader(folder) as reader:
            definitions = {
                (connection.topic, connection.id): Definition(
                    full_name(connection.msgtype),
                    forms.get(connection.msgdef.format, ''),
                    connection.msgdef.data,
                )
                for connection in reader.connections
            }
            for connection in reader.connections:
                if profiles := connection.ext.offered_qos_profiles:
                    latched = any(q.durability.name == 'TRANSIENT_LOCAL' for q in profiles)
                    contents.latched[connection.topic] = latched
            for connection, log_time, data in reader.messages():
                definition = definitions[connection.topic, connection.id]
                yield connection.topic, definition, log_time, bytes(data)
    except (ReaderError, FileNotFoundError, sqlite3.Error) as error:
        raise UserError(f'{folder}: cannot be read as a recording: {error}') from error
