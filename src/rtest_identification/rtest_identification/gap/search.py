"""Find and name what the base model lacks: singles and pairs, extended BIC, rivals."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rtest_identification.gap.projection import Candidate, Projection

# Probability of taking the best of all candidates for real where there is nothing.
FALSE_ALARM = 0.003
# The same for every further effect.
FURTHER_ALARM = 0.001
# Candidates less than 100 times less likely are rivals.
RIVAL = math.log(100.0)
# A name and its rivals are eight at most.
MAX_RIVALS = 7
MAX_EFFECTS = 4
# A further effect lowers the criterion by this much at least; one that is there does by far more.
GROWTH = 6.0
_FIRST = 12


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
    null : sorted smallest probabilities over all candidates where there is nothing
    """

    named: tuple[Named, ...]
    invisible: tuple[str, ...]
    probability: float
    before: float
    after: float
    freedom: int
    null: np.ndarray

    def without_names(self) -> Search:
        """The same rows with nothing named in them."""
        freedom = self.freedom + sum(n.candidate.count for n in self.named)
        return replace(self, named=(), after=self.before, freedom=freedom)


def search(projection: Projection, null: np.ndarray | None = None) -> Search:
    """Singles and pairs first, then grow, swap and drop while the criterion falls.

    null : of a search with the same library and nearly the same rows; made when omitted
    """
    candidates = projection.candidates
    everyone = range(len(candidates))
    if null is None:
        null = projection.threshold()
    strongest = min(projection.probability(i) for i in everyone)
    probability = float(np.searchsorted(null, strongest, 'right') + 1) / (len(null) + 1)
    if strongest > null[int(FALSE_ALARM * len(null))]:
        return _result(projection, [], probability, null)
    limit = null[int(FURTHER_ALARM * len(null))]
    singles = sorted(everyone, key=lambda i: projection.criterion([i]))
    # The best of each effect, with its best shape: between two of a grid it may look worse than
    # what only resembles it.
    leaders: dict[str, int] = {}
    for i in singles[:_FIRST]:
        leaders.setdefault(candidates[i].effect.key, i)
    sets = [[projection.refine([i], 0)] for i in leaders.values()]
    for first in singles[:_FIRST]:
        others = (i for i in everyone if candidates[i].effect.key != candidates[first].effect.key)
        second = min(others, key=lambda i, f=first: projection.criterion([f, i]))
        sets.append([first, second])
    best = min(sets, key=lambda one: projection.criterion(one) + GROWTH * (len(one) - 1))
    best = _improve(projection, _refine(projection, best), limit)
    return _result(projection, best, probability, null)


def _result(
    projection: Projection, best: list[int], probability: float, null: np.ndarray
) -> Search:
    named = tuple(_name(projection, best, place) for place in range(len(best)))
    freedom = projection.freedom - sum(projection.candidates[i].count for i in best)
    return Search(
        named, projection.invisible, probability, projection.total / projection.freedom,
        (projection.total - projection.gain(best)) / freedom, freedom, null,
    )


def _refine(projection: Projection, best: list[int]) -> list[int]:
    """The same effects with the best shapes."""
    for place in range(len(best)):
        other = [*best[:place], projection.refine(best, place), *best[place + 1 :]]
        # Never worse than before, so that a search which only goes down comes to an end.
        best = min(best, other, key=projection.criterion)
    return best


def _improve(projection: Projection, best: list[int], limit: float) -> list[int]:
    """Swap, grow and drop while the criterion falls; shapes are refined before more is added."""
    candidates = projection.candidates
    offered = range(projection.offered)
    while True:
        keys = {candidates[i].effect.key for i in best}
        free = [i for i in offered if candidates[i].effect.key not in keys]
        now = projection.criterion(best)
        moves = [(best[:k] + best[k + 1 :], 0.0) for k in range(len(best)) if len(best) > 1]
        for k, old in enumerate(best):
            same = [
                i for i in offered
                if candidates[i].effect.key == candidates[old].effect.key and i != old
            ]
            moves += [([*best[:k], i, *best[k + 1 :]], 0.0) for i in (*free, *same)]
        if len(best) < MAX_EFFECTS:
            # Significance is judged as strictly for the next effect as for the first.
            moves += [
                ([*best, i], GROWTH) for i in free if projection.probability(i, best) <= limit
            ]
        scored = [(projection.criterion(move) + more, move) for move, more in moves]
        value, move = min(scored, default=(math.inf, best))
        if value >= now - 1e-9:
            return best
        best = _refine(projection, move)


def _name(projection: Projection, best: list[int], place: int) -> Named:
    """Confidence and rivals of one effect, the others staying."""
    candidates = projection.candidates
    own = candidates[best[place]]
    taken = {candidates[i].effect.key for i in best}
    # What another effect can do at its best: of every shape the best of its grid, refined.
    nearest: dict[str, int] = {}
    for index in range(projection.offered):
        key = candidates[index].effect.key
        if key not in taken and candidates[index].shape:
            sets = [[*best[:place], i, *best[place + 1 :]] for i in (index, nearest.get(key))
                    if i is not None]
            nearest[key] = max(sets, key=projection.likelihood)[place]
    for index in nearest.values():
        projection.refine([*best[:place], index, *best[place + 1 :]], place)
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
