"""Uncertainty of the location errors: GUM linear propagation, and Monte Carlo (JCGM 101).

Contributions, each carried through the gain of the estimator (what a value changes per
displacement of each pose):

- noise: what the fit leaves, by its degrees of freedom (type A);
- nest calibration: the directions of the gauges are as good as the readings at the calibration's
  steps; what is wrong with them multiplies the displacements of the whole set-up;
- sphere run-out: the centre of the sphere's circle about the spindle axis;
- linear axes: their error motions about their average lines are no unknowns of the fit and look
  like errors of the rotary axes. They dominate (Bringmann and Knapp 2009) and cannot be seen from
  the data; they enter as priors that the user gives, from a calibration or the maker's limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats

from rtest_estimation.errors import UserError
from rtest_estimation.records import Cycle, Kind
from rtest_estimation.yaml_text import read_yaml
from rtest_identification.kinematics import ERROR_LETTERS
from rtest_identification.location import Estimate
from rtest_identification.machine import Machine
from rtest_identification.observations import Observations

NOISE, NEST, RUNOUT, LINEAR = 'noise', 'nest calibration', 'sphere run-out', 'linear axes'
COVERAGE_FACTOR = 2.0
# Nodes along an axis on which an error motion is described; linear between them.
_NODES = 41
_KEYS = {'positioning_um', 'straightness_um', 'angular_urad', 'wavelength_mm'}


@dataclass(frozen=True)
class AxisPrior:
    """Error motion of a linear axis about its average line, as standard uncertainties.

    positioning, straightness : rms over the range used [m]; angular : of each of roll, pitch and
    yaw [rad]; wavelength : of its typical waves [m]
    """

    positioning: float
    straightness: float
    angular: float
    wavelength: float


@dataclass(frozen=True)
class Budget:
    """Covariances of the location errors by contribution; `total` is their sum.

    parts : name to (p, p); freedom : (p,) effective degrees of freedom (Welch-Satterthwaite)
    """

    parts: dict[str, np.ndarray]
    freedom: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """(p, p) combined covariance."""
        return sum(self.parts.values())

    @property
    def correlation(self) -> np.ndarray:
        """(p, p) correlation coefficients."""
        stddev = np.sqrt(np.diag(self.total))
        return self.total / np.outer(stddev, stddev)

    @property
    def interval_factor(self) -> np.ndarray:
        """(p,) factor of a 95 % interval, Student's t at the effective degrees of freedom."""
        return stats.t.ppf(0.975, self.freedom)


@dataclass(frozen=True)
class Draws:
    """Monte Carlo propagation: one row a trial.

    value : (m, p) [m] or [rad]
    """

    value: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """(p, p)."""
        return np.atleast_2d(np.cov(self.value, rowvar=False))

    def interval(self, probability: float = 0.95) -> np.ndarray:
        """(2, p) probabilistically symmetric coverage interval (JCGM 101, 7.7)."""
        tail = 50.0 * (1.0 - probability)
        return np.percentile(self.value, [tail, 100.0 - tail], axis=0)


def load_priors(path: Path | str, machine: Machine) -> dict[str, AxisPrior]:
    """Read a file of priors: ``linear_axes: {X: {positioning_um: .., straightness_um: ..}}``.

    Raises UserError naming file, key and what is expected.
    """
    data = read_yaml(path, 'the priors')
    axes = data.get('linear_axes') if isinstance(data, dict) and len(data) == 1 else None
    if not isinstance(axes, dict) or not axes:
        raise UserError(f'{path}: expected the one key linear_axes, a mapping of axis letters')
    priors = {}
    for name, spec in axes.items():
        where = f'{path}: linear_axes: {name}'
        if name not in machine.linear:
            raise UserError(f'{where}: expected a linear axis, one of {", ".join(machine.linear)}')
        if not isinstance(spec, dict) or set(spec) != _KEYS:
            raise UserError(f'{where}: expected the keys {", ".join(sorted(_KEYS))}')
        for key, value in spec.items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if not (number and math.isfinite(value) and value >= 0.0):
                raise UserError(f'{where}: {key}: expected a number from 0, got {value!r}')
        if not spec['wavelength_mm'] > 0.0:
            raise UserError(f'{where}: wavelength_mm: expected a length above 0')
        priors[name] = AxisPrior(
            spec['positioning_um'] * 1e-6, spec['straightness_um'] * 1e-6,
            spec['angular_urad'] * 1e-6, spec['wavelength_mm'] * 1e-3,
        )
    return priors


@dataclass(frozen=True)
class Sources:
    """What the uncertainty comes from, besides the scatter of the fit.

    errors : (k, 6) identified errors about which everything is linearised
    cycles : of the session, for the nest calibrations
    noise : standard deviation of a pose, per component [m]; NaN where it is not known
    runout : (2, 2) covariance of the sphere's offset across the spindle [m2], None if unmeasured
    priors : of the linear axes, by letter
    """

    observations: Observations
    errors: np.ndarray
    cycles: Sequence[Cycle]
    noise: float
    runout: np.ndarray | None = None
    priors: dict[str, AxisPrior] | None = None

    def carry(self, gain: np.ndarray) -> dict[str, np.ndarray]:
        """Covariance (p, p) of each source for values with this gain (p, n, 3)."""
        parts = {NEST: self._nest(gain)}
        if self.runout is not None:
            slope = np.einsum('pni,nij->pj', gain, self.runout_slope())
            parts[RUNOUT] = slope @ self.runout @ slope.T
        if self.priors:
            parts[LINEAR] = self._linear(gain)
        return parts

    def runout_slope(self) -> np.ndarray:
        """(n, 3, 2) change of the predicted centres per sphere offset across the spindle."""
        step, machine = 1e-6, self.observations.machine
        centre = self.observations.predict(self.errors)[0]
        slopes = []
        for direction in np.eye(3)[:2]:
            moved = replace(machine, tool=machine.tool + step * direction)
            shifted = replace(self.observations, machine=moved).predict(self.errors)[0]
            slopes.append((shifted - centre) / step)
        return np.stack(slopes, axis=2)

    def _nest(self, gain: np.ndarray) -> np.ndarray:
        total = np.zeros((len(gain), len(gain)))
        displacement = self.observations.displacement
        for rows, factor in nest_scatter(self.observations, self.cycles, self.noise):
            # Sensitivity to E_ij: gain along i times displacement along j.
            wave = np.einsum('pni,nj->pij', gain[:, rows], displacement[rows]) @ factor
            total += np.einsum('pij,qij->pq', wave, wave)
        return total

    def _linear(self, gain: np.ndarray) -> np.ndarray:
        _, jacobian = self.observations.predict(self.errors, jacobian=True)
        total = np.zeros((len(gain), len(gain)))
        for axis, letter, nodes, shape in motions(self.observations, self.priors or {}):
            column = 6 * self.observations.machine.letters.index(axis) + letter
            slope = np.einsum('pni,ni->pn', gain, jacobian[:, :, column])
            wave = slope @ nodes @ shape
            total += wave @ wave.T
        return total


def budget(location: Estimate, sources: Sources) -> Budget:
    """Propagate every contribution to the location errors (GUM, law of propagation).

    location : whose covariance is that of the scatter of the fit
    """
    parts = {NOISE: location.covariance, **sources.carry(location.gain)}
    total = np.diag(sum(parts.values()))
    # Only the noise has finite degrees of freedom.
    freedom = location.freedom * (total / np.diag(location.covariance)) ** 2
    return Budget(parts, freedom)


def monte_carlo(
    location: Estimate, sources: Sources, rms: float, trials: int = 10_000, seed: int = 1
) -> Draws:
    """Propagate the same contributions by random trials through the kinematics (JCGM 101).

    rms : of the fit's residual, per component [m]
    """
    rng = np.random.default_rng(seed)
    observations, table = sources.observations, sources.errors
    centre, _ = observations.predict(table)
    values = np.empty((trials, len(location.value)))
    scatter = nest_scatter(observations, sources.cycles, sources.noise)
    waves = motions(observations, sources.priors or {})
    slope = sources.runout_slope()
    for trial in range(trials):
        # A scaled inverse chi-squared draw: the variance is known by its degrees of freedom only.
        sigma = rms * math.sqrt(location.freedom / rng.chisquare(location.freedom))
        change = sigma * rng.standard_normal(centre.shape)
        for rows, factor in scatter:
            wrong = rng.standard_normal((3, 3)) @ factor.T
            change[rows] += observations.displacement[rows] @ wrong.T
        if waves:
            errors = np.repeat(table[None], len(observations), axis=0)
            for axis, letter, nodes, shape in waves:
                wave = nodes @ (shape @ rng.standard_normal(shape.shape[1]))
                errors[:, observations.machine.letters.index(axis), letter] += wave
            change += observations.predict(errors)[0] - centre
        if sources.runout is not None:
            offset = rng.multivariate_normal(np.zeros(2), sources.runout, method='eigh')
            change += slope @ offset
        values[trial] = location.value + np.einsum('pni,ni->p', location.gain, change)
    return Draws(values)


def nest_scatter(
    observations: Observations, cycles: Sequence[Cycle], noise: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rows of each static cycle and the (3, 3) factor of its nest's error per component.

    A calibrated nest reads (1 + E) x for a displacement x. Each row of E is the error of a
    regression on the calibration's steps: covariance noise^2 (X^T X)^-1.
    """
    steps = {}
    for cycle in cycles:
        if cycle.plan.kind is Kind.NEST_CALIBRATION and cycle.calibration and cycle.points:
            rows = [p.index for p in cycle.points]
            place = cycle.plan.commands[rows][:, [cycle.plan.axes.index(a) for a in 'XYZ']]
            place = place - place.mean(axis=0)
            steps[cycle.plan.setup] = noise * np.linalg.cholesky(np.linalg.inv(place.T @ place))
    found = []
    for number, setup in enumerate(observations.setups):
        if setup in steps and math.isfinite(noise):
            found.append((np.flatnonzero(observations.cycle == number), steps[setup]))
    return found


def motions(
    observations: Observations, priors: dict[str, AxisPrior]
) -> list[tuple[str, int, np.ndarray, np.ndarray]]:
    """Axis, letter, (n, m) interpolation from nodes, and (m, m) factor of the nodes' covariance.

    An error motion is a random function with the correlation of waves of the given length. What
    the fit's own unknowns and offsets stand for is taken out: the mean everywhere, and of a
    straightness the slope, which is squareness.
    """
    found = []
    for axis, prior in priors.items():
        positions = observations.axis(axis)
        low, high = float(positions.min()), float(positions.max())
        if high - low < 1e-6:
            continue
        grid = np.linspace(low, high, _NODES)
        place = (positions - low) / (high - low) * (_NODES - 1)
        first = np.minimum(place.astype(int), _NODES - 2)
        nodes = np.zeros((len(positions), _NODES))
        nodes[np.arange(len(positions)), first] = 1.0 - (place - first)
        nodes[np.arange(len(positions)), first + 1] = place - first
        width = prior.wavelength / (2.0 * math.pi)
        kernel = np.exp(-0.5 * ((grid[:, None] - grid[None, :]) / width) ** 2)
        direction = observations.machine.axes[axis].direction
        for letter, name in enumerate(ERROR_LETTERS):
            along = name in 'XYZ' and abs(direction['XYZ'.index(name)]) > 0.5
            size = prior.angular if name in 'ABC' else (
                prior.positioning if along else prior.straightness
            )
            powers = 1 if along or name in 'ABC' else 2
            basis = np.linalg.qr(np.vander(grid - grid.mean(), powers))[0]
            free = np.eye(_NODES) - basis @ basis.T
            covariance = free @ kernel @ free
            rms = math.sqrt(max(np.trace(covariance) / _NODES, 1e-300))
            values, vectors = np.linalg.eigh(covariance)
            factor = vectors * np.sqrt(np.maximum(values, 0.0))
            found.append((axis, letter, nodes, size / rms * factor))
    return found
