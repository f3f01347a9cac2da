"""The thermal session of a recording, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

from rtest_estimation.bagfile import read_bag
from rtest_estimation.errors import UserError
from rtest_estimation.recording import TYPES, recording_of, temperatures
from rtest_identification.offline import estimate_recording, lost_cycles, machine_of
from rtest_identification.thermal.cycles import told_apart
from rtest_identification.thermal.pipeline import Thermal, identify_thermal
from rtest_identification.thermal.temperature import Thermometer
from rtest_identification.uncertainty import load_priors


def thermal_recording(
    path: Path | str,
    machine_path: Path | str | None = None,
    progress: Callable[[str], None] = lambda line: None,
    topics: Mapping[str, str] | None = None,
    priors_path: Path | str | None = None,
) -> Thermal:
    """Identify every cycle of a recorded thermal session.

    machine_path : another machine file than the recorded one
    topics : role to topic name, as in `rtest_estimation.recording.read_recording`
    priors_path : file of what is known of the linear axes' error motions, for the reference

    Raises UserError naming file and what is expected.
    """
    bag = read_bag(path, TYPES)
    machine = machine_of(bag, machine_path, topics)
    priors = load_priors(priors_path, machine) if priors_path is not None else None
    warnings: list[str] = []
    thermometers = [
        Thermometer.of(sensor, stamp, celsius)
        for sensor, (stamp, celsius) in sorted(temperatures(bag, warnings).items())
    ]
    if not thermometers:
        warnings.append('no temperatures were recorded: errors are given over time alone')
    recording = recording_of(bag, topics)
    recording = replace(recording, plans=told_apart(recording.plans))
    finished = estimate_recording(recording, None, progress)
    try:
        result = identify_thermal(machine, [f.cycle for f in finished], thermometers, priors)
    except UserError as error:
        why = '; '.join(lost_cycles(finished))
        raise UserError(f'{path}: {error}' + (f' ({why})' if why else '')) from None
    problems = [f'{f.cycle.plan.cycle}: {f.problem}' for f in finished if f.problem]
    return replace(
        result, session=result.session or recording.session,
        warnings=(*recording.warnings, *warnings, *problems, *result.warnings),
    )
