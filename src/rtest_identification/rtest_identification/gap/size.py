"""How large the effects are that were named: what the data show of them, with uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_identification.gap.effects import Effect
from rtest_identification.gap.projection import VISIBLE
from rtest_identification.gap.rows import Rows
from rtest_identification.gap.search import Named
from rtest_identification.gap.separate import separate

# A parameter of which this share is in what the data do not show is not determined.
HIDDEN_SHARE = 0.05

Chosen = tuple[Effect, tuple[float, ...]]


@dataclass(frozen=True)
class Found:
    """An effect that was added, with its size.

    value, stddev : of `effect.parameters`, then of its shape; where the data show a parameter only
        together with others stddev is infinite and value a part of it
    strength : signal to noise, the norm of what the base model leaves of it in standard deviations
    seen : rms of that over all poses and directions [m]
    separate_by : the measurement that would tell it from its rivals
    """

    effect: Effect
    shape: tuple[float, ...]
    value: np.ndarray
    stddev: np.ndarray
    strength: float
    seen: float
    confidence: float
    rivals: tuple[str, ...]
    separate_by: str


def sizes(
    rows: Rows,
    named: Sequence[Named],
    chosen: Sequence[Chosen],
    more: Sequence[Effect],
) -> tuple[Found, ...]:
    """Every parameter with its standard uncertainty."""
    if not named:
        return ()
    value, cofactor, rest = visible(rows, chosen)
    free = 3 * len(rows.residual) - rows.base.shape[2] - len(value)
    variance = max(rest / max(free, 1), 1.0) * np.diag(cofactor)
    spread = _spread(rows, chosen)
    for place, width in enumerate(spread):
        if np.isfinite(width):
            # What the others become where the shape is a standard uncertainty off.
            low, high = (
                visible(rows, _reshaped(chosen, place, chosen[place][1][0] + step))[0]
                for step in (-width, width)
            )
            variance = variance + (0.5 * (high - low)) ** 2
    stddev = np.sqrt(variance)
    found, column = [], 0
    base = _base(rows)
    rms = float(np.sqrt(np.mean(rows.sigma**2) / rows.residual.size))
    for (effect, shape), width, name in zip(chosen, spread, named, strict=True):
        part = slice(column, column + len(effect.parameters))
        column = part.stop
        whole = rows.white(effect.columns(rows.scene, shape) @ value[part])
        strength = float(np.linalg.norm(whole - base @ (base.T @ whole)))
        found.append(
            Found(
                effect, shape, np.append(value[part], shape),
                np.append(stddev[part], [width] * len(shape)), strength, strength * rms,
                name.confidence, name.rivals,
                separate(rows, effect, name.rivals, more),
            )
        )
    return tuple(found)


def visible(
    rows: Rows, chosen: Sequence[tuple[Effect, tuple[float, ...]]]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Parameters of effects beside the base model, cofactor, and sum of squares.

    Combinations of parameters that the base model can take over are not in the data: they are set
    to zero, so that a size is stated only for what is seen.
    """
    u = _base(rows)
    y = rows.white(rows.residual)
    y = y - u @ (u.T @ y)
    columns = rows.white(np.concatenate([e.columns(rows.scene, s) for e, s in chosen], axis=2))
    norm = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    columns = columns / norm
    v, s, wt = np.linalg.svd(columns - u @ (u.T @ columns), full_matrices=False)
    good = s > VISIBLE
    inverse = wt[good].T / s[good]
    value = inverse @ (v[:, good].T @ y)
    rest = float(y @ y - ((v[:, good].T @ y) ** 2).sum())
    cofactor = inverse @ inverse.T / np.outer(norm, norm)
    # What lies partly in a combination that is set to zero may have any size.
    open_ones = (wt[~good] ** 2).sum(axis=0) > HIDDEN_SHARE**2
    cofactor[open_ones, open_ones] = np.inf
    return value / norm, cofactor, rest


def overlap(rows: Rows, chosen: Sequence[Chosen]) -> float:
    """Largest cosine between what is seen of two of the effects; 0 of one alone.

    Effects that are there by themselves have little to do with each other. Those that stand in for
    another one, which the library lacks, need each other.
    """
    value, _, _ = visible(rows, chosen)
    base, seen, column = _base(rows), [], 0
    for effect, shape in chosen:
        part = slice(column, column + len(effect.parameters))
        column = part.stop
        whole = rows.white(effect.columns(rows.scene, shape) @ value[part])
        left = whole - base @ (base.T @ whole)
        seen.append(left / max(float(np.linalg.norm(left)), 1e-300))
    cosines = np.abs(np.array(seen) @ np.array(seen).T)
    return float(np.max(cosines - np.diag(np.diag(cosines))))


def _base(rows: Rows) -> np.ndarray:
    """(3 n, r) orthonormal: what the base model can do."""
    base = rows.white(rows.base)
    u, s, _ = np.linalg.svd(
        base / np.maximum(np.linalg.norm(base, axis=0), 1e-300), full_matrices=False
    )
    return u[:, s > 1e-6 * s[0]]


def _spread(rows: Rows, chosen: Sequence[Chosen]) -> list[float]:
    """Standard uncertainties of the shapes, from the curvature of the sum of squares."""
    spread = [float('nan')] * len(chosen)
    for place, (effect, shape) in enumerate(chosen):
        if len(shape) != 1:
            continue

        def cost(value: float, place: int = place) -> float:
            return visible(rows, _reshaped(chosen, place, value))[2]

        (best,), values = shape, [s[0] for s in effect.grid]
        width = max(values) - min(values) or 1.0
        # Out to where the sum of squares is one more: that far the shape is as likely as not.
        here = cost(best)
        ends = []
        for sign in (-1.0, 1.0):
            step = 1e-4 * width
            while step < width and cost(best + sign * step) < here + 1.0:
                step *= 1.5
            ends.append(step)
        spread[place] = float(np.mean(ends))
    return spread


def _reshaped(chosen: Sequence[Chosen], place: int, shape: float) -> list[Chosen]:
    """The same effects, the one at `place` with another shape."""
    return [*chosen[:place], (chosen[place][0], (shape,)), *chosen[place + 1 :]]
