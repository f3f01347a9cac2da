"""Find and name what the base model lacks: projected signatures, extended BIC, rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_identification.gap.effects import Effect
from rtest_identification.gap.rows import Rows

# A candidate of which less than this is left beside the base model is invisible in these data.
VISIBLE = 0.02
NOTHING = 1e-9
# Probability of taking the best of all candidates for real where there is nothing.
FALSE_ALARM = 0.001
# Candidates less than 100 times less likely are rivals.
RIVAL = math.log(100.0)
MAX_RIVALS = 8
MAX_EFFECTS = 4
_TRIALS = 3000
_FIRST = 30


@dataclass(frozen=True)
class Candidate:
    """An effect with one shape; `basis` (m, k) is what is left of it beside the base model."""

    effect: Effect
    shape: tuple[float, ...]
    basis: np.ndarray
    left: float

    @property
    def count(self) -> int:
        """Unknowns: linear ones that the data show, and the shape."""
        return self.basis.shape[1] + len(self.shape)


@dataclass(frozen=True)
class Named:
    """An effect found, how sure its name is, and who else it could be."""

    candidate: Candidate
    confidence: float
    rivals: tuple[str, ...]


@dataclass(frozen=True)
class Search:
    """Result of a search.

    named : effects in the order found
    invisible : keys of which these data show nothing
    probability : of the strongest candidate where there is nothing, over all candidates
    before, after : chi-squared per degree of freedom without and with what was named
    freedom : degrees of freedom of `after`
    """

    named: tuple[Named, ...]
    invisible: tuple[str, ...]
    probability: float
    before: float
    after: float
    freedom: int


class Projection:
    """Whitened rows with the base model taken out, and all candidates in them."""

    def __init__(self, rows: Rows, effects: Sequence[Effect]) -> None:
        base = rows.white(rows.base)
        u, s, _ = np.linalg.svd(
            base / np.maximum(np.linalg.norm(base, axis=0), 1e-300), full_matrices=False
        )
        self.base = u[:, s > 1e-6 * s[0]]
        y = rows.white(rows.residual)
        self.y = y - self.base @ (self.base.T @ y)
        self.freedom = len(y) - self.base.shape[1]
        self.candidates: list[Candidate] = []
        invisible = []
        for effect in effects:
            seen = False
            for shape in effect.grid:
                candidate = self.project(rows, effect, shape)
                if candidate is not None:
                    self.candidates.append(candidate)
                    seen = True
            if not seen:
                invisible.append(effect.key)
        self.invisible = tuple(invisible)
        self.all = np.concatenate([c.basis for c in self.candidates], axis=1)
        ends = np.cumsum([c.basis.shape[1] for c in self.candidates])
        self.slices = [
            slice(int(e) - c.basis.shape[1], int(e))
            for e, c in zip(ends, self.candidates, strict=True)
        ]
        self.gram = self.all.T @ self.all
        self.score = self.all.T @ self.y
        self.total = float(self.y @ self.y)

    def project(self, rows: Rows, effect: Effect, shape: tuple[float, ...]) -> Candidate | None:
        """What is left of an effect beside the base model; None where nothing is."""
        raw = effect.columns(rows.scene, shape)
        # A column of rounding errors is no signature: less than a nanometre per unit.
        moves = np.abs(raw).max(axis=(0, 1)) > NOTHING
        if not moves.any():
            return None
        columns = rows.white(raw[:, :, moves])
        norm = np.linalg.norm(columns, axis=0)
        whole, size, _ = np.linalg.svd(columns / norm, full_matrices=False)
        whole = whole[:, size > 1e-6 * size[0]]
        u, s, _ = np.linalg.svd(whole - self.base @ (self.base.T @ whole), full_matrices=False)
        kept = u[:, s > VISIBLE]
        if not kept.shape[1]:
            return None
        return Candidate(effect, shape, kept, float(s[0]))

    def gain(self, chosen: Sequence[int]) -> float:
        """By how much these candidates together lower the sum of squares."""
        if not chosen:
            return 0.0
        place = np.concatenate([np.arange(s.start, s.stop) for s in map(self.slice, chosen)])
        gram, score = self.gram[np.ix_(place, place)], self.score[place]
        values, vectors = np.linalg.eigh(gram)
        good = values > 1e-3
        return float(((vectors[:, good].T @ score) ** 2 / values[good]).sum())

    def slice(self, index: int) -> slice:
        """Columns of a candidate in `all`."""
        return self.slices[index]

    def criterion(self, chosen: Sequence[int]) -> float:
        """Extended BIC of a set of candidates (Chen and Chen 2008, gamma = 1)."""
        rest = max(self.total - self.gain(chosen), 1e-12)
        count = sum(self.candidates[i].count for i in chosen)
        keys = len({c.effect.key for c in self.candidates})
        choices = math.lgamma(keys + 1) - math.lgamma(len(chosen) + 1)
        choices -= math.lgamma(keys - len(chosen) + 1)
        n = self.freedom
        return n * math.log(rest / n) + count * math.log(n) + 2.0 * choices

    def likelihood(self, chosen: Sequence[int]) -> float:
        """Logarithm of the likelihood, up to a constant."""
        rest = max(self.total - self.gain(chosen), 1e-12)
        return -0.5 * self.freedom * math.log(rest)

    def probability(self, index: int, given: Sequence[int] = ()) -> float:
        """F test of one candidate beside those given."""
        more = self.gain([*given, index]) - self.gain(given)
        rest = self.total - self.gain([*given, index])
        k = self.candidates[index].basis.shape[1]
        used = sum(self.candidates[i].basis.shape[1] for i in given) + k
        free = self.freedom - used
        return float(stats.f.sf(more / k / (rest / free), k, free))

    def threshold(self, seed: int = 1) -> np.ndarray:
        """Sorted smallest probabilities over all candidates of sessions without an effect."""
        rng = np.random.default_rng(seed)
        smallest = np.ones(_TRIALS)
        sizes = np.array([c.basis.shape[1] for c in self.candidates])
        owner = np.repeat(np.arange(len(sizes)), sizes)
        for begin in range(0, _TRIALS, 250):
            noise = rng.standard_normal((len(self.y), 250))
            noise -= self.base @ (self.base.T @ noise)
            total = (noise**2).sum(axis=0)
            squares = (self.all.T @ noise) ** 2
            gains = np.zeros((len(sizes), 250))
            np.add.at(gains, owner, squares)
            f = gains / sizes[:, None] / ((total - gains) / (self.freedom - sizes)[:, None])
            p = stats.f.sf(f, sizes[:, None], (self.freedom - sizes)[:, None])
            smallest[begin : begin + 250] = p.min(axis=0)
        return np.sort(smallest)


def search(projection: Projection) -> Search:
    """Singles and pairs first, then grow, swap and drop while the criterion falls."""
    candidates = projection.candidates
    everyone = range(len(candidates))
    null = projection.threshold()
    strongest = min(projection.probability(i) for i in everyone)
    probability = float(np.searchsorted(null, strongest, 'right') + 1) / (len(null) + 1)
    limit = null[int(FALSE_ALARM * len(null))]
    if strongest > limit:
        return _result(projection, [], probability)
    singles = sorted(everyone, key=lambda i: projection.criterion([i]))
    sets = [[singles[0]]]
    for first in singles[:_FIRST]:
        others = (i for i in everyone if candidates[i].effect.key != candidates[first].effect.key)
        second = min(others, key=lambda i, f=first: projection.criterion([f, i]))
        sets.append([first, second])
    best = min(sets, key=projection.criterion)
    best = _improve(projection, best, limit)
    return _result(projection, best, probability)


def _result(projection: Projection, best: list[int], probability: float) -> Search:
    named = tuple(_name(projection, best, place) for place in range(len(best)))
    freedom = projection.freedom - sum(projection.candidates[i].count for i in best)
    return Search(
        named, projection.invisible, probability, projection.total / projection.freedom,
        (projection.total - projection.gain(best)) / freedom, freedom,
    )


def _improve(projection: Projection, best: list[int], limit: float) -> list[int]:
    candidates = projection.candidates
    while True:
        keys = {candidates[i].effect.key for i in best}
        free = [i for i in range(len(candidates)) if candidates[i].effect.key not in keys]
        moves = [best[:k] + best[k + 1 :] for k in range(len(best)) if len(best) > 1]
        for k, old in enumerate(best):
            same = [
                i for i in range(len(candidates))
                if candidates[i].effect.key == candidates[old].effect.key and i != old
            ]
            moves += [[*best[:k], i, *best[k + 1 :]] for i in (*free, *same)]
        if len(best) < MAX_EFFECTS:
            # Significance is judged as strictly for the next effect as for the first.
            moves += [[*best, i] for i in free if projection.probability(i, best) <= limit]
        move = min(moves, key=projection.criterion, default=None)
        if move is None or projection.criterion(move) >= projection.criterion(best) - 1e-9:
            return best
        best = move


def _name(projection: Projection, best: list[int], place: int) -> Named:
    """Confidence and rivals of one effect, the others staying."""
    candidates = projection.candidates
    own = candidates[best[place]]
    taken = {candidates[i].effect.key for i in best}
    own_likelihood, own_criterion = projection.likelihood(best), projection.criterion(best)
    likely: dict[str, float] = {}
    weight: dict[str, float] = {}
    for index, candidate in enumerate(candidates):
        key = candidate.effect.key
        if key in taken:
            continue
        other = [*best[:place], index, *best[place + 1 :]]
        likely[key] = max(likely.get(key, -math.inf), projection.likelihood(other))
        weight[key] = min(weight.get(key, math.inf), projection.criterion(other))
    rivals = [k for k, v in likely.items() if v > own_likelihood - RIVAL]
    rivals.sort(key=lambda k: weight[k])
    others = sum(math.exp(-0.5 * min(w - own_criterion, 700.0)) for w in weight.values())
    return Named(own, 1.0 / (1.0 + others), tuple(rivals[:MAX_RIVALS]))
