"""Typed look-ups in a YAML mapping whose errors name file and key."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from rtest_estimation.errors import UserError

_REQUIRED = object()


def number(value: Any, where: str) -> float:
    """A finite number; raises UserError naming `where`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UserError(f'{where}: expected a number, got {value!r}')
    return float(value)


class Fields:
    """A mapping of a YAML file; `where` is the file and the keys that lead to it.

    Raises UserError when `value` is no mapping. Call `done` when everything was read: what is left
    over is a misspelt key.
    """

    def __init__(self, value: Any, where: str) -> None:
        if not isinstance(value, dict):
            raise UserError(f'{where}: expected a mapping, got {value!r}')
        self.where = where
        self._data = {str(key): item for key, item in value.items()}
        self._known: set[str] = set()

    def __contains__(self, key: str) -> bool:
        self._known.add(key)
        return key in self._data

    def raw(self, key: str, default: Any = _REQUIRED) -> Any:
        """The value as YAML gave it."""
        self._known.add(key)
        if key not in self._data:
            if default is _REQUIRED:
                raise UserError(f'{self.where}: {key}: missing')
            return default
        return self._data[key]

    def number(
        self, key: str, default: Any = _REQUIRED, lower: float = -math.inf, scale: float = 1.0
    ) -> float:
        """A finite number not below `lower`, times `scale`; the default is not scaled."""
        value = self.raw(key, default)
        if value is default:
            return value
        value = number(value, f'{self.where}: {key}')
        if value < lower:
            raise UserError(f'{self.where}: {key}: expected at least {lower:g}, got {value:g}')
        return value * scale

    def integer(self, key: str, default: Any = _REQUIRED, lower: int = 0) -> int:
        """A whole number not below `lower`."""
        value = self.raw(key, default)
        if value is default:
            return value
        if isinstance(value, bool) or not isinstance(value, int) or value < lower:
            raise UserError(
                f'{self.where}: {key}: expected a whole number from {lower} up, got {value!r}'
            )
        return value

    def numbers(self, key: str, count: int, scale: float = 1.0) -> list[float]:
        """A list of `count` finite numbers, each times `scale`."""
        value = self.raw(key)
        if not isinstance(value, list) or len(value) != count:
            raise UserError(f'{self.where}: {key}: expected {count} numbers, got {value!r}')
        return [number(item, f'{self.where}: {key}') * scale for item in value]

    def choice(self, key: str, known: Iterable[str], default: Any = _REQUIRED) -> Any:
        """One of the names in `known`."""
        value = self.raw(key, default)
        known = sorted(known)
        if value is not default and value not in known:
            raise UserError(f'{self.where}: {key}: expected one of {known}, got {value!r}')
        return value

    def section(self, key: str) -> Fields:
        """A mapping inside this one; empty where it is not given."""
        return Fields(self.raw(key, {}), f'{self.where}: {key}')

    def items(self, key: str) -> list[tuple[str, Any]]:
        """Keys and values of a mapping inside this one; none where it is not given."""
        section = self.section(key)
        return list(section._data.items())

    def entries(self, key: str) -> list[Fields]:
        """Mappings in a list; none where it is not given."""
        value = self.raw(key, [])
        return mappings(value, f'{self.where}: {key}')

    def done(self) -> None:
        """Refuse keys that nobody asked for."""
        for key in self._data:
            if key not in self._known:
                raise UserError(
                    f'{self.where}: unknown key {key!r}, expected one of {sorted(self._known)}'
                )


def mappings(value: Any, where: str) -> list[Fields]:
    """A list of mappings; raises UserError naming `where`."""
    if not isinstance(value, list):
        raise UserError(f'{where}: expected a list, got {value!r}')
    return [Fields(item, f'{where}[{index}]') for index, item in enumerate(value)]


def read_yaml(path: Path) -> Fields:
    """The mapping in a YAML file; raises UserError naming the file."""
    try:
        data = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'{path}: cannot read the file: {error}') from None
    except yaml.YAMLError as error:
        raise UserError(f'{path}: not valid YAML: {" ".join(str(error).split())}') from None
    return Fields(data, str(path))
