"""From finished cycles to the identification of a machine: one function for node and command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from rtest_estimation import runout as runouts
from rtest_estimation.records import Cycle, Kind
from rtest_identification.location import AxisMap, Estimate, Fit, fit
from rtest_identification.machine import Machine
from rtest_identification.observations import Observations, repeatability, stack

# A residual this improbable at the measured repeatability means that the model lacks something.
MISFIT_PROBABILITY = 0.01


@dataclass(frozen=True)
class Unused:
    """A pose that did not take part: missing, or left out as an outlier."""

    cycle: str
    pose: int
    reason: str


@dataclass(frozen=True)
class Identification:
    """Result for one session.

    noise : repeatability of a pose, per component [m]; NaN where nothing was repeated
    runout : of the sphere against the spindle axis; None where it was not measured
    """

    session: str
    machine: Machine
    observations: Observations
    fit: Fit
    noise: float
    noise_freedom: int
    runout: runouts.Runout | None
    outliers: tuple[Unused, ...]
    missing: tuple[Unused, ...]
    warnings: tuple[str, ...]

    @property
    def location(self) -> Estimate:
        """Location errors and squareness."""
        return self.fit.location

    @property
    def maps(self) -> tuple[AxisMap, ...]:
        """Error maps that were identified."""
        return (self.fit.error_map,) if self.fit.error_map else ()


def identify(machine: Machine, cycles: Sequence[Cycle]) -> Identification:
    """Identify a machine from the finished cycles of one session.

    Raises UserError where there is nothing to identify from.
    """
    # The order of acquisition, however the cycles arrived.
    cycles = sorted(cycles, key=lambda c: (c.plan.stamp, c.plan.cycle))
    warnings: list[str] = []
    turned = [c for c in cycles if c.plan.kind is Kind.SPINDLE_RUNOUT and c.points]
    offset, runout = np.zeros(3), None
    if turned:
        try:
            offset, runout = _sphere_offset(turned[-1])
        except ValueError as error:
            warnings.append(f'{turned[-1].plan.cycle}: sphere run-out not used: {error}')
    if runout is None:
        warnings.append(
            "the sphere's run-out against the spindle was not measured: the position errors of "
            'the rotary axes across the spindle contain it'
        )
    observations = stack(replace(machine, tool=machine.tool + offset), cycles)
    result = fit(observations)
    if runout is not None:
        result = _with_runout(observations, result, runout)
    noise, freedom = repeatability(cycles)
    warnings += _judge(result, noise, freedom)
    session = next((c.plan.session for c in cycles if c.plan.session), '')
    missing = tuple(
        Unused(cycle.plan.cycle, item.index, item.reason)
        for cycle in cycles
        for item in cycle.missing
    )
    outliers = tuple(
        Unused(
            observations.cycles[observations.cycle[row]],
            int(observations.pose[row]),
            'far from the fit',
        )
        for row in result.outliers
    )
    return Identification(
        session, machine, observations, result, noise, freedom, runout, outliers, missing,
        tuple(warnings),
    )


def _sphere_offset(cycle: Cycle) -> tuple[np.ndarray, runouts.Runout]:
    """Where the sphere stands off the spindle axis in ordinary cycles, S = 0 (Eq. 2-7)."""
    points = np.array([p.displacement[:2] for p in cycle.points])
    circle = runouts.fit(points)
    spindle = np.array([p.feedback[cycle.plan.axes.index('S')] for p in cycle.points])
    home = np.abs(np.angle(np.exp(1j * spindle))) < 1e-3
    if not home.any():
        raise ValueError('no valid point at S = 0, where the other cycles stand')
    # The circle's point in the direction of the readings at S = 0 is less noisy than they are.
    towards = points[home].mean(axis=0) - circle.centre
    towards *= circle.radius / max(np.linalg.norm(towards), 1e-12)
    return np.append(towards, 0.0), circle


def _with_runout(observations: Observations, result: Fit, runout: runouts.Runout) -> Fit:
    """Carry the uncertainty of the sphere's offset to the location errors."""
    step = 1e-6
    slopes = []
    machine = observations.machine
    for direction in np.eye(3)[:2]:
        shifted = replace(machine, tool=machine.tool + step * direction)
        moved = replace(observations, machine=shifted)
        slopes.append((fit(moved).location.value - result.location.value) / step)
    gain = np.array(slopes).T
    covariance = result.location.covariance + gain @ runout.covariance[:2, :2] @ gain.T
    return replace(result, location=replace(result.location, covariance=covariance))


def _judge(result: Fit, noise: float, freedom: int) -> list[str]:
    """What a user must know before trusting the numbers."""
    warnings = []
    location = result.location
    lost = [s for s, good in zip(location.symbols, location.determined, strict=True) if not good]
    if lost:
        warnings.append(
            f'not determined by these poses: {", ".join(lost)}; measure another sphere position'
        )
    for group in result.error_map.left_open if result.error_map else ():
        warnings.append(
            f'map of {result.error_map.axis}: {group} over its stations cannot be told from '
            'constant errors and is kept out of the map'
        )
    if len(result.outliers):
        warnings.append(f'{len(result.outliers)} poses left out as outliers')
    if freedom and result.rms > 0.0:
        ratio = (result.rms / noise) ** 2
        if stats.f.sf(ratio, location.freedom, freedom) < MISFIT_PROBABILITY:
            warnings.append(
                f'residual {result.rms * 1e6:.2f} um against a repeatability of '
                f'{noise * 1e6:.2f} um: the model lacks an effect (or the machine repeats less '
                'well elsewhere than at the nest calibration); the values may be off by more '
                'than their stated uncertainty'
            )
    if not freedom:
        warnings.append('no repeated poses: the residual cannot be judged against the noise')
    return warnings
