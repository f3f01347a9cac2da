"""The proof: poses that took no part in naming and fitting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_identification.error_map import stations
from rtest_identification.gap.effects import Effect
from rtest_identification.gap.projection import Projection
from rtest_identification.gap.rows import Rows
from rtest_identification.gap.search import search
from rtest_identification.symbols import RANK_TOLERANCE


@dataclass(frozen=True)
class HeldOut:
    """What is left on held-out poses [m].

    worse : by how much in chi-squared with what is named
    """

    before: float
    after: float
    noise: float
    worse: float


def hold_out(rows: Rows, effects: Sequence[Effect], null: np.ndarray) -> HeldOut:
    """Gap on levels of the outer axis that took no part in naming and fitting, and their noise.

    One inner level at a time; the outermost always take part, so that nothing is extrapolated.

    null : of the search in all rows; by it the same strength counts as found in a part of them
    """
    axis = rows.scene.machine.rotary[0]
    level = stations(rows.scene.position(axis))[1]
    if level.max() < 2:
        return HeldOut(*[float('nan')] * 3, 0.0)
    squares, white = np.zeros(3), np.zeros(2)
    count = 0
    for one in range(1, level.max()):
        held = level == one
        train, sigma = rows.keep(~held), rows.sigma[held, None]
        named = search(Projection(train, effects), null).named
        chosen = [(n.candidate.effect, n.candidate.shape) for n in named]
        for place, extra in enumerate(((), chosen)):
            value, _, _ = _solve(_design(train, extra), train.white(train.residual))
            columns = [effect.columns(rows.scene, shape)[held] for effect, shape in extra]
            design = np.concatenate([rows.base[held], *columns], axis=2)
            left = rows.residual[held] - design @ value
            squares[place] += float((left**2).sum())
            white[place] += float(((left / sigma) ** 2).sum())
        squares[2] += 3.0 * float((sigma**2).sum())
        count += left.size
    return HeldOut(*np.sqrt(squares / count).tolist(), float(white[1] - white[0]))


def _design(rows: Rows, chosen: Sequence[tuple[Effect, tuple[float, ...]]]) -> np.ndarray:
    columns = [effect.columns(rows.scene, shape) for effect, shape in chosen]
    return rows.white(np.concatenate([rows.base, *columns], axis=2))


def _solve(design: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Value, cofactor and sum of squares of a least-squares problem, columns scaled."""
    norm = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    u, s, vt = np.linalg.svd(design / norm, full_matrices=False)
    # Held-out poses show at once what a nearly open combination would be extrapolated to.
    good = s > RANK_TOLERANCE * s[0]
    inverse = vt[good].T / s[good]
    value = inverse @ (u[:, good].T @ y) / norm
    cofactor = inverse @ inverse.T / np.outer(norm, norm)
    return value, cofactor, float(((y - design @ value) ** 2).sum())
