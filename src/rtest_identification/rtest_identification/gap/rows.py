"""The rows of the search: what the base model leaves, whitened, and how noisy they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtest_estimation.records import Cycle, Kind
from rtest_identification.gap.effects import Effect
from rtest_identification.gap.noise import Noise, estimate, whiten
from rtest_identification.gap.scene import Scene
from rtest_identification.least_squares import solve
from rtest_identification.observations import Observations
from rtest_identification.symbols import ErrorParameter, location_parameters

_ITERATIONS = 3


@dataclass(frozen=True)
class Rows:
    """A session against its base model: locations, squareness, an offset per cycle.

    scene : poses, response and the displacement the base model fits
    residual : (n, 3) what it leaves [m]
    base : (n, 3, r) columns of everything that is free in it
    sigma : (n,) standard deviation of a row, per component [m]
    freedom : degrees of freedom that sigma rests on
    correlation : of the noise of a pose with that of the next
    nests : (n, 3, q) what a standard uncertainty of each nest calibration does to the rows [m]
    odd : (n,) poses that are far outside the noise
    constants : location errors and squareness that are free, the first columns of `base`
    errors : (p,) their values about which the rows stand
    sizes : (k,) values of the effects' columns, the last of `base`
    """

    scene: Scene
    residual: np.ndarray
    base: np.ndarray
    sigma: np.ndarray
    freedom: int
    correlation: float
    nests: np.ndarray
    odd: np.ndarray
    constants: tuple[ErrorParameter, ...]
    errors: np.ndarray
    sizes: np.ndarray

    def keep(self, chosen: np.ndarray) -> Rows:
        """Only these rows (bool mask or indices)."""
        scene = self.scene
        part = replace(
            scene, observations=scene.observations.keep(chosen), jacobian=scene.jacobian[chosen],
            fitted=scene.fitted[chosen],
        )
        return replace(
            self, scene=part, residual=self.residual[chosen], base=self.base[chosen],
            sigma=self.sigma[chosen], nests=self.nests[chosen], odd=self.odd[chosen],
        )

    def white(self, values: np.ndarray) -> np.ndarray:
        """(n, 3) or (n, 3, p) to (3 n,) or (3 n, p) of unit variance, uncorrelated."""
        values = self._scaled(values)
        u, less = self._shared
        return values - u @ ((less * (u.T @ values).T).T)

    def _scaled(self, values: np.ndarray) -> np.ndarray:
        scaled = values / self.sigma.reshape(-1, *[1] * (values.ndim - 1))
        observations = self.scene.observations
        whiten(scaled, self.correlation, observations.cycle, observations.pose)
        return scaled.reshape(3 * len(values), *values.shape[2:])

    @cached_property
    def _shared(self) -> tuple[np.ndarray, np.ndarray]:
        """Directions of the nests' errors, and by how much whitening shrinks each.

        With the covariance I + N N', N = U S V', whitening is I - U (1 - 1 / sqrt(1 + S^2)) U'.
        """
        u, s, _ = np.linalg.svd(self._scaled(self.nests), full_matrices=False)
        return u, 1.0 - 1.0 / np.sqrt(1.0 + s**2)


def nest_spread(cycles: Sequence[Cycle]) -> dict[str, np.ndarray]:
    """How uncertain the axes of each set-up's nest are, per metre of noise: (3,) by set-up [1/m].

    A nest is calibrated by steps x_j of the sphere (Eq. 2-5). Noise e_j of the sphere in the
    dwells turns the nest's axes by sum e_j x_j' (sum x_j x_j')^-1, so that a displacement x is
    found wrong by as much of x: nothing at the start of a cycle, more the larger the machine's
    errors are.
    """
    found = {}
    for cycle in cycles:
        if cycle.plan.kind is Kind.NEST_CALIBRATION and len(cycle.points) > 3:
            linear = [cycle.plan.axes.index(name) for name in 'XYZ']
            steps = np.array([point.feedback[linear] for point in cycle.points])
            square = ((steps - steps.mean(axis=0)) ** 2).sum(axis=0)
            if (square > 0.0).all():
                found[cycle.plan.setup] = 1.0 / np.sqrt(square)
    return found


def make_rows(
    observations: Observations,
    start: int,
    directions: Mapping[str, np.ndarray],
    extra: Sequence[tuple[Effect, tuple[float, ...]]] = (),
    constants: Sequence[ErrorParameter] | None = None,
    spread: Mapping[str, np.ndarray] | None = None,
) -> Rows:
    """Fit the base model and estimate the noise.

    start : of the session [ns]
    directions : of the gauges by set-up
    extra : effects that the model has besides, with their shape
    constants : location errors and squareness that are free; all that the machine has when omitted
    spread : of the nests, from `nest_spread`; they are taken as exact when omitted
    """
    if constants is None:
        constants = location_parameters(observations.machine)
    equal = Noise(np.ones(len(observations)), 0, 0.0, np.zeros(len(observations), dtype=bool))
    rows = None
    for _ in range(_ITERATIONS):
        # The noise does not depend on where the errors stand, once they are near.
        errors = np.zeros(len(constants)) if rows is None else rows.errors
        rows = _fit(observations, start, directions, extra, tuple(constants), errors, equal)
    noise = estimate(rows.scene, rows.base, rows.residual)
    nests = _nest_errors(rows.scene, noise, spread or {})
    return _fit(observations, start, directions, extra, rows.constants, rows.errors, noise, nests)


def _nest_errors(scene: Scene, noise: Noise, spread: Mapping[str, np.ndarray]) -> np.ndarray:
    """(n, 3, 9 k) what one standard uncertainty of each element of a nest's axes does [m]."""
    observations = scene.observations
    level = float(np.sqrt(np.mean(noise.sigma**2)))
    found = [np.zeros((len(observations), 3, 0))]
    for number, setup in enumerate(observations.setups):
        if setup in spread:
            mine = (observations.cycle == number)[:, None] * scene.fitted * spread[setup] * level
            found.append(np.einsum('nj,ik->nijk', mine, np.eye(3)).reshape(len(mine), 3, 9))
    return np.concatenate(found, axis=2)


def _fit(
    observations: Observations,
    start: int,
    directions: Mapping[str, np.ndarray],
    extra: Sequence[tuple[Effect, tuple[float, ...]]],
    constants: tuple[ErrorParameter, ...],
    errors: np.ndarray,
    noise: Noise,
    nests: np.ndarray | None = None,
) -> Rows:
    """One step of Gauss and Newton from `errors`."""
    columns = [p.column for p in constants]
    table = np.zeros((len(observations.machine.letters), 6))
    table.flat[columns] = errors
    predicted, jacobian = observations.predict(table, jacobian=True)
    left = observations.displacement - predicted
    fitted = predicted - predicted[_starts(observations)]
    scene = Scene(observations, jacobian, fitted, start, directions)
    more = [effect.columns(scene, shape) for effect, shape in extra]
    base = np.concatenate([jacobian[:, :, columns], observations.offsets(), *more], axis=2)
    if nests is None:
        nests = np.zeros((len(observations), 3, 0))
    rows = Rows(scene, left, base, noise.sigma, noise.freedom, noise.correlation, nests, noise.odd,
                constants, errors, np.zeros(0))
    design = rows.white(base)
    scale = 1.0 / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    value = solve(design, rows.white(left), scale).value
    sizes = value[len(errors) + 3 * len(observations.cycles) :]
    return replace(
        rows, residual=left - base @ value, errors=errors + value[: len(errors)], sizes=sizes
    )


def _starts(observations: Observations) -> np.ndarray:
    """(n,) row at which the cycle of each row began."""
    first = np.array([
        np.flatnonzero(observations.cycle == number)[0]
        for number in range(len(observations.cycles))
    ])
    return first[observations.cycle]
