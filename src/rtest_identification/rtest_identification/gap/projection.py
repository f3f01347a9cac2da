"""Signatures of effects beside the base model: whitened, projected, what they would explain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, stats

from rtest_estimation.errors import UserError
from rtest_identification.gap.effects import Effect
from rtest_identification.gap.rows import Rows

# A candidate of which less than this is left beside the base model is invisible in these data.
VISIBLE = 0.02
NOTHING = 1e-9
# Eigenvalue of signatures' products below which they are one and the same.
_SAME = 1e-3
_TRIALS = 3000
# Values between two of a shape's grid that are tried before the best of them is refined.
_SAMPLES = 25


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


class Projection:
    """Whitened rows with the base model taken out, and all candidates in them."""

    def __init__(self, rows: Rows, effects: Sequence[Effect]) -> None:
        self.rows = rows
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
                candidate = self.project(effect, shape)
                if candidate is not None:
                    self.candidates.append(candidate)
                    seen = True
            if not seen:
                invisible.append(effect.key)
        self.invisible = tuple(invisible)
        if not self.candidates:
            raise UserError(
                f'these {len(rows.residual)} poses show no effect of the library; measure more '
                'poses, or see in `rtest info` why so many are missing'
            )
        if self.freedom <= max(c.basis.shape[1] for c in self.candidates):
            raise UserError(
                f'{len(rows.residual)} poses are too few to compare with the model; measure more, '
                'or see in `rtest info` why so many are missing'
            )
        # How many the library offers; refined shapes come to them.
        self.offered = len(self.candidates)
        self.keys = len({c.effect.key for c in self.candidates})
        self._gains: dict[tuple[int, ...], float] = {}
        self.all = np.concatenate([c.basis for c in self.candidates], axis=1)
        ends = np.cumsum([c.basis.shape[1] for c in self.candidates])
        self.slices = [
            slice(int(e) - c.basis.shape[1], int(e))
            for e, c in zip(ends, self.candidates, strict=True)
        ]
        self.gram = self.all.T @ self.all
        self.score = self.all.T @ self.y
        self.total = float(self.y @ self.y)

    def add(self, candidate: Candidate) -> int:
        """One more candidate; returns its index."""
        width = self.all.shape[1]
        self.candidates.append(candidate)
        self.slices.append(slice(width, width + candidate.basis.shape[1]))
        cross = self.all.T @ candidate.basis
        own = candidate.basis.T @ candidate.basis
        self.gram = np.block([[self.gram, cross], [cross.T, own]])
        self.score = np.append(self.score, candidate.basis.T @ self.y)
        self.all = np.concatenate([self.all, candidate.basis], axis=1)
        return len(self.candidates) - 1

    def refine(self, chosen: Sequence[int], place: int) -> int:
        """The candidate at `place` of a set with the best shape around its own; its index.

        The candidate itself where its effect has no shape, or none is better.
        """
        own = self.candidates[chosen[place]]
        if len(own.shape) != 1:
            return chosen[place]
        grid = np.unique([shape[0] for shape in own.effect.grid])
        low = grid[max(np.searchsorted(grid, own.shape[0] * (1 - 1e-12)) - 1, 0)]
        high = grid[min(np.searchsorted(grid, own.shape[0], 'right'), len(grid) - 1)]
        if not low < high:
            return chosen[place]
        others = [*chosen[:place], *chosen[place + 1 :]]
        columns = [self.candidates[i].basis for i in others]
        basis = np.linalg.qr(np.concatenate(columns, axis=1))[0] if columns else None
        y = self.y if basis is None else self.y - basis @ (basis.T @ self.y)

        def cost(value: float) -> float:
            candidate = self.project(own.effect, (float(value),))
            if candidate is None:
                return 0.0
            left = candidate.basis
            if basis is not None:
                left, r = np.linalg.qr(left - basis @ (basis.T @ left))
                left = left[:, np.abs(np.diag(r)) > math.sqrt(_SAME)]
            return -float(((left.T @ y) ** 2).sum())

        tried = np.linspace(low, high, _SAMPLES)
        costs = [cost(value) for value in tried]
        best = int(np.argmin(costs))
        around = tried[max(best - 1, 0)], tried[min(best + 1, _SAMPLES - 1)]
        refined = optimize.minimize_scalar(
            cost, bounds=around, method='bounded', options={'xatol': 1e-4 * (high - low)}
        )
        found, value = min((costs[best], tried[best]), (refined.fun, refined.x))
        if found >= cost(own.shape[0]) - 1e-9:
            return chosen[place]
        return self.add(self.project(own.effect, (float(value),)))

    def project(self, effect: Effect, shape: tuple[float, ...]) -> Candidate | None:
        """What is left of an effect beside the base model; None where nothing is."""
        rows = self.rows
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
        key = tuple(sorted(chosen))
        if key not in self._gains:
            self._gains[key] = self._gain(key)
        return self._gains[key]

    def _gain(self, chosen: Sequence[int]) -> float:
        place = np.concatenate([np.arange(s.start, s.stop) for s in map(self.slice, chosen)])
        gram, score = self.gram[np.ix_(place, place)], self.score[place]
        values, vectors = np.linalg.eigh(gram)
        good = values > _SAME
        return float(((vectors[:, good].T @ score) ** 2 / values[good]).sum())

    def slice(self, index: int) -> slice:
        """Columns of a candidate in `all`."""
        return self.slices[index]

    def criterion(self, chosen: Sequence[int]) -> float:
        """Extended BIC of a set of candidates (Chen and Chen 2008, gamma = 1)."""
        rest = max(self.total - self.gain(chosen), 1e-12)
        count = sum(self.candidates[i].count for i in chosen)
        choices = math.lgamma(self.keys + 1) - math.lgamma(len(chosen) + 1)
        choices -= math.lgamma(self.keys - len(chosen) + 1)
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
        if free <= 0:
            # Nothing is left to tell it from noise.
            return 1.0
        return float(stats.f.sf(more / k / (rest / free), k, free))

    def threshold(self, seed: int = 1) -> np.ndarray:
        """Sorted smallest probabilities over all candidates of sessions without an effect."""
        rng = np.random.default_rng(seed)
        smallest = np.ones(_TRIALS)
        sizes = np.array([c.basis.shape[1] for c in self.candidates])
        starts = np.cumsum(sizes) - sizes
        # Six digits are enough to count how often chance does as much.
        base, columns = self.base.astype(np.float32), self.all.astype(np.float32)
        for begin in range(0, _TRIALS, 250):
            noise = rng.standard_normal((len(self.y), 250), dtype=np.float32)
            noise -= base @ (base.T @ noise)
            total = (noise**2).sum(axis=0)
            gains = np.add.reduceat((columns.T @ noise) ** 2, starts, axis=0)
            f = gains / sizes[:, None] / ((total - gains) / (self.freedom - sizes)[:, None])
            # The smallest probability of each number of parameters is that of the largest F.
            found = [
                stats.f.sf(f[sizes == k].max(axis=0), k, self.freedom - k)
                for k in np.unique(sizes)
            ]
            smallest[begin : begin + 250] = np.min(found, axis=0)
        return np.sort(smallest)
