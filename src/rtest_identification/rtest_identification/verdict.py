"""Pass, fail or undecided by a tolerance file, with the decision rules of ISO 14253-1.

An error passes where its whole uncertainty interval lies within the tolerance (the tolerance zone
reduced by U), fails where all of it lies outside (the zone enlarged by U), and is undecided in
between. What the data do not determine never passes.

For a constant the interval is value +- U, U = k u. For the largest absolute value of a map and
for its peak-to-peak value, noise adds to what is found and never to the truth, so that the two
ends differ (`extremes`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_identification.error_field import ErrorField
from rtest_identification.field_maps import AxisNodes, GridNodes
from rtest_identification.interpolation import TURN, Stations
from rtest_identification.intrinsic import left_open_by_any
from rtest_identification.pipeline import Identification
from rtest_identification.symbols import map_parameters
from rtest_identification.tolerance import (
    LARGEST,
    PEAK,
    RESIDUAL,
    VOLUMETRIC,
    Limits,
    Tolerances,
)

PASS, FAIL, UNDECIDED = 'pass', 'fail', 'undecided'
NOT_DETERMINED = 'not determined'
# Intervals between neighbouring stations, by the number of axes of the map.
_FINE = {1: 6, 2: 3}
# Random trials for the extremes of the noise.
_TRIALS = 4000


@dataclass(frozen=True)
class Judgement:
    """Verdict on one quantity.

    key : symbol, 'residual' or 'volumetric'
    value : found [m] or [rad]; NaN where not determined
    low, high : ends of its uncertainty interval at the coverage factor of the limits
    reason : why undecided, or a remark
    """

    key: str
    limits: Limits
    value: float
    low: float
    high: float
    verdict: str
    reason: str = ''


@dataclass(frozen=True)
class Verdict:
    """Judgements by one tolerance file.

    overall : fail where anything fails, else undecided where anything is, else pass
    """

    path: str
    judgements: tuple[Judgement, ...]

    @property
    def overall(self) -> str:
        """Of all of them; nothing judged is undecided."""
        found = {item.verdict for item in self.judgements} or {UNDECIDED}
        return next(v for v in (FAIL, UNDECIDED, PASS) if v in found)

    @property
    def summary(self) -> str:
        """For example `fail (1 fail, 2 undecided, 11 pass)`."""
        found = [item.verdict for item in self.judgements]
        counts = ((found.count(kind), kind) for kind in (FAIL, UNDECIDED, PASS))
        return f'{self.overall} ({", ".join(f"{n} {kind}" for n, kind in counts if n)})'


def decide(limits: Limits, low: float, high: float) -> str:
    """ISO 14253-1 on an uncertainty interval; NaN is undecided.

    The limits themselves belong to the tolerance.
    """
    if low >= limits.lower and high <= limits.upper:
        return PASS
    if high < limits.lower or low > limits.upper:
        return FAIL
    return UNDECIDED


def judge(result: Identification, tolerances: Tolerances) -> Verdict:
    """Judge an identification by a tolerance file.

    Raises UserError where a limit of the file can be of no error of the machine.
    """
    tolerances.check(result.machine)
    found = [*_constants(result, tolerances), *_maps(result, tolerances)]
    for limits in tolerances.entries.get(RESIDUAL, ()):
        rms, freedom = result.fit.rms, result.location.freedom
        # Standard uncertainty of a standard deviation (GUM E.4.3).
        expanded = limits.coverage_factor * rms / math.sqrt(2.0 * freedom)
        found.append(_judged(RESIDUAL, limits, rms, rms - expanded, rms + expanded))
    for limits in tolerances.entries.get(VOLUMETRIC, ()):
        found.append(_volumetric(result, limits))
    return Verdict(tolerances.path, tuple(found))


def _judged(
    key: str, limits: Limits, value: float, low: float, high: float, remark: str = ''
) -> Judgement:
    verdict = decide(limits, low, high)
    if not math.isfinite(value):
        return Judgement(key, limits, math.nan, math.nan, math.nan, UNDECIDED, NOT_DETERMINED)
    if verdict == UNDECIDED:
        wide = high - low > limits.upper - limits.lower
        remark = (
            'U is larger than the tolerance can bear: no value could pass'
            if wide else 'a limit lies within the uncertainty'
        )
    return Judgement(key, limits, value, low, high, verdict, remark)


def _constants(result: Identification, tolerances: Tolerances) -> list[Judgement]:
    found = []
    location = result.location
    for p, value, stddev, good in zip(
        location.parameters, location.value, location.stddev, location.determined, strict=True
    ):
        group = 'location_errors' if p.axis in result.machine.rotary else 'squareness'
        for limits in tolerances.of_constant(p, group):
            middle = float(value) if good else math.nan
            expanded = limits.coverage_factor * float(stddev)
            found.append(
                _judged(p.symbol, limits, middle, middle - expanded, middle + expanded)
            )
    return found


def _maps(result: Identification, tolerances: Tolerances) -> list[Judgement]:
    machine, found = result.machine, []
    wanted = [
        (p, limits) for axis in machine.rotary for p in map_parameters(machine, axis)
        for limits in tolerances.of_map(p)
    ]
    if not wanted:
        return []
    field = ErrorField.from_identification(result, every_map=True)
    lost = _lost(result, field)
    for p, limits in wanted:
        nodes = next((n for n in (field.outer, field.inner) if n and n.axis == p.axis), None)
        if nodes is None or p.symbol in lost:
            found.append(_judged(p.symbol, limits, math.nan, math.nan, math.nan))
            continue
        row = [q.symbol for q in map_parameters(machine, p.axis)].index(p.symbol)
        weights, doubt = _over_the_range(field, nodes)
        covariance = _of_nodes(field, nodes, row)
        value, low, high = extremes(
            nodes.value[row], covariance, weights, doubt[:, row], limits.quantity,
            limits.coverage_factor,
        )
        found.append(_judged(p.symbol, limits, value, low, high))
    return found


def _lost(result: Identification, field: ErrorField) -> set[str]:
    """Symbols of the maps that more set-ups would determine better than these did."""
    lost = set(field.undetermined)
    any_cycle = left_open_by_any(result)
    for fitted in (result.fit.error_map, result.fit.inner_map):
        for group in fitted.left_open if fitted else ():
            if group not in any_cycle:
                lost |= {p.symbol for p in fitted.parameters if p.symbol in group}
    return lost


def _over_the_range(
    field: ErrorField, nodes: AxisNodes | GridNodes
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (n, m) and doubt (n, 6) of the map at the stations and between them."""
    ranges = [field.outer.stations] if nodes is field.outer else [nodes.levels, nodes.grid]
    axes = [field.machine.letters.index(name) for name in field.rotary][: len(ranges)]
    fine = [_fine(stations, _FINE[len(ranges)]) for stations in ranges]
    mesh = np.meshgrid(*fine, indexing='ij')
    positions = np.zeros((mesh[0].size, len(field.machine.letters)))
    for column, values in zip(axes, mesh, strict=True):
        positions[:, column] = values.ravel()
    read = nodes.read(positions)
    return read.weights[read.inside], read.doubt[read.inside]


def _fine(stations: Stations, parts: int) -> np.ndarray:
    knots = stations.knots
    ends = np.append(knots, knots[0] + TURN) if stations.periodic else knots
    steps = np.linspace(0.0, len(ends) - 1.0, parts * (len(ends) - 1) + 1)
    return np.interp(steps, np.arange(len(ends)), ends)


def _of_nodes(field: ErrorField, nodes: AxisNodes | GridNodes, row: int) -> np.ndarray:
    """(m, m) covariance of one error at the nodes of its map."""
    if isinstance(nodes, GridNodes):
        return np.diag(nodes.covariance[:, row, row])
    count = nodes.value.shape[1]
    first = len(field.value) + row * count
    return field.covariance[first : first + count, first : first + count]


def extremes(
    nodes: np.ndarray,
    covariance: np.ndarray,
    weights: np.ndarray,
    doubt: np.ndarray,
    quantity: str,
    factor: float,
) -> tuple[float, float, float]:
    """Peak-to-peak value or largest absolute value of a map, and its uncertainty interval.

    Parameters
    ----------
    nodes, covariance : (m,), (m, m) values at the stations
    weights, doubt : (n, m), (n,) interpolation over the range, its standard uncertainty
    quantity : PEAK or LARGEST
    factor : k; each end holds with the probability that k gives one side of a normal value

    Returns
    -------
    value, low, high. Upper end: what is found is at least what is found where the truth has its
    extremes a and b, and that is v_a - v_b with its own u_ab; not knowing a and b, the largest of
    v_a - v_b + k u_ab over all pairs is taken. Lower end: noise picks the place, so that what
    is found may exceed the truth by the noise's own peak-to-peak value (the triangle inequality),
    whose quantile comes from random trials. For the largest absolute value it is the same with
    single places. Noise alone thus never fails a map.
    """
    value = weights @ nodes
    spread = weights @ covariance @ weights.T
    variance = np.maximum(np.diag(spread), 0.0) + doubt**2
    size, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(size, 0.0))
    rng = np.random.default_rng(0)
    noise = (weights @ root) @ rng.standard_normal((len(size), _TRIALS))
    noise += doubt[:, None] * rng.standard_normal((len(doubt), _TRIALS))
    if quantity == PEAK:
        found = float(np.ptp(value))
        both = variance[:, None] + variance - 2.0 * spread
        apart = value[:, None] - value + factor * np.sqrt(np.maximum(both, 0.0))
        high, excess = float(apart.max()), np.ptp(noise, axis=0)
    elif quantity == LARGEST:
        found = float(np.abs(value).max())
        high = float((np.abs(value) + factor * np.sqrt(variance)).max())
        excess = np.abs(noise).max(axis=0)
    else:
        raise ValueError(f'quantity: expected {PEAK!r} or {LARGEST!r}, got {quantity!r}')
    return found, max(found - float(np.quantile(excess, stats.norm.cdf(factor))), 0.0), high


def _volumetric(result: Identification, limits: Limits) -> Judgement:
    """Largest predicted error of a sphere at the measured poses, zeroed at the first of them."""
    field = ErrorField.from_identification(result)
    data = result.observations
    first = [data.axis(name)[0] for name in field.rotary]
    found = field.at(data.positions, reference=np.array(first), outside='nan')
    size = np.linalg.norm(found.error, axis=1)
    if not np.isfinite(size).all():
        return _judged(VOLUMETRIC, limits, math.nan, math.nan, math.nan)
    along = found.error / np.maximum(size, 1e-15)[:, None]
    stddev = np.sqrt(np.einsum('ni,nij,nj->n', along, found.covariance, along))
    factor, worst = limits.coverage_factor, int(np.argmax(size))
    # Sidak: noise may have picked the place among all poses.
    picked = -float(stats.norm.ppf(-np.expm1(np.log(stats.norm.cdf(factor)) / len(size))))
    return _judged(
        VOLUMETRIC, limits, float(size[worst]),
        max(float(size[worst] - picked * stddev[worst]), 0.0),
        float((size + factor * stddev).max()),
    )
