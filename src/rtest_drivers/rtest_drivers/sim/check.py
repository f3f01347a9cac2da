"""Compares what was identified with what the simulated cell was given.

No R-test can tell every shape of a position-dependent error from constants: the mean of an error
of B looks like its location error, and what turns with B like a constant error of C or of the
table. The truth is therefore split into what is visible and what looks constant
(`split_visible`), in closed form and without anything from the identification.
"""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtest_drivers.sim.errors import split
from rtest_drivers.sim.truth import Truth, load_truth
from rtest_identification.machine import Machine

# Of the eleven constants one in 200 comparisons is outside by chance.
CONSTANT_LIMIT = 3.5
# Of the 546 values of the maps of B and C one in 270 comparisons is outside by chance.
MAP_LIMIT = 4.5
# The rms of 546 normalised deviations is 1 +- 0.03 where the stated uncertainties are right.
MAP_RMS_LIMIT = 1.5
_ORDER = 'XYZABC'
# Where errors of B that also depend on C are averaged.
_TURN = np.arange(12) * (math.pi / 6.0)
_READABLE = {'m': (1e6, 'µm'), 'rad': (180.0 * 3600.0 / math.pi, 'arcsec')}


@dataclass(frozen=True)
class Row:
    """One constant: truth, identified value and its standard uncertainty [m] or [rad].

    given : in the truth file, without what of the position-dependent errors looks constant
    """

    symbol: str
    unit: str
    given: float
    truth: float
    value: float
    stddev: float

    @property
    def ok(self) -> bool:
        """Whether they agree within the uncertainty."""
        return abs(self.value - self.truth) <= CONSTANT_LIMIT * self.stddev


@dataclass(frozen=True)
class MapRow:
    """One symbol of an error map: differences and standard uncertainties at the stations."""

    symbol: str
    unit: str
    difference: np.ndarray
    stddev: np.ndarray

    @property
    def rms(self) -> float:
        """Rms difference [m] or [rad]."""
        return float(np.sqrt(np.mean(self.difference**2)))

    @property
    def normalised(self) -> np.ndarray:
        """Differences in standard uncertainties."""
        return self.difference / self.stddev

    @property
    def ok(self) -> bool:
        """Whether every station agrees within the uncertainty."""
        return bool((np.abs(self.normalised) <= MAP_LIMIT).all())


@dataclass(frozen=True)
class Comparison:
    """Truth and result side by side.

    missing : symbols of the truth that the result does not have
    """

    constants: tuple[Row, ...]
    maps: tuple[MapRow, ...]
    missing: tuple[str, ...]

    @property
    def map_rms(self) -> float:
        """Rms of all normalised differences of the maps; 1 where the uncertainties are right."""
        if not self.maps:
            return math.nan
        values = np.concatenate([row.normalised for row in self.maps])
        return float(np.sqrt(np.mean(values**2)))

    @property
    def ok(self) -> bool:
        """Whether everything that was given was found."""
        rows = (*self.constants, *self.maps)
        return not self.missing and all(r.ok for r in rows) and self.map_rms <= MAP_RMS_LIMIT

    def table(self) -> str:
        """For a person: constants with U (k = 2), then the maps."""
        head = f'{"":12}{"truth":>10}{"identified":>12}{"U (k=2)":>9}'
        lines = [head]
        for row in self.constants:
            scale, unit = _READABLE[row.unit]
            lines.append(
                f'{row.symbol:12}{row.truth * scale:10.3f}{row.value * scale:12.3f}'
                f'{2.0 * row.stddev * scale:9.3f} {unit:7}{_verdict(row.ok)}'
            )
        lines.append(f'{"map":12}{"rms difference":>22}{"U (k=2)":>9}')
        for row in self.maps:
            scale, unit = _READABLE[row.unit]
            typical = float(np.sqrt(np.mean(row.stddev**2)))
            lines.append(
                f'{row.symbol:12}{row.rms * scale:22.3f}{2.0 * typical * scale:9.3f} '
                f'{unit:7}{_verdict(row.ok)}'
            )
        lines += [f'{symbol:12}not identified' for symbol in self.missing]
        for row in self.constants:
            scale, unit = _READABLE[row.unit]
            if abs(row.truth - row.given) > row.stddev:
                lines.append(
                    f'{row.symbol} was given as {row.given * scale:.3f} {unit}; the rest of the '
                    'truth above is in its map, in a shape that looks constant to any R-test'
                )
        return '\n'.join(lines)

    def verdict(self) -> str:
        """One sentence."""
        agreed = sum(row.ok for row in self.constants)
        lengths = [row.rms for row in self.maps if row.unit == 'm']
        rms = math.sqrt(np.mean(np.square(lengths))) * 1e6 if lengths else math.nan
        return (
            f'{"agrees with the truth" if self.ok else "DOES NOT AGREE with the truth"}: '
            f'{agreed} of {len(self.constants) + len(self.missing)} constants within '
            f'{CONSTANT_LIMIT} standard uncertainties, maps within {rms:.2f} µm rms '
            f'({self.map_rms:.2f} standard uncertainties)'
        )


def check(truth: Path, identification: Path) -> Comparison:
    """Compare an identification.json with a truth file."""
    cell = load_truth(truth)
    found = json.loads(identification.read_text(encoding='utf-8'))
    results = {**found['location_errors'], **found['squareness']}
    expected = {text: cell.errors.constants.get(text, 0.0) for text in results}
    rows: list[MapRow] = []
    for axis, entry in found['error_maps'].items():
        if 'c_rad' in entry:
            rows += _inner_rows(cell, axis, entry)
            continue
        stations = np.array(entry['b_rad'])
        visible, own, inner = split_visible(cell, axis, stations)
        for text in expected:
            symbol = split(text)
            column = _ORDER.index(symbol.component)
            if symbol.axis == axis:
                expected[text] += own[column]
            elif symbol.axis == _carried_by(cell.machine, axis):
                expected[text] += inner[column]
        for text, stddev in entry['stddev'].items():
            symbol = split(text)
            difference = np.array(entry[text]) - visible[_ORDER.index(symbol.component)]
            unit = 'm' if symbol.component in 'XYZ' else 'rad'
            rows.append(MapRow(text, unit, difference, np.array(stddev)))
    constants = tuple(
        Row(
            text,
            entry['unit'],
            cell.errors.constants.get(text, 0.0),
            expected[text],
            entry['value'],
            entry['stddev'],
        )
        for text, entry in results.items()
    )
    missing = [text for text in cell.errors.constants if text not in results]
    if not rows:
        missing.append('error map')
    return Comparison(constants, tuple(rows), tuple(missing))


def _inner_rows(cell: Truth, axis: str, entry: dict) -> list[MapRow]:
    """The inner axis's map over (outer, inner): what is left of the truth without its mean.

    The mean over the inner stations belongs to the outer axis's map. Poses that the result leaves
    open are not compared.
    """
    (outer,) = (name for name, map_ in cell.machine.axes.items() if map_.rotary and name != axis)
    positions = {name: np.zeros((1, 1)) for name in cell.machine.axes}
    positions[outer] = np.array(entry['b_rad'])[:, np.newaxis]
    positions[axis] = np.array(entry['c_rad'])[np.newaxis, :]
    rows = []
    for text in entry['stddev']:
        value = np.array(entry[text], dtype=float)
        known = np.isfinite(value)
        if not known.any():
            continue
        truth = np.zeros(value.shape)
        if text in cell.errors.terms:
            truth = truth + cell.errors.dependent(text, positions)
        count = np.maximum(known.sum(axis=1, keepdims=True), 1)
        truth = truth - np.where(known, truth, 0.0).sum(axis=1, keepdims=True) / count
        stddev = np.array(entry['stddev'][text], dtype=float)
        unit = 'm' if split(text).component in 'XYZ' else 'rad'
        rows.append(MapRow(text, unit, (value - truth)[known], stddev[known]))
    return rows


def split_visible(
    cell: Truth, axis: str, stations: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split an axis's position-dependent errors into what is visible and what looks constant.

    An error t of the axis that this one carries, or of the table, appears as R(q) t in the frame
    in which this axis's errors are counted, displacements and tilts alike. The visible part is
    free of such shapes and has the mean zero over the stations.

    Returns the visible part (6, s), the constants that add to this axis (6,) and those that add
    to the axis it carries (6,), all in the order X Y Z A B C [m] and [rad].
    """
    machine = cell.machine.axes[axis]
    turned = np.array([_turn(machine.direction, machine.sense * q) for q in stations])
    mean = turned.mean(axis=0)
    shapes = (turned - mean).reshape(-1, 3)
    visible, own, inner = np.zeros((6, len(stations))), np.zeros(6), np.zeros(6)
    for part in (slice(0, 3), slice(3, 6)):
        errors = np.array([_dependent(cell, c, axis, stations) for c in _ORDER[part]])
        level = errors.mean(axis=1)
        rest = (errors - level[:, np.newaxis]).T.reshape(-1)
        constant = np.linalg.lstsq(shapes, rest, rcond=1e-9)[0]
        visible[part] = (rest - shapes @ constant).reshape(-1, 3).T
        own[part], inner[part] = level - mean @ constant, constant
    return visible, own, inner


def _carried_by(machine: Machine, axis: str) -> str | None:
    """The next axis towards the table."""
    side = machine.table_side
    place = side.index(axis) + 1 if axis in side else len(side)
    return side[place] if place < len(side) else None


def _turn(direction: np.ndarray, angle: float) -> np.ndarray:
    """(3, 3) rotation about a unit vector."""
    x, y, z = direction
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross


def _dependent(cell: Truth, component: str, axis: str, stations: np.ndarray) -> np.ndarray:
    """(s,) position-dependent error at the stations, averaged over the other rotary axes."""
    total = np.zeros(len(stations))
    for text in cell.errors.terms:
        symbol = split(text)
        if (symbol.component, symbol.axis) != (component, axis):
            continue
        positions = {
            name: _TURN[np.newaxis, :] if one.rotary else np.zeros((1, 1))
            for name, one in cell.machine.axes.items()
        }
        positions[axis] = stations[:, np.newaxis]
        total += cell.errors.dependent(text, positions).mean(axis=1)
    return total


def _verdict(ok: bool) -> str:
    return 'ok' if ok else 'OFF'


def main(arguments: list[str]) -> int:
    """``check TRUTH IDENTIFICATION``: print the comparison; 1 where they do not agree."""
    truth, identification = map(Path, arguments)
    comparison = check(truth, identification)
    print(comparison.table())
    print(comparison.verdict())
    return 0 if comparison.ok else 1


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
