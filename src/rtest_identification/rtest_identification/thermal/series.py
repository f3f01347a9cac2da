"""One error over the cycles of a session: what changed, and whether that is more than noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats
from scipy.interpolate import PchipInterpolator

from rtest_identification.symbols import ErrorParameter
from rtest_identification.uncertainty import COVERAGE_FACTOR

# An error drifts where chance would make as much of all errors together this rarely.
SIGNIFICANCE = 0.05


@dataclass(frozen=True)
class Series:
    """Change of one error since the reference cycle.

    time : (k,) middle of each cycle since the middle of the reference [s]
    value : (k,) [m] or [rad]; NaN where the cycle does not determine it
    stddev : (k,) of the change; 0 at the reference
    scatter : (k,) standard deviation of what differs from cycle to cycle, at the reference too;
        what is fitted over time has a free level and these as uncertainties
    """

    parameter: ErrorParameter
    time: np.ndarray
    value: np.ndarray
    stddev: np.ndarray
    scatter: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """(k,) bool."""
        return np.isfinite(self.value)


@dataclass(frozen=True)
class Drift:
    """Whether an error drifts.

    probability : of changes this large from noise alone; adjusted : the same of all errors asked
        about together (Holm 1979)
    last, largest : change and its standard uncertainty at the last cycle that determines it, and
        where it is largest against its uncertainty
    beyond_since : time from which on it stays beyond U [s]; None where it does not end beyond U
    """

    probability: float
    adjusted: float
    last: tuple[float, float]
    largest: tuple[float, float]
    beyond_since: float | None

    @property
    def size(self) -> float:
        """The largest change over its U."""
        value, stddev = self.largest
        return abs(value) / (COVERAGE_FACTOR * stddev) if stddev > 0.0 else 0.0

    @property
    def significant(self) -> bool:
        """More than noise makes of so many errors, and somewhere beyond U."""
        return self.adjusted < SIGNIFICANCE and self.size > 1.0


def change_between(one: Series, start: float, times: np.ndarray) -> np.ndarray:
    """Change from a time to others near it [s], by the curve through the cycles around."""
    curve = PchipInterpolator(one.time[one.known], one.value[one.known])
    return curve(times) - curve(start)


def variation(
    values: Sequence[np.ndarray], covariances: Sequence[np.ndarray], freedom: int
) -> float:
    """Probability of vectors that differ this much from cycle to cycle by noise alone (F test).

    values : (q,) of each cycle; covariances : (q, q), by a noise known with `freedom` degrees of
        freedom, of the same rank in every cycle
    """
    if len(values) < 2 or freedom <= 0:
        return 1.0
    # Directions that the data determine; the same ones in every cycle.
    w, v = np.linalg.eigh(covariances[0])
    kept = v[:, w > 1e-9 * w[-1]]
    weights = [np.linalg.inv(kept.T @ c @ kept) for c in covariances]
    seen = [kept.T @ value for value in values]
    mean = np.linalg.solve(sum(weights), sum(w @ x for w, x in zip(weights, seen, strict=True)))
    chi2 = sum((x - mean) @ w @ (x - mean) for w, x in zip(weights, seen, strict=True))
    degrees = kept.shape[1] * (len(values) - 1)
    return float(stats.f.sf(chi2 / degrees, degrees, freedom))


def holm(probabilities: Sequence[float]) -> np.ndarray:
    """Probabilities adjusted for asking so many questions at once (Holm 1979)."""
    p = np.asarray(probabilities, dtype=float)
    order = np.argsort(p)
    adjusted = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    result = np.empty_like(p)
    result[order] = np.minimum(adjusted, 1.0)
    return result


def drifts(series: Sequence[Series], freedom: int) -> tuple[Drift, ...]:
    """Judge every error, all together. freedom : of the noise."""
    probabilities = [
        variation(
            one.value[one.known][:, None], (one.scatter[one.known] ** 2)[:, None, None], freedom
        )
        for one in series
    ]
    return tuple(
        _drift(one, probability, adjusted)
        for one, probability, adjusted in zip(
            series, probabilities, holm(probabilities), strict=True
        )
    )


def _drift(one: Series, probability: float, adjusted: float) -> Drift:
    known = np.flatnonzero(one.known)
    if not len(known):
        nothing = (float('nan'), float('nan'))
        return Drift(1.0, 1.0, nothing, nothing, None)
    last = int(known[-1])
    # Against its uncertainty; the reference has none.
    part = np.abs(one.value[known]) / np.maximum(one.stddev[known], 1e-15)
    largest = int(known[part.argmax()])
    inside = np.abs(one.value[known]) <= COVERAGE_FACTOR * one.stddev[known]
    first = known[np.flatnonzero(inside)[-1] + 1 :] if inside.any() else known
    return Drift(
        probability, float(adjusted),
        (float(one.value[last]), float(one.stddev[last])),
        (float(one.value[largest]), float(one.stddev[largest])),
        float(one.time[first[0]]) if len(first) else None,
    )
