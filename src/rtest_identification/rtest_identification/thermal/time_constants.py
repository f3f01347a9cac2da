"""Time constants: changes that settle as 1 - exp(-t / tau), while warming up and cooling down."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_identification.thermal.series import Series
from rtest_identification.uncertainty import COVERAGE_FACTOR

# Level, size and time constant need three cycles, and one more to be judged.
FEWEST = 4
# A turn from warming to cooling is believed where chance makes it this rarely.
TURN_PROBABILITY = 0.001
_STEPS = 400


@dataclass(frozen=True)
class Phase:
    """Cycles over which the machine goes one way: warms up, or cools down again.

    first, last : index of its first and last cycle; start, end : times of these [s]
    """

    first: int
    last: int
    start: float
    end: float


@dataclass(frozen=True)
class TimeConstant:
    """How one error settles within a phase: change = level - rest exp(-(t - start) / tau).

    start : time of the first cycle of the phase that determines the error [s]
    tau : [s], interval : where it can lie (k = 2) [s]; the upper end is infinite where a straight
        line does as well
    rest, rest_stddev : how far it goes from the start until it has settled
    level : change since the reference when it has settled
    undetermined : why no time constant can be given; '' where it can
    misfit : probability of a misfit as large as this one by noise alone
    """

    phase: Phase
    start: float
    tau: float
    interval: tuple[float, float]
    rest: float
    rest_stddev: float
    level: float
    undetermined: str
    misfit: float

    def curve(self, time: np.ndarray) -> np.ndarray:
        """Change since the reference at times within the phase [s]."""
        return self.level - self.rest * np.exp(-(time - self.start) / self.tau)


@dataclass(frozen=True)
class _Scan:
    """Weighted least squares of level and size for every time constant tried."""

    tau: np.ndarray
    chi2: np.ndarray
    line: float
    level: np.ndarray
    size: np.ndarray
    variance: np.ndarray


def phases(series: Sequence[Series], time: np.ndarray) -> tuple[Phase, ...]:
    """One phase, or two where the errors that drift turn back together.

    series : those that drift; time : (k,) of every cycle [s]
    """
    whole = Phase(0, len(time) - 1, float(time[0]), float(time[-1]))
    splits = range(FEWEST, len(time) - FEWEST + 1)
    if not series or not len(splits):
        return (whole,)
    chi2, freedom = _misfit(series, whole)
    tried = []
    for split in splits:
        parts = (
            Phase(0, split - 1, float(time[0]), float(time[split - 1])),
            Phase(split, len(time) - 1, float(time[split]), float(time[-1])),
        )
        both = [_misfit(series, part) for part in parts]
        tried.append((sum(b[0] for b in both), sum(b[1] for b in both), parts))
    best, left, parts = min(tried, key=lambda item: item[0])
    added = freedom - left
    if left <= 0 or added <= 0:
        return (whole,)
    # The noise is known: what is left may not be smaller.
    ratio = (chi2 - best) / added / max(best / left, 1.0)
    unlikely = stats.f.sf(ratio, added, left) * len(splits) < TURN_PROBABILITY
    return parts if unlikely and _turns(series, parts) else (whole,)


def time_constant(one: Series, phase: Phase, period: float) -> TimeConstant | None:
    """Time constant of one error in one phase; None where there are too few cycles.

    period : time from cycle to cycle [s], below which nothing can be seen
    """
    rows = _rows(one, phase)
    if len(rows) < FEWEST:
        return None
    start = float(one.time[rows[0]])
    time = one.time[rows] - start
    span = float(np.ptp(time))
    scan = _scan(time, one.value[rows], one.scatter[rows])
    best = int(scan.chi2.argmin())
    freedom = len(rows) - 3
    variance = max(1.0, float(scan.chi2[best]) / freedom)
    near = scan.chi2 <= scan.chi2[best] + COVERAGE_FACTOR**2 * variance
    low, high = float(scan.tau[near].min()), float(scan.tau[near].max())
    if scan.line <= scan.chi2[best] + COVERAGE_FACTOR**2 * variance:
        high = float('inf')
    why = ''
    if high > span:
        why = (
            f'longer than {low / 60:.0f} min; near or above the {span / 60:.0f} min observed, '
            'where it looks like a straight line'
        )
    elif low < period:
        why = f'shorter than {high / 60:.0f} min; near or below the {period / 60:.0f} min ' \
              'between cycles'
    return TimeConstant(
        phase, start, float(scan.tau[best]), (low, high), float(scan.size[best]),
        float(np.sqrt(scan.variance[best] * variance)), float(scan.level[best]), why,
        float(stats.chi2.sf(scan.chi2[best], freedom)),
    )


def _rows(one: Series, phase: Phase) -> np.ndarray:
    index = np.arange(len(one.time))
    return np.flatnonzero(one.known & (index >= phase.first) & (index <= phase.last))


def _misfit(series: Sequence[Series], phase: Phase) -> tuple[float, int]:
    """Chi-squared of the best time constant of each error, and degrees of freedom."""
    chi2, freedom = 0.0, 0
    for one in series:
        rows = _rows(one, phase)
        if len(rows) < FEWEST:
            continue
        time = one.time[rows] - one.time[rows[0]]
        scan = _scan(time, one.value[rows], one.scatter[rows])
        chi2 += min(float(scan.chi2.min()), scan.line)
        freedom += len(rows) - 3
    return chi2, freedom


def _turns(series: Sequence[Series], parts: tuple[Phase, Phase]) -> bool:
    """Whether the error that moves most goes back in the second phase."""
    def way(one: Series, phase: Phase) -> float:
        rows = _rows(one, phase)
        if len(rows) < 2:
            return 0.0
        return float((one.value[rows[-1]] - one.value[rows[0]]) / one.scatter[rows].mean())

    ways = [(way(one, parts[0]), way(one, parts[1])) for one in series]
    first, second = max(ways, key=lambda pair: abs(pair[0]) + abs(pair[1]))
    return first * second < 0.0


def _scan(time: np.ndarray, value: np.ndarray, scatter: np.ndarray) -> _Scan:
    """Fit level and size for time constants from a fifth of a step to ten times the span."""
    weight = 1.0 / scatter**2
    step, span = float(np.diff(time).min()), float(np.ptp(time))
    tau = np.geomspace(0.2 * step, 10.0 * span, _STEPS)

    def fit(shape: np.ndarray) -> tuple[np.ndarray, ...]:
        total = weight.sum()
        x = shape - (shape @ weight / total)[..., None]
        y = value - value @ weight / total
        sxx = (x**2) @ weight
        size = (x * y) @ weight / sxx
        chi2 = ((y - size[..., None] * x) ** 2) @ weight
        level = value @ weight / total - size * (shape @ weight / total)
        return chi2, level, size, 1.0 / sxx

    chi2, start, size, variance = fit(1.0 - np.exp(-time / tau[:, None]))
    line = float(fit(time[None, :] / span)[0][0])
    return _Scan(tau, chi2, line, start + size, size, variance)
