"""Fields of the messages that are read from recordings.

A recording defines its own message types. One made with a later version of a type may have more
fields, or in another order; one of the same name that lacks a field that is read here, or has
something else in it, cannot be used at all, which is to be told before the first message.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rosbags.interfaces import Nodetype

INTEGER, NUMBER, TEXT, NUMBERS, TEXTS = 'an integer', 'a number', 'a text', 'numbers', 'texts'
_HEADER = {'header.stamp.sec': INTEGER, 'header.stamp.nanosec': INTEGER, 'header.frame_id': TEXT}
# What `messages` takes from a message, by its type.
READ: dict[str, dict[str, str]] = {
    'rtest_msgs/msg/GaugeSamples': {
        **_HEADER,
        'sequence': INTEGER,
        'period': NUMBER,
        'channels': INTEGER,
        'displacement': NUMBERS,
        'status': NUMBERS,
    },
    'sensor_msgs/msg/JointState': {**_HEADER, 'name': TEXTS, 'position': NUMBERS},
    'rtest_msgs/msg/CyclePlan': {
        **_HEADER,
        'session': TEXT,
        'cycle': TEXT,
        'kind': INTEGER,
        'setup': TEXT,
        'sphere.x': NUMBER,
        'sphere.y': NUMBER,
        'sphere.z': NUMBER,
        'axes': TEXTS,
        'commands': NUMBERS,
        'dwell': NUMBER,
        'feed': NUMBER,
    },
    'std_msgs/msg/String': {'data': TEXT},
    'sensor_msgs/msg/Temperature': {**_HEADER, 'temperature': NUMBER},
}


def difference(defined: Mapping[str, Any], name: str) -> str:
    """First field of a type that is not as it is read here; '' where all are, or none is read.

    defined : message types as rosbags holds them, ``Typestore.fielddefs``
    name : ``package/msg/Type``
    """
    for path, expected in READ.get(name, {}).items():
        found = _kind(defined, name, path)
        # An integer is a number too.
        if found != expected and (found, expected) != (INTEGER, NUMBER):
            return f'{path} is {found or "missing"}, expected {expected}'
    return ''


def _kind(defined: Mapping[str, Any], name: str, path: str) -> str:
    """What a field holds; '' where there is none."""
    field, _, rest = path.partition('.')
    fields = dict(defined[name][1])
    if field not in fields:
        return ''
    kind, detail = fields[field]
    if rest:
        return _kind(defined, detail, rest) if kind == Nodetype.NAME else ''
    if kind == Nodetype.BASE:
        return _base(detail[0])
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and detail[0][0] == Nodetype.BASE:
        return TEXTS if _base(detail[0][1][0]) == TEXT else NUMBERS
    return 'a message' if kind == Nodetype.NAME else 'messages'


def _base(base: str) -> str:
    if base == 'string':
        return TEXT
    return NUMBER if base.startswith('float') else INTEGER
