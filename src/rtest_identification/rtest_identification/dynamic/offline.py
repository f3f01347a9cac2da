"""Dynamic measurements of a recording, without ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtest_estimation import nest as nests
from rtest_estimation.bagfile import read_bag
from rtest_estimation.buffers import FeedbackBuffer, GaugeBuffer
from rtest_estimation.cycle_end import arrivals
from rtest_estimation.dwell import DwellRules, turns
from rtest_estimation.errors import UserError
from rtest_estimation.laser.solver import CentreSolver, CentreStatus
from rtest_estimation.pipeline import Finished
from rtest_estimation.recording import TYPES, Recording, recording_of
from rtest_estimation.records import NestCalibration, NestKind, Status
from rtest_identification.dynamic.motion import Readings
from rtest_identification.dynamic.pipeline import DynamicResult, analyse
from rtest_identification.machine import Machine
from rtest_identification.offline import estimate_recording, machine_of


@dataclass(frozen=True)
class DynamicSession:
    """Everything dynamic in one recording, set-up by set-up."""

    session: str
    results: tuple[DynamicResult, ...]
    warnings: tuple[str, ...] = ()


def dynamic_recording(
    path: Path | str,
    machine_path: Path | str | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> DynamicSession:
    """Evaluate the dynamic cycles of a recording.

    machine_path : another machine file than the recorded one

    Raises UserError naming file and what is expected.
    """
    bag = read_bag(path, TYPES)
    machine = machine_of(bag, machine_path)
    recording = recording_of(bag)
    finished = estimate_recording(recording)
    try:
        return dynamic_session(machine, recording, finished, progress)
    except UserError as error:
        raise UserError(f'{path}: {error}') from None


def dynamic_session(
    machine: Machine,
    recording: Recording,
    finished: list[Finished],
    progress: Callable[[str], None] = lambda line: None,
) -> DynamicSession:
    """Evaluate the dynamic cycles of a session whose nests are calibrated.

    finished : every cycle, as `offline.estimate_recording` gives them

    Raises UserError where there is no dynamic cycle, or none with a calibrated nest.
    """
    cycles = [f.cycle for f in finished if turns(f.cycle.plan)]
    if not cycles:
        raise UserError('no dynamic cycle in this session; `rtest identify` evaluates static ones')
    nest_of = {f.nest.setup: f.nest for f in finished if f.nest is not None}
    gauges, feedback = GaugeBuffer(), FeedbackBuffer()
    for block in recording.gauges.pieces():
        gauges.append(block)
    for piece in recording.feedback.pieces():
        feedback.extend(piece.axes, piece.stamps, piece.positions)
    start = min(plan.stamp for plan in recording.plans)
    by_setup: dict[str, list[Readings]] = {}
    warnings = list(recording.warnings)
    for cycle in cycles:
        plan = cycle.plan
        nest = nest_of.get(plan.setup)
        if nest is None:
            warnings.append(f'{plan.cycle}: no nest calibration of set-up {plan.setup}')
            continue
        stamps, positions = feedback.window(plan, plan.stamp, cycle.stamp)
        absent = [name for name in machine.letters if name not in plan.axes]
        if absent:
            raise UserError(
                f'{plan.cycle}: the plan has axes {" ".join(plan.axes)}, the machine file '
                f'{machine.name!r} also has {" ".join(absent)}; give the right machine file'
            )
        # How the axes came to the first pose is no part of the measurement.
        began = arrivals(plan, positions, DwellRules())[:1]
        stamps, positions = stamps[sum(began) :], positions[sum(began) :]
        order = [plan.axes.index(name) for name in machine.letters]
        times, displacement, status = gauges.window(plan.stamp, cycle.stamp)
        if not len(stamps) or not len(times):
            warnings.append(f'{plan.cycle}: no readings or no encoder feedback')
            continue
        centre, good = centres(nest, displacement, status)
        lost = len(good) - int(good.sum())
        if lost:
            warnings.append(f'{plan.cycle}: {lost} of {len(good)} readings are not valid')
        by_setup.setdefault(plan.setup, []).append(
            Readings(
                plan.cycle, plan.setup, plan.sphere, (times[good] - start) * 1e-9, centre[good],
                (stamps - start) * 1e-9, positions[:, order], nest.kind is NestKind.CONTACT,
            )
        )
    if not by_setup:
        raise UserError('; '.join(warnings))
    results = []
    for setup, parts in by_setup.items():
        progress(f'{setup}: {", ".join(one.cycle for one in parts)}')
        results.append(analyse(machine, parts))
    return DynamicSession(recording.session, tuple(results), tuple(warnings))


def centres(
    nest: NestCalibration, displacement: np.ndarray, status: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sphere centres (n, 3) of single readings [m], frame ``table``, and which are valid (n,).

    displacement : (n, gauges) [m]; status : (n, gauges), see `records.Status`

    Raises UserError where the number of gauges is not the calibration's.
    """
    count = len(nest.direction)
    if displacement.shape[1] != count:
        raise UserError(
            f'{displacement.shape[1]} gauges, the nest was calibrated with {count}'
        )
    good = ((status == Status.VALID) & np.isfinite(displacement)).all(axis=1)
    if nest.kind is NestKind.CONTACT:
        return nests.centres(nest, displacement), good
    found, state = CentreSolver(nest)(np.where(good[:, None], displacement, np.nan))
    return found, good & (state == CentreStatus.VALID)
