"""Takes the numbers of many serialised messages at once.

The messages of a driver differ in their numbers and in nothing else: names, and how many elements
every list has, stay the same. Where that holds of a batch, its numbers are read as columns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

# A CDR message begins with how it is encoded: here plain and little-endian (RTPS 2.5, 10.5).
_LITTLE_ENDIAN = b'\0\1'
_HEAD = 4


@dataclass(frozen=True)
class Layout:
    """Where the numbers of a message are.

    template : the message; numbers : name, as ``header.stamp.sec``, to place, type and how many
    fixed : the other parts of the message, which all messages of this layout share
    """

    template: np.ndarray
    numbers: Mapping[str, tuple[int, np.dtype, int]]
    fixed: tuple[slice, ...]

    def columns(self, batch: Sequence[bytes]) -> dict[str, np.ndarray] | None:
        """Name to (messages, elements); None where a message has another layout."""
        size = len(self.template)
        if set(map(len, batch)) != {size}:
            return None
        rows = np.frombuffer(b''.join(batch), np.uint8).reshape(-1, size)
        if any((rows[:, part] != self.template[part]).any() for part in self.fixed):
            return None
        return {
            name: np.ascontiguousarray(rows[:, place : place + count * kind.itemsize]).view(kind)
            for name, (place, kind, count) in self.numbers.items()
        }


def layout_of(types: Mapping[str, Any], name: str, data: bytes) -> Layout | None:
    """Layout of one message that can be deserialised; None where it cannot be told.

    types : field definitions of rosbags by type name; name : of the message's type
    """
    if data[:2] != _LITTLE_ENDIAN:
        return None
    walk = _Walk(types, data)
    try:
        walk.message(name, '')
    except IndexError:
        return None
    if walk.place > len(data):
        return None
    edges = [0]
    for place, kind, count in sorted(walk.numbers.values(), key=lambda number: number[0]):
        edges += [place, place + count * kind.itemsize]
    edges.append(len(data))
    fixed = tuple(
        slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a
    )
    return Layout(np.frombuffer(data, np.uint8), walk.numbers, fixed)


class _Walk:
    """Goes through one message by its definition (XCDR1: aligned to the size of an element)."""

    def __init__(self, types: Mapping[str, Any], data: bytes) -> None:
        self.numbers: dict[str, tuple[int, np.dtype, int]] = {}
        self._types, self._data, self.place = types, data, _HEAD

    def message(self, name: str, prefix: str) -> None:
        for field, (kind, detail) in self._types[name][1]:
            path = f'{prefix}{field}'
            if kind == Nodetype.SEQUENCE:
                self._many(detail[0], self._count(), path)
            elif kind == Nodetype.ARRAY:
                self._many(detail[0], detail[1], path)
            else:
                self._one(kind, detail, path)

    def _one(self, kind: Nodetype, detail: Any, path: str) -> None:
        if kind == Nodetype.NAME:
            self.message(detail, f'{path}.')
        elif detail[0] in ('string', 'wstring'):
            length = self._count()
            self.place += length
        else:
            self._numbers(detail[0], 1, path)

    def _many(self, element: Any, count: int, path: str) -> None:
        kind, detail = element
        if kind == Nodetype.BASE and detail[0] not in ('string', 'wstring'):
            self._numbers(detail[0], count, path)
        else:
            for number in range(count):
                self._one(kind, detail, f'{path}[{number}]')

    def _numbers(self, base: str, count: int, path: str) -> None:
        kind = np.dtype({'byte': 'u1', 'octet': 'u1', 'char': 'u1', 'bool': 'u1'}.get(base, base))
        if count:
            self._align(kind.itemsize)
        self.numbers[path] = (self.place, kind.newbyteorder('<'), count)
        self.place += count * kind.itemsize

    def _count(self) -> int:
        self._align(4)
        self.place += 4
        if self.place > len(self._data):
            raise IndexError('a list or text beyond the end')
        return int.from_bytes(self._data[self.place - 4 : self.place], 'little')

    def _align(self, size: int) -> None:
        self.place += -(self.place - _HEAD) % size
