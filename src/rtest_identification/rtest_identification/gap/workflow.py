"""The workflow: where the gap is, what it is, add it, prove it, and stop."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from rtest_identification.gap.catalogue import every_effect
from rtest_identification.gap.effects import Effect, library, location
from rtest_identification.gap.generic import generic_probability
from rtest_identification.gap.held_out import hold_out
from rtest_identification.gap.model_file import Model
from rtest_identification.gap.projection import Projection
from rtest_identification.gap.rows import Rows, make_rows
from rtest_identification.gap.search import Named, Search, search
from rtest_identification.gap.size import HIDDEN_SHARE, Chosen, Found, overlap, sizes
from rtest_identification.gap.where import Place, locate
from rtest_identification.observations import Observations
from rtest_identification.symbols import RANK_TOLERANCE, ErrorParameter, location_parameters

# Where a rest is left, effects that are named must take at least this share of the excess over the
# noise: less is a part of something else that the library does not have.
EXPLAINED_SHARE = 0.9
# Effects that overlap more than this (cosine), two and more of them, stand in for one that the
# library does not have: of effects that are there by chance together, 3 % of the pairs do.
ENTANGLED = {2: 0.3, 3: 0.2, 4: 0.2}
# Probability of seeing an unexplained rest where there is none. Stricter than for a candidate: the
# noise by which it is judged is itself estimated, by levels where they differ.
REST_ALARM = 0.0005
# A name this unsure in the presence of an unexplained rest is no name.
SURE = 0.9
# Standard deviations by which a number of the model is told to differ.
DIFFERS = 3.0
# Something is there, though no name holds, when chance does as much in so few sessions.
SURELY_SOMETHING = 0.001
# By how much, in chi-squared, what was named may fit the held-out poses worse than nothing: a true
# effect does by chance, in three of a thousand sessions in which it is six standard deviations.
HELD_OUT_CHANCE = 9.0


@dataclass(frozen=True)
class Gap:
    """The gap as numbers [m]: rms per component, before and after, fitted and held out.

    noise : of all poses; heldout_noise : of those that are held out, which may be less noisy
    """

    noise: float
    before: float
    after: float
    heldout_before: float
    heldout_after: float
    heldout_noise: float


@dataclass(frozen=True)
class Constants:
    """Location errors and squareness; value, stddev : (p,) [m] or [rad].

    stddev is infinite where these poses do not determine the error.
    """

    parameters: tuple[ErrorParameter, ...]
    value: np.ndarray
    stddev: np.ndarray


@dataclass(frozen=True)
class Carried:
    """An effect that the model has already, as large as it is in this session.

    value, stddev : of `effect.parameters`; stddev is infinite where the data leave them open
    """

    effect: Effect
    value: np.ndarray
    stddev: np.ndarray


@dataclass(frozen=True)
class Difference:
    """A number of the model that does not hold in this session; stddev : of the difference."""

    name: str
    model: float
    found: float
    stddev: float
    unit: str


@dataclass(frozen=True)
class GapResult:
    """What the workflow found in one session.

    constants : location errors and squareness, identified together with the effects
    carried : effects of the model that was given, identified again
    differs : numbers of that model that do not hold here
    rows : the session against its base model, with the noise as finally known
    residual : (n, 3) what is left after the effects were added [m]
    odd : poses that were left out because they contradict others like them: cycle, row of its plan
    """

    verdict: str
    found: tuple[Found, ...]
    invisible: tuple[str, ...]
    where: tuple[Place, ...]
    gap: Gap
    probability: float
    rest_probability: float
    constants: Constants
    carried: tuple[Carried, ...]
    differs: tuple[Difference, ...]
    rows: Rows
    residual: np.ndarray
    odd: tuple[tuple[str, int], ...]


def analyse(
    observations: Observations,
    start: int,
    directions: Mapping[str, np.ndarray],
    known: Model | None = None,
    more: Sequence[Effect] = (),
    without: Collection[str] = (),
    spread: Mapping[str, np.ndarray] | None = None,
) -> GapResult:
    """Find what the base model lacks in the poses of one session.

    start : of the session [ns]; directions : of the gauges by set-up
    known : a model, whose effects are free besides the constants it lists
    more : effects of the user's own; without : keys of the library that are out of the question
    spread : how uncertain the nests are, from `rows.nest_spread`

    Raises UserError where the model has an effect that the machine cannot have.
    """
    machine = observations.machine
    constants = known.free(machine) if known else location_parameters(machine)
    rows = make_rows(observations, start, directions, (), constants)
    odd: list[tuple[str, int]] = []
    while rows.odd.any():
        for k in np.flatnonzero(rows.odd):
            number = observations.cycle[k]
            odd.append((observations.cycles[number], int(observations.pose[k])))
        observations = observations.keep(~rows.odd)
        rows = make_rows(observations, start, directions, (), constants)

    def model_rows(extra: Sequence[Chosen] = ()) -> Rows:
        return make_rows(observations, start, directions, [*model, *extra], constants, spread)

    effects = [*library(rows.scene), *more]
    # A model may have what these poses do not show.
    offered = {effect.key: effect for effect in (*every_effect(machine), *effects)}
    model = known.resolve(list(offered.values())) if known else []
    have = {effect.key for effect, _ in model} | set(without)
    left_out = [p for p in location_parameters(machine) if p not in constants]
    effects = [effect for effect in effects if effect.key not in have]
    effects += [location(parameter) for parameter in left_out]
    rows = model_rows()
    first = search(Projection(rows, effects))
    if first.named:
        # What was found is no longer taken for noise, and the names are judged anew.
        chosen = [(n.candidate.effect, n.candidate.shape) for n in first.named]
        richer = model_rows(chosen)
        rows = replace(
            rows, sigma=richer.sigma, freedom=richer.freedom, correlation=richer.correlation,
            nests=richer.nests,
        )
        first = search(Projection(rows, effects))
    chosen = [(n.candidate.effect, n.candidate.shape) for n in first.named]
    named, verdict, rest = _judge(rows, first, chosen)
    held = hold_out(rows, effects, first.null)
    if named and held.worse > HELD_OUT_CHANCE:
        # What makes poses that took no part worse is not there, whatever it does to the others.
        named, (_, verdict, rest) = (), _judge(rows, first.without_names(), ())
        if first.probability <= SURELY_SOMETHING:
            verdict = 'unknown effect'
    found = sizes(rows, named, chosen, more)
    after = model_rows([(f.effect, f.shape) for f in found])
    gap = Gap(
        float(np.sqrt(np.mean(rows.sigma**2))), _rms(rows.residual, rows.base),
        _rms(after.residual, after.base), held.before, held.after if found else held.before,
        held.noise,
    )
    solved, carried = _constants(after), _carried(after, model)
    return GapResult(
        verdict, found, first.invisible,
        locate(after if verdict == 'partly explained' else rows), gap, first.probability, rest,
        solved, carried, _differences(known, solved, carried), rows, after.residual, tuple(odd),
    )


def _constants(rows: Rows) -> Constants:
    """The base model's own errors, at whose values the rows stand."""
    return Constants(rows.constants, rows.errors, _stddev(rows)[: len(rows.constants)])


def _carried(rows: Rows, model: Sequence[Chosen]) -> tuple[Carried, ...]:
    """The effects that the model has, as large as they are in these rows."""
    stddev = _stddev(rows)[rows.base.shape[2] - len(rows.sizes) :]
    found, column = [], 0
    for effect, _ in model:
        part = slice(column, column + len(effect.parameters))
        column = part.stop
        found.append(Carried(effect, rows.sizes[part], stddev[part]))
    return tuple(found)


def _stddev(rows: Rows) -> np.ndarray:
    """(r,) standard uncertainty of every column of the base model; infinite where it is open."""
    design = rows.white(rows.base)
    norm = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    _, s, vt = np.linalg.svd(design / norm, full_matrices=True)
    good = np.zeros(len(vt), dtype=bool)
    good[: len(s)] = s > RANK_TOLERANCE * s[0]
    variance = ((vt[good] / s[good[: len(s)], None]) ** 2).sum(axis=0) / norm**2
    return np.sqrt(np.where((vt[~good] ** 2).sum(axis=0) > HIDDEN_SHARE**2, np.inf, variance))


def _differences(
    known: Model | None, constants: Constants, carried: Sequence[Carried]
) -> tuple[Difference, ...]:
    """Numbers of the model that do not hold here: more than three standard deviations away."""
    if known is None:
        return ()
    pairs = [
        (p.symbol, known.values.get(p.symbol), v, s, p.unit)
        for p, v, s in zip(constants.parameters, constants.value, constants.stddev, strict=True)
    ]
    for entry, now in zip(known.effects, carried, strict=True):
        pairs += [
            (f'{entry.key}: {p.name}', entry.parameters.get(p.name), v, s, p.unit)
            for p, v, s in zip(now.effect.parameters, now.value, now.stddev, strict=True)
        ]
    return tuple(
        Difference(name, old.value, float(v), float(np.hypot(s, old.stddev or 0.0)), unit)
        for name, old, v, s, unit in pairs
        if old is not None and abs(v - old.value) > DIFFERS * np.hypot(s, old.stddev or 0.0)
    )


def _rms(residual: np.ndarray, base: np.ndarray) -> float:
    return float(np.sqrt((residual**2).sum() / max(residual.size - base.shape[2], 1)))


def _judge(
    rows: Rows, result: Search, chosen: Sequence[Chosen]
) -> tuple[tuple[Named, ...], str, float]:
    """Verdict, from what is named and what is left beyond the noise."""
    named, after, freedom = result.named, result.after, result.freedom
    misfit = float(stats.f.sf(after, freedom, rows.freedom))
    rest = min(misfit, generic_probability(rows, chosen))
    if len(named) > 1 and overlap(rows, chosen) > ENTANGLED[len(named)]:
        return (), 'unknown effect', rest
    if rest > REST_ALARM:
        return named, 'explained' if named else 'no gap', rest
    if named:
        excess = max(result.before - 1.0, 1e-9)
        share = (result.before - after) / excess
        if share >= EXPLAINED_SHARE and min(n.confidence for n in named) >= SURE:
            return named, 'partly explained', rest
    return (), 'unknown effect', rest
