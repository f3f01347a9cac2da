"""The rows of the search: what the base model leaves, whitened, and how noisy they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from rtest_identification.error_map import stations
from rtest_identification.gap.effects import Effect
from rtest_identification.gap.scene import Scene
from rtest_identification.least_squares import solve
from rtest_identification.observations import Observations
from rtest_identification.symbols import location_parameters

# Levels of the outer axis are as noisy as each other unless it is this improbable.
EQUAL_NOISE = 0.01
# With fewer rows that repeat what others say, the noise is not known well enough by level.
FEW_REPEATS = 300
_ITERATIONS = 5


@dataclass(frozen=True)
class Rows:
    """A session against its base model: locations, squareness, an offset per cycle.

    scene : poses, response and the displacement the base model fits
    residual : (n, 3) what it leaves [m]
    base : (n, 3, r) columns of everything that is free in it
    sigma : (n,) standard deviation of a row, per component [m]
    freedom : degrees of freedom that sigma rests on
    errors : (p,) location errors and squareness about which the rows stand
    """

    scene: Scene
    residual: np.ndarray
    base: np.ndarray
    sigma: np.ndarray
    freedom: int
    errors: np.ndarray

    def keep(self, chosen: np.ndarray) -> Rows:
        """Only these rows (bool mask or indices)."""
        scene = self.scene
        part = replace(
            scene, observations=scene.observations.keep(chosen), jacobian=scene.jacobian[chosen],
            fitted=scene.fitted[chosen],
        )
        return Rows(part, self.residual[chosen], self.base[chosen], self.sigma[chosen],
                    self.freedom, self.errors)

    def white(self, values: np.ndarray) -> np.ndarray:
        """(n, 3) or (n, 3, p) to (3 n,) or (3 n, p) of unit variance."""
        scaled = values / self.sigma.reshape(-1, *[1] * (values.ndim - 1))
        return scaled.reshape(-1, *values.shape[2:])


def make_rows(
    observations: Observations,
    start: int,
    directions: Mapping[str, np.ndarray],
    extra: Sequence[tuple[Effect, tuple[float, ...]]] = (),
) -> Rows:
    """Fit the base model and estimate the noise.

    start : of the session [ns]
    directions : of the gauges by set-up
    extra : effects that the model has besides, with their shape
    """
    constants = location_parameters(observations.machine)
    columns = [p.column for p in constants]
    errors = np.zeros(len(constants))
    table = np.zeros((len(observations.machine.letters), 6))
    offsets = observations.offsets()
    sigma = np.ones(len(observations))
    freedom = 0
    base = residual = scene = None
    for _ in range(_ITERATIONS):
        table.flat[columns] = errors
        predicted, jacobian = observations.predict(table, jacobian=True)
        left = observations.displacement - predicted
        fitted = predicted - predicted[_starts(observations)]
        scene = Scene(observations, jacobian, fitted, start, directions)
        more = [effect.columns(scene, shape) for effect, shape in extra]
        base = np.concatenate([jacobian[:, :, columns], offsets, *more], axis=2)
        weight = 1.0 / sigma[:, None]
        design = (base * weight[:, :, None]).reshape(-1, base.shape[2])
        scale = 1.0 / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        solution = solve(design, (left * weight).reshape(-1), scale)
        change = solution.value[: len(errors)]
        errors = errors + change
        residual = left - base @ solution.value
        sigma, freedom = _noise(scene, base, residual)
        if np.abs(change).max() < 1e-13:
            break
    return Rows(scene, residual, base, sigma, freedom, errors)


def _starts(observations: Observations) -> np.ndarray:
    """(n,) row at which the cycle of each row began."""
    first = np.array([
        np.flatnonzero(observations.cycle == number)[0]
        for number in range(len(observations.cycles))
    ])
    return first[observations.cycle]


def cells(scene: Scene) -> list[np.ndarray]:
    """Rows at each pose of the rotary axes."""
    index = [stations(scene.position(axis))[1] for axis in scene.machine.rotary]
    key = np.stack(index, axis=1)
    _, inverse = np.unique(key, axis=0, return_inverse=True)
    return [np.flatnonzero(inverse.ravel() == k) for k in range(inverse.max() + 1)]


def cell_basis(scene: Scene, rows: np.ndarray) -> np.ndarray:
    """(3 m, k) orthonormal: what any error of the rotary axes could do at one pose of theirs."""
    axis = scene.machine.rotary[-1]
    design = np.stack([scene.slope(axis, letter)[rows] for letter in 'XYZABC'], axis=2)
    u, s, _ = np.linalg.svd(design.reshape(-1, 6) * [1, 1, 1, 10, 10, 10], full_matrices=False)
    return u[:, s > 1e-3 * s[0]]


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


def _noise(scene: Scene, base: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, int]:
    """Standard deviation of every row from the richest model, by levels of the outer axis.

    The richest model lets the rotary axes do anything at each of their poses, so that none of
    their effects is taken for noise; to it come what depends on the direction of approach and,
    slowly, on time. What is left are differences between set-ups and visits.
    """
    observations = scene.observations
    time = scene.time - scene.time.mean()
    time = time / max(np.abs(time).max(), 1e-9)
    extras = [base]
    for axis in scene.machine.letters:
        for letter in 'XYZ':
            moved = scene.slope(scene.machine.rotary[0], letter) * scene.direction(axis)[:, None]
            extras.append(moved[:, :, None])
    for power in (1, 2, 3):
        extras += [
            (scene.slope(scene.machine.rotary[0], c) * time[:, None] ** power)[:, :, None]
            for c in 'XYZ'
        ]
    for axis in scene.machine.linear:
        place = scene.position(axis)
        extras += [(scene.slope(axis, c) * place[:, None])[:, :, None] for c in 'ABCXYZ']
    y = residual.reshape(-1).copy()
    count = np.full(len(observations), 3.0)
    poses = [(rows, cell_basis(scene, rows)) for rows in cells(scene)]
    repeated = residual.size - sum(basis.shape[1] for _, basis in poses)
    if repeated < FEW_REPEATS:
        # Too little is seen twice: the rotary axes may do only what is smooth in the inner one.
        poses = []
        extras.append(_smooth(scene))
    design = np.concatenate(extras, axis=2).reshape(residual.size, -1)
    flat = np.arange(residual.size).reshape(-1, 3)
    for rows, basis in poses:
        place = flat[rows].reshape(-1)
        design[place] -= basis @ (basis.T @ design[place])
        y[place] -= basis @ (basis.T @ y[place])
        count[rows] -= (basis**2).sum(axis=1).reshape(-1, 3).sum(axis=1)
    norm = np.linalg.norm(design, axis=0)
    u, s, _ = np.linalg.svd(design[:, norm > 0] / norm[norm > 0], full_matrices=False)
    u = u[:, s > 1e-6 * s[0]]
    y -= u @ (u.T @ y)
    count -= (u**2).sum(axis=1).reshape(-1, 3).sum(axis=1)
    square = (y.reshape(-1, 3) ** 2).sum(axis=1)
    freedom = round(count.sum())
    if freedom < 30:
        # Too little is repeated: the base model's own residual has to do.
        free = max(residual.size - base.shape[2], 1)
        return np.full(len(observations), np.sqrt((residual**2).sum() / free)), free
    pooled = square.sum() / count.sum()
    level = stations(np.abs(scene.position(scene.machine.rotary[0])))[1]
    share = np.bincount(level, count)
    own = np.bincount(level, square) / np.maximum(share, 1e-9)
    good = share >= 25
    # Bartlett's test on the variances of the levels.
    statistic = share[good].sum() * np.log(pooled) - (share[good] * np.log(own[good])).sum()
    if good.sum() >= 2 and stats.chi2.sf(statistic, good.sum() - 1) < EQUAL_NOISE:
        variance = np.where(good, own, pooled)
        return np.sqrt(variance[level]), freedom
    return np.full(len(observations), np.sqrt(pooled)), freedom
