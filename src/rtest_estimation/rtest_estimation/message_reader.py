"""Deserialises recorded messages by the definitions that the recording carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)

from rtest_estimation.errors import UserError

# What deserialising a damaged message ends with (rosbags wraps most, not all of them).
_DAMAGE = (SerdeError, IndexError, OverflowError, MemoryError, TypeError)


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

    where : begins the sentence of the UserError raised where the type is not defined
    """
    try:
        store = _typestore(definition)
    except (TypesysError, KeyError) as error:
        raise UserError(
            f'{where}: the file does not define {definition.type_name} in a form that can be read '
            f'({error})'
        ) from error
    return partial(_read, store, definition.type_name)


def type_hash(definition: Definition) -> str:
    """ROS 2 type hash (REP 2016) of a definition, ``RIHS01_...``; '' where it cannot be read."""
    try:
        return _typestore(definition).hash_rihs01(definition.type_name)
    except (TypesysError, KeyError):
        return ''


@lru_cache(maxsize=100)
def _typestore(definition: Definition) -> Any:
    """Type store that knows one definition; parsing a text takes longer than reading a bag."""
    store = get_typestore(Stores.EMPTY if definition.text else Stores.ROS2_JAZZY)
    if definition.form == 'ros2msg' and definition.text:
        store.register(get_types_from_msg(definition.text, definition.type_name))
    elif definition.form == 'ros2idl' and definition.text:
        for text in definition.text.split('=' * 80 + '\n'):
            # Each part starts with the line "IDL: package/msg/Type".
            store.register(get_types_from_idl(text.partition('\n')[2] or text))
    store.get_msgdef(definition.type_name)
    return store


def _read(store: Any, name: str, data: bytes) -> Any:
    try:
        return store.deserialize_cdr(data, name)
    except _DAMAGE as error:
        return DamagedMessage(str(error))
