"""Which axis has the wrong sign, unit or name, from moves in a known direction.

Somebody moves one axis after the other by a little; of each move the feedback from before to after
it is kept. What the feedback says of the move is compared with what was done.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_drivers.cnc.axes import ANGLES, LENGTHS, AxisSource
from rtest_estimation.dwell import ROTARY_LETTERS

# Part of the feedback at either end of a move in which the axes stand still.
_END = 0.1
# A move by hand is as good.
_NEAR = 0.1
# Less than this part of the largest motion, each in moves of its axis, is no motion.
_STANDS = 0.05
# A move of an axis that is not moved itself [m], [rad].
_USUAL = (1e-3, math.radians(1.0))
# Encoders tell less than this apart from nothing [m], [rad].
_LEAST = 2e-8


@dataclass(frozen=True)
class Move:
    """What was done: an axis and how far, positive as the machine file counts [m], [rad]."""

    axis: str
    distance: float

    @property
    def shown(self) -> float:
        """The distance in [mm] or [deg]."""
        return math.degrees(self.distance) if self.axis in ROTARY_LETTERS else self.distance * 1e3

    def __str__(self) -> str:
        unit = 'deg' if self.axis in ROTARY_LETTERS else 'mm'
        return f'{self.axis} {self.shown:+g} {unit}'


@dataclass(frozen=True)
class Finding:
    """What the feedback of one move says.

    kind : 'right', 'sign', 'unit', 'name' (another axis moved), 'still' (nothing moved), 'several'
        (more than one moved), 'scale' (no known unit explains how far it moved)
    ratio : feedback over what was done, of the axis that moved; NaN where none did
    moved : letters of the axes that moved
    text : what to change, one line; says so where nothing is to be changed
    """

    axis: str
    kind: str
    ratio: float
    moved: tuple[str, ...]
    text: str


def judge(
    axes: Sequence[AxisSource], moves: Sequence[Move], recorded: Sequence[np.ndarray]
) -> list[Finding]:
    """One finding for each move.

    axes : of the device file; moves : one after the other, each axis once
    recorded : (n, axes) feedback [m], [rad] for each move, from standing to standing, read with
        the device file as it is
    """
    named = {axis.name: axis for axis in axes}
    done = {move.axis: abs(move.distance) for move in moves}
    usual = np.array([done.get(name, _USUAL[name in ROTARY_LETTERS]) for name in named])
    return [
        _judge(named, move, *_change(np.asarray(rows)), usual)
        for move, rows in zip(moves, recorded, strict=True)
    ]


def _change(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(k,) how far every axis went, and (k,) what is noise."""
    end = max(1, round(_END * len(rows)))
    first, last = rows[:end], rows[-end:]
    noise = 5.0 * np.maximum(first.std(axis=0), last.std(axis=0))
    return np.median(last, axis=0) - np.median(first, axis=0), np.maximum(noise, _LEAST)


def _judge(
    axes: dict[str, AxisSource], move: Move, change: np.ndarray, noise: np.ndarray,
    usual: np.ndarray,
) -> Finding:
    went = np.where(np.abs(change) > noise, np.abs(change) / usual, 0.0)
    moves = (went > 0.0) & (went > _STANDS * went.max())
    moved = tuple(name for name, one in zip(axes, moves, strict=True) if one)
    start = f'{move}:'
    if not moved:
        return Finding(
            move.axis, 'still', math.nan, moved,
            f'{start} nothing moved in the feedback; is it frozen, or the source of '
            f'{move.axis} that of no axis?',
        )
    if len(moved) > 1:
        return Finding(
            move.axis, 'several', math.nan, moved,
            f'{start} {", ".join(moved)} moved; switch TCP mode and rotated coordinates off, take '
            'positions of the machine axes, and move one axis at a time',
        )
    seen = axes[moved[0]]
    ratio = float(change[list(axes).index(seen.name)]) / move.distance
    if seen.name != move.axis:
        return Finding(
            move.axis, 'name', ratio, moved,
            f'{start} what moved is called {seen.name}; give {move.axis} the source '
            f'{seen.source!r}',
        )
    wrong = []
    if ratio < 0.0:
        wrong.append(f'sign: {-seen.sign} instead of {seen.sign}')
    unit = _unit(seen, abs(ratio))
    if unit is None:
        return Finding(
            move.axis, 'scale', ratio, moved,
            f'{start} moved {ratio:.4g} times as far, which no unit explains; was it the move '
            'that was asked for, and is the source a position of this axis?',
        )
    if unit != seen.unit:
        wrong.append(f'unit: {unit} instead of {seen.unit}')
    kind = 'unit' if unit != seen.unit else 'sign' if wrong else 'right'
    said = f'axes: {move.axis}: {", ".join(wrong)}' if wrong else 'as it should'
    return Finding(move.axis, kind, ratio, moved, f'{start} {said}')


def _unit(axis: AxisSource, ratio: float) -> str | None:
    """The unit with which the axis would have gone as far as it did; its own where that fits."""
    kinds = ANGLES if axis.unit in ANGLES else LENGTHS
    for unit in sorted(kinds, key=lambda unit: unit != axis.unit):
        if abs(ratio * kinds[unit] / kinds[axis.unit] - 1.0) < _NEAR:
            return unit
    return None
