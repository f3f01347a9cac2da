"""Errors against temperatures: sensitivity, correlation, lag, and the sensor that explains best.

Model: change = level + k T(time - lag), by weighted least squares over the cycles. A positive lag
means that the error follows the sensor. Lags of both signs are tried. Before their first values
error and sensor are taken to have been at rest: without that, curves that settle exponentially
look alike at any lag.

Anything that only rises correlates with anything else that only rises. How many independent values
a correlation rests on (Bartlett 1935) is given with it; below four it says nothing of a cause.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_identification.thermal.series import Series
from rtest_identification.thermal.temperature import Thermometer
from rtest_identification.uncertainty import COVERAGE_FACTOR

# Cycles that sensitivity, level and lag take, and two more to judge them by.
FEWEST = 5
# Lags tried per time between cycles, and to how large a part of the session.
_STEPS = 15
_REACH = 1.0 / 3.0
# Draws of the noise of a thermometer, and parts of the time it is averaged over.
_DRAWS, _PARTS = 40, 5
# A sensor whose noise makes as much of all cycles with this probability did not change.
_CHANGED = 1e-3
# Independent values below which a correlation says nothing.
FEWEST_INDEPENDENT = 4.0
# An error of which a sensor explains less than this part does not follow it at any lag.
FOLLOWS = 0.9
# A sensor whose chi-squared is larger than the best one's by less than this is a rival: a
# likelihood of 5 % of the best one's.
_RIVAL = 6.0


@dataclass(frozen=True)
class Lag:
    """How much later than the sensor an error changes [s].

    value : NaN where none was looked for; interval : where it can lie (k = 2)
    undetermined : why it cannot be given; '' where it can
    """

    value: float
    interval: tuple[float, float]
    undetermined: str


@dataclass(frozen=True)
class Dependence:
    """One error against one sensor.

    sensitivity, stddev : at no lag [m/K] or [rad/K]
    correlation, correlation_stddev : coefficient at no lag, and its standard uncertainty by the
        noise of the measurement
    independent : number of independent values it rests on
    lag : best of both signs
    delay : best that is not negative [s]: only what a sensor showed before can explain an error;
        0 where another one explains no more
    delayed_sensitivity, delayed_stddev : at this delay
    explained : part of the variation that the delayed temperature explains
    chi2 : what it leaves, by the noise of `cycles` cycles; misfit : probability of as much
    """

    sensor: str
    sensitivity: float
    stddev: float
    correlation: float
    correlation_stddev: float
    independent: float
    lag: Lag
    delay: float
    delayed_sensitivity: float
    delayed_stddev: float
    explained: float
    chi2: float
    cycles: int
    misfit: float


@dataclass(frozen=True)
class Best:
    """Sensor that explains an error best, and those that the data do not tell from it."""

    sensor: str
    rivals: tuple[str, ...]


@dataclass(frozen=True)
class Clock:
    """When the cycles were: middle of the reference [ns], duration and distance of cycles [s]."""

    origin: int
    duration: float
    period: float

    @property
    def window(self) -> float:
        """Over which temperatures are averaged [s]."""
        return max(self.duration, self.period / 3.0)

    @property
    def near(self) -> float:
        """How far from a cycle the nearest reading of a thermometer may be [s]."""
        return max(self.duration, self.period)

    def stamps(self, time: np.ndarray) -> np.ndarray:
        """Times since the reference [s] as stamps [ns]."""
        return self.origin + np.rint(np.asarray(time) * 1e9).astype(np.int64)


def changed(thermometer: Thermometer, time: np.ndarray, clock: Clock) -> bool:
    """Whether a sensor's temperature changed over the cycles by more than its readings scatter."""
    stamps = clock.stamps(time)
    at = thermometer.mean(stamps, clock.window)
    at = at[_read(thermometer, stamps, clock)]
    spread = max(thermometer.mean_stddev(clock.window), 1e-9)
    if len(at) < 2:
        return False
    chi2 = float(((at - at.mean()) ** 2).sum()) / spread**2
    return bool(stats.chi2.sf(chi2, len(at) - 1) < _CHANGED)


def dependence(
    one: Series, thermometer: Thermometer, clock: Clock, drifting: bool
) -> Dependence | None:
    """One error against one sensor; None where they share too few cycles.

    drifting : whether the error changes at all; only then a lag is looked for
    """
    rows = np.flatnonzero(one.known & _read(thermometer, clock.stamps(one.time), clock))
    if len(rows) < FEWEST:
        return None
    time, value = one.time[rows], one.value[rows]
    lags = _lags(float(np.ptp(time)), clock.period) if drifting else np.zeros(1)
    # The error before its first cycle, when it was at rest, and at every cycle.
    early = lags[lags < 0.0]
    when = np.concatenate([time[0] + early, time])
    change = np.concatenate([np.full(len(early), value[0]), value])
    celsius = thermometer.mean(clock.stamps(when - lags[:, None]), clock.window)
    zero = int(np.abs(lags).argmin())
    now = celsius[zero, len(early) :]
    # Scatter of the temperatures counts as scatter of the error, by the slope.
    slope = float(np.polyfit(now - now.mean(), value, 1)[0]) if np.ptp(now) > 0.0 else 0.0
    scatter = np.hypot(one.scatter[rows], slope * thermometer.mean_stddev(clock.window))
    share = np.hstack([
        _at_rest(lags, early) * (rows[0] == 0), np.ones((len(lags), len(rows)))
    ])
    share[~np.isfinite(celsius)] = 0.0
    weight = share / np.concatenate([np.full(len(early), scatter[0]), scatter]) ** 2
    scan = _scan(np.nan_to_num(celsius), change, weight, share.sum(axis=1))
    lag = Lag(float('nan'), (float('nan'), float('nan')), 'the error does not drift')
    if drifting:
        asked = when - lags[:, None]
        spread = np.std([
            lags[_scan(
                np.nan_to_num(celsius + noise), change, weight, scan.count
            ).score(len(rows)).argmin()]
            for noise in _noise(thermometer, asked, clock)
        ])
        lag = _lag(lags, scan, len(rows), clock, float(np.ptp(time)), float(spread))
    follows = np.flatnonzero(lags >= 0.0)
    delayed, freedom = int(follows[scan.chi2[follows].argmin()]), len(rows) - 3
    if scan.chi2[zero] - scan.chi2[delayed] < COVERAGE_FACTOR**2 * scan.variance(delayed, freedom):
        delayed = zero
    chi2 = float(scan.chi2[delayed])
    r, r_stddev, independent = _correlation(now, value, one.scatter[rows])
    return Dependence(
        thermometer.sensor, float(scan.slope[zero]), scan.stddev(zero, len(rows) - 2),
        r, r_stddev, independent, lag,
        float(lags[delayed]), float(scan.slope[delayed]), scan.stddev(delayed, freedom),
        float(1.0 - chi2 / scan.total[delayed]) if scan.total[delayed] > 0.0 else 0.0,
        chi2, len(rows), float(stats.chi2.sf(chi2, freedom)),
    )


def _read(thermometer: Thermometer, stamps: np.ndarray, clock: Clock) -> np.ndarray:
    """Whether a temperature is known at each time."""
    known = np.isfinite(thermometer.mean(stamps, clock.window))
    return known & thermometer.covers(stamps, clock.near)


def best(found: Sequence[Dependence]) -> Best | None:
    """The sensor that leaves least of an error, of those that saw most cycles."""
    seen = max((one.cycles for one in found), default=0)
    able = [one for one in found if one.cycles == seen]
    if not able:
        return None
    first = min(able, key=lambda one: one.chi2)
    variance = max(1.0, first.chi2 / max(seen - 3, 1))
    rivals = [
        one.sensor for one in able
        if one is not first and one.chi2 - first.chi2 < _RIVAL * variance
    ]
    return Best(first.sensor, tuple(rivals))


@dataclass(frozen=True)
class _Scan:
    """Straight-line fit at every lag.

    chi2, total : of the line, and of a level alone; count : values they are sums over
    slope, cofactor : with its variance where the line fits
    """

    chi2: np.ndarray
    total: np.ndarray
    count: np.ndarray
    slope: np.ndarray
    cofactor: np.ndarray

    def score(self, count: int) -> np.ndarray:
        """Chi-squared as it would be with `count` values: one left out is as good as noise."""
        missing = count - self.count
        return self.chi2 + missing * max(1.0, float((self.chi2 + missing).min()) / (count - 3))

    def variance(self, place: int, freedom: int) -> float:
        """Variance factor, larger than one where the line does not fit (Birge)."""
        return max(1.0, float(self.chi2[place]) / freedom)

    def stddev(self, place: int, freedom: int) -> float:
        """Standard uncertainty of a slope."""
        return float(np.sqrt(self.variance(place, freedom) * self.cofactor[place]))


def _lags(span: float, period: float) -> np.ndarray:
    step = period / _STEPS
    reach = np.floor(_REACH * span / step)
    return step * np.arange(-reach, reach + 1)


def _at_rest(lags: np.ndarray, early: np.ndarray) -> np.ndarray:
    """Share of each time before the first cycle in the fit at each lag.

    A negative lag looks at the sensor ahead of time: it must not have moved while the error was
    at rest. As long as it looks ahead, that counts as one cycle.
    """
    looked = (early >= lags[:, None] - 1e-6) & (lags[:, None] < 0.0)
    return looked / np.maximum(looked.sum(axis=1, keepdims=True), 1)


def _scan(x: np.ndarray, y: np.ndarray, weight: np.ndarray, count: np.ndarray) -> _Scan:
    """Weighted fits y = level + slope x, one a row."""
    total = weight.sum(axis=1, keepdims=True)
    x = x - (weight * x).sum(axis=1, keepdims=True) / total
    y = y - (weight * y).sum(axis=1, keepdims=True) / total
    sxx = (weight * x**2).sum(axis=1)
    # Where the temperature stands still there is no slope.
    some = sxx > 0.0
    safe = np.where(some, sxx, 1.0)
    slope = np.where(some, (weight * x * y).sum(axis=1) / safe, 0.0)
    chi2 = (weight * (y - slope[:, None] * x) ** 2).sum(axis=1)
    cofactor = np.where(some, 1.0 / safe, np.inf)
    return _Scan(chi2, (weight * y**2).sum(axis=1), count, slope, cofactor)


def _noise(
    thermometer: Thermometer, asked: np.ndarray, clock: Clock
) -> Iterator[np.ndarray]:
    """Draws of what the scatter of the readings does to the temperatures at these times [K]."""
    rng = np.random.default_rng(0)
    step = clock.window / _PARTS
    first = clock.origin - int(thermometer.stamp[0])
    grid = np.arange(asked.min() - step, asked.max() + 2.0 * step, step)
    for _ in range(_DRAWS):
        parts = thermometer.mean_stddev(step) * rng.normal(size=len(grid) + _PARTS - 1)
        means = np.convolve(parts, np.full(_PARTS, 1.0 / _PARTS), 'valid')
        # Before the first reading the temperature is the same one all the time.
        yield np.interp(np.maximum(asked, -first * 1e-9), grid, means)


def _lag(
    lags: np.ndarray, scan: _Scan, count: int, clock: Clock, span: float, spread: float
) -> Lag:
    """Best lag and where it can lie. spread : by the scatter of the temperatures alone [s]."""
    score = scan.score(count)
    place = int(score.argmin())
    variance = max(1.0, float(score[place]) / (count - 3))
    near = np.flatnonzero(score <= score[place] + COVERAGE_FACTOR**2 * variance)
    why = ''
    if scan.chi2[place] > (1.0 - FOLLOWS) * scan.total[place]:
        why = 'the error does not follow this sensor at any lag'
    elif near[0] == 0 or near[-1] == len(lags) - 1:
        why = f'may be longer than a third of the {span / 60:.0f} min observed'
    elif abs(lags[place]) < clock.period:
        why = f'near or below the {clock.period / 60:.0f} min between cycles'
    # When within a cycle an error was what it is given as, is not known better than half of it.
    low, high = (
        float(np.hypot(lags[n] - lags[place], COVERAGE_FACTOR * spread)) + 0.5 * clock.duration
        for n in (near[0], near[-1])
    )
    return Lag(float(lags[place]), (float(lags[place]) - low, float(lags[place]) + high), why)


def _correlation(
    x: np.ndarray, y: np.ndarray, scatter: np.ndarray
) -> tuple[float, float, float]:
    """Coefficient, its standard uncertainty by the scatter of y, number of independent values."""
    # Weighted, so that a cycle cut short counts for as much as it is known.
    weight = scatter.min() / scatter
    share = weight**2 / (weight**2).sum()
    a, b = weight * (x - x @ share), weight * (y - y @ share)
    size_a, size_b = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    if not size_a or not size_b:
        return float('nan'), float('nan'), float('nan')
    r = float(a @ b) / (size_a * size_b)
    slope = a / (size_a * size_b) - r * b / size_b**2
    own = [float(v[1:] @ v[:-1] / (v @ v)) for v in (a, b)]
    product = float(np.clip(own[0] * own[1], 0.0, 1.0))
    independent = len(x) * (1.0 - product) / (1.0 + product)
    # In these units every cycle scatters alike.
    return r, float(scatter.min() * np.linalg.norm(slope)), independent
