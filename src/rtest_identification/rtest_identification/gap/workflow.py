"""The workflow: where the gap is, what it is, add it, prove it, and stop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, stats

from rtest_identification.error_map import stations
from rtest_identification.gap.effects import Effect, library
from rtest_identification.gap.generic import generic_probability
from rtest_identification.gap.model_file import Model
from rtest_identification.gap.rows import Rows, make_rows
from rtest_identification.gap.search import VISIBLE, Named, Projection, Search, search
from rtest_identification.gap.separate import separate
from rtest_identification.gap.where import Place, locate
from rtest_identification.observations import Observations
from rtest_identification.symbols import RANK_TOLERANCE, ErrorParameter, location_parameters

# Of the excess over the noise, effects that are named must take at least this share: less is a
# part of something else that the library does not have.
EXPLAINED_SHARE = 0.5
# Probability of seeing an unexplained rest where there is none. Stricter than for a candidate: the
# noise by which it is judged is itself estimated, by levels where they differ.
REST_ALARM = 0.0005
# A name this unsure in the presence of an unexplained rest is no name.
SURE = 0.9


Chosen = tuple[Effect, tuple[float, ...]]


@dataclass(frozen=True)
class Found:
    """An effect that was added, with its size.

    value, stddev : of `effect.parameters`, then of its shape
    separate_by : the measurement that would tell it from its rivals
    """

    effect: Effect
    shape: tuple[float, ...]
    value: np.ndarray
    stddev: np.ndarray
    confidence: float
    rivals: tuple[str, ...]
    separate_by: str


@dataclass(frozen=True)
class Gap:
    """The gap as numbers [m]: rms per component, before and after, fitted and held out."""

    noise: float
    before: float
    after: float
    heldout_before: float
    heldout_after: float


@dataclass(frozen=True)
class Constants:
    """Location errors and squareness; value, stddev : (p,) [m] or [rad]."""

    parameters: tuple[ErrorParameter, ...]
    value: np.ndarray
    stddev: np.ndarray


@dataclass(frozen=True)
class GapResult:
    """What the workflow found in one session.

    constants : location errors and squareness, identified together with the effects
    rows : the session against its base model, with the noise as finally known
    residual : (n, 3) what is left after the effects were added [m]
    """

    verdict: str
    found: tuple[Found, ...]
    invisible: tuple[str, ...]
    where: tuple[Place, ...]
    gap: Gap
    probability: float
    rest_probability: float
    constants: Constants
    rows: Rows
    residual: np.ndarray


def analyse(
    observations: Observations,
    start: int,
    directions: Mapping[str, np.ndarray],
    known: Model | None = None,
    more: Sequence[Effect] = (),
) -> GapResult:
    """Find what the base model lacks in the poses of one session.

    start : of the session [ns]; directions : of the gauges by set-up
    known : a model whose effects are free besides the base model's errors
    more : effects of the user's own

    Raises UserError where the model has an effect that the machine cannot have.
    """
    rows = make_rows(observations, start, directions)
    effects = [*library(rows.scene), *more]
    model = known.resolve(effects) if known else []
    if model:
        have = {effect.key for effect, _ in model}
        rows = make_rows(observations, start, directions, model)
        effects = [effect for effect in effects if effect.key not in have]
    first = search(Projection(rows, effects))
    if first.named:
        # What was found is no longer taken for noise, and the names are judged anew.
        chosen = [(n.candidate.effect, n.candidate.shape) for n in first.named]
        richer = make_rows(observations, start, directions, [*model, *chosen])
        rows = replace(rows, sigma=richer.sigma, freedom=richer.freedom)
        first = search(Projection(rows, effects))
    chosen, spread = _refine(rows, first.named)
    named, verdict, rest = _judge(rows, first, chosen)
    held = _hold_out(rows, effects)
    if named and held[1] > held[0]:
        # What makes poses that took no part worse is not there, whatever it does to the others.
        named, verdict = (), 'unknown effect'
    found = _size(rows, named, chosen, spread, more)
    after = make_rows(
        observations, start, directions, [*model, *((f.effect, f.shape) for f in found)]
    )
    gap = Gap(
        float(np.sqrt(np.mean(rows.sigma**2))), _rms(rows.residual, rows.base),
        _rms(after.residual, after.base), *held,
    )
    return GapResult(
        verdict, found, first.invisible, locate(rows), gap, first.probability, rest,
        _constants(after), rows, after.residual,
    )


def _constants(rows: Rows) -> Constants:
    """The base model's own errors, at whose values the rows stand."""
    parameters = location_parameters(rows.scene.machine)
    design = rows.white(rows.base)
    norm = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    _, s, vt = np.linalg.svd(design / norm, full_matrices=False)
    good = s > RANK_TOLERANCE * s[0]
    variance = ((vt[good] / s[good, None]) ** 2).sum(axis=0) / norm**2
    return Constants(parameters, rows.errors, np.sqrt(variance[: len(parameters)]))


def _rms(residual: np.ndarray, base: np.ndarray) -> float:
    return float(np.sqrt((residual**2).sum() / max(residual.size - base.shape[2], 1)))


def _judge(
    rows: Rows, result: Search, chosen: Sequence[Chosen]
) -> tuple[tuple[Named, ...], str, float]:
    """Verdict, from what is named and what is left beyond the noise."""
    named, after, freedom = result.named, result.after, result.freedom
    if chosen:
        # With the refined shapes: between two values of a grid a large effect leaves a rest.
        after = _visible(rows, chosen)[2] / freedom
    misfit = float(stats.f.sf(after, freedom, rows.freedom))
    rest = min(misfit, generic_probability(rows, chosen))
    if rest > REST_ALARM:
        return named, 'explained' if named else 'no gap', rest
    if named:
        excess = max(result.before - 1.0, 1e-9)
        share = (result.before - after) / excess
        if share >= EXPLAINED_SHARE and min(n.confidence for n in named) >= SURE:
            return named, 'partly explained', rest
    return (), 'unknown effect', rest


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


def _visible(
    rows: Rows, chosen: Sequence[tuple[Effect, tuple[float, ...]]]
) -> tuple[np.ndarray, np.ndarray, float]:
    """Parameters of effects beside the base model, cofactor, and sum of squares.

    Combinations of parameters that the base model can take over are not in the data: they are set
    to zero, so that a size is stated only for what is seen.
    """
    base = rows.white(rows.base)
    u, s, _ = np.linalg.svd(
        base / np.maximum(np.linalg.norm(base, axis=0), 1e-300), full_matrices=False
    )
    u = u[:, s > 1e-6 * s[0]]
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
    return value / norm, inverse @ inverse.T / np.outer(norm, norm), rest


def _refine(rows: Rows, named: Sequence[Named]) -> tuple[list[Chosen], list[float]]:
    """Best shapes between the values of the grids, and their standard uncertainties."""
    chosen = [(n.candidate.effect, n.candidate.shape) for n in named]
    spread = [float('nan')] * len(chosen)

    def cost(place: int, value: float) -> float:
        trial = [*chosen]
        trial[place] = (chosen[place][0], (value,))
        return _visible(rows, trial)[2]

    for place, (effect, shape) in enumerate(chosen):
        if len(shape) != 1:
            continue
        grid = sorted({s[0] for s in effect.grid})
        at = grid.index(shape[0])
        low, high = grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]
        best = shape[0]
        if high > low:
            refined = optimize.minimize_scalar(
                lambda v, place=place: cost(place, v), bounds=(low, high), method='bounded'
            )
            best = float(refined.x) if refined.fun < cost(place, shape[0]) else shape[0]
        step = 0.02 * (high - low) or 1e-3
        bend = cost(place, best + step) - 2 * cost(place, best) + cost(place, best - step)
        spread[place] = float(np.sqrt(2.0 * step**2 / bend)) if bend > 0 else high - low
        chosen[place] = (effect, (best,))
    return chosen, spread


def _size(
    rows: Rows,
    named: Sequence[Named],
    chosen: Sequence[Chosen],
    spread: Sequence[float],
    more: Sequence[Effect],
) -> tuple[Found, ...]:
    """Every parameter with its standard uncertainty."""
    if not named:
        return ()
    value, cofactor, rest = _visible(rows, chosen)
    free = 3 * len(rows.residual) - rows.base.shape[2] - len(value)
    stddev = np.sqrt(max(rest / max(free, 1), 1.0) * np.diag(cofactor))
    found, column = [], 0
    for (effect, shape), width, name in zip(chosen, spread, named, strict=True):
        part = slice(column, column + len(effect.parameters))
        column = part.stop
        found.append(
            Found(
                effect, shape, np.append(value[part], shape),
                np.append(stddev[part], [width] * len(shape)), name.confidence, name.rivals,
                separate(rows, effect, name.rivals, more),
            )
        )
    return tuple(found)


def _hold_out(rows: Rows, effects: Sequence[Effect]) -> tuple[float, float]:
    """Gap on levels of the outer axis that took no part in naming and fitting.

    Two folds of inner levels; the outermost always take part, so that nothing is extrapolated.
    """
    axis = rows.scene.machine.rotary[0]
    level = stations(rows.scene.position(axis))[1]
    inner = np.arange(1, level.max())
    if len(inner) < 2:
        return float('nan'), float('nan')
    before = after = 0.0
    count = 0
    for fold in (inner[::2], inner[1::2]):
        held = np.isin(level, fold)
        train = rows.keep(~held)
        result = search(Projection(train, effects))
        chosen = [(n.candidate.effect, n.candidate.shape) for n in result.named]
        y = rows.white(rows.residual)
        mask = np.repeat(held, 3)
        for extra, total in (((), 'before'), (chosen, 'after')):
            design = _design(rows, extra)
            value, _, _ = _solve(design[~mask], y[~mask])
            left = (y - design @ value).reshape(-1, 3)[held] * rows.sigma[held, None]
            if total == 'before':
                before += float((left**2).sum())
            else:
                after += float((left**2).sum())
        count += 3 * int(held.sum())
    return float(np.sqrt(before / count)), float(np.sqrt(after / count))
