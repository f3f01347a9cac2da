"""How noisy the rows are: what the richest model leaves, its levels, correlation and odd poses.

The richest model lets the rotary axes do anything at each of their poses, so that none of their
effects is taken for noise; to it come what depends on the direction of approach and, slowly, on
time and on the linear axes. What is left are differences between set-ups and visits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_identification.error_map import stations
from rtest_identification.gap.scene import Scene
from rtest_identification.symbols import location_parameters

# Levels of the outer axis are as noisy as each other unless it is this improbable.
EQUAL_NOISE = 0.01
# With fewer rows that repeat what others say, the noise is not known well enough by level.
FEW_REPEATS = 300
# Poses this improbable among the others are left out, unless there are more than a few.
ODD_POSE = 1e-6
MOST_ODD = 0.02
# Correlation is believed when the rest shows this many standard deviations more than white noise.
_CORRELATED = 3.0
_GRID = np.array([0.0, 0.2, 0.4, 0.6, 0.75, 0.9])
_DRAWS = 40


@dataclass(frozen=True)
class Noise:
    """Noise of a session's rows.

    sigma : (n,) standard deviation of a row, per component [m]
    freedom : degrees of freedom that sigma rests on
    correlation : of the noise of a pose with that of the next one of the same cycle
    odd : (n,) poses that are far outside it
    """

    sigma: np.ndarray
    freedom: int
    correlation: float
    odd: np.ndarray


class _Richest:
    """The richest model as a projection. count : (n,) degrees of freedom left to each row."""

    def __init__(self, scene: Scene, base: np.ndarray) -> None:
        size = 3 * len(scene.observations)
        extras = [base, *_slow(scene)]
        flat = np.arange(size).reshape(-1, 3)
        self._poses = [(flat[rows].reshape(-1), _basis(scene, rows)) for rows in _cells(scene)]
        if size - sum(basis.shape[1] for _, basis in self._poses) < FEW_REPEATS:
            # Little is seen twice: the rotary axes may do only what is smooth in the inner one.
            self._poses = []
            extras.append(_smooth(scene))
        self._rest = np.empty((size, 0))
        design = self.rest(np.concatenate(extras, axis=2).reshape(size, -1))
        norm = np.linalg.norm(design, axis=0)
        u, s, _ = np.linalg.svd(design[:, norm > 0] / norm[norm > 0], full_matrices=False)
        self._rest = u[:, s > 1e-6 * s[0]]
        count = 1.0 - (self._rest**2).sum(axis=1)
        for place, basis in self._poses:
            count[place] -= (basis**2).sum(axis=1)
        self.count = count.reshape(-1, 3).sum(axis=1)

    def rest(self, values: np.ndarray) -> np.ndarray:
        """What the model leaves of (3 n, k)."""
        values = values.copy()
        for place, basis in self._poses:
            values[place] -= basis @ (basis.T @ values[place])
        return values - self._rest @ (self._rest.T @ values)


def estimate(scene: Scene, base: np.ndarray, residual: np.ndarray) -> Noise:
    """Noise of the rows from what the richest model leaves of `residual` (n, 3) [m].

    base : (n, 3, r) columns of everything that is free
    """
    count = len(residual)
    model = _Richest(scene, base)
    square = (model.rest(residual.reshape(-1, 1)).reshape(-1, 3) ** 2).sum(axis=1)
    freedom = round(model.count.sum())
    if freedom < 30:
        # Too little is repeated: the base model's own residual has to do.
        free = max(residual.size - base.shape[2], 1)
        sigma = np.full(count, np.sqrt((residual**2).sum() / free))
        return Noise(sigma, free, 0.0, np.zeros(count, dtype=bool))
    sigma = _levels(scene, square, model.count)
    correlation, share = _correlation(scene, model, residual / sigma[:, None])
    sigma = sigma / np.sqrt(share)
    return Noise(sigma, freedom, correlation, _odd(square, model.count, _cells(scene)))


def whiten(values: np.ndarray, correlation: float, cycle: np.ndarray, pose: np.ndarray) -> None:
    """Take the correlation with the pose before out of (n, ...) rows of unit variance, in place.

    Where poses are missing between two rows, so much less of it is left.
    """
    if not correlation:
        return
    same = cycle[1:] == cycle[:-1]
    left = np.where(same, correlation ** np.maximum(pose[1:] - pose[:-1], 1), 0.0)
    left = left.reshape(-1, *[1] * (values.ndim - 1))
    values[1:] = (values[1:] - left * values[:-1]) / np.sqrt(1.0 - left**2)


def _levels(scene: Scene, square: np.ndarray, count: np.ndarray) -> np.ndarray:
    """(n,) standard deviation, by levels of the outer axis where they differ (Bartlett's test)."""
    pooled = square.sum() / count.sum()
    level = stations(np.abs(scene.position(scene.machine.rotary[0])))[1]
    share = np.bincount(level, count)
    own = np.bincount(level, square) / np.maximum(share, 1e-9)
    good = share >= 25
    statistic = share[good].sum() * np.log(pooled) - (share[good] * np.log(own[good])).sum()
    if good.sum() >= 2 and stats.chi2.sf(statistic, good.sum() - 1) < EQUAL_NOISE:
        return np.sqrt(np.where(good, own, pooled))[level]
    return np.full(len(square), np.sqrt(pooled))


def _correlation(scene: Scene, model: _Richest, residual: np.ndarray) -> tuple[float, float]:
    """Correlation from pose to pose, and the share of the variance that the rest still shows.

    The model takes some of the correlation out of the rest: how much is seen from noise of known
    correlation that is sent through it.
    """
    observations = scene.observations
    same = observations.cycle[1:] == observations.cycle[:-1]

    def neighbours(rest: np.ndarray) -> np.ndarray:
        rest = rest.reshape(len(residual), 3, -1)
        product = (rest[1:] * rest[:-1])[same].sum(axis=(0, 1))
        return product / (rest**2).sum(axis=(0, 1))

    rng = np.random.default_rng(0)
    white = rng.standard_normal((len(residual), 3, _DRAWS))
    seen = float(neighbours(model.rest(residual.reshape(-1, 1)))[0])
    expected, share = [], []
    for correlation in _GRID:
        noise = white.copy()
        for row in np.flatnonzero(same) + 1:
            noise[row] = correlation * noise[row - 1] + np.sqrt(1 - correlation**2) * white[row]
        rest = model.rest(noise.reshape(-1, _DRAWS))
        values = neighbours(rest)
        expected.append(float(values.mean()))
        share.append(float((rest**2).sum() / _DRAWS / model.count.sum()))
        if correlation == 0.0 and seen < expected[0] + _CORRELATED * values.std():
            return 0.0, 1.0
    found = float(np.interp(seen, expected, _GRID))
    return found, float(np.interp(found, _GRID, share) / share[0])


def _odd(square: np.ndarray, count: np.ndarray, cells: list[np.ndarray]) -> np.ndarray:
    """(n,) poses that repeat others and are far from what these say.

    The worst of those at the same pose of the rotary axes: the others may be good, and only look
    bad beside it.
    """
    judged = count > 0.5
    # Of normal noise the median of chi-squared, by the degrees of freedom of each row.
    scale = np.median(square[judged] / stats.chi2.median(count[judged]))
    odd = np.zeros(len(square), dtype=bool)
    odd[judged] = stats.chi2.sf(square[judged] / scale, count[judged]) < ODD_POSE
    worst = np.zeros_like(odd)
    for rows in cells:
        worst[rows[np.argmax(square[rows])]] = True
    odd &= worst
    return odd if odd.mean() <= MOST_ODD else np.zeros_like(odd)


def _cells(scene: Scene) -> list[np.ndarray]:
    """Rows at each pose of the rotary axes."""
    index = [stations(scene.position(axis))[1] for axis in scene.machine.rotary]
    key = np.stack(index, axis=1)
    _, inverse = np.unique(key, axis=0, return_inverse=True)
    return [np.flatnonzero(inverse.ravel() == k) for k in range(inverse.max() + 1)]


def _basis(scene: Scene, rows: np.ndarray) -> np.ndarray:
    """(3 m, k) orthonormal: what any error of the rotary axes could do at one pose of theirs."""
    axis = scene.machine.rotary[-1]
    design = np.stack([scene.slope(axis, letter)[rows] for letter in 'XYZABC'], axis=2)
    u, s, _ = np.linalg.svd(design.reshape(-1, 6) * [1, 1, 1, 10, 10, 10], full_matrices=False)
    return u[:, s > 1e-3 * s[0]]


def _slow(scene: Scene) -> list[np.ndarray]:
    """(n, 3, p) columns each: constants, approach, time to the third power, linear axes."""
    constants = location_parameters(scene.machine)
    carrier = scene.machine.rotary[0]
    time = scene.time - scene.time.mean()
    time = time / max(np.abs(time).max(), 1e-9)
    shifts = np.stack([scene.slope(carrier, letter) for letter in 'XYZ'], axis=2)
    found = [scene.jacobian[:, :, [p.column for p in constants]]]
    found += [shifts * scene.direction(axis)[:, None, None] for axis in scene.machine.letters]
    found += [shifts * time[:, None, None] ** power for power in (1, 2, 3)]
    for axis in scene.machine.linear:
        place = scene.position(axis)
        found.append(
            np.stack([scene.slope(axis, c) * place[:, None] for c in 'ABCXYZ'], axis=2)
        )
    return found


def _smooth(scene: Scene) -> np.ndarray:
    """(n, 3, p): the inner axis's six errors, to twice a turn, at every level of the outer one."""
    outer, inner = scene.machine.rotary
    places, level = stations(scene.position(outer))
    turn = scene.position(inner)
    waves = [np.ones_like(turn)] + [f(n * turn) for n in (1, 2) for f in (np.cos, np.sin)]
    columns = [
        scene.slope(inner, letter) * (wave * (level == k))[:, None]
        for letter in 'XYZABC' for wave in waves for k in range(len(places))
    ]
    return np.stack(columns, axis=2)
