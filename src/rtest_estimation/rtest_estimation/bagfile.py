"""Finds and reads recordings as they are: closed, killed, cut, damaged, made by others.

Whatever can be read is; the rest is counted and named in `Bag.warnings`. MCAP files are read by
`McapScan`; other storages (sqlite3, files compressed as a whole) are left to rosbags.
"""

from __future__ import annotations

import sqlite3
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError

from rtest_estimation.errors import UserError
from rtest_estimation.mcap_scan import McapScan
from rtest_estimation.message_reader import Definition, full_name, message_reader


@dataclass(frozen=True)
class Bag:
    """What a recording holds, messages still serialised.

    topics : name to (type, number of messages)
    size : of the files [bytes]; start, end : first and last log time [ns], 0 in an empty bag
    closed : whether every file has the index that is written when a recording is closed
    raw : topic to its messages in file order, each with the definition to read it by
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

    def stream(self, topics: Collection[str]) -> Iterator[tuple[str, Definition, int, bytes]]:
        """Topic, definition, log time [ns] and data of every message, in the order of log time.

        Reads the files again, and so needs little memory; all of it where they are not in order.
        """
        found = (m for m in _stored(self.files, _Contents(())) if m[0] in topics)
        return found if self.ordered else iter(sorted(found, key=lambda message: message[2]))

    def messages(self, topic: str) -> Iterator[Any]:
        """Deserialised messages of a topic, in file order; a `DamagedMessage` for a damaged one.

        Raises UserError where the file does not say what the type looks like.
        """
        readers: dict[Definition, Callable[[bytes], Any]] = {}
        for definition, data in self.raw.get(topic, ()):
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
        files = _find_files(path, contents)
        for message in _stored(files, contents):
            contents.add(*message)
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
    )


def _stored(
    files: tuple[Path, ...], contents: _Contents
) -> Iterator[tuple[str, Definition, int, bytes]]:
    """Messages of the files in the order in which they are stored.

    contents : takes what else the files say
    """
    if any(file.suffix in ('.db3', '.zstd') for file in files):
        yield from _other(files[0], contents)
        return
    for file in files:
        scan = McapScan(file)
        yield from scan.messages()
        contents.closed &= scan.closed
        contents.warnings += scan.warnings
        for topic, profiles in scan.offered.items():
            if (latched := _latched(profiles)) is not None:
                contents.latched[topic] = latched


def _latched(profiles: str) -> bool | None:
    """Whether any of the publishers' profiles (YAML) is latched; None where there is none."""
    try:
        # Older versions of rosbag2 wrote numbers.
        found = [profile['durability'] for profile in yaml.safe_load(profiles)]
    except (yaml.YAMLError, KeyError, TypeError):
        return None
    return any(durability in ('transient_local', 1) for durability in found)


def _find_files(path: Path, contents: _Contents) -> tuple[Path, ...]:
    """Files of a recording in order."""
    if path.name == 'metadata.yaml':
        path = path.parent
    if path.is_file():
        return (path,)
    listed = _listed_files(path)
    missing = [name for name in listed if not (path / name).is_file()]
    if missing:
        contents.warnings.append(f'{path}/metadata.yaml names {missing[0]}, which is not there')
    files = [path / name for name in listed if name not in missing]
    # metadata.yaml can be provisional, gone, or of a bag that was renamed.
    files = files or _unlisted_files(path)
    if not files:
        inside = sorted(entry.parent.name for entry in path.glob('*/*.mcap'))
        hint = f'; name one of its recordings: {", ".join(inside[:5])}' if inside else ''
        raise UserError(f'{path}: no recording in this directory{hint}')
    return tuple(files)


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
    try:
        content = yaml.safe_load((folder / 'metadata.yaml').read_text(encoding='utf-8'))
        listed = content['rosbag2_bagfile_information']['relative_file_paths']
        # Older versions wrote the directory too; and nobody's metadata leads out of the bag.
        return [Path(name).name for name in listed]
    except (FileNotFoundError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        return []


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
