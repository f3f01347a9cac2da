"""Geometric errors of the simulated machine as functions of its axes' positions.

The truth file gives, by symbol, the constants (location and squareness
errors, Table 2-3) and the position-dependent errors (Table 2-4) as sums of terms:

    location_errors_um: {E_X(0Y)B: -7.8}
    location_errors_urad: {E_A(0Y)B: 18.0}
    squareness_urad: {E_C(0Y)X: 14.0}
    position_dependent:
      E_X(B)C:
        - {constant_um: 0.1}
        - {harmonic: 2, cos_um: 0.3, sin_um: -0.1, times: {abs: B}}
        - {power: 1, of: B, at_90deg_um: 0.4}

A term is a constant, a harmonic of an axis's angle, or a power of an axis's position (its size
given at 90 deg or at 100 mm); `of` names the axis, by default the one the error belongs to.
`times` multiplies it by |q| / 90 deg (or 100 mm), cos n q or sin n q of another axis. Units: um,
urad, arcsec.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from rtest_drivers.sim.fields import Fields, mappings, number
from rtest_estimation.errors import UserError
from rtest_identification.machine import Axis, Machine

# The order in which an axis's six errors act (Eqs. 2-13, 2-14) and in which they are stored.
COMPONENTS = 'ABCXYZ'
UNITS = {'um': 1e-6, 'urad': 1e-6, 'arcsec': math.pi / 648000.0}
_LENGTH, _ANGLE = ('um',), ('urad', 'arcsec')
# E_X(0Y)B is a location error, E_X(Y)B (or E_XB) depends on the position.
_SYMBOL = re.compile(r'E_([XYZABC])(?:\((0?)([A-Z])\))?([A-Z])')
_FULL = {True: ('90deg', math.pi / 2), False: ('100mm', 0.1)}


@dataclass(frozen=True)
class Symbol:
    """An error's name, taken apart.

    component : X Y Z A B C, the direction; axis : the moving axis; location : constant or not
    """

    text: str
    component: str
    axis: str
    location: bool

    @property
    def column(self) -> int:
        """Index in the order A B C X Y Z."""
        return COMPONENTS.index(self.component)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit suffixes that fit the component."""
        return _LENGTH if self.component in 'XYZ' else _ANGLE


@dataclass(frozen=True)
class Factor:
    """cos n q, sin n q or |q| / `full` of one axis."""

    shape: str
    axis: str
    order: int = 1
    full: float = 1.0

    def __call__(self, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """Values at the positions, the same shape."""
        q = positions[self.axis]
        if self.shape == 'abs':
            return np.abs(q) / self.full
        return np.cos(self.order * q) if self.shape == 'cos' else np.sin(self.order * q)


@dataclass(frozen=True)
class Term:
    """One term: cosine cos n q + sine sin n q, or cosine (q / full)^n; [m] or [rad].

    A constant is the power 0.
    """

    shape: str
    axis: str
    order: int
    cosine: float
    sine: float = 0.0
    full: float = 1.0
    times: Factor | None = None

    def __call__(self, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """Values at the positions [m] or [rad], the same shape."""
        q = positions[self.axis]
        if self.shape == 'power':
            value = self.cosine * (q / self.full) ** self.order
        else:
            value = self.cosine * np.cos(self.order * q) + self.sine * np.sin(self.order * q)
        return value if self.times is None else value * self.times(positions)


class Motions(Protocol):
    """Error motions from elsewhere."""

    @property
    def axes(self) -> set[str]:
        """Axes that have any."""

    def of_axis(self, axis: str, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, 6) errors A B C X Y Z of one axis [rad] and [m]."""


@dataclass(frozen=True)
class GeometricErrors:
    """All geometric errors of a machine.

    constants : location and squareness errors by symbol [m] or [rad]
    terms : position-dependent errors by symbol
    model : further error motions, of a model file
    """

    constants: dict[str, float]
    terms: dict[str, tuple[Term, ...]]
    model: Motions | None = None

    @property
    def axes(self) -> frozenset[str]:
        """Axes that have any error."""
        more = self.model.axes if self.model else set()
        return frozenset(split(text).axis for text in (*self.constants, *self.terms)) | more

    def dependent(self, symbol: str, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """A position-dependent error alone, without the constant [m] or [rad].

        positions : by axis letter [m] or [rad]; zero where the symbol is not in the truth
        """
        shape = np.broadcast_shapes(*(np.shape(q) for q in positions.values()))
        arrays = {name: np.broadcast_to(np.asarray(q), shape) for name, q in positions.items()}
        return sum((term(arrays) for term in self.terms.get(symbol, ())), np.zeros(shape))

    def of_axis(self, axis: str, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, 6) errors A B C X Y Z of one axis [rad] and [m]; positions as (n,) arrays."""
        values = np.zeros((len(next(iter(positions.values()))), len(COMPONENTS)))
        for text, constant in self.constants.items():
            symbol = split(text)
            if symbol.axis == axis:
                values[:, symbol.column] += constant
        for text, terms in self.terms.items():
            symbol = split(text)
            if symbol.axis == axis:
                for term in terms:
                    values[:, symbol.column] += term(positions)
        if self.model is not None:
            values += self.model.of_axis(axis, positions)
        return values


NO_ERRORS = GeometricErrors({}, {})


@lru_cache(maxsize=1024)
def split(text: str, where: str = 'truth') -> Symbol:
    """Take a symbol apart; raises UserError where it is none."""
    match = _SYMBOL.fullmatch(text)
    if match is None:
        raise UserError(f'{where}: {text}: expected a symbol such as E_X(0Y)B or E_A(B)C')
    return Symbol(text, match[1], match[4], match[2] == '0')


def parse_errors(fields: Fields, machine: Machine) -> GeometricErrors:
    """Read the error sections of a truth file.

    Raises UserError naming file, key and what is expected.
    """
    constants: dict[str, float] = {}
    for section, rotary, units in (
        ('location_errors', True, UNITS),
        ('squareness', False, {unit: UNITS[unit] for unit in _ANGLE}),
    ):
        for unit, scale in units.items():
            where = f'{fields.where}: {section}_{unit}'
            for text, value in fields.items(f'{section}_{unit}'):
                symbol = known_symbol(text, machine, where)
                if not symbol.location or machine.axes[symbol.axis].rotary is not rotary:
                    kind = 'rotary' if rotary else 'linear'
                    raise UserError(
                        f'{where}: {text}: expected a constant of a {kind} axis, as E_A(0Y)B'
                    )
                if unit not in symbol.units:
                    raise UserError(f'{where}: {text}: expected in {" or ".join(symbol.units)}')
                _once(symbol, constants, where)
                constants[text] = number(value, f'{where}: {text}') * scale
    terms: dict[str, tuple[Term, ...]] = {}
    where = f'{fields.where}: position_dependent'
    for text, value in fields.items('position_dependent'):
        symbol = known_symbol(text, machine, where)
        if symbol.location:
            raise UserError(f'{where}: {text}: a location error; expected as E_X(B)C')
        _once(symbol, terms, where)
        entries = mappings(value, f'{where}: {text}')
        terms[text] = tuple(_term(entry, symbol, machine) for entry in entries)
    return GeometricErrors(constants, terms)


def _once(symbol: Symbol, known: Mapping[str, object], where: str) -> None:
    # E_X(0Y)B and E_X(0Z)B would be one and the same transform.
    for text in known:
        other = split(text)
        if (other.axis, other.component) == (symbol.axis, symbol.component):
            raise UserError(f'{where}: {symbol.text}: given already as {text}')


def known_symbol(text: str, machine: Machine, where: str) -> Symbol:
    """Take a symbol apart; raises UserError where the machine has no such axis."""
    symbol = split(text, where)
    reference = text[text.index('(') + 1 : text.index(')')].lstrip('0') if '(' in text else None
    for letter in (symbol.axis, reference):
        if letter is not None and letter not in machine.axes:
            raise UserError(
                f'{where}: {text}: no axis {letter} in the machine, expected one of '
                f'{sorted(machine.axes)}'
            )
    return symbol


def _axis(fields: Fields, key: str, machine: Machine, default: str | None = None) -> Axis:
    name = fields.choice(key, machine.axes, *(() if default is None else (default,)))
    return machine.axes[name]


def _term(fields: Fields, symbol: Symbol, machine: Machine) -> Term:
    axis = _axis(fields, 'of', machine, symbol.axis)
    full_name, full = _FULL[axis.rotary]
    times = _factor(fields, machine)
    if 'harmonic' in fields:
        if not axis.rotary:
            raise UserError(f'{fields.where}: harmonic: {axis.name} does not turn, expected power')
        order = fields.integer('harmonic', lower=1)
        cosine = amplitude(fields, 'cos', symbol, optional=True)
        sine = amplitude(fields, 'sin', symbol, optional=True)
        term = Term('harmonic', axis.name, order, cosine, sine, times=times)
    elif 'power' in fields:
        order = fields.integer('power', lower=1)
        size = amplitude(fields, f'at_{full_name}', symbol)
        term = Term('power', axis.name, order, size, full=full, times=times)
    else:
        term = Term('power', axis.name, 0, amplitude(fields, 'constant', symbol), times=times)
    fields.done()
    return term


def amplitude(fields: Fields, name: str, symbol: Symbol, optional: bool = False) -> float:
    """A size under the key NAME_UNIT with a unit that fits the symbol [m] or [rad].

    Raises UserError where there is none, unless it is optional, and where there are several.
    """
    given = [unit for unit in symbol.units if f'{name}_{unit}' in fields]
    if len(given) > 1 or not (given or optional):
        wanted = ' or '.join(f'{name}_{unit}' for unit in symbol.units)
        raise UserError(f'{fields.where}: expected {wanted}')
    return fields.number(f'{name}_{given[0]}') * UNITS[given[0]] if given else 0.0


def _factor(fields: Fields, machine: Machine) -> Factor | None:
    if 'times' not in fields:
        return None
    section = fields.section('times')
    if 'abs' in section:
        axis = _axis(section, 'abs', machine)
        factor = Factor('abs', axis.name, full=_FULL[axis.rotary][1])
    else:
        shape = 'cos' if 'cos' in section else 'sin'
        order = section.integer(shape, lower=1)
        axis = _axis(section, 'of', machine)
        factor = Factor(shape, axis.name, order)
    section.done()
    return factor
