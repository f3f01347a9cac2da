"""Location errors and squareness, and the error map of the outer rotary axis.

Location errors (Eq. 3-16) are fitted together with the squareness of the linear axes and an offset
for every cycle, so that no single zero reading is trusted. The six position-dependent errors of
the outer rotary axis (B; Eqs. 3-22 and 3-23) are then fitted to what is left, with mean zero over
the stations. What a constant error explains is never put into the map: of all maps that fit
equally well the smallest is taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from rtest_identification.error_map import AxisMap, coupled, stations, zero_mean
from rtest_identification.grid_map import GridMap, contrasts, fit_grid
from rtest_identification.least_squares import Solution, solve
from rtest_identification.observations import Observations
from rtest_identification.symbols import (
    RANK_TOLERANCE,
    ErrorParameter,
    location_parameters,
    map_parameters,
    parameter,
)

# The map takes part in the location errors where it is there with this significance.
MAP_SIGNIFICANCE = 0.01
# A point this improbable under the fit (chi-squared, over all points) is an outlier.
OUTLIER_PROBABILITY = 1e-4
_ITERATIONS = 8
# A column below a nanometre per unit is rounding, and no effect.
_NOTHING = 1e-9


@dataclass(frozen=True)
class Estimate:
    """Named values with their covariance (standard uncertainties squared).

    value : (p,) [m] or [rad]; covariance : (p, p)
    determined : (p,) bool; the value of an undetermined one means nothing
    freedom : degrees of freedom of the residual the covariance rests on
    gain : (p, n, 3) change of each value per displacement of each observation
    """

    parameters: tuple[ErrorParameter, ...]
    value: np.ndarray
    covariance: np.ndarray
    determined: np.ndarray
    rank: int
    condition: float
    freedom: int
    gain: np.ndarray

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols in the order of the values."""
        return tuple(p.symbol for p in self.parameters)

    @property
    def stddev(self) -> np.ndarray:
        """(p,) standard uncertainties."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class Fit:
    """What a session's static cycles give.

    location : location and squareness errors
    error_map : of the outer rotary axis; None where it has fewer than three stations
    residual : (n, 3) what the map and a model's effects leave, frame ``table`` [m]; rows of
        outliers are left out
    rms : of the residual per component, corrected for degrees of freedom [m]
    rms_location : the same with the location errors alone
    outliers : rows of the observations that were left out
    joint : whether the location errors were fitted together with the map
    across : (p, 6 s) covariance of the location errors with the map, zero where they were not
        fitted together; None without a map
    inner_map : of the inner rotary axis, from what all this leaves; None where it has too few
        stations or the spheres determine nothing of it beyond noise
    joint_inner : whether everything was fitted together with the inner map
    """

    location: Estimate
    error_map: AxisMap | None
    residual: np.ndarray
    rms: float
    rms_location: float
    outliers: np.ndarray
    joint: bool
    across: np.ndarray | None = None
    inner_map: GridMap | None = None
    joint_inner: bool = False


# Columns (n, 3, k) of the effects of a model at some observations: called with these, the
# Jacobian, and the displacement (n, 3) that the errors identified so far explain.
Effects = Callable[[Observations, np.ndarray, np.ndarray], np.ndarray]


def fit(observations: Observations, effects: Effects | None = None) -> Fit:
    """Identify location errors, squareness and the maps of both rotary axes, without outliers.

    effects : of a model that are free besides
    """
    rows = np.arange(len(observations))
    free = None
    while True:
        kept = observations.keep(rows)
        result, explained, jacobian = _fit(kept)
        if effects is not None:
            free = effects(kept, jacobian, kept.displacement - result.residual)
            free = free[:, :, (np.abs(free) > _NOTHING).any(axis=(0, 1))]
            result, explained, jacobian = _fit(kept, free, noise=result.rms)
        bad = _outliers(result.residual)
        if not bad.any() or np.sum(~bad) < 0.8 * len(observations):
            break
        rows = rows[~bad]
    left_out = np.setdiff1d(np.arange(len(observations)), rows)
    inner = fit_grid(kept, jacobian, result.residual, explained)
    if inner and inner.significance < MAP_SIGNIFICANCE and not inner.undetermined:
        # Waves of the inner axis look in part like squareness: they are fitted together.
        waves = contrasts(kept, jacobian)
        together, explained, jacobian = _fit(kept, free, waves, inner.rms)
        if (together.location.determined >= result.location.determined).all():
            again = fit_grid(kept, jacobian, together.residual, explained)
            again = replace(again, significance=inner.significance)
            result, inner = replace(together, joint_inner=True, rms=result.rms), again
    return replace(result, outliers=left_out, inner_map=inner)


def _fit(
    observations: Observations,
    effects: np.ndarray | None = None,
    waves: np.ndarray | None = None,
    noise: float = 0.0,
) -> tuple[Fit, np.ndarray, np.ndarray]:
    """Fit, orthonormal basis (3 n, p) of what it explains, and the full Jacobian.

    effects : (n, 3, k) columns of a model that are free besides, taken out of the residual
    waves : (n, 3, w) columns that are free besides, left in the residual
    noise : of a component, where there is either of them [m]
    """
    constants = location_parameters(observations.machine)
    columns = [p.column for p in constants]
    weights = _Whitening(observations.covariance, 0.0)
    errors = np.zeros(len(constants))
    table = np.zeros((len(observations.machine.letters), 6))
    offsets = observations.offsets()
    scale = np.concatenate([[p.scale for p in constants], np.ones(offsets.shape[2])])
    for last in (False,) * (_ITERATIONS - 1) + (True,):
        table.flat[columns] = errors
        predicted, jacobian = observations.predict(table, jacobian=True)
        design = np.concatenate([jacobian[:, :, columns], offsets], axis=2)
        left = observations.displacement - predicted
        first = solve(weights.rows(design), weights.rows(left), scale)
        change = first.value[: len(errors)]
        if last or (np.abs(change / scale[: len(errors)]) <= 1e-12).all():
            break
        errors = errors + change
        rms = _rms(left - design @ first.value, first.rank)
        weights = _Whitening(observations.covariance, rms)
    nothing = np.zeros((len(observations), 3, 0))
    effects = nothing if effects is None else effects
    waves = nothing if waves is None else waves
    if effects.size or waves.size:
        weights = _Whitening(observations.covariance, noise)
        weights.absorb(effects, waves, weights.rows(design) * scale)
        first = solve(weights.rows(design), weights.rows(left), scale)
    errors = errors + first.value[: len(errors)]
    residual = weights.without_effects(left - design @ first.value)
    freedom = max(residual.size - first.rank - weights.absorbed, 1)
    unit = _variance(weights.rows(residual), freedom)
    gain = weights.gain(first.inverse)
    location = _location(constants, errors, first, unit * first.cofactor, freedom, gain)
    none = np.empty(0, dtype=int)
    rms = weights.typical * float(np.sqrt(unit))
    alone = Fit(location, None, residual, rms, rms, none, False)
    outer = observations.machine.rotary[0] if observations.machine.rotary else None
    places, station = stations(observations.axis(outer)) if outer else (np.empty(0), none)
    linear = (design, jacobian, weights)
    flat = np.concatenate([design, effects], axis=2).reshape(residual.size, -1)
    size = np.linalg.norm(effects, axis=(0, 1)) / np.sqrt(len(observations))
    scale = np.append(scale, 1.0 / size)
    if len(places) < 3:
        return alone, _orthonormal(flat, scale), jacobian
    result, effect = _with_map(observations, alone, outer, (places, station), linear)
    flat = np.concatenate([flat, effect.reshape(residual.size, -1)], axis=1)
    scale = np.append(scale, np.repeat([p.scale for p in result.error_map.parameters],
                                       len(places) - 1))
    return result, _orthonormal(flat, scale), jacobian


def _with_map(
    observations: Observations,
    alone: Fit,
    axis: str,
    grid: tuple[np.ndarray, np.ndarray],
    linear: tuple[np.ndarray, np.ndarray, _Whitening],
) -> tuple[Fit, np.ndarray]:
    """Add the map of `axis` to the location errors (Eq. 3-23); also its design (n, 3, p)."""
    places, station = grid
    design, jacobian, weights = linear
    parameters = map_parameters(observations.machine, axis)
    count, size = len(places), len(design[0, 0])
    # Unknowns: coordinates in the space of sequences of mean zero over the stations.
    waves = zero_mean(count)
    spread = waves[station]
    columns = [parameter(observations.machine, axis, p.letter).column for p in parameters]
    effect = np.einsum('nip,ns->nips', jacobian[:, :, columns], spread)
    effect = effect.reshape(len(observations), 3, -1)
    scale = np.repeat([p.scale for p in parameters], count - 1)
    a, b = weights.rows(design), weights.rows(effect)
    y = weights.rows(alone.residual)
    scale_a = np.concatenate(
        [[p.scale for p in alone.location.parameters], np.ones(size - len(alone.location.value))]
    )
    # The same rank as the fit of the constants has, or the map would take what they leave open.
    base = _orthonormal(a, scale_a)
    free = b - base @ (base.T @ b)
    second = solve(free, y - base @ (base.T @ y), scale)
    coordinates = second.value
    # What the map takes away from the constants: shift of the first solution.
    shift = solve(a, y - b @ coordinates, scale_a)
    residual = alone.residual - effect @ coordinates - design @ shift.value
    residual = weights.without_effects(residual)
    freedom = max(residual.size - shift.rank - second.rank - weights.absorbed, 1)
    unit = _variance(weights.rows(residual), freedom)
    before = float((weights.rows(alone.residual) ** 2).sum())
    after = float((weights.rows(residual) ** 2).sum())
    f = ((before - after) / max(second.rank, 1)) / (after / freedom) if after > 0 else np.inf
    significance = float(stats.f.sf(f, second.rank, freedom))
    free_inverse = second.inverse - (second.inverse @ base) @ base.T
    turn = np.kron(np.eye(len(parameters)), waves)
    covariance = turn @ (unit * second.cofactor) @ turn.T
    value = (turn @ coordinates).reshape(len(parameters), count)
    error_map = AxisMap(
        axis, parameters, places, value, covariance, second.rank, second.condition,
        coupled(parameters, turn @ (second.nullspace * scale[:, None])), significance,
        weights.gain(turn @ free_inverse),
    )
    rms = weights.typical * float(np.sqrt(unit))
    joint = significance < MAP_SIGNIFICANCE
    location = alone.location
    # Without the map the constants take what it is orthogonal to.
    across = np.zeros((len(location.value), len(covariance)))
    if joint:
        carry = solve(a, b, scale_a).value
        total = unit * (shift.cofactor + carry @ second.cofactor @ carry.T)
        across = -(carry @ (unit * second.cofactor) @ turn.T)[: len(location.value)]
        moved = location.value + shift.value[: len(location.value)]
        gain = shift.inverse - carry @ free_inverse
        location = _location(
            location.parameters, moved, shift, total, freedom, weights.gain(gain)
        )
    found = Fit(location, error_map, residual, rms, alone.rms, alone.outliers, joint, across)
    return found, effect


def _location(
    parameters: tuple[ErrorParameter, ...],
    value: np.ndarray,
    solution: Solution,
    covariance: np.ndarray,
    freedom: int,
    gain: np.ndarray,
) -> Estimate:
    count = len(parameters)
    return Estimate(
        parameters, value[:count], covariance[:count, :count], solution.determined[:count],
        solution.rank, solution.condition, freedom, gain[:count],
    )


class _Whitening:
    """Scales rows to unit variance: scatter of the readings plus what differs between dwells."""

    def __init__(self, covariance: np.ndarray, rms: float) -> None:
        readings = float(np.trace(covariance, axis1=1, axis2=2).mean()) / 3.0
        # Of few readings the scatter is singular, and of a single pose there is no residual.
        dwell = max(rms**2 - readings, 0.1 * rms**2, 1e-9 * readings)
        if rms == 0.0:
            covariance, dwell = np.zeros_like(covariance), 1.0
        total = covariance + dwell * np.eye(3)
        self.factor = np.linalg.inv(np.linalg.cholesky(total))
        self.typical = float(np.sqrt(np.trace(total, axis1=1, axis2=2).mean() / 3.0))
        self._effects = self._basis = np.empty((3 * len(covariance), 0))

    @property
    def absorbed(self) -> int:
        """How many columns are taken out of every row."""
        return self._basis.shape[1]

    def absorb(self, effects: np.ndarray, waves: np.ndarray, kept: np.ndarray) -> None:
        """Take columns (n, 3, k) and (n, 3, w) out of every row from now on.

        What the `kept` columns (3 n, p) can make as well stays theirs: a wave that looks like the
        offset of a cycle is one.
        """
        kept = _orthonormal(kept, np.ones(kept.shape[1]))
        white = self.rows(np.concatenate([effects, waves], axis=2))
        self._effects = _beside(white[:, : effects.shape[2]], kept)
        self._basis = _beside(white, kept)

    def without_effects(self, residual: np.ndarray) -> np.ndarray:
        """(n, 3) without what the absorbed effects can make of it; waves stay."""
        white = np.einsum('nij,nj->ni', self.factor, residual).reshape(-1)
        part = (self._effects @ (self._effects.T @ white)).reshape(residual.shape)
        return residual - np.linalg.solve(self.factor, part[:, :, None])[:, :, 0]

    def rows(self, values: np.ndarray) -> np.ndarray:
        """(n, 3) or (n, 3, p) to whitened (3 n,) or (3 n, p)."""
        white = np.einsum('nij,nj...->ni...', self.factor, values)
        return self._free(white.reshape(-1, *values.shape[2:]))

    def gain(self, inverse: np.ndarray) -> np.ndarray:
        """(p, 3 n) per whitened row to (p, n, 3) per displacement."""
        inverse = self._free(inverse.T).T
        return np.einsum('pni,nij->pnj', inverse.reshape(len(inverse), -1, 3), self.factor)

    def _free(self, white: np.ndarray) -> np.ndarray:
        return white - self._basis @ (self._basis.T @ white)


def _rms(residual: np.ndarray, rank: int) -> float:
    return float(np.sqrt((residual**2).sum() / max(residual.size - rank, 1)))


def _variance(white: np.ndarray, freedom: int) -> float:
    """Variance factor of whitened residuals."""
    return float((white**2).sum() / freedom)


def _orthonormal(design: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Orthonormal basis of columns, of the rank that `solve` finds with this scale."""
    u, s, _ = np.linalg.svd(design * scale, full_matrices=False)
    return u[:, s > RANK_TOLERANCE * s[0]]


def _beside(white: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Orthonormal basis of what columns make that `kept`, orthonormal too, cannot make."""
    if not white.size:
        return white
    basis = _orthonormal(white, 1.0 / np.linalg.norm(white, axis=0))
    u, s, _ = np.linalg.svd(basis.T @ kept)
    return basis @ u[:, int(np.sum(s > 1.0 - 1e-6)) :]


def _outliers(residual: np.ndarray) -> np.ndarray:
    """(n,) points far from the fit, judged by the robust spread of the others."""
    sigma = 1.4826 * np.median(np.abs(residual))
    size = (residual**2).sum(axis=1)
    # The robust spread is used with a margin, because the model may lack an effect. A gross
    # outlier pulls its neighbours along: what is small beside the worst is judged without it.
    limit = 2.0 * stats.chi2.isf(OUTLIER_PROBABILITY / len(residual), 3) * sigma**2
    return size > max(limit, 0.25 * size.max())
