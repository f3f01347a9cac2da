"""Deserialises recorded messages by the definitions that the recording carries.

rosbags makes Python code of a definition. What a stranger's definition could do with that (arrays
that make endless code or endless empty messages, types made of themselves) is refused before.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)

from rtest_estimation.errors import UserError
from rtest_estimation.fields import difference

# What deserialising a damaged message ends with (rosbags wraps most, not all of them).
_DAMAGE = (SerdeError, IndexError, OverflowError, MemoryError, TypeError)
# Characters; the definition of a message of readings has a few thousand.
MAX_DEFINITION = 64 * 1024
# Every element of a fixed array becomes lines of code; of all in a definition together.
MAX_ARRAYS = 10_000
_TYPE_NAME = re.compile(r'[A-Za-z]\w*(/(msg|srv|action))?/[A-Za-z]\w*', re.ASCII)


@dataclass(frozen=True)
class Definition:
    """Text of a message type as the file carries it; `form` is ``ros2msg`` or ``ros2idl``."""

    type_name: str
    form: str
    text: str


@dataclass(frozen=True)
class DamagedMessage:
    """Stands for a message that cannot be deserialised."""

    reason: str


def full_name(name: str) -> str:
    """``package/Type`` to ``package/msg/Type``; other names as they are."""
    package, _, rest = name.partition('/')
    return name if '/' in rest or not rest else f'{package}/msg/{rest}'


def message_reader(definition: Definition, where: str) -> Callable[[bytes], Any]:
    """Function from serialised (CDR) to message, or to `DamagedMessage`.

    A file without definitions is read by those of ROS 2 Jazzy, for the common types.

    where : begins the sentence of the UserError raised where the type is not defined, and where
        fields are missing that this package reads
    """
    name = definition.type_name
    try:
        store = _typestore(definition)
    except (TypesysError, KeyError, ValueError, RecursionError) as error:
        reason = ' '.join(str(error).split())[:200]
        raise UserError(
            f'{where}: the file does not define {name} in a form that can be read ({reason})'
        ) from error
    if wrong := difference(store.fielddefs, name):
        raise UserError(f'{where}: {name} is defined in another way: {wrong}')
    return partial(_read, store, name)


def type_hash(definition: Definition) -> str:
    """ROS 2 type hash (REP 2016) of a definition, ``RIHS01_...``; '' where it cannot be read."""
    try:
        return _typestore(definition).hash_rihs01(definition.type_name)
    except (TypesysError, KeyError, ValueError, RecursionError):
        return ''


def field_definitions(definition: Definition) -> Mapping[str, Any]:
    """Fields of a type, for which there is a `message_reader`, and of its parts (rosbags)."""
    return _typestore(definition).fielddefs


@lru_cache(maxsize=100)
def _typestore(definition: Definition) -> Any:
    """Type store that knows one definition; parsing a text takes longer than reading a bag."""
    if not _TYPE_NAME.fullmatch(definition.type_name):
        raise TypesysError('not the name of a message type')
    if len(definition.text) > MAX_DEFINITION:
        raise TypesysError(f'{len(definition.text)} characters')
    store = get_typestore(Stores.EMPTY if definition.text else Stores.ROS2_JAZZY)
    for types in _parsed(definition):
        _check(types)
        store.register(types)
    _check_parts(store.fielddefs, definition.type_name, (), set())
    store.get_msgdef(definition.type_name)
    return store


def _parsed(definition: Definition) -> list[Mapping[str, Any]]:
    if definition.form == 'ros2msg' and definition.text:
        return [get_types_from_msg(definition.text, definition.type_name)]
    if definition.form == 'ros2idl' and definition.text:
        # Each part starts with the line "IDL: package/msg/Type".
        parts = definition.text.split('=' * 80 + '\n')
        return [get_types_from_idl(text.partition('\n')[2] or text) for text in parts]
    return []


def _check(types: Mapping[str, Any]) -> None:
    """Refuse fixed arrays of lengths that no message has; raises TypesysError."""
    total = 0
    for name, (_, fields) in types.items():
        for field, (kind, detail) in fields:
            if kind == Nodetype.ARRAY:
                total += detail[1]
                # Of empty ones any number fits into no data at all.
                if not detail[1] or total > MAX_ARRAYS:
                    raise TypesysError(f'{name}.{field} has {detail[1]} elements')


def _check_parts(
    defined: Mapping[str, Any], name: str, within: tuple[str, ...], done: set[str]
) -> None:
    """Refuse a type that is made of itself; raises TypesysError, KeyError where a part lacks."""
    if name in within:
        raise TypesysError(f'{name} is made of itself')
    if name in done:
        return
    for _, (kind, detail) in defined[name][1]:
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            kind, detail = detail[0]
        if kind == Nodetype.NAME:
            _check_parts(defined, detail, (*within, name), done)
    done.add(name)


def _read(store: Any, name: str, data: bytes) -> Any:
    try:
        return store.deserialize_cdr(data, name)
    except _DAMAGE as error:
        return DamagedMessage(str(error))
