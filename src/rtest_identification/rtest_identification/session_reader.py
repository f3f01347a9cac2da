"""Typed look-ups in the YAML of a session file."""

from __future__ import annotations

import math
from typing import Any

from rtest_estimation.errors import UserError


class Reader:
    """Typed look-ups in a YAML mapping whose errors name file and key."""

    def __init__(self, where: str, data: dict) -> None:
        self.where, self.data = where, data

    def only(self, known: set[str]) -> None:
        """Refuse keys that are not known."""
        for key in self.data:
            if key not in known:
                raise UserError(
                    f'{self.where}: unknown key {key!r}, expected one of {sorted(known)}'
                )

    def required(self, key: str) -> Any:
        """The value of a key that must be there."""
        if key not in self.data:
            raise UserError(f'{self.where}: {key}: missing')
        return self.data[key]

    def section(self, key: str, known: set[str]) -> Reader:
        """A mapping with known keys, empty where it is not given."""
        value = self.data.get(key, {})
        if not isinstance(value, dict):
            raise UserError(f'{self.where}: {key}: expected a mapping of {sorted(known)}')
        section = Reader(f'{self.where}: {key}', value)
        section.only(known)
        return section

    def number(
        self, key: str, default: float, limits: tuple[float, float] = (0.0, math.inf)
    ) -> float:
        """A finite positive number within limits; the default is what it is."""
        if key not in self.data:
            return default
        value, (lower, upper) = self.data[key], limits
        good = isinstance(value, int | float) and not isinstance(value, bool)
        if not (good and math.isfinite(value) and value > 0.0 and lower <= value <= upper):
            wanted = 'a positive number' if math.isinf(upper) else f'{lower:g} to {upper:g}'
            raise UserError(f'{self.where}: {key}: expected {wanted}, got {value!r}')
        return float(value)

    def integer(self, key: str, default: int, limits: tuple[int, int]) -> int:
        """A whole number within limits."""
        value, (lower, upper) = self.data.get(key, default), limits
        if isinstance(value, bool) or not isinstance(value, int) or not lower <= value <= upper:
            raise UserError(
                f'{self.where}: {key}: expected a whole number from {lower} to {upper}, '
                f'got {value!r}'
            )
        return value

    def real(self, key: str) -> float:
        """A number of either sign."""
        value = self.required(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or value - value != 0:
            raise UserError(f'{self.where}: {key}: expected a number, got {value!r}')
        return float(value)

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        """A list of finite numbers, of `count` where that is given."""
        value = self.required(key)
        good = isinstance(value, list) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)
            for v in value
        )
        if not good or not value or (count and len(value) != count):
            wanted = f'{count} numbers' if count else 'a list of numbers'
            raise UserError(f'{self.where}: {key}: expected {wanted}, got {value!r}')
        return [float(v) for v in value]
