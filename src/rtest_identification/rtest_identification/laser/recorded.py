"""Laser nests in a recording: the calibrated volume verified, the sphere scanned (chapter 5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rtest_estimation import nest as nests
from rtest_estimation.buffers import FeedbackBuffer, GaugeBuffer
from rtest_estimation.dwell import ROTARY_LETTERS
from rtest_estimation.errors import UserError
from rtest_estimation.laser import CentreSolver, CentreStatus
from rtest_estimation.laser.correction import KERNELS, Kernel, leave_one_out
from rtest_estimation.laser.profile import SphereProfile, measure_profile
from rtest_estimation.laser.verification import Deviation, Verification, deviation, verify
from rtest_estimation.pipeline import EstimationRules, Finished
from rtest_estimation.recording import Recording, read_recording
from rtest_estimation.records import CyclePlan, Kind, NestCalibration, NestKind, Status
from rtest_identification.offline import estimate_recording, rules_of

# Readings of a scan count at these shares of its feed, and at this cosine of their motion and the
# lines: not at the ends of the lines and on the ways between them.
_SPEEDS = (0.02, 1.5)
_ALONG = 0.95


@dataclass(frozen=True)
class KernelCheck:
    """One kernel of the correction.

    left_out : rms error at left-out nodes [m], None where the nodes cannot tell
    verified : at the verification points; None without any in the calibrated volume
    """

    kernel: Kernel
    left_out: float | None
    verified: Deviation | None


@dataclass(frozen=True)
class NestCheck:
    """One calibrated laser nest.

    chosen : kernel that sphere centres are corrected with; None where none is better than nothing
    kernels : every one that the nodes allow, in the order of `correction.KERNELS`
    positions : (n, 3) of the verification points relative to the start of the calibration [m]
    verification : at these, with the chosen kernel; None where there were none
    contact : what the algorithm of contact nests gives there (Eqs. 2-5, 2-6), and its error (n, 3)
    """

    nest: NestCalibration
    chosen: Kernel | None
    kernels: tuple[KernelCheck, ...]
    positions: np.ndarray
    verification: Verification | None = None
    contact: Deviation | None = None
    contact_error: np.ndarray | None = None


@dataclass(frozen=True)
class Scan:
    """Lines over the sphere with one laser.

    laser : its number, from 1
    place : (n, 2) of the sphere in the scanned plane, along the lines and across them [m]
    reading : (n,) [m]; valid : (n,) whether there was a signal
    """

    cycle: str
    setup: str
    laser: int
    place: np.ndarray
    reading: np.ndarray
    valid: np.ndarray
    profile: SphereProfile


@dataclass(frozen=True)
class LaserResult:
    """Everything in one recording."""

    session: str
    sphere_radius: float
    checks: tuple[NestCheck, ...]
    scans: tuple[Scan, ...]
    warnings: tuple[str, ...]


def laser_recording(
    path: Path | str,
    progress: Callable[[str], None] = lambda line: None,
    sphere_radius: float | None = None,
) -> LaserResult:
    """Evaluate the laser nests of a recording.

    sphere_radius : [m], where the recording does not say it

    Raises UserError where there is nothing of a laser nest in it, or where it says otherwise.
    """
    recording = read_recording(path)
    rules = rules_of(recording)
    if recording.nests and rules.nest is not NestKind.LASER:
        raise UserError(f'{path}: the nest is of contact gauges, as the recording says')
    said = rules.sphere_radius
    if sphere_radius is not None and said > 0.0 and abs(sphere_radius / said - 1.0) > 1e-3:
        raise UserError(
            f'{path}: --sphere-radius-mm: the recording says {said * 1e3:g} mm; leave it out'
        )
    if sphere_radius is not None:
        rules = replace(rules, nest=NestKind.LASER, sphere_radius=sphere_radius)
    if rules.nest is not NestKind.LASER:
        raise UserError(
            f'{path}: the nest is of contact gauges; if it is of lasers, give --sphere-radius-mm'
        )
    return evaluate(recording, rules, progress)


def evaluate(
    recording: Recording,
    rules: EstimationRules,
    progress: Callable[[str], None] = lambda line: None,
) -> LaserResult:
    """As `laser_recording`, of a recording that was read."""
    finished = estimate_recording(recording, rules, progress)
    checks = tuple(_check(one, finished) for one in finished if one.nest is not None)
    warnings = [*recording.warnings]
    warnings += [
        f'{f.cycle.plan.cycle}: {f.problem}' for f in finished
        if f.problem and f.cycle.plan.kind is not Kind.DYNAMIC
    ]
    scans = []
    for one in finished:
        if one.cycle.plan.kind is Kind.DYNAMIC and not _turns(one.cycle.plan):
            try:
                scans.append(_scan(recording, one, rules, checks))
            except ValueError as error:
                warnings.append(f'{one.cycle.plan.cycle}: {error}')
    if not checks and not scans:
        why = '; '.join(warnings) or 'it has no nest calibration and no scan'
        raise UserError(f'{recording.path}: nothing of a laser nest could be evaluated: {why}')
    return LaserResult(
        recording.session, rules.sphere_radius, checks, tuple(scans), tuple(warnings)
    )


def _turns(plan: CyclePlan) -> bool:
    """Whether a rotary axis or the spindle moves."""
    columns = [k for k, axis in enumerate(plan.axes) if axis in ROTARY_LETTERS]
    return bool(np.ptp(plan.commands[:, columns], axis=0).any())


def _linear(plan: CyclePlan) -> list[int]:
    return [plan.axes.index(axis) for axis in ('X', 'Y', 'Z')]


def _check(calibration: Finished, finished: Sequence[Finished]) -> NestCheck:
    """The nest at its own positions, and at those of the cycles that step the sphere in it."""
    nest, plan = calibration.nest, calibration.cycle.plan
    start = plan.commands[0, _linear(plan)]
    stepped = [
        one for one in finished
        if one.cycle.plan.kind is Kind.STATIC and one.cycle.calibration == nest.calibration
        and not _turns(one.cycle.plan)
    ]
    positions, readings = _means(stepped, start)
    solver = CentreSolver(nest)
    if not len(positions):
        kernels = _kernels(nest, positions, readings)
        return NestCheck(nest, solver.correction.kernel, kernels, positions)
    verification = verify(solver, positions, readings)
    contact = nests.calibrate(*_means([calibration], start), nest.calibration, nest.setup, 0)
    error = nests.centres(contact, readings) - positions
    valid = verification.status == CentreStatus.VALID
    return NestCheck(
        nest, solver.correction.kernel, _kernels(nest, positions, readings), positions,
        verification, deviation(error[valid]), error,
    )


def _means(cycles: Sequence[Finished], start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) by the encoders, relative to `start`, and mean readings (n, lasers) [m]."""
    pairs = [
        (dwell.feedback[_linear(one.cycle.plan)] - start, mean.mean)
        for one in cycles for dwell, mean in one.means
    ]
    positions, readings = zip(*pairs, strict=True) if pairs else ((), ())
    return np.array(positions).reshape(len(pairs), 3), np.array(readings)


def _kernels(
    nest: NestCalibration, positions: np.ndarray, readings: np.ndarray
) -> tuple[KernelCheck, ...]:
    found = []
    for kernel in KERNELS:
        left = leave_one_out(nest.correction_nodes, nest.correction_values, kernel)
        if left is None and kernel.degree >= 0:
            continue
        verified = None
        if len(positions):
            verified = verify(CentreSolver(nest, kernel), positions, readings).corrected
        rms = None if left is None else float(np.sqrt((left**2).sum(axis=1).mean()))
        found.append(KernelCheck(kernel, rms, verified))
    return tuple(found)


def _scan(
    recording: Recording, finished: Finished, rules: EstimationRules, checks: Sequence[NestCheck]
) -> Scan:
    """Readings along the lines, and the sphere in them; raises ValueError where there is none."""
    plan = finished.cycle.plan
    centre = plan.commands[:, _linear(plan)].mean(axis=0)
    along, across, normal = _plane(plan.commands[:, _linear(plan)])
    times, displacement, status, positions = _on_lines(recording, finished, along)
    if not len(times):
        raise ValueError('no readings while the axes moved along the lines')
    laser = _laser_of(displacement.shape[1], normal, plan.setup, checks)
    place = (positions - centre) @ np.column_stack([along, across])
    reading, valid = displacement[:, laser], status[:, laser] == Status.VALID
    if not rules.sphere_radius > 0.0:
        raise ValueError('the radius of the sphere is not in the recording; --sphere-radius-mm')
    profile = measure_profile(place, reading, valid, rules.sphere_radius)
    return Scan(plan.cycle, plan.setup, laser + 1, place, reading, valid, profile)


def _on_lines(
    recording: Recording, finished: Finished, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (n,), readings and status (n, lasers), positions (n, 3) on the lines of a scan."""
    plan, end = finished.cycle.plan, finished.cycle.stamp
    gauges, feedback = GaugeBuffer(), FeedbackBuffer()
    for block in recording.gauges.pieces():
        gauges.append(block)
    for piece in recording.feedback.pieces():
        feedback.extend(piece.axes, piece.stamps, piece.positions)
    times, displacement, status = gauges.window(plan.stamp, end)
    stamps, rows = feedback.window(plan, plan.stamp, end)
    if len(stamps) < 2 or not len(times):
        return times[:0], displacement[:0], status[:0], np.empty((0, 3))
    rows = rows[:, _linear(plan)]
    velocity = np.diff(rows, axis=0) / (np.diff(stamps) * 1e-9)[:, np.newaxis]
    speed = np.linalg.norm(velocity, axis=1)
    step = np.searchsorted(stamps, times, 'right') - 1
    inside = (step >= 0) & (step < len(speed))
    slow, fast = (share * plan.feed for share in _SPEEDS)
    good = (speed > slow) & (speed < fast) & (np.abs(velocity @ along) > _ALONG * speed)
    kept = inside & good[np.clip(step, 0, len(speed) - 1)]
    since = (times[kept] - stamps[0]) * 1e-9
    known = (stamps - stamps[0]) * 1e-9
    positions = np.column_stack([np.interp(since, known, column) for column in rows.T])
    return times[kept], displacement[kept], status[kept], positions


def _plane(commands: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors along the lines of a scan, across them in its plane, and normal to it.

    commands : (n, 3) the start, ends of lines, the start again [m]

    Raises ValueError where they are no scan.
    """
    spread, axes = np.linalg.svd(commands - commands.mean(axis=0))[1:]
    if len(commands) < 4 or not spread[2] < 1e-3 * spread[1]:
        raise ValueError('its poses are no lines in one plane, which a scan of a sphere is')
    along = commands[2] - commands[1]
    along /= np.linalg.norm(along)
    return along, np.cross(axes[2], along), axes[2]


def _laser_of(
    channels: int, normal: np.ndarray, setup: str, checks: Sequence[NestCheck]
) -> int:
    """Which laser looks across the scanned plane; raises ValueError where that is not known."""
    if channels == 1:
        return 0
    for check in checks:
        if check.nest.setup == setup and len(check.nest.spot) == channels:
            return int(np.argmax(np.abs(check.nest.sensitive @ normal)))
    raise ValueError('which laser was scanned is not known without a calibration of its nest')
