"""Sessions of the simulated machine with an effect hidden in them, dwell by dwell.

The readings of every dwell are drawn as the cell's gauges give them and averaged, calibrated and
made into cycles by the estimation's own functions; only the time between the dwells is left out,
which is what makes hundreds of sessions affordable.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rtest_drivers.sim.errors import GeometricErrors
from rtest_drivers.sim.gauges import GaugeData, Nest, mount
from rtest_drivers.sim.hidden import Hidden, HiddenErrors, Poses, directions
from rtest_drivers.sim.kinematics import sphere_in_table
from rtest_estimation import nest as nests
from rtest_estimation.average import average
from rtest_estimation.records import Cycle, CyclePlan, CyclePoint, NestCalibration, Status
from rtest_identification.kinematics import predict
from rtest_identification.machine import Machine
from rtest_identification.plans import nest_calibration
from rtest_identification.symbols import location_parameters

# Sizes of the machine's constants: of Table 3-2.
_SHIFT, _TILT = 1e-5, 2e-5
_GAUGES = GaugeData(
    azimuth=np.radians([30.0, 150.0, 270.0]), tilt=np.full(3, np.pi / 4), direction_error=0.0175,
    position_error=1.5e-5, noise=1e-7, dwell_noise=0.0, lower=-3e-3, upper=3e-3,
    period=20_000_000, batch=10,
)
# Less than this share beside the constants is not in the data; above this cosine two are one.
_VISIBLE, _ALIKE = 0.02, 0.9
_READINGS = 10
_POSE_S = 0.7


@dataclass(frozen=True)
class Noise:
    """What the measurement does to the truth.

    dwell : standard deviation of the sphere in a dwell, each direction [m]
    ends : how many times more at the outermost levels of the outer axis
    outliers, outlier : share of readings, their standard deviation [m]
    correlation : of the dwell noise from one pose to the next
    """

    dwell: float
    ends: float = 1.0
    outliers: float = 0.0
    outlier: float = 5e-5
    correlation: float = 0.0


@dataclass(frozen=True)
class Blind:
    """A session and what is hidden in it.

    cycles : nest calibrations and static cycles; directions : of the gauges by set-up
    hidden : effects with their amplitude; delta : what is left of each, in standard deviations
    left : (3 n,) of each, what its location and squareness errors leave, in standard deviations
    """

    machine: Machine
    cycles: list[Cycle]
    directions: dict[str, np.ndarray]
    hidden: tuple[tuple[Hidden, float], ...]
    delta: tuple[float, ...]
    left: tuple[np.ndarray, ...]
    constants: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Setting:
    """A machine with constants, its plans, and the nests as they were mounted."""

    machine: Machine
    plans: tuple[CyclePlan, ...]
    base: GeometricErrors
    nests: tuple[Nest, ...]
    poses: Poses


def setting(machine: Machine, plans: Sequence[CyclePlan], rng: np.random.Generator) -> Setting:
    """Draw a machine's location and squareness errors and mount the nests."""
    constants = {
        p.symbol: float(rng.normal() * (_SHIFT if p.unit == 'm' else _TILT))
        for p in location_parameters(machine)
    }
    signs = [directions(machine, plan.commands, plan.sphere) for plan in plans]
    sizes = [len(plan.commands) for plan in plans]
    # A nest calibration and a change of the set-up lie between the cycles.
    starts = np.cumsum([0.0, *(_POSE_S * n + 30.0 for n in sizes[:-1])])
    time = [start + _POSE_S * np.arange(n) for start, n in zip(starts, sizes, strict=True)]
    poses = Poses(
        machine, np.concatenate([p.commands for p in plans]), np.concatenate(signs),
        np.concatenate(time), np.repeat(np.arange(len(plans)), sizes),
    )
    mounted = tuple(mount(_GAUGES, plan.sphere, rng) for plan in plans)
    return Setting(machine, tuple(plans), GeometricErrors(constants, {}), mounted, poses)


def make(
    where: Setting, hidden: Sequence[Hidden], delta: Sequence[float], noise: Noise,
    rng: np.random.Generator,
) -> Blind | None:
    """Hide effects, each scaled to a signal to noise `delta`, and measure.

    delta : |W M phi|, the norm of what the location and squareness errors and an offset per cycle
        leave of an effect, in standard deviations of the dwell means.

    Returns None where these data show less than 2 % of an effect, or two of them as one and the
    same.
    """
    sigma = _sigma(where, noise)
    scaled, left = [], []
    for effect, size in zip(hidden, delta, strict=True):
        signature, share = _signature(where, effect, sigma)
        if share < _VISIBLE:
            return None
        left.append(signature / np.linalg.norm(signature))
        scaled.append((effect, size / np.linalg.norm(signature)))
    if any(abs(one @ other) > _ALIKE for one, other in itertools.combinations(left, 2)):
        return None
    sphere = _displacement(where, scaled)
    sphere = sphere + sigma[:, None] * _dwell_noise(where, noise, rng)
    cycles: list[Cycle] = []
    found: dict[str, np.ndarray] = {}
    for number, plan in enumerate(where.plans):
        rows = where.poses.cycle == number
        nest, calibrated = _calibrate(where, number, noise, scaled, rng)
        cycles.append(calibrated)
        read = _readings(where.nests[number], sphere[rows], scaled, True)
        cycles.append(_cycle(where, number, read, nest, noise, rng))
        found[plan.setup] = nest.direction
    return Blind(
        where.machine, cycles, found, tuple(scaled), tuple(delta),
        tuple(size * one for size, one in zip(delta, left, strict=True)), where.base.constants,
    )


def _sigma(where: Setting, noise: Noise) -> np.ndarray:
    """(n,) standard deviation of a dwell mean per direction [m]."""
    outer = np.abs(where.poses.at(where.machine.rotary[0]))
    return noise.dwell * np.where(outer > outer.max() - 0.01, noise.ends, 1.0)


def _dwell_noise(where: Setting, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) of unit variance, correlated from one pose to the next within a cycle."""
    white = rng.standard_normal((len(where.poses), 3))
    rho = noise.correlation
    for row in range(1, len(white)):
        if where.poses.cycle[row] == where.poses.cycle[row - 1]:
            white[row] = rho * white[row - 1] + np.sqrt(1.0 - rho**2) * white[row]
    return white


def _displacement(where: Setting, hidden: Sequence[tuple[Hidden, float]]) -> np.ndarray:
    """(n, 3) sphere in the table frame, exactly [m]."""
    poses = where.poses
    errors = HiddenErrors(where.base, tuple(hidden))
    sphere = sphere_in_table(where.machine, poses.positions, errors)
    for effect, amplitude in hidden:
        if effect.slip is not None:
            sphere = sphere + amplitude * effect.slip
    return sphere


def _readings(
    nest: Nest, sphere: np.ndarray, hidden: Sequence[tuple[Hidden, float]], used: bool
) -> np.ndarray:
    """(n, gauges) what the gauges would read without noise [m].

    used : after the calibration, when a gauge may have been knocked out of its direction
    """
    vectors, gain = nest.directions.copy(), np.ones(len(nest.directions))
    for effect, amplitude in hidden:
        if effect.gauge >= 0:
            gain[effect.gauge] += amplitude * effect.gain
            if used:
                vectors[effect.gauge] += amplitude * effect.turn
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return gain * Nest(vectors, nest.origin).read(sphere)


def _signature(
    where: Setting, effect: Hidden, sigma: np.ndarray
) -> tuple[np.ndarray, float]:
    """What is left of an effect of amplitude 1, in standard deviations, and its share."""
    small = 1e-7 if effect.errors or effect.slip is not None else 1e-3
    change = []
    for amplitude in (-small, small):
        sphere = _displacement(where, [(effect, amplitude)])
        rows = []
        for number in range(len(where.plans)):
            mine = where.poses.cycle == number
            nest = where.nests[number]
            read = _readings(nest, sphere[mine], [(effect, amplitude)], True)
            rows.append(read @ np.linalg.pinv(nest.directions).T)
        change.append(np.concatenate(rows))
    signature = ((change[1] - change[0]) / (2.0 * small) / sigma[:, None]).reshape(-1)
    columns = [p.column for p in location_parameters(where.machine)]
    jacobian = predict(where.machine, where.poses.positions, None, True).jacobian[:, :, columns]
    offsets = np.einsum(
        'nc,ij->nicj', np.eye(len(where.plans))[where.poses.cycle], np.eye(3)
    ).reshape(len(signature) // 3, 3, -1)
    base = np.concatenate([jacobian, offsets], axis=2) / sigma[:, None, None]
    base = base.reshape(len(signature), -1)
    q, _ = np.linalg.qr(base / np.linalg.norm(base, axis=0))
    left, whole = signature - q @ (q.T @ signature), np.linalg.norm(signature)
    return left, float(np.linalg.norm(left) / whole) if whole else 0.0


def _calibrate(
    where: Setting, number: int, noise: Noise, hidden: Sequence[tuple[Hidden, float]],
    rng: np.random.Generator,
) -> tuple[NestCalibration, Cycle]:
    plan = nest_calibration(where.machine, where.plans[number].setup, where.plans[number].sphere)
    sphere = sphere_in_table(where.machine, plan.commands, where.base)
    sphere = sphere + noise.dwell * rng.standard_normal(sphere.shape)
    read = _readings(where.nests[number], sphere, hidden, False)
    means = _means(read, noise, rng)
    linear = [where.machine.letters.index(name) for name in 'XYZ']
    steps = (plan.commands - plan.commands[0])[:, linear]
    nest = nests.calibrate(
        steps, np.array([m.mean for m in means]), f'{plan.setup}-nest', plan.setup, 0
    )
    return nest, _finished(plan, means, nest, np.zeros_like(plan.commands), 0.0)


def _cycle(
    where: Setting, number: int, read: np.ndarray, nest: NestCalibration, noise: Noise,
    rng: np.random.Generator,
) -> Cycle:
    rows = where.poses.cycle == number
    means = _means(read, noise, rng)
    start = float(where.poses.time[rows][0])
    return _finished(where.plans[number], means, nest, where.poses.direction[rows], start)


def _means(read: np.ndarray, noise: Noise, rng: np.random.Generator) -> list:
    shape = (len(read), _READINGS, read.shape[1])
    values = read[:, None, :] + _GAUGES.noise * rng.standard_normal(shape)
    spoilt = rng.random(shape) < noise.outliers
    values = values + spoilt * noise.outlier * rng.standard_normal(shape)
    status = np.full(shape[1:], Status.VALID, dtype=np.uint8)
    return [average(rows, status) for rows in values]


def _finished(
    plan: CyclePlan, means: list, nest: NestCalibration, signs: np.ndarray, start: float
) -> Cycle:
    points = []
    for index, mean in enumerate(means):
        position, covariance, _ = nests.centre(nest, mean)
        stamp = round((start + _POSE_S * index) * 1e9)
        points.append(CyclePoint(
            index, stamp, plan.commands[index], signs[index].astype(np.int8), position,
            covariance, mean.readings,
        ))
    begun = CyclePlan(**{**vars(plan), 'stamp': points[0].stamp, 'session': 'blind'})
    return Cycle(begun, tuple(points), (), nest.calibration, points[-1].stamp)
