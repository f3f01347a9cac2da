"""What changed since a reference cycle, pose by pose.

Every cycle visits the same poses. The difference of two displacements at a pose holds what
changed and nothing else: whatever stays as it is falls out, also what no model knows (error
motions of the linear axes, of the inner axis, the directions of the gauges). The changes of the
errors follow from it by least squares, and what that leaves is the machine's repeatability from
cycle to cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_estimation.records import Cycle
from rtest_identification.location import OUTLIER_PROBABILITY
from rtest_identification.observations import stack
from rtest_identification.thermal.poses import Gains, Poses, places

# Where more poses than this part of a cycle were outliers, the model is wrong and not the poses.
_MOST_OUTLIERS = 0.2


@dataclass(frozen=True)
class Readings:
    """One cycle at the poses of the plan.

    displacement : (m, 3) relative to what the reference's errors predict at the encoder positions
        of this cycle [m]; NaN where missing
    stamp : (m,) [ns]; 0 where missing
    variance : of a component, from the scatter of the readings, mean over the poses [m2]
    """

    displacement: np.ndarray
    stamp: np.ndarray
    variance: float

    @property
    def measured(self) -> np.ndarray:
        """(m,) bool."""
        return np.isfinite(self.displacement[:, 0])


@dataclass(frozen=True)
class Changes:
    """Every cycle of a session against one of them.

    used : (k, m) poses that take part in each cycle; those the reference lacks take part in none
    difference : (k, m, 3) displacement against the reference [m]; NaN where not used
    gains : of each cycle
    residual : (k, m, 3) about the mean over the cycles [m]; NaN where not used
    noise : repeatability of a displacement from cycle to cycle, per component [m]; NaN with one
        cycle; freedom : its degrees of freedom
    outliers : (k, m) bool
    """

    poses: Poses
    reference: int
    used: np.ndarray
    difference: np.ndarray
    gains: tuple[Gains, ...]
    residual: np.ndarray
    noise: float
    freedom: int
    outliers: np.ndarray

    def values(self, gain: Sequence[np.ndarray]) -> np.ndarray:
        """(k, q) change of q quantities whose gains (q, m, 3) are given for each cycle."""
        filled = np.nan_to_num(self.difference)
        return np.array([np.einsum('qmi,mi->q', g, d) for g, d in zip(gain, filled, strict=True)])

    def stddev(self, gain: Sequence[np.ndarray]) -> np.ndarray:
        """(k, q) standard uncertainty of these changes; 0 at the reference.

        Both cycles scatter; the reference takes part with the gain of the other cycle.
        """
        size = np.array([np.sqrt(2.0 * (g**2).sum(axis=(1, 2))) for g in gain]) * self.noise
        size[self.reference] = 0.0
        return size

    def scatter(self, gain: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Covariance (q, q) of what differs from cycle to cycle, at the reference too.

        The noise of the reference is common to all changes: a level of the series. What is not
        common, because poses are missing here and there, is in it.
        """
        own = gain[self.reference]
        found = []
        for g in gain:
            parts = np.stack([g, g - own])
            found.append(self.noise**2 * np.einsum('apmi,aqmi->pq', parts, parts))
        return found


def readings(poses: Poses, cycle: Cycle, errors: np.ndarray) -> Readings:
    """A cycle's points at the places of the plan.

    errors : (axes, 6) identified constants, for what differs between encoder positions
    """
    place = places(poses.plan, cycle.plan)
    data = stack(poses.machine, [cycle])
    at = place[data.pose]
    good = at >= 0
    displacement = np.full((len(poses), 3), np.nan)
    stamp = np.zeros(len(poses), dtype=np.int64)
    displacement[at[good]] = (data.displacement - data.predict(errors)[0])[good]
    stamp[at[good]] = data.stamp[good]
    variance = float(np.trace(data.covariance, axis1=1, axis2=2).mean()) / 3.0
    return Readings(displacement, stamp, variance)


def changes(
    poses: Poses, cycles: Sequence[Readings], reference: int, without_outliers: bool = True
) -> Changes:
    """Differences against one cycle, and what constants and map leave of them."""
    measured = np.array([cycle.measured for cycle in cycles])
    outliers = np.zeros_like(measured)
    while True:
        found = _fit(poses, cycles, reference, measured & ~outliers, outliers)
        if not without_outliers:
            return found
        bad = _outliers(found, max(cycle.variance for cycle in cycles))
        too_many = (outliers | bad).sum(axis=1) > _MOST_OUTLIERS * measured.sum(axis=1)
        bad[too_many] = False
        if not bad.any():
            return found
        outliers = outliers | bad


def _fit(
    poses: Poses,
    cycles: Sequence[Readings],
    reference: int,
    good: np.ndarray,
    outliers: np.ndarray,
) -> Changes:
    used = good & good[reference]
    own = cycles[reference].displacement
    difference = np.full((*used.shape, 3), np.nan)
    residual = difference.copy()
    gains, known, freedom = [], {}, 0
    for number, cycle in enumerate(cycles):
        rows = used[number]
        key = rows.tobytes()
        if key not in known:
            known[key] = poses.gains(rows)
        gain = known[key]
        gains.append(gain)
        difference[number, rows] = y = (cycle.displacement - own)[rows]
        residual[number, rows] = (y.ravel() - gain.explained @ y.ravel()).reshape(-1, 3)
        if number != reference:
            freedom += max(y.size - gain.rank, 0)
    counts = np.maximum(used.sum(axis=0), 1)[:, None]
    residual -= np.nansum(residual, axis=0) / counts
    noise = float('nan')
    if freedom:
        noise = float(np.sqrt(np.nansum(residual**2) / freedom))
    return Changes(
        poses, reference, used, difference, tuple(gains), residual, noise, freedom, outliers
    )


def _outliers(found: Changes, least: float) -> np.ndarray:
    """(k, m) the pose of each cycle that is farthest from the others, where it is too far.

    least : variance that a component has at least [m2]

    One a cycle at a time: an outlier pulls its neighbours along, which are judged without it.
    """
    bad = np.zeros_like(found.used)
    if not found.freedom:
        return bad
    # About the median over the cycles: an outlier of the reference is then its own.
    about = np.where(found.used[:, :, None], found.residual, 0.0)
    about = about - np.median(about, axis=0)
    # The robust spread of the residuals, which the fit has made smaller than the noise.
    values = found.residual[found.used]
    sigma2 = (1.4826 * np.median(np.abs(values))) ** 2 * values.size / found.freedom
    sigma2 = max(float(sigma2), least)
    size = np.where(found.used, (about**2).sum(axis=2), 0.0)
    # With a margin, as in the fit of a session, because the model may lack an effect.
    limit = 2.0 * stats.chi2.isf(OUTLIER_PROBABILITY / len(values), 3) * sigma2
    worst = size.argmax(axis=1)
    rows = np.arange(len(size))
    bad[rows, worst] = size[rows, worst] > limit
    return bad
