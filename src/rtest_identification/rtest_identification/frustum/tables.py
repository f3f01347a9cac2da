"""Tables 6-2 to 6-7 of the thesis computed again, beside the printed numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rtest_identification.frustum.circles import (
    least_squares_circle,
    minimum_zone_circle,
    zone_width,
)
from rtest_identification.frustum.commands import NEGATIVE, Commands, command
from rtest_identification.frustum.cone import Frustum
from rtest_identification.frustum.contour import contour_error, response
from rtest_identification.frustum.thesis import (
    CASE_B_AS_PRINTED,
    CASES,
    CONSTANTS,
    ROWS,
    SPREAD,
    Draw,
    Row,
    size,
)
from rtest_identification.kinematics import ERROR_LETTERS
from rtest_identification.machine import Machine

SIMULATIONS = 1000
# Printed numbers are met where they are as near as this: what the printed digits and the choice of
# points can make of them.
_PART, _LENGTH = 1.0 / 3.0, 1e-6
_CONSTANT, _ZERO = 0.1e-6, 0.01e-6


@dataclass(frozen=True)
class Line:
    """One row of a table in one case; circularity [m].

    case : 'a', 'b', or 'b, printed centre'
    printed, least_squares, minimum_zone : means; of Table 6-2, the one value
    spreads : standard deviations of the same three; None for Table 6-2
    """

    table: str
    case: str
    name: str
    printed: float
    least_squares: float
    minimum_zone: float
    spreads: tuple[float, float, float] | None = None

    def met(self, value: float) -> bool:
        """Whether a value is the printed one: of Table 6-2 to 0.1 µm, else to a third or 1 µm."""
        if self.spreads is None:
            return abs(value - self.printed) <= _CONSTANT
        return abs(value - self.printed) <= max(_LENGTH, _PART * self.printed)


def compare(machine: Machine, simulations: int = SIMULATIONS, seed: int = 1) -> list[Line]:
    """Every row of the tables in both cases.

    machine : with axes B and C as in Fig. 2-5
    """
    lines = []
    commands = {
        name: command(machine, cone.feature(), NEGATIVE) for name, cone in CASES.items()
    }
    as_printed = command(machine, CASE_B_AS_PRINTED.feature(), NEGATIVE)
    for number, case in enumerate('ab'):
        lines += _constants(commands[case], CASES[case], case, number)
    lines += _constants(as_printed, CASE_B_AS_PRINTED, 'b, printed centre', 1)
    for number, case in enumerate('ab'):
        slope = response(commands[case])
        for place, row in enumerate(ROWS):
            rng = np.random.default_rng((seed, number, place))
            profiles = simulate(commands[case], slope, row, simulations, rng)
            lines.append(_simulated(commands[case].feature.scale, row, case, number, profiles))
    return lines


def simulate(
    commands: Commands, slope: np.ndarray, row: Row, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Deviations (count, n) of random errors of one row, about the least-squares circle [m].

    slope : `contour.response`. Linear in the errors: at these sizes the circularity is that of the
        exact kinematics to 0.03 µm
    """
    deviation = 0.0
    for error, column in draw_errors(commands, row, count, rng):
        deviation = deviation + error * slope[:, column]
    return commands.feature.form(np.broadcast_to(deviation, (count, len(slope))))


def draw_errors(
    commands: Commands, row: Row, count: int, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, int]]:
    """Random errors of a row: each (count, n) [m] or [rad], with its column in the Jacobian."""
    amount = size(row.angular) * rng.normal(1.0, SPREAD, (count, 1))
    draw = Draw(
        commands.axis('B'), commands.axis('C'), rng.uniform(0.0, 2.0 * np.pi, (count, 1)),
        rng.uniform(size=(count, 1)),
    )
    for axis, letter, profile in row.terms:
        column = 6 * commands.machine.letters.index(axis) + ERROR_LETTERS.index(letter)
        yield amount * profile(draw), column


def _constants(commands: Commands, cone: Frustum, case: str, number: int) -> list[Line]:
    lines = []
    for name, axis, letter, *printed in CONSTANTS:
        errors = np.zeros((len(commands.machine.letters), 6))
        where = commands.machine.letters.index(axis), ERROR_LETTERS.index(letter)
        errors[where] = size(letter in 'ABC')
        points = cone.section(commands.feature.tip + contour_error(commands, errors))
        lines.append(Line(
            '6-2', case, name, printed[number], least_squares_circle(points).circularity,
            minimum_zone_circle(points).circularity,
        ))
    return lines


def _simulated(
    scale: float, row: Row, case: str, number: int, profiles: np.ndarray
) -> Line:
    angle = 2.0 * np.pi * np.arange(profiles.shape[1]) / profiles.shape[1]
    squares, zones = np.ptp(profiles, axis=1), zone_width(angle, profiles)
    mean, spread = row.printed[number]
    return Line(
        row.table, case, row.name, mean, float(squares.mean()), float(zones.mean()),
        (spread, float(squares.std()), float(zones.std())),
    )


def text(lines: list[Line]) -> list[str]:
    """The tables for a person, with the centres used and where they deviate."""
    a, b = (np.asarray(CASES[case].centre) * 1e3 for case in 'ab')
    told = [
        'Circularity [µm]: paper, ours about the least-squares (LS) and the minimum-zone (MZ) '
        'circle; * deviates',
        f'(a) phi 15 deg, normals meet at ({_mm(a)}) mm, as printed in Table 6-1',
        f'(b) phi 75 deg, normals meet at ({_mm(b)}) mm, which is printed nowhere',
    ]
    by_case = {
        case: {(one.table, one.name): one for one in lines if one.case == case} for case in 'ab'
    }
    table = ''
    for key, first in by_case['a'].items():
        if first.table != table:
            table = first.table
            what = '10 µm or 0.01 deg' if first.spreads is None else 'mean ± standard deviation'
            told += ['', f'{f"Table {table}, {what}":40}{"(a) paper":>13}{"LS":>13}{"MZ":>13}'
                     f'{"(b) paper":>16}{"LS":>13}{"MZ":>13}']
        told.append(f'{first.name:40}{_columns(first)}   {_columns(by_case["b"][key])}')
    return [*told, '', *findings(lines)]


def summary(lines: list[Line]) -> str:
    """One line: how many of the printed numbers come out."""
    constants = [one for one in lines if one.spreads is None and one.case in 'ab']
    simulated = [one for one in lines if one.spreads is not None]
    squares, zones = (
        sum(one.met(getattr(one, name)) for one in simulated)
        for name in ('least_squares', 'minimum_zone')
    )
    return (
        f'Table 6-2: {sum(one.met(one.least_squares) for one in constants)} of {len(constants)} '
        f'to 0.1 µm; Tables 6-3 to 6-7: {squares} of {len(simulated)} to a third or 1 µm about '
        f'the least-squares circle, {zones} about the minimum-zone circle'
    )


def findings(lines: list[Line]) -> list[str]:
    """What came out and what did not, plainly."""
    constants = [one for one in lines if one.spreads is None and one.case in 'ab']
    printed = [one for one in lines if one.case not in 'ab']
    lower = max(one.least_squares - one.minimum_zone for one in constants) * 1e6
    met = sum(one.met(one.least_squares) for one in constants)
    wrong = [f'{one.name} {one.least_squares * 1e6:.1f} for {one.printed * 1e6:.1f}'
             for one in printed if not one.met(one.least_squares)]
    x, y, z = 1e3 * np.asarray(CASE_B_AS_PRINTED.centre)
    told = [
        f'Table 6-2: {met} of {len(constants)} numbers come out to 0.1 µm about the least-squares '
        f'circle. The text says minimum radial separation; that is up to {lower:.1f} µm lower.',
        f'Case (b) at the printed centre ({x:g}, {y:g}, {z:g}) mm: {len(printed) - len(wrong)} of '
        f'{len(printed)} come out, not {", ".join(wrong)}.',
    ]
    simulated = [one for one in lines if one.spreads is not None]
    moving = [one for one in simulated if one.printed > 0.0]
    zero = [one.least_squares < _ZERO for one in simulated if one.printed == 0.0]
    told.append(
        f'Tables 6-3 to 6-7: {sum(zero)} of {len(zero)} means that are printed as zero are less '
        f'than {_ZERO * 1e6:g} µm; the others to a third or 1 µm:'
    )
    for name in ('least_squares', 'minimum_zone'):
        off = [one for one in moving if not one.met(getattr(one, name))]
        told.append(
            f'  about the {name.replace("_", "-")} circle {len(moving) - len(off)} of '
            f'{len(moving)}' + (', not ' if off else '') + '; '.join(
                f'{one.name} ({one.case}) {1e6 * getattr(one, name):.1f} for '
                f'{1e6 * one.printed:.1f}' for one in off
            )
        )
    return told


def _columns(one: Line) -> str:
    values = (one.printed, one.least_squares, one.minimum_zone)
    cells = [f'{1e6 * v:.1f}' for v in values]
    if one.spreads is not None:
        cells = [f'{c} ± {1e6 * s:.1f}' for c, s in zip(cells, one.spreads, strict=True)]
    # Of Table 6-2 the least-squares circle is meant, of the others either.
    marks = ['' if one.met(v) else '*' for v in values]
    if one.spreads is None:
        marks[2] = ''
    return ''.join(f'{c + m:>13}' for c, m in zip(cells, marks, strict=True))


def _mm(centre: np.ndarray) -> str:
    return ', '.join(f'{value:g}' for value in centre)
