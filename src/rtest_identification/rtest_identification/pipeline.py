"""From finished cycles to the identification of a machine: one function for node and command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from rtest_estimation import runout as runouts
from rtest_estimation.errors import UserError
from rtest_estimation.records import Cycle, Kind, NestCalibration
from rtest_identification.error_map import AxisMap
from rtest_identification.grid_map import GridMap
from rtest_identification.location import MAP_SIGNIFICANCE, Effects, Estimate, Fit, fit
from rtest_identification.machine import Machine
from rtest_identification.observations import Observations, repeatability, stack, turns
from rtest_identification.symbols import ErrorParameter
from rtest_identification.uncertainty import AxisPrior, Budget, Sources, budget

# A residual this improbable at the measured repeatability means that the model lacks something.
MISFIT_PROBABILITY = 0.01
# Errors and residuals beyond these are not errors of a machine but another machine [m], [rad].
LARGEST_RESIDUAL, LARGEST_LENGTH, LARGEST_ANGLE = 1e-3, 5e-3, 0.02


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
    budget : contributions to the uncertainty of the location errors
    sources : where they come from, for Monte Carlo propagation
    warnings : what to mend or mind before using the numbers; notes : what holds for every R-test
    model : name of the model whose effects were free besides
    disagreement : rms of what more than three gauges leave of each other, by cycle [m]
    poses : planned in all static cycles, measured or not
    """

    session: str
    machine: Machine
    observations: Observations
    fit: Fit
    noise: float
    noise_freedom: int
    runout: runouts.Runout | None
    budget: Budget
    sources: Sources
    outliers: tuple[Unused, ...]
    missing: tuple[Unused, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...] = ()
    disagreement: dict[str, float] = field(default_factory=dict)
    poses: int = 0
    model: str | None = None

    @property
    def location(self) -> Estimate:
        """Location errors and squareness."""
        return self.fit.location

    @property
    def maps(self) -> tuple[AxisMap, ...]:
        """Error maps over one axis: that of the outer rotary axis."""
        return (self.fit.error_map,) if self.fit.error_map else ()

    @property
    def inner_map(self) -> GridMap | None:
        """Error map of the inner rotary axis over both; None where there is none to show."""
        return self.fit.inner_map


def identify(
    machine: Machine,
    cycles: Sequence[Cycle],
    priors: dict[str, AxisPrior] | None = None,
    effects: Effects | None = None,
    nests: Sequence[NestCalibration] = (),
) -> Identification:
    """Identify a machine from the finished cycles of one session.

    priors : what is known of the error motions of the linear axes, by letter
    effects : of a model that are free besides
    nests : calibrations of the session; the scatter of laser nests is in them

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
    result = fit(observations, effects)
    known = np.where(result.location.determined, result.location.value, np.nan)
    refuse_other_machine(machine, result.location.parameters, known, result.rms)
    noise, freedom = repeatability(cycles, nests)
    errors = np.zeros((len(machine.letters), 6))
    errors.flat[[p.column for p in result.location.parameters]] = result.location.value
    used = observations.keep(np.setdiff1d(np.arange(len(observations)), result.outliers))
    across = None if runout is None else runout.covariance[:2, :2]
    sources = Sources(used, errors, cycles, noise, across, priors)
    result, shares = _with_sources(result, sources)
    found, notes = _judge(result, noise, freedom)
    warnings += found
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
        session, machine, observations, result, noise, freedom, runout, shares, sources, outliers,
        missing, tuple(warnings), tuple(notes) + _about_priors(priors), _disagreement(cycles),
        poses=sum(len(c.plan.commands) for c in cycles if turns(machine, c.plan)),
    )


def refuse_other_machine(
    machine: Machine, parameters: Sequence[ErrorParameter], values: np.ndarray, rms: float
) -> None:
    """Raise UserError where the machine file cannot be that of the recording.

    values : identified constants [m] or [rad], NaN where not determined; rms : residual [m]
    """
    text = f'machine {machine.name!r} does not fit this recording: '
    hint = '; check chain, direction and sense of the axes in the machine file'
    if rms > LARGEST_RESIDUAL:
        raise UserError(f'{text}residual {rms * 1e3:.1f} mm{hint}')
    for p, value in zip(parameters, values, strict=True):
        if abs(value) > (LARGEST_ANGLE if p.angular else LARGEST_LENGTH):
            raise UserError(f'{text}{p.symbol} would be {value:.3g} {p.unit}{hint}')


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


def _with_sources(result: Fit, sources: Sources) -> tuple[Fit, Budget]:
    """Add what does not show in the scatter of the fit to every covariance."""
    shares = budget(result.location, sources)
    location = replace(result.location, covariance=shares.total)
    error_map, inner = result.error_map, result.inner_map
    if error_map is not None:
        more = sum(sources.carry(error_map.gain).values())
        error_map = replace(error_map, covariance=error_map.covariance + more)
    if inner is not None and sources.priors:
        more = np.diag(sum(sources.carry(inner.gain).values())).reshape(inner.value.shape)
        inner = replace(inner, stddev=np.sqrt(inner.stddev**2 + more))
    return replace(result, location=location, error_map=error_map, inner_map=inner), shares


def _about_priors(priors: dict[str, AxisPrior] | None) -> tuple[str, ...]:
    if priors:
        return ()
    return (
        'error motions of the linear axes are not in the uncertainty, and often larger than it; '
        'give what is known of them with --priors',
    )


def _disagreement(cycles: Sequence[Cycle]) -> dict[str, float]:
    found = {}
    for cycle in cycles:
        values = [p.disagreement for p in cycle.points if p.disagreement > 0.0]
        if values:
            found[cycle.plan.cycle] = float(np.sqrt(np.mean(np.square(values))))
    return found


def _judge(result: Fit, noise: float, freedom: int) -> tuple[list[str], list[str]]:
    """What a user must know before trusting the numbers: warnings, and notes."""
    warnings: list[str] = []
    notes: list[str] = []
    location = result.location
    lost = [s for s, good in zip(location.symbols, location.determined, strict=True) if not good]
    if lost:
        warnings.append(
            f'not determined by these poses: {", ".join(lost)}; measure another sphere position'
        )
    for group in result.error_map.left_open if result.error_map else ():
        notes.append(
            f'map of {result.error_map.axis}: {group} over its stations cannot be told from '
            'constant errors and is kept out of the map'
        )
    if len(result.outliers):
        warnings.append(f'{len(result.outliers)} poses left out as outliers')
    inner = result.inner_map
    # The richest model whose residual still has enough degrees of freedom to be judged.
    rms, left = result.rms, location.freedom
    if inner and inner.significance < MAP_SIGNIFICANCE:
        rms, left = inner.rms, inner.freedom
    if inner and inner.undetermined:
        warnings.append(
            f'map of {inner.axis}: these sphere positions cannot tell '
            f'{", ".join(inner.undetermined)} from each other at every pose; measure at other '
            'heights and radii'
        )
    for group in inner.left_open if inner else ():
        notes.append(
            f'map of {inner.axis}: {group} that turn with the table look like an offset of the '
            'cycle and are kept out of the map'
        )
    if freedom and rms > 0.0:
        ratio = (rms / noise) ** 2
        if stats.f.sf(ratio, left, freedom) < MISFIT_PROBABILITY:
            warnings.append(
                f'residual {rms * 1e6:.2f} µm against a repeatability of '
                f'{noise * 1e6:.2f} µm: the model lacks an effect (or the machine repeats less '
                'well elsewhere than at the nest calibration); the values may be off by more '
                'than their stated uncertainty'
            )
    if result.joint:
        notes.append(
            f'errors of {result.error_map.axis} change with it: the location errors are means '
            'over its stations, fitted together with the map'
        )
    if inner and inner.significance < MAP_SIGNIFICANCE and not result.joint_inner:
        warnings.append(
            f'errors of {inner.axis} change with it, and these set-ups cannot fit squareness and '
            f'location errors together with its map: they may be off by more than their stated '
            'uncertainty; measure more sphere positions'
        )
    if not freedom:
        warnings.append('no repeated poses: the residual cannot be judged against the noise')
    return warnings, notes
