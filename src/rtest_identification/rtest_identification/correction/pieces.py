"""Straight moves, cut where the correction along them is no straight line.

Corrected ends do not make a corrected way: between them the controller goes straight, and the
correction may not. Moves are looked at along their whole way, cut, and looked at again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.correction.known import KnownErrors
from rtest_identification.correction.step import (
    Correction,
    axis_slopes,
    correct,
    join,
    judged,
)
from rtest_identification.machine import Machine
from rtest_identification.nc_program import LINEAR_DIGITS, ROTARY_DIGITS

# How far the tool may be off between the ends of a piece [m]; its direction counts at this lever.
STRAIGHT, _LEVER = 1e-7, 0.1
# Points along a move are in spans of this length at most [m], [rad], and so many in a piece.
_SPAN, _SPAN_TURN, _SPANS = 2e-3, math.radians(1.0), 3
# Most pieces of a move.
_PIECES = 2000
# Points that are computed at once.
_CHUNK = 20_000


@dataclass(frozen=True)
class Moves:
    """Straight moves of all axes.

    start, end : (m, k) in the order of ``machine.letters`` [m] or [rad]
    came, approach : (m, k) signs of each axis's last motion before the move, and in it
    whole : (m,) bool, whether it must stay one block
    names : (m,) of each, for messages
    """

    start: np.ndarray
    end: np.ndarray
    came: np.ndarray
    approach: np.ndarray
    whole: np.ndarray
    names: Sequence[str]


@dataclass(frozen=True)
class Cut:
    """Corrected moves.

    shares : of each move, (p,) where its pieces end, 1 last; 0 first where an axis that reverses
        takes up its play before the tool goes on
    rows : of each move, (p, k) corrected commands there, rounded as they are written
    along : at points along all moves, run as written; between corrected ends the controller goes
        straight
    move : (n,) which move each point of `along` is of
    bent : (m,) how far the tool is off because the correction is no straight line [m]
    """

    shares: tuple[np.ndarray, ...]
    rows: tuple[np.ndarray, ...]
    along: Correction
    move: np.ndarray
    bent: np.ndarray


@dataclass(frozen=True)
class _Points:
    """Nominal positions (n, k), signs of the motions (n, k), and (n,) which move they are of."""

    nominal: np.ndarray
    approach: np.ndarray
    move: np.ndarray

    @classmethod
    def of(
        cls, moves: Moves, chosen: np.ndarray, shares: list[np.ndarray], approach: np.ndarray
    ) -> _Points:
        """At shares of the chosen moves. approach : (m, k) of all moves."""
        move = np.repeat(chosen, [len(share) for share in shares])
        way = np.concatenate(shares)[:, None] * (moves.end - moves.start)[move]
        return cls(moves.start[move] + way, approach[move], move)

    def chunks(self) -> list[tuple[slice, _Points]]:
        """In parts that the memory holds."""
        parts = [slice(k, k + _CHUNK) for k in range(0, len(self.move), _CHUNK)]
        return [(p, _Points(self.nominal[p], self.approach[p], self.move[p])) for p in parts]


def rounded(machine: Machine, rows: np.ndarray) -> np.ndarray:
    """Positions (n, k) as a program has them."""
    rows = rows.copy()
    for column, name in enumerate(machine.letters):
        if machine.axes[name].rotary:
            rows[:, column] = np.radians(np.round(np.degrees(rows[:, column]), ROTARY_DIGITS))
        else:
            rows[:, column] = 1e-3 * np.round(1e3 * rows[:, column], LINEAR_DIGITS)
    return rows


def cut(known: KnownErrors, moves: Moves) -> Cut:
    """Cut moves so that the tool stays within `STRAIGHT` of its way along them.

    Raises UserError naming the move where very many pieces do not suffice, or where it leaves the
    measured stations.
    """
    every = np.arange(len(moves.start))
    zero = [np.zeros(1)] * len(every)
    came = _changes(known, moves, every, zero, moves.came)
    first = _changes(known, moves, every, zero, moves.approach)
    play = _apart(known, moves, every, zero, came, first) > STRAIGHT
    # A move that must stay whole takes it up on its way.
    first = np.where((play & moves.whole)[:, None], came, first)
    spans = _spans(known.machine, moves.end - moves.start)
    pieces, bent = np.ones(len(every), dtype=int), np.zeros(len(every))
    changes: list[np.ndarray] = [first[:0]] * len(every)
    points = list(zero)
    rng, todo = np.random.default_rng(0), every
    while len(todo):
        ends = [np.arange(1, pieces[k] + 1) / pieces[k] for k in todo]
        found = _changes(known, moves, todo, ends, moves.approach)
        for k, part in zip(todo, _parts(found, ends), strict=True):
            changes[k] = np.vstack([first[k], part])
            number = max(spans[k], _SPANS * pieces[k])
            # Anywhere in each span: even ones would miss what has their period.
            points[k] = (np.arange(number) + rng.random(number)) / number
        chosen = [points[k] for k in todo]
        run = np.concatenate([_between(changes[k], points[k]) for k in todo])
        wanted = _changes(known, moves, todo, chosen, moves.approach)
        off = _apart(known, moves, todo, chosen, run, wanted)
        bent[todo] = [part.max() for part in _parts(off, chosen)]
        todo = todo[(bent[todo] > STRAIGHT) & ~moves.whole[todo]]
        # The sagitta of a piece goes with the square of its length.
        more = np.ceil(pieces[todo] * np.sqrt(bent[todo] / STRAIGHT)).astype(int)
        pieces[todo] = np.maximum(more, pieces[todo] + 1)
        if len(todo) and pieces[todo].max() > _PIECES:
            worst = todo[int(np.argmax(pieces[todo]))]
            raise UserError(
                f'{moves.names[worst]}: the correction bends too much along this block: give '
                'shorter ones'
            )
    return _as_written(known, moves, play & ~moves.whole, changes, points, bent)


def _as_written(
    known: KnownErrors, moves: Moves, play: np.ndarray, changes: list[np.ndarray],
    points: list[np.ndarray], bent: np.ndarray,
) -> Cut:
    shares, rows, run = [], [], []
    for k, change in enumerate(changes):
        share = np.linspace(0.0, 1.0, len(change))
        nominal = moves.start[k] + share[:, None] * (moves.end[k] - moves.start[k])
        written = rounded(known.machine, nominal + change)
        run.append(_between(written - nominal, points[k]))
        skipped = 0 if play[k] else 1
        shares.append(share[skipped:])
        rows.append(written[skipped:])
    at = _Points.of(moves, np.arange(len(changes)), points, moves.approach)
    change = np.concatenate(run)
    along = join([
        judged(known.machine, some.nominal, change[part], _errors(known, moves, some))
        for part, some in at.chunks()
    ])
    return Cut(tuple(shares), tuple(rows), along, at.move, bent)


def _spans(machine: Machine, way: np.ndarray) -> np.ndarray:
    """(m,) in how many spans moves by (m, k) are looked at."""
    limit = [_SPAN_TURN if machine.axes[name].rotary else _SPAN for name in machine.letters]
    return np.ceil((np.abs(way) / limit).max(axis=1)).astype(int)


def _parts(values: np.ndarray, shares: list[np.ndarray]) -> list[np.ndarray]:
    return np.split(values, np.cumsum([len(share) for share in shares])[:-1])


def _errors(known: KnownErrors, moves: Moves, at: _Points) -> np.ndarray:
    return known.named(at.nominal, at.approach, lambda row: moves.names[at.move[row]])


def _changes(
    known: KnownErrors, moves: Moves, chosen: np.ndarray, shares: list[np.ndarray],
    approach: np.ndarray,
) -> np.ndarray:
    """(n, k) corrections at shares of the chosen moves."""
    return np.concatenate([
        correct(known.machine, some.nominal, _errors(known, moves, some)).change
        for _, some in _Points.of(moves, chosen, shares, approach).chunks()
    ])


def _between(changes: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """(n, k) at shares (n,) of a move, straight between changes (p + 1, k) at even ones."""
    even = np.linspace(0.0, 1.0, len(changes))
    return np.stack([np.interp(shares, even, column) for column in changes.T], axis=1)


def _apart(
    known: KnownErrors, moves: Moves, chosen: np.ndarray, shares: list[np.ndarray],
    one: np.ndarray, other: np.ndarray,
) -> np.ndarray:
    """(n,) how far the tool is from where it should be when run with one change, not the other.

    To first order in them; [m], directions at the lever.
    """
    off = []
    for part, some in _Points.of(moves, chosen, shares, moves.approach).chunks():
        point, axis = axis_slopes(known.machine, some.nominal)
        step = (one - other)[part]
        off.append(np.maximum(
            np.linalg.norm(np.einsum('nik,nk->ni', point, step), axis=1),
            _LEVER * np.linalg.norm(np.einsum('nik,nk->ni', axis, step), axis=1),
        ))
    return np.concatenate(off)
