"""Device files of the CNC driver (YAML): the file whose path is the parameter `address`."""

from __future__ import annotations

from typing import Any

from rtest_drivers.cnc.axes import LENGTHS, UNITS, AxisSource
from rtest_estimation.dwell import ROTARY_LETTERS
from rtest_estimation.errors import UserError
from rtest_estimation.yaml_text import read_yaml
from rtest_identification.session_reader import Reader


class DeviceReader(Reader):
    """Typed look-ups in a device file whose errors name file and key."""

    def text(self, key: str, default: str | None = None) -> str:
        """A text that is not empty; a default of None makes it required."""
        value = self.required(key) if default is None else self.data.get(key, default)
        if not isinstance(value, str) or (not value and default is None):
            raise UserError(f'{self.where}: {key}: expected a text, got {value!r}')
        return value

    def choice(self, key: str, options: tuple[str, ...]) -> str:
        """One of the options, the first where it is not given."""
        value = self.data.get(key, options[0])
        if value not in options:
            raise UserError(
                f'{self.where}: {key}: expected one of {list(options)}, got {value!r}'
            )
        return value

    def axes(self, key: str, kind: type) -> tuple[AxisSource, ...]:
        """The mapping `axes`: letter to {`key`: where from, unit: ..., sign: 1 or -1}.

        kind : of the value of `key`, int or str
        """
        data = self.required('axes')
        if not isinstance(data, dict) or not data:
            raise UserError(
                f'{self.where}: axes: expected a mapping of axis letters to {{{key}, unit, sign}}'
            )
        axes = tuple(self._axis(name, spec, key, kind) for name, spec in data.items())
        for axis in axes:
            twins = [other.name for other in axes if other.source == axis.source]
            if len(twins) > 1:
                raise UserError(
                    f'{self.where}: axes: {" and ".join(twins)}: the same {key} {axis.source!r}'
                )
        return axes

    def _axis(self, name: Any, spec: Any, key: str, kind: type) -> AxisSource:
        where = f'{self.where}: axes: {name}'
        if not (isinstance(name, str) and len(name) == 1 and name.isupper()):
            raise UserError(f'{where}: expected a capital letter as name of an axis')
        if not isinstance(spec, dict):
            raise UserError(f'{where}: expected a mapping of {key}, unit and sign')
        axis = DeviceReader(where, spec)
        axis.only({key, 'unit', 'sign'})
        axis.required(key)
        source: str | int = axis.integer(key, -1, (0, 99)) if kind is int else axis.text(key)
        unit = axis.text('unit')
        if unit not in UNITS:
            raise UserError(f'{where}: unit: expected one of {sorted(UNITS)}, got {unit!r}')
        if (name in ROTARY_LETTERS) == (unit in LENGTHS):
            turns = 'rotary' if name in ROTARY_LETTERS else 'linear'
            raise UserError(f'{where}: unit: {unit} is no unit of the {turns} axis {name}')
        sign = spec.get('sign', 1)
        if type(sign) is not int or sign not in (1, -1):
            raise UserError(f'{where}: sign: expected 1 or -1, got {sign!r}')
        return AxisSource(name, source, unit, sign)


def load(path: str, known: set[str]) -> DeviceReader:
    """Read a device file and refuse keys that are not known.

    Raises UserError naming file, key and what is expected.
    """
    data = read_yaml(path, 'the device file')
    if not isinstance(data, dict):
        raise UserError(f'{path}: expected a mapping of {sorted(known)}')
    reader = DeviceReader(path, data)
    reader.only(known)
    return reader
