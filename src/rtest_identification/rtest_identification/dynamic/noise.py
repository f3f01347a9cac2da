"""How noisy the blocks are: their scatter, its correlation, and slow drift.

What repeats from turn to turn of a pass is no noise. The scatter within each pass, the correlation
of a block with the next, and the strength of a random drift of nest and machine are estimated;
rows are whitened by all three, so that a lag is not found from passes that merely drifted apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_identification.dynamic.blocks import Scene
from rtest_identification.gap.noise import whiten

# What one turn has and another of the same pass has not is noise; so many harmonics are common.
_COMMON_ORDERS = 30
# Harmonics of each pass that are not taken for drift: an effect may depend on speed.
_PASS_ORDERS = 6
_GEOMETRIC_ORDERS = 12
# Median of the absolute value of normal noise, in standard deviations.
_NORMAL_MEDIAN = 0.6745
# It tells as much of the scatter as so large a part of the rows would.
_MEDIAN_EFFICIENCY = 0.37
# No scale shows less than this [m].
_FINEST = 2e-9
# Drift is random between knots: at most so many a pass, at least so far apart [s].
_KNOTS, _KNOT_SPACING = 40, 0.2
# Strengths of drift that are tried [m/sqrt(s)]; it is believed where the likelihood rises by this.
_STRENGTHS = np.geomspace(1e-9, 1e-5, 81)
_BELIEVED = 2.0


@dataclass(frozen=True)
class Noise:
    """Noise of one channel.

    sigma : (n,) standard deviation of a row, per component [m]
    correlation : of the noise of a block with that of the next of its pass
    freedom : degrees of freedom that sigma rests on
    drift : strength of the random drift, per component [m/sqrt(s)]
    basis, less : (n, q), (q,) directions of the drift in scaled rows, and by how much whitening
        shrinks each
    """

    sigma: np.ndarray
    correlation: float
    freedom: int
    drift: float
    basis: np.ndarray
    less: np.ndarray

    def white(self, scene: Scene, values: np.ndarray) -> np.ndarray:
        """(n, 3) or (n, 3, p) to (3 n,) or (3 n, p) of unit variance, uncorrelated."""
        scaled = _scaled(scene, values, self.sigma, self.correlation)
        if self.drift:
            flat = scaled.reshape(len(scaled), -1)
            flat = flat - self.basis @ (self.less[:, None] * (self.basis.T @ flat))
            scaled = flat.reshape(scaled.shape)
        return scaled.reshape(3 * len(values), *values.shape[2:])


def waves(angle: np.ndarray, orders: int) -> np.ndarray:
    """(n, 2 orders + 1): one, then cosine and sine of every order."""
    columns = [np.ones_like(angle)]
    for order in range(1, orders + 1):
        columns += [np.cos(order * angle), np.sin(order * angle)]
    return np.stack(columns, axis=1)


def orthonormal(design: np.ndarray) -> np.ndarray:
    """(n, r) basis of the columns; what is next to nothing beside others is left out."""
    norm = np.linalg.norm(design, axis=0)
    design = design[:, norm > 1e-12 * max(norm.max(), 1e-300)]
    u, s, _ = np.linalg.svd(design / np.linalg.norm(design, axis=0), full_matrices=False)
    return u[:, s > 1e-6 * s[0]]


def estimate(scene: Scene, value: np.ndarray, drifts: bool = True) -> Noise:
    """Noise of a channel. value : (n, 3) [m]; drifts : whether it may drift."""
    sigma, correlation, freedom = _scatter(scene, value)
    none = Noise(sigma, correlation, freedom, 0.0, np.empty((len(value), 0)), np.empty(0))
    if not drifts:
        return none
    ramps = _scaled(scene, _ramps(scene), sigma, correlation)
    strength = _drift(scene, value, sigma, correlation, ramps)
    if not strength:
        return none
    # With the covariance I + N N', N = U S V', whitening is I - U (1 - 1 / sqrt(1 + S^2)) U'.
    basis, size, _ = np.linalg.svd(ramps * strength, full_matrices=False)
    return Noise(sigma, correlation, freedom, strength, basis, 1.0 - 1.0 / np.sqrt(1.0 + size**2))


def _scaled(
    scene: Scene, values: np.ndarray, sigma: np.ndarray, correlation: float
) -> np.ndarray:
    """(n, ...) over their standard deviation, the correlation of neighbours taken out."""
    scaled = values / sigma.reshape(-1, *[1] * (values.ndim - 1))
    whiten(scaled, correlation, scene.number, scene.place)
    return scaled


def _scatter(scene: Scene, value: np.ndarray) -> tuple[np.ndarray, float, int]:
    """Standard deviation of every row, correlation with the next, degrees of freedom.

    From the steady part of each pass against harmonics and a trend of its own.
    """
    sigma = np.empty(len(scene))
    product, square, freedom = 0.0, 0.0, 0
    for number, one in enumerate(scene.motion.passes):
        mine = scene.of_pass(number)
        steady = mine[scene.steady[mine]]
        turns = np.ptp(scene.angle[steady]) / (2.0 * np.pi)
        orders = int(min(_COMMON_ORDERS * min(max(turns, 0.2), 1.0), len(steady) // 6))
        time = scene.time[steady] - 0.5 * sum(one.steady)
        design = orthonormal(np.column_stack([waves(scene.angle[steady], orders), time]))
        left = value[steady] - design @ (design.T @ value[steady])
        free = max(len(steady) - design.shape[1], 1)
        # Single spikes, as at reversals, are no noise: the median does not see them.
        variance = float(np.median(np.abs(left)) / _NORMAL_MEDIAN) ** 2 * len(steady) / free
        # A short block holds more of what changes from reading to reading.
        typical = float(np.median(scene.count[steady]))
        white = min(scene.white[number] ** 2 / typical, variance)
        sigma[mine] = np.sqrt(variance + white * (typical / scene.count[mine] - 1.0))
        moving = mine[~scene.steady[mine]]
        sigma[moving] = np.maximum(sigma[moving], scene.short[number])
        product += float((left[1:] * left[:-1]).sum()) / max(variance, _FINEST**2)
        square += float((left**2).sum()) / max(variance, _FINEST**2)
        freedom += 3 * free
    found = product / max(square, 1e-300)
    correlation = float(np.clip(found, 0.0, 0.95)) if found > 4.0 / np.sqrt(freedom) else 0.0
    return np.hypot(sigma, _FINEST), correlation, round(_MEDIAN_EFFICIENCY * freedom)


def _ramps(scene: Scene) -> np.ndarray:
    """(n, q) random walk of unit strength: what happens from each knot to the next [sqrt(s)]."""
    knots = []
    for number in range(len(scene.motion.passes)):
        mine = scene.of_pass(number)
        begin, end = float(scene.begin[mine[0]]), float(scene.end[mine[-1]])
        count = int(np.clip((end - begin) / _KNOT_SPACING, 1, _KNOTS))
        knots.append(np.linspace(begin, end, count + 1))
    knots = np.unique(np.concatenate(knots))
    step = np.diff(knots)
    return np.clip((scene.time[:, None] - knots[:-1]) / step, 0.0, 1.0) * np.sqrt(step)


def _drift(
    scene: Scene, value: np.ndarray, sigma: np.ndarray, correlation: float, ramps: np.ndarray
) -> float:
    """Strength of random drift by restricted maximum likelihood, 0 where none is believed.

    Beside it everything is free that an effect could do: harmonics of the whole and of each pass,
    a trend, starts and stops.
    """
    number, steady = scene.number, scene.steady
    columns = [waves(scene.angle, _GEOMETRIC_ORDERS), scene.time[:, None]]
    own = waves(scene.angle, _PASS_ORDERS)
    for index, one in enumerate(scene.motion.passes):
        mine = number == index
        columns.append(own * (mine & steady)[:, None])
        middle = 0.5 * (one.start + one.end)
        for part in (scene.time < middle, scene.time >= middle):
            speed = scene.omega / one.speed
            columns.append(np.vander(speed, 4) * (mine & ~steady & part)[:, None])
    free = orthonormal(_scaled(scene, np.concatenate(columns, axis=1), sigma, correlation))
    y = _scaled(scene, value, sigma, correlation)
    y = y - free @ (free.T @ y)
    u, s, _ = np.linalg.svd(ramps - free @ (free.T @ ramps), full_matrices=False)
    square = ((u.T @ y) ** 2).sum(axis=1)
    # Of three components: log likelihood above that without drift.
    grown = 1.0 + np.outer(_STRENGTHS, s) ** 2
    gain = 0.5 * (square * (1.0 - 1.0 / grown)).sum(axis=1) - 1.5 * np.log(grown).sum(axis=1)
    best = int(np.argmax(gain))
    return float(_STRENGTHS[best]) if gain[best] > _BELIEVED else 0.0
