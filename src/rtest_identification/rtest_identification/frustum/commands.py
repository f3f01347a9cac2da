"""Commands of the axes for a feature: inverse kinematics of any five-axis chain.

With all axes at zero the tool points along +Z of the machine (ISO 841: Z is the spindle's axis).
Seen from the table it points along

    t = R(w1, q1) R(w2, q2) z,

the rotary axes counted from the table to the tool, whichever side of the bed they are on; w is an
axis's direction, turned round where its sense is -1 or where it carries the table. There are two
solutions, one on either side of the plane of w1 and w2, closed for any two directions that are not
parallel (the second Paden-Kahan subproblem).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.frustum.feature import Feature
from rtest_identification.kinematics import linear_positions, rotation
from rtest_identification.machine import Machine
from rtest_identification.moves import AxisPath

AUTO, NEGATIVE, POSITIVE = 'auto', 'negative', 'positive'
SOLUTIONS = (AUTO, NEGATIVE, POSITIVE)
_SPINDLE = np.array([0.0, 0.0, 1.0])
_TURN = 2.0 * np.pi
# Nearer to it than this, the tool axis is along the first rotary axis, whose position is then
# anything; to rounding a direction is out of reach.
_ALONG, _ROUNDING = 1e-9, 1e-12
# Sine of the angle between them below which that axis turns fast: 5 deg.
_POLE = np.sin(np.radians(5.0))


@dataclass(frozen=True)
class Commands:
    """A feature and the positions of the axes that make it.

    positions : (n, k) in the order of ``machine.letters`` [m] or [rad], rotary axes unwrapped
    notes : what a person should know: axes out of their range
    lines : (n,) of the file that each point is from, counted from 1; empty where there is none
    """

    machine: Machine
    feature: Feature
    positions: np.ndarray
    notes: tuple[str, ...] = ()
    lines: tuple[int, ...] = ()

    def where(self, row: int) -> str:
        """What a person finds a point by."""
        if self.lines:
            return f'{self.feature.name}:{self.lines[row]}'
        return f'{self.feature.name}: point {row + 1}'

    def axis(self, name: str) -> np.ndarray:
        """(n,) positions of one axis."""
        return self.positions[:, self.machine.letters.index(name)]

    @property
    def approach(self) -> np.ndarray:
        """(n, k) sign of each axis's last motion; the tool comes along the path to its start."""
        count = len(self.positions)
        signs = AxisPath(self.positions, np.arange(count), np.zeros(count)).signs()
        signs[0] = signs[min(1, count - 1)]
        return signs


def command(
    machine: Machine,
    feature: Feature,
    solution: str = AUTO,
    inside: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Commands:
    """Positions of the axes for a feature.

    solution : NEGATIVE or POSITIVE, the sign of the rotary axis nearest to the tool where the
        feature starts; AUTO takes the first of the two whose rotary axes stay within their ranges,
        and within `inside`, where one does
    inside : positions (n, k) to (n,) bool, for example where errors were measured

    Raises UserError where the rotary axes cannot point the tool that way.
    """
    if solution not in SOLUTIONS:
        raise UserError(f'solution {solution!r}: expected one of {", ".join(SOLUTIONS)}')
    found = []
    for rotary in _both(machine, feature):
        positions = np.zeros((len(feature), len(machine.letters)))
        positions[:, [machine.letters.index(name) for name in _pair(machine)[0]]] = rotary
        found.append(linear_positions(machine, feature.tip, positions))
    found.sort(key=lambda positions: _sign(machine, positions))
    if solution == AUTO:
        positions = min(found, key=lambda positions: _misses(machine, positions, inside))
    else:
        positions = found[0 if solution == NEGATIVE else 1]
    notes = (*out_of_range(machine, positions).values(), *near_pole(machine, feature, positions))
    return Commands(machine, feature, positions, notes)


def tool_axis(machine: Machine, positions: np.ndarray) -> np.ndarray:
    """(n, 3) unit vectors from tool tip into spindle, frame ``table``, at positions (n, k)."""
    axis = np.broadcast_to(_SPINDLE, (len(positions), 3))
    for name in reversed(machine.chain):
        if name in machine.axes and machine.axes[name].rotary:
            turn = rotation(_direction(machine, name), positions[:, machine.letters.index(name)])
            axis = np.einsum('nij,nj->ni', turn, axis)
    return axis


def out_of_range(machine: Machine, positions: np.ndarray) -> dict[str, str]:
    """Axes that leave their range, and that in words."""
    notes = {}
    for name, column in zip(machine.letters, positions.T, strict=True):
        axis = machine.axes[name]
        scale, unit = (180.0 / np.pi, 'deg') if axis.rotary else (1e3, 'mm')
        low, high = column.min(), column.max()
        beyond = max(axis.lower - low, high - axis.upper)
        if beyond > 1e-9:
            # What is little too much must be seen.
            digits = 1 if beyond * scale > 0.1 else 4
            notes[name] = (
                f'{name} goes from {low * scale:.{digits}f} to {high * scale:.{digits}f} '
                f'{unit}, its range is {axis.lower * scale:g} to {axis.upper * scale:g}: the '
                'machine cannot run this path as it is placed'
            )
    return notes


def near_pole(machine: Machine, feature: Feature, positions: np.ndarray) -> list[str]:
    """Where the tool comes so near to the axis next to the table that this must turn fast."""
    (name, _), first, _ = _pair(machine)
    sine = np.linalg.norm(np.cross(feature.axis, first), axis=1)
    nearest = int(np.argmin(sine))
    turn = np.abs(np.diff(positions[:, machine.letters.index(name)]))
    way = np.linalg.norm(np.diff(feature.tip, axis=0), axis=1)
    if sine[nearest] >= _POLE or not turn.any():
        return []
    rate = np.degrees(turn / np.maximum(way * 1e3, 1e-3)).max()
    return [
        f'at point {nearest + 1} the tool comes within {np.degrees(np.arcsin(sine[nearest])):.2g} '
        f'deg of a pole (along {name}): {name} turns by up to {rate:.3g} deg per mm of path; '
        'where that is faster than it can, the feed is not kept, and a small change of the path '
        'changes the commands much'
    ]


def _pair(machine: Machine) -> tuple[tuple[str, str], np.ndarray, np.ndarray]:
    """The two rotary axes from the table to the tool, and their directions w."""
    names = tuple(n for n in machine.chain if n in machine.axes and machine.axes[n].rotary)
    if len(names) != 2:
        raise UserError(
            f'machine {machine.name!r}: tool axis directions need two rotary axes, it has '
            f'{len(names)}: give a path of axis positions'
        )
    first, second = (_direction(machine, name) for name in names)
    if np.linalg.norm(np.cross(first, second)) < 1e-6:
        raise UserError(f'machine {machine.name!r}: {names[0]} and {names[1]} are parallel')
    return names, first, second


def _direction(machine: Machine, name: str) -> np.ndarray:
    axis = machine.axes[name]
    return axis.direction * axis.sense * (-1.0 if name in machine.table_side else 1.0)


def _both(machine: Machine, feature: Feature) -> list[np.ndarray]:
    """The two solutions for the rotary axes, (n, 2) each, continuous along the feature."""
    names, first, second = _pair(machine)
    cosine = first @ second
    # v = R(w2, q2) z = R(w1, -q1) t has known components along w1 and w2.
    one, two = feature.axis @ first, second @ _SPINDLE
    alpha = (one - cosine * two) / (1.0 - cosine**2)
    beta = (two - cosine * one) / (1.0 - cosine**2)
    normal = np.cross(first, second)
    square = 1.0 - alpha**2 - beta**2 - 2.0 * alpha * beta * cosine
    square /= normal @ normal
    if square.min() < -_ROUNDING:
        row = int(np.argmin(square))
        i, j, k = feature.axis[row]
        raise UserError(
            f'{feature.name}: point {row + 1}: {names[0]} and {names[1]} cannot point the tool '
            f'along ({i:.4f}, {j:.4f}, {k:.4f}) of the table'
        )
    branches = []
    for sign in (-1.0, 1.0):
        across = sign * np.sqrt(np.maximum(square, 0.0))
        v = alpha[:, None] * first + beta[:, None] * second + across[:, None] * normal
        spindle = np.broadcast_to(_SPINDLE, v.shape)
        branches.append(
            np.stack([_angle(first, v, feature.axis), _angle(second, spindle, v)], axis=1)
        )
    free = np.linalg.norm(np.cross(feature.axis, first), axis=1) < _ALONG
    return [
        _within(machine, names, _follow(np.stack(branches), free, start)) for start in (0, 1)
    ]


def _angle(axis: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(n,) angle about a unit vector from vectors (n, 3) to others."""
    sine = np.cross(start, end) @ axis
    return np.arctan2(sine, np.einsum('ni,ni->n', start, end) - (start @ axis) * (end @ axis))


def _follow(branches: np.ndarray, free: np.ndarray, start: int) -> np.ndarray:
    """From two solutions (2, n, 2) at each point the way (n, 2) that moves the axes least.

    free : (n,) points at which the first axis may be anywhere; it goes on evenly there
    """
    count = branches.shape[1]
    way = np.empty((count, 2))
    known = np.flatnonzero(~free)
    last = branches[start, known[0] if len(known) else 0]
    for row in known:
        both = branches[:, row] - _TURN * np.round((branches[:, row] - last) / _TURN)
        last = way[row] = both[int(np.argmin(np.abs(both - last).max(axis=1)))]
    rows = np.flatnonzero(free)
    if len(rows):
        way[rows, 0] = np.interp(rows, known, way[known, 0]) if len(known) else 0.0
        # Both solutions are one where the first axis is free.
        way[rows, 1] = branches[start, rows, 1]
    return way


def _within(machine: Machine, names: tuple[str, str], way: np.ndarray) -> np.ndarray:
    """The way shifted by whole turns into the ranges of the axes, or as near to zero as can be."""
    way = way.copy()
    for column, name in enumerate(names):
        axis = machine.axes[name]
        turns = _TURN * np.arange(-4, 5)
        low, high = way[:, column].min() + turns, way[:, column].max() + turns
        outside = np.maximum(axis.lower - low, 0.0) + np.maximum(high - axis.upper, 0.0)
        best = np.lexsort((np.abs(low + high), outside > _ALONG))[0]
        way[:, column] += turns[best]
    return way


def _sign(machine: Machine, positions: np.ndarray) -> float:
    """Which solution it is: the sign of the rotary axis nearest to the tool at the start."""
    column = positions[:, machine.letters.index(_pair(machine)[0][1])]
    return float(np.sign(column[np.argmax(np.abs(column) > _ALONG)]))


def _misses(
    machine: Machine, positions: np.ndarray, inside: Callable[[np.ndarray], np.ndarray] | None
) -> tuple[int, ...]:
    """How many rotary ranges are left, then how many points are not inside."""
    rotary = sum(name in machine.rotary for name in out_of_range(machine, positions))
    return (rotary, 0 if inside is None else int((~inside(positions)).sum()))
