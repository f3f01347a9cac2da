"""A machine that warms up: temperatures and constant errors that follow a source of heat.

Section `warming` of the truth file:

    warming:
      heat: [[0, 1.0], [180, 0.0]]      # minutes since the first static cycle, share of full heat
      thermometers: {every_s: 10, noise_k: 0.02}
      sensors:
        B_cover: {rest_c: 22.0, rise_k: 1.4, lag_min: 30}
      errors:
        E_Y(0Y)B: {rise_um: -6.0, lag_min: 40}

Each is a first-order lag of the heat, lag dx/dt = rise heat - x, from x = 0 at rest: under full
heat it settles `rise` away from rest, 63 % of that after `lag_min`. Units: um, urad, arcsec.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rtest_drivers.sim.errors import COMPONENTS, GeometricErrors, amplitude, known_symbol, split
from rtest_drivers.sim.fields import Fields, number
from rtest_estimation.errors import UserError
from rtest_estimation.records import Temperature
from rtest_identification.machine import Machine

_MINUTE = 60.0


@dataclass(frozen=True)
class Lagging:
    """Something that follows the heat.

    rise : away from rest under full heat, when settled; lag : time constant [s]
    rest : value at rest
    """

    rise: float
    lag: float
    rest: float = 0.0


@dataclass(frozen=True)
class Warming:
    """How the machine warms up.

    heat : times [s] and shares of full heat from then on
    sensors : by name, rest [degC] and rise [K]; errors : by symbol, rise [m] or [rad]
    period : of the thermometers [ns]; noise : standard deviation of a temperature [K]
    """

    heat: tuple[tuple[float, float], ...]
    sensors: dict[str, Lagging]
    errors: dict[str, Lagging]
    period: int
    noise: float

    def value(self, one: Lagging, seconds: np.ndarray) -> np.ndarray:
        """What follows the heat, at times since it began; at rest before, the same shape."""
        values, share = np.full(np.shape(seconds), one.rest), 0.0
        for start, now in self.heat:
            since = np.maximum(seconds - start, 0.0)
            values += one.rise * (now - share) * -np.expm1(-since / one.lag)
            share = now
        return values


class Thermometers:
    """The sensors, read in order of time: every temperature draws its noise.

    noise : where the numbers come from
    """

    def __init__(self, warming: Warming, noise: np.random.Generator) -> None:
        self._warming, self._random = warming, noise

    def read(self, times: np.ndarray, seconds: np.ndarray) -> list[Temperature]:
        """The next temperatures, of all sensors at one time after the other.

        times : (n,) [ns]; seconds : (n,) since the heat began
        """
        warming = self._warming
        values = warming.noise * self._random.standard_normal((len(times), len(warming.sensors)))
        for column, sensor in enumerate(warming.sensors.values()):
            values[:, column] += warming.value(sensor, seconds)
        return [
            Temperature(int(time), name, float(value), warming.noise**2)
            for time, row in zip(times, values, strict=True)
            for name, value in zip(warming.sensors, row, strict=True)
        ]


@dataclass(frozen=True)
class WarmErrors:
    """Errors of the machine at instants: those of the cold machine and what the heat adds.

    seconds : (n,) since the heat began, of the positions that are asked for
    """

    cold: GeometricErrors
    warming: Warming
    seconds: np.ndarray

    @property
    def axes(self) -> frozenset[str]:
        """Axes that have any error."""
        return self.cold.axes | {split(text).axis for text in self.warming.errors}

    def of_axis(self, axis: str, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, 6) errors A B C X Y Z of one axis [rad] and [m]; positions as (n,) arrays."""
        values = self.cold.of_axis(axis, positions)
        for text, one in self.warming.errors.items():
            symbol = split(text)
            if symbol.axis == axis:
                values[:, COMPONENTS.index(symbol.component)] += self.warming.value(
                    one, self.seconds
                )
        return values


def parse_warming(fields: Fields, machine: Machine) -> Warming | None:
    """Read the section `warming` of a truth file; None where there is none.

    Raises UserError naming file, key and what is expected.
    """
    if 'warming' not in fields:
        return None
    section = fields.section('warming')
    thermometers = section.section('thermometers')
    warming = Warming(
        _heat(section),
        {name: _sensor(name, Fields(value, f'{section.where}: sensors: {name}'))
         for name, value in section.items('sensors')},
        {text: _error(text, Fields(value, f'{section.where}: errors: {text}'), machine)
         for text, value in section.items('errors')},
        round(1e9 * thermometers.number('every_s', 10.0, 0.1)),
        thermometers.number('noise_k', 0.0, 0.0),
    )
    thermometers.done()
    section.done()
    return warming


def _heat(section: Fields) -> tuple[tuple[float, float], ...]:
    steps = section.raw('heat', [[0, 1.0]])
    where = f'{section.where}: heat'
    if not isinstance(steps, list) or not all(isinstance(s, list) and len(s) == 2 for s in steps):
        raise UserError(f'{where}: expected a list of [minute, share of full heat], got {steps!r}')
    heat = tuple((_MINUTE * number(start, where), number(share, where)) for start, share in steps)
    times = [start for start, _ in heat]
    if not times or times[0] < 0.0 or sorted(set(times)) != times:
        raise UserError(f'{where}: expected ascending minutes from 0 on, got {steps!r}')
    return heat


def _sensor(name: str, fields: Fields) -> Lagging:
    if not (name.isascii() and name.isidentifier()):
        raise UserError(f'{fields.where}: expected a name of letters, digits and _')
    sensor = Lagging(
        fields.number('rise_k'), fields.number('lag_min', lower=0.01, scale=_MINUTE),
        fields.number('rest_c'),
    )
    fields.done()
    return sensor


def _error(text: str, fields: Fields, machine: Machine) -> Lagging:
    symbol = known_symbol(text, machine, fields.where)
    if not symbol.location:
        raise UserError(f'{fields.where}: expected a constant, as E_Y(0Y)B')
    error = Lagging(
        amplitude(fields, 'rise', symbol), fields.number('lag_min', lower=0.01, scale=_MINUTE)
    )
    fields.done()
    return error
