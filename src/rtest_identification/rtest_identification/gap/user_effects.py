"""Effects of the user's own, as data: a formula for each error motion, with units (YAML)."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.gap.confusions import INVISIBLE
from rtest_identification.gap.effects import Effect, Parameter
from rtest_identification.gap.formula import (
    CONSTANTS,
    FUNCTIONS,
    SIGN,
    TEMPERATURE,
    Formula,
    parse_formula,
    shown,
)
from rtest_identification.gap.plain_yaml import read_plain
from rtest_identification.gap.scene import Scene
from rtest_identification.gap.units import EXPECTED, to_si
from rtest_identification.machine import Machine
from rtest_identification.symbols import symbol

# Families of the project's own vocabulary.
RESERVED = frozenset((
    'location', 'angular-scale', 'angular-two-slope', 'angular-cyclic', 'torque-twist', 'sag',
    'radial', 'axial', 'coning', 'runout-grows', 'coning-grows', 'line-shift-grows',
    'line-tilt-grows', 'backlash', 'scale', 'straightness', 'angle', 'linear-cyclic', 'drift',
    'drift-temperature', 'nest-slip', 'gauge-gain', 'gauge-direction', 'tool-runout',
    'laser-incidence', 'servo-mismatch', 'clock-offset', 'friction-lag', 'radius-shrink',
    'reversal-spike',
))
MAX_EFFECTS, MAX_PARAMETERS, MAX_SHAPE, MAX_GRID, MAX_GAUGES = 50, 12, 2, 40, 12
# Of all effects of a file over their grids: every one takes its time in every search.
MAX_COLUMNS = 600
# Random rows, within these limits, on which a formula must change with each of its parameters:
# positions [m] or [rad], powers of ten of times [s], temperatures [deg C], readings [m].
_ROWS, _FAR, _TIMES, _WARM, _READING = 2000, 10.0, (-1.0, 5.0), (0.0, 50.0), 1e-5
# By this part of its range a shape may lie beyond its grid; the ends are taken for it there.
_BEYOND = 0.05
_KEY = re.compile(r'([A-Za-z0-9][A-Za-z0-9_.-]{0,39})(/[A-Za-z0-9][A-Za-z0-9_.-]{0,39})?')
_NAME = re.compile(r'[A-Za-z][A-Za-z0-9_]{0,29}')
_GAUGE = re.compile(r'd[0-9]+')
_SYMBOL = re.compile(r'E_([XYZABC])(?:\((\w+)\))?(\w+)')

# Sensor to its record: stamps [ns] in order, temperatures [deg C].
Temperatures = Mapping[str, tuple[np.ndarray, np.ndarray]]


def load_effects(
    path: Path | str, machine: Machine, temperatures: Temperatures | None = None
) -> list[Effect]:
    """Read effects from a file; see config/effects_example.yaml.

    temperatures : of the session, by sensor

    Raises UserError naming file, effect, formula and what is expected.
    """
    data = _mapping(read_plain(path), str(path), {'effects'})
    specs = data.get('effects')
    if not isinstance(specs, list) or not 0 < len(specs) <= MAX_EFFECTS:
        raise UserError(f'{path}: effects: expected a list of 1 to {MAX_EFFECTS} effects')
    effects: dict[str, Effect] = {}
    for number, spec in enumerate(specs):
        effect = _effect(spec, f'{path}: effects[{number}]', str(path), machine, temperatures)
        if effect.key in effects:
            raise UserError(f'{path}: {effect.key}: there are two effects of this key')
        effects[effect.key] = effect
    count = sum(len(e.parameters) * len(e.grid) for e in effects.values())
    if count > MAX_COLUMNS:
        raise UserError(
            f'{path}: {count} parameters over all values of grid, expected {MAX_COLUMNS} at most; '
            'give shorter grids'
        )
    return list(effects.values())


def of_positions(effect: Effect) -> bool:
    """Whether an effect of the user's own is error motions that hang on positions alone."""
    own = {*(p.name for p in effect.parameters), *(p.name for p in effect.shape)}
    return all(
        axis and not any(_elsewhere(name) for name in formula.names - own)
        for axis, _, formula in effect.columns.terms
    )


def _elsewhere(name: str) -> bool:
    """Whether a formula's name is time, a direction of motion, a temperature or a reading."""
    return name == 't' or '(' in name or '.' in name or bool(_GAUGE.fullmatch(name))


@dataclass(frozen=True)
class _Columns:
    """The columns of an effect: its formulas over a scene.

    terms : axis, letter and formula of an error motion; an empty axis for the table frame
    shape : name, lowest and highest value
    where : file and effect, for errors
    """

    terms: tuple[tuple[str, str, Formula], ...]
    parameters: tuple[str, ...]
    shape: tuple[tuple[str, float, float], ...]
    temperatures: Temperatures
    where: str

    def __call__(self, scene: Scene, shape: tuple[float, ...]) -> np.ndarray:
        """(n, 3, p) displacement per parameter, frame ``table``."""
        values: dict[str, np.ndarray | float] = {}
        for (name, low, high), value in zip(self.shape, shape, strict=True):
            if not low - _BEYOND * (high - low) <= value <= high + _BEYOND * (high - low):
                raise UserError(
                    f'{self.where}: {name} = {value:.6g}: expected a value within its grid, '
                    f'{low:.6g} to {high:.6g} (SI units)'
                )
            # Refinement looks a little beyond the ends, where the formula may mean nothing.
            values[name] = min(max(value, low), high)
        columns = np.zeros((*scene.jacobian.shape[:2], len(self.parameters)))
        for axis, letter, formula in self.terms:
            for name in formula.names.difference(values, self.parameters):
                values[name] = self._variable(scene, name, formula.where)
            slope = scene.slope(axis, letter) if axis else np.eye(3)['XYZ'.index(letter)][None]
            for k, name in enumerate(self.parameters):
                if name in formula.names:
                    factor = formula.coefficient(name, self.parameters, values)
                    columns[:, :, k] += slope * factor[:, None]
        return columns

    def _variable(self, scene: Scene, name: str, where: str) -> np.ndarray:
        """(n,) of what a name stands for."""
        if name in scene.machine.axes:
            return scene.position(name)
        if name == 't':
            return scene.time
        if name.startswith(f'{SIGN}('):
            return scene.direction(name[len(SIGN) + 1 : -1])
        if name.startswith(f'{TEMPERATURE}.'):
            stamps, values = self.temperatures[name[len(TEMPERATURE) + 1 :]]
            return np.interp(scene.observations.stamp, stamps, values)
        gauge = int(name[1:]) - 1
        if gauge >= scene.gauges:
            have = f'has {scene.gauges} gauges' if scene.gauges else 'is not calibrated everywhere'
            raise UserError(f'{where}: {name}: the nest of this session {have}')
        reading = np.empty(len(scene.observations))
        for number, setup in enumerate(scene.observations.setups):
            at = scene.observations.cycle == number
            reading[at] = scene.fitted[at] @ scene.directions[setup][gauge]
        return reading


def _effect(
    spec: Any, where: str, path: str, machine: Machine, temperatures: Temperatures | None
) -> Effect:
    spec = _mapping(spec, where, {'key', 'name', 'motions', 'table', 'parameters', 'shape'})
    key = spec.get('key')
    match = _KEY.fullmatch(key) if isinstance(key, str) else None
    if match is None:
        raise UserError(f'{where}: key: expected family/axis in letters, for example my-bearing/C')
    where = f'{path}: {key}'
    if match[1] in RESERVED or key == INVISIBLE:
        raise UserError(f'{where}: the library has a family {match[1]}; expected another name')
    name = spec.get('name', key)
    if not (isinstance(name, str) and name.isprintable() and 0 < len(name) <= 80):
        raise UserError(f'{where}: name: expected up to 80 printable characters')
    taken = {*machine.axes, *FUNCTIONS, *CONSTANTS, SIGN, TEMPERATURE, 't'}
    parameters = [
        Parameter(one, _unit(_mapping(about, at, {'unit'}), at)[1])
        for one, about, at in _named(spec, 'parameters', where, taken, MAX_PARAMETERS)
    ]
    if not parameters:
        raise UserError(f'{where}: parameters: expected at least one, for example p: {{unit: um}}')
    taken |= {p.name for p in parameters}
    shape, grids = [], []
    for one, about, at in _named(spec, 'shape', where, taken, MAX_SHAPE):
        about = _mapping(about, at, {'unit', 'grid'})
        scale, unit = _unit(about, at)
        shape.append(Parameter(one, unit))
        grids.append(tuple(scale * v for v in _grid(about.get('grid'), at)))
    linear = tuple(p.name for p in parameters)
    known = {*machine.axes, *(f'{SIGN}({axis})' for axis in machine.axes), 't'}
    known |= {f'd{k + 1}' for k in range(MAX_GAUGES)} | {p.name for p in shape}
    known |= {f'{TEMPERATURE}.{sensor}' for sensor in temperatures or {}}
    terms: dict[str, tuple[str, str, Formula]] = {}
    for text, formula in _mapping(spec.get('motions', {}), f'{where}: motions').items():
        axis, letter = _motion(text, f'{where}: motions', machine)
        if f'E_{letter}{axis}' in terms:
            raise UserError(f'{where}: motions: {text}: there are two formulas for this error')
        checked = parse_formula(formula, f'{where}: {text}', linear, known)
        terms[f'E_{letter}{axis}'] = axis, letter, checked
    for letter, formula in _mapping(spec.get('table', {}), f'{where}: table', set('XYZ')).items():
        checked = parse_formula(formula, f'{where}: table {letter}', linear, known)
        terms[letter] = '', letter, checked
    if not terms:
        raise UserError(f'{where}: expected formulas under motions or table')
    used = frozenset().union(*(formula.names for *_, formula in terms.values()))
    unused = [one for one in (*linear, *(p.name for p in shape)) if one not in used]
    if unused:
        raise UserError(f'{where}: {", ".join(unused)}: in no formula; expected a use or no entry')
    drawn = _drawn(used, machine, dict(zip((p.name for p in shape), grids, strict=True)))
    idle = [
        one for one in linear
        if not any(formula.changes_with(one, linear, drawn) for *_, formula in terms.values())
    ]
    if idle:
        raise UserError(
            f'{where}: {", ".join(idle)}: its factor in the formulas is always 0; expected '
            'formulas that change with it or no entry'
        )
    columns = _Columns(
        tuple(terms.values()), linear,
        tuple((p.name, min(g), max(g)) for p, g in zip(shape, grids, strict=True)),
        dict(temperatures or {}), where,
    )
    return Effect(
        key, name, '; '.join(f'{error} = {term[2].text}' for error, term in terms.items()),
        tuple(error for error, term in terms.items() if term[0]), tuple(parameters), columns,
        tuple(shape), tuple(itertools.product(*grids)),
    )


def _drawn(
    names: Iterable[str], machine: Machine, grids: Mapping[str, Sequence[float]]
) -> dict[str, np.ndarray]:
    """Random values of what formulas read besides their parameters."""
    rng = np.random.default_rng(0)
    values = {}
    for name in sorted(names):
        if name in grids:
            values[name] = rng.choice(grids[name], _ROWS)
        elif name in machine.axes:
            axis = machine.axes[name]
            values[name] = rng.uniform(max(axis.lower, -_FAR), min(axis.upper, _FAR), _ROWS)
        elif name.startswith(f'{SIGN}('):
            values[name] = rng.choice([-1.0, 0.0, 1.0], _ROWS)
        elif name == 't':
            values[name] = 10.0 ** rng.uniform(*_TIMES, _ROWS)
        elif name.startswith(f'{TEMPERATURE}.'):
            values[name] = rng.uniform(*_WARM, _ROWS)
        elif _GAUGE.fullmatch(name):
            values[name] = _READING * rng.standard_normal(_ROWS)
    return values


def _mapping(data: Any, where: str, known: set[str] | None = None) -> dict[str, Any]:
    if not isinstance(data, dict):
        wanted = f' with {", ".join(sorted(known))}' if known else ''
        raise UserError(f'{where}: expected a mapping{wanted}')
    for key in data:
        if known is not None and key not in known:
            raise UserError(
                f'{where}: unknown key {shown(key)}, expected one of {", ".join(sorted(known))}'
            )
    return data


def _named(
    spec: dict, part: str, where: str, taken: set[str], most: int
) -> Iterable[tuple[str, Any, str]]:
    """Name, description and place of each entry of parameters or shape."""
    entries = _mapping(spec.get(part, {}), f'{where}: {part}')
    if len(entries) > most:
        raise UserError(f'{where}: {part}: {len(entries)} entries, expected {most} at most')
    for name, about in entries.items():
        if not _NAME.fullmatch(name) or name in taken or _GAUGE.fullmatch(name):
            raise UserError(
                f'{where}: {part}: {shown(name)}: expected a name of ASCII letters and digits '
                'that is no axis, function, gauge reading (d1) or other name of formulas'
            )
        yield name, about, f'{where}: {part}: {name}'


def _unit(about: dict, where: str) -> tuple[float, str]:
    """Size in SI and the SI unit."""
    text = about.get('unit')
    found = to_si(text) if isinstance(text, str) else None
    if found is None:
        raise UserError(f'{where}: unit: expected {EXPECTED}')
    return found


def _grid(data: Any, where: str) -> list[float]:
    try:
        grid = sorted({float(text) for text in data}) if isinstance(data, list) else []
    except (TypeError, ValueError):
        grid = []
    if not 2 <= len(grid) <= MAX_GRID or not all(abs(v) <= 1e12 for v in grid):
        raise UserError(f'{where}: grid: expected a list of 2 to {MAX_GRID} different numbers')
    return grid


def _motion(text: str, where: str, machine: Machine) -> tuple[str, str]:
    """Axis and letter of an error motion, E_X(B)C or E_XC."""
    match = _SYMBOL.fullmatch(text)
    letter, frame, axis = match.groups() if match else ('', None, '')
    if axis not in machine.axes:
        raise UserError(
            f'{where}: {shown(text)}: expected an error motion as E_{{letter of X Y Z A B C}}'
            f'{{axis of {" ".join(machine.letters)}}}, for example '
            f'{symbol(machine, machine.letters[-1], "X", False)} or E_X{machine.letters[-1]}'
        )
    right = symbol(machine, axis, letter, constant=False)
    if frame is not None and text != right:
        raise UserError(f'{where}: {shown(text)}: on this machine expected {right}')
    return axis, letter
