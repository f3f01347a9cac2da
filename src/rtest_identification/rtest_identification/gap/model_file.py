"""A model is data: which errors are free, which effects it has, their values and where from."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from rtest_estimation.errors import UserError
from rtest_estimation.yaml_text import read_yaml
from rtest_identification.gap.catalogue import every_effect
from rtest_identification.gap.effects import Effect
from rtest_identification.machine import Machine
from rtest_identification.symbols import ErrorParameter, location_parameters

_KEYS = {'name', 'machine', 'values', 'effects'}
_EFFECT_KEYS = {'key', 'parameters', 'shape', 'confidence', 'rivals', 'provenance'}


@dataclass(frozen=True)
class Value:
    """A value with its standard uncertainty, SI; stddev None where it is not known."""

    value: float
    stddev: float | None
    unit: str


@dataclass(frozen=True)
class ModelEffect:
    """An effect that a model has.

    parameters : by name, those the effect is linear in; shape : the others
    provenance : session, when and why it was added
    """

    key: str
    parameters: dict[str, Value]
    shape: dict[str, Value] = field(default_factory=dict)
    confidence: float | None = None
    rivals: tuple[str, ...] = ()
    provenance: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Model:
    """Location errors, squareness and effects of a machine.

    machine : name of the machine it was identified on
    values : identified constants by symbol; what is listed is free when the model is used again
    """

    name: str
    machine: str
    values: dict[str, Value] = field(default_factory=dict)
    effects: tuple[ModelEffect, ...] = ()

    def check(self, machine: Machine, more: Sequence[Effect] = ()) -> None:
        """Whether it can be a model of this machine.

        more : effects of the user's own

        Raises UserError naming model, key and what is expected.
        """
        if self.machine and self.machine != machine.name:
            raise UserError(
                f'model {self.name!r} is of machine {self.machine!r}, the recording of '
                f'{machine.name!r}; give the model of this machine'
            )
        self.resolve([*every_effect(machine), *more])

    def free(self, machine: Machine) -> tuple[ErrorParameter, ...]:
        """Location and squareness errors that it frees: those it lists, all where it lists none.

        Raises UserError where it lists one that the machine does not have.
        """
        known = {p.symbol: p for p in location_parameters(machine)}
        for symbol in self.values:
            if symbol not in known:
                raise UserError(
                    f'model {self.name!r}: values: {symbol} is no free error of this machine; '
                    f'it has {", ".join(known)}'
                )
            self._unit(symbol, self.values[symbol], known[symbol].unit)
        return tuple(p for s, p in known.items() if s in self.values or not self.values)

    def resolve(self, library: Sequence[Effect]) -> list[tuple[Effect, tuple[float, ...]]]:
        """The model's effects with their shape, from a library.

        Raises UserError naming key, parameter and what is expected.
        """
        known = {effect.key: effect for effect in library}
        found = []
        for entry in self.effects:
            effect = known.get(entry.key)
            if effect is None:
                near = difflib.get_close_matches(entry.key, known, 3)
                hint = f'; did you mean {", ".join(near)}?' if near else ''
                raise UserError(
                    f'model {self.name!r}: no effect {entry.key!r} for this machine{hint}; '
                    'if it is your own, give it with --effects'
                )
            names = [p.name for p in effect.shape]
            if sorted(entry.shape) != sorted(names):
                raise UserError(
                    f'model {self.name!r}: {entry.key}: shape has {sorted(entry.shape)}, '
                    f'expected {sorted(names)}'
                )
            units = {p.name: p.unit for p in (*effect.parameters, *effect.shape)}
            for name, value in (*entry.parameters.items(), *entry.shape.items()):
                if name not in units:
                    raise UserError(
                        f'model {self.name!r}: {entry.key}: no parameter {name!r}, expected one '
                        f'of {", ".join(units)}'
                    )
                self._unit(f'{entry.key}: {name}', value, units[name])
            found.append((effect, tuple(entry.shape[name].value for name in names)))
        return found

    def _unit(self, where: str, value: Value, unit: str) -> None:
        if value.unit and value.unit != unit:
            raise UserError(
                f'model {self.name!r}: {where}: unit {value.unit!r}, expected {unit!r}; a model '
                'is in SI units'
            )


def load_model(path: Path | str) -> Model:
    """Read a model file.

    Raises UserError naming file, key and what is expected.
    """
    data = read_yaml(path, 'the model')
    if not isinstance(data, dict):
        raise UserError(f'{path}: expected a mapping with name, machine, values and effects')
    _only(data, _KEYS, str(path))
    effects = data.get('effects') or []
    if not isinstance(effects, list):
        raise UserError(f'{path}: effects: expected a list')
    return Model(
        str(data.get('name', Path(path).stem)), str(data.get('machine', '')),
        _values(data.get('values') or {}, f'{path}: values'),
        tuple(_effect(entry, f'{path}: effects[{n}]') for n, entry in enumerate(effects)),
    )


def save_model(model: Model, path: Path) -> None:
    """Write a model file."""
    data: dict[str, Any] = {
        'name': model.name,
        'machine': model.machine,
        'values': {k: _plain(v) for k, v in model.values.items()},
        'effects': [
            {
                'key': e.key,
                'parameters': {k: _plain(v) for k, v in e.parameters.items()},
                **({'shape': {k: _plain(v) for k, v in e.shape.items()}} if e.shape else {}),
                **({'confidence': e.confidence} if e.confidence is not None else {}),
                **({'rivals': list(e.rivals)} if e.rivals else {}),
                **({'provenance': dict(e.provenance)} if e.provenance else {}),
            }
            for e in model.effects
        ],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
    head = '# SI units. Free when used again: the values and the effects.\n'
    path.write_text(head + text, encoding='utf-8')


def _plain(value: Value) -> dict[str, Any]:
    known = value.stddev is not None and math.isfinite(value.stddev)
    return {
        'value': float(value.value),
        **({'stddev': float(value.stddev)} if known else {}),
        'unit': value.unit,
    }


def _effect(entry: Any, where: str) -> ModelEffect:
    if not isinstance(entry, dict) or not isinstance(entry.get('key'), str):
        raise UserError(f'{where}: expected a mapping with a key such as scale/X')
    _only(entry, _EFFECT_KEYS, where)
    provenance = entry.get('provenance') or {}
    if not isinstance(provenance, dict):
        raise UserError(f'{where}: provenance: expected a mapping')
    confidence = entry.get('confidence')
    if confidence is not None and not _number(confidence):
        raise UserError(f'{where}: confidence: expected a number, got {confidence!r}')
    return ModelEffect(
        entry['key'],
        _values(entry.get('parameters') or {}, f'{where}: parameters'),
        _values(entry.get('shape') or {}, f'{where}: shape'),
        confidence, tuple(map(str, entry.get('rivals') or ())),
        {str(k): str(v) for k, v in provenance.items()},
    )


def _values(data: Any, where: str) -> dict[str, Value]:
    if not isinstance(data, dict):
        raise UserError(f'{where}: expected a mapping')
    values = {}
    for name, entry in data.items():
        if not isinstance(entry, dict) or not _number(entry.get('value')):
            raise UserError(f'{where}: {name}: expected {{value: number, stddev, unit}}')
        _only(entry, {'value', 'stddev', 'unit'}, f'{where}: {name}')
        stddev = entry.get('stddev')
        if stddev is not None and not (_number(stddev) and stddev >= 0):
            raise UserError(f'{where}: {name}: stddev: expected a number from 0, got {stddev!r}')
        values[str(name)] = Value(float(entry['value']), stddev, str(entry.get('unit', '')))
    return values


def _number(value: Any) -> bool:
    good = isinstance(value, int | float) and not isinstance(value, bool)
    return good and math.isfinite(value)


def _only(data: dict, known: set[str], where: str) -> None:
    for key in data:
        if key not in known:
            raise UserError(f'{where}: unknown key {key!r}, expected one of {sorted(known)}')
