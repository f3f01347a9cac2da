"""The tolerance file: limits of errors by symbol or group (YAML), for any machine."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtest_estimation.errors import UserError
from rtest_estimation.yaml_text import read_yaml
from rtest_identification.machine import Machine
from rtest_identification.symbols import ErrorParameter, location_parameters, map_parameters

# Suffix of a key, and what it is in SI.
UNITS = {'um': 1e-6, 'urad': 1e-6, 'arcsec': math.radians(1.0 / 3600.0)}
CONSTANT_GROUPS = ('location_errors', 'squareness')
MAP_GROUP = 'maps'
RESIDUAL, VOLUMETRIC = 'residual', 'volumetric'
COVERAGE = 'coverage_factor'
VALUE, PEAK, LARGEST = 'value', 'peak-to-peak', 'largest'
_QUANTITY = {'limit': VALUE, 'lower': VALUE, 'upper': VALUE, 'peak_to_peak': PEAK, 'max': LARGEST}


@dataclass(frozen=True)
class Limits:
    """Tolerance of one quantity: of a constant error, or of a map over its range.

    quantity : VALUE, PEAK (largest minus smallest) or LARGEST (of the absolute values)
    lower, upper : [m] or [rad]; infinite where there is none
    unit : suffix in the file, in which it is shown
    coverage_factor : k of the expanded uncertainty U = k u
    """

    quantity: str
    lower: float
    upper: float
    unit: str
    coverage_factor: float

    @property
    def angular(self) -> bool:
        """Whether it is for angles."""
        return self.unit != 'um'


@dataclass(frozen=True)
class Tolerances:
    """A tolerance file: key (symbol, group, residual or volumetric) to its limits."""

    path: str
    entries: dict[str, tuple[Limits, ...]]

    def of_constant(self, parameter: ErrorParameter, group: str) -> tuple[Limits, ...]:
        """Limits of a location error or squareness; its own, else those of its group."""
        return self._of(parameter, (parameter.symbol, group))

    def of_map(self, parameter: ErrorParameter) -> tuple[Limits, ...]:
        """Limits of a position-dependent error; its own, its axis's (maps_B), else all maps'."""
        keys = (parameter.symbol, f'{MAP_GROUP}_{parameter.axis}', MAP_GROUP)
        return self._of(parameter, keys)

    def _of(self, parameter: ErrorParameter, keys: Sequence[str]) -> tuple[Limits, ...]:
        for key in keys:
            found = tuple(
                limits for limits in self.entries.get(key, ())
                if limits.angular is parameter.angular
            )
            if found:
                return found
        return ()

    def check(self, machine: Machine) -> None:
        """Whether every limit can be of an error of this machine.

        Raises UserError naming file, key and what is expected, or the nearest symbols.
        """
        constants = location_parameters(machine)
        maps = [p for axis in machine.rotary for p in map_parameters(machine, axis)]
        turning, square = CONSTANT_GROUPS
        groups = {
            turning: [p for p in constants if p.axis in machine.rotary],
            square: [p for p in constants if p.axis not in machine.rotary],
            MAP_GROUP: maps,
        }
        groups |= {f'{MAP_GROUP}_{n}': [p for p in maps if p.axis == n] for n in machine.rotary}
        symbols = {p.symbol: [p] for p in (*constants, *maps)}
        varying = {p.symbol for p in maps}
        known = {**symbols, **groups}
        for key, entry in self.entries.items():
            where = f'{self.path}: {key}'
            if key in (RESIDUAL, VOLUMETRIC):
                continue
            if key not in known:
                names = [*known, RESIDUAL, VOLUMETRIC]
                near = difflib.get_close_matches(key, names, n=3, cutoff=0.0)
                raise UserError(
                    f'{where}: this machine has no such error or group; nearest: '
                    f'{", ".join(near)}'
                )
            for limits in entry:
                if all(p.angular is not limits.angular for p in known[key]):
                    kind, unit = ('angles', '_um') if limits.angular else (
                        'lengths', '_urad or _arcsec'
                    )
                    raise UserError(
                        f'{where}: _{limits.unit} is for {kind}; expected a limit in {unit}'
                    )
                if key in symbols and (limits.quantity == VALUE) is (key in varying):
                    raise UserError(f'{where}: expected {_expected(key in varying)}')


def load_tolerances(path: Path | str) -> Tolerances:
    """Read a tolerance file; the machine's symbols are checked by `Tolerances.check`.

    Raises UserError naming file, key and what is expected.
    """
    data = read_yaml(path, 'the tolerance file')
    if not isinstance(data, dict):
        raise UserError(f'{path}: expected a mapping of symbols and groups to limits')
    factor = _factor(data.pop(COVERAGE, 2.0), str(path))
    if not data:
        raise UserError(f'{path}: no limits in it')
    return Tolerances(
        str(path), {str(key): _entry(str(key), spec, factor, path) for key, spec in data.items()}
    )


def _entry(key: str, spec: Any, factor: float, path: Path | str) -> tuple[Limits, ...]:
    where = f'{path}: {key}'
    if not isinstance(spec, dict):
        raise UserError(f'{where}: expected a mapping of limits, for example {{limit_um: 5}}')
    spec = dict(spec)
    factor = _factor(spec.pop(COVERAGE, factor), where)
    kinds: dict[str, dict[str, float]] = {}
    for name, value in spec.items():
        kind, _, unit = str(name).rpartition('_')
        if kind not in _QUANTITY or unit not in UNITS:
            raise UserError(
                f'{where}: unknown key {name!r}, expected limit, lower, upper, peak_to_peak or '
                f'max, each with _um, _urad or _arcsec'
            )
        if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
            raise UserError(f'{where}: {name}: expected a number, got {value!r}')
        if kind not in ('lower', 'upper') and not value > 0:
            raise UserError(f'{where}: {name}: expected a number above 0, got {value!r}')
        kinds.setdefault(unit, {})[kind] = value
    if 'urad' in kinds and 'arcsec' in kinds:
        raise UserError(f'{where}: has limits in _urad and in _arcsec; give one of them')
    found = [
        limits for unit, given in kinds.items() for limits in _limits(where, unit, given, factor)
    ]
    quantities = {limits.quantity for limits in found}
    if not found:
        raise UserError(f'{where}: no limit in it')
    if key in (RESIDUAL, VOLUMETRIC):
        if set(kinds) != {'um'} or quantities != {LARGEST}:
            raise UserError(f'{where}: expected the one limit max_um')
    elif key in CONSTANT_GROUPS and quantities != {VALUE}:
        raise UserError(f'{where}: expected {_expected(False)}')
    elif key.startswith(MAP_GROUP) and VALUE in quantities:
        raise UserError(f'{where}: expected {_expected(True)}')
    return tuple(found)


def _limits(where: str, unit: str, given: dict[str, float], factor: float) -> list[Limits]:
    scale = UNITS[unit]
    found = []
    if 'limit' in given and ('lower' in given or 'upper' in given):
        raise UserError(f'{where}: has limit_{unit} and lower or upper; give one kind')
    lower, upper = given.get('lower', -math.inf), given.get('upper', math.inf)
    if 'limit' in given:
        lower, upper = -given['limit'], given['limit']
    if not lower < upper:
        raise UserError(f'{where}: lower_{unit} {lower} is not below upper_{unit} {upper}')
    if lower > -math.inf or upper < math.inf:
        found.append(Limits(VALUE, lower * scale, upper * scale, unit, factor))
    for kind in ('peak_to_peak', 'max'):
        if kind in given:
            found.append(Limits(_QUANTITY[kind], -math.inf, given[kind] * scale, unit, factor))
    return found


def _expected(varying: bool) -> str:
    if varying:
        return 'peak_to_peak_ or max_ over the range, as it changes with position'
    return 'limit_ (either way), lower_ or upper_, as it is a constant'


def _factor(value: Any, where: str) -> float:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (number and math.isfinite(value) and value > 0):
        raise UserError(f'{where}: {COVERAGE}: expected a number above 0, got {value!r}')
    return float(value)
