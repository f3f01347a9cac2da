"""Identification of a recording, without ROS."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from rtest_estimation.errors import UserError
from rtest_estimation.pipeline import EstimationRules, Estimator, Finished
from rtest_estimation.recording import Recording, read_recording
from rtest_identification.machine import load_machine, parse_machine
from rtest_identification.pipeline import Identification, identify
from rtest_identification.uncertainty import load_priors


def estimate_recording(
    recording: Recording,
    rules: EstimationRules | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> list[Finished]:
    """Every cycle of a recording, as the estimator node finished them."""
    estimator = Estimator(rules)
    done: list[Finished] = []

    def note(ready: Finished) -> None:
        done.append(ready)
        cycle = ready.cycle
        progress(
            f'{cycle.plan.cycle}: {len(cycle.points)} of {len(cycle.plan.commands)} poses'
            + (f' ({ready.problem})' if ready.problem else '')
        )

    for plan in recording.plans:
        estimator.add_plan(plan)
    for _, add, record in _in_order(estimator, recording):
        add(record)
        while (ready := estimator.finished()) is not None:
            note(ready)
    for ready in estimator.finish():
        note(ready)
    return done


def identify_recording(
    path: Path | str,
    machine_path: Path | str | None = None,
    progress: Callable[[str], None] = lambda line: None,
    topics: Mapping[str, str] | None = None,
    priors_path: Path | str | None = None,
) -> Identification:
    """Identify the machine from a recording alone.

    machine_path : another machine file than the recorded one
    topics : role to topic name, as in `rtest_estimation.recording.read_recording`
    priors_path : file of what is known of the linear axes' error motions

    Raises UserError naming file and what is expected.
    """
    recording = read_recording(path, topics)
    if machine_path is not None:
        machine = load_machine(machine_path)
    elif recording.machine_text is not None:
        machine = parse_machine(recording.machine_text, f'{path}: /rtest/machine')
    else:
        raise UserError(f'{path}: no machine was recorded; give its file with --machine')
    priors = load_priors(priors_path, machine) if priors_path is not None else None
    finished = estimate_recording(recording, None, progress)
    try:
        result = identify(machine, [f.cycle for f in finished], priors)
    except UserError as error:
        problems = '; '.join(dict.fromkeys(f.problem for f in finished if f.problem))
        raise UserError(f'{path}: {error}' + (f' ({problems})' if problems else '')) from None
    problems = tuple(f'{f.cycle.plan.cycle}: {f.problem}' for f in finished if f.problem)
    warnings = (*recording.warnings, *problems, *result.warnings)
    return replace(result, warnings=warnings, session=result.session or recording.session)


def _in_order(
    estimator: Estimator, recording: Recording
) -> Iterator[tuple[int, Callable[..., None], object]]:
    """Feedback and gauge blocks merged by acquisition time."""
    feedback = ((r.stamp, estimator.add_feedback, r) for r in recording.feedback)
    gauges = ((r.stamp, estimator.add_gauges, r) for r in recording.gauges)
    return heapq.merge(feedback, gauges, key=lambda item: item[0])
