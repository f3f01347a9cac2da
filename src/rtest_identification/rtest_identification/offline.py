"""Identification of a recording, without ROS."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtest_estimation.attempts import counted
from rtest_estimation.bagfile import Bag, read_bag
from rtest_estimation.dwell import ROTARY_LETTERS
from rtest_estimation.errors import UserError
from rtest_estimation.missing import grouped
from rtest_estimation.pipeline import EstimationRules, Estimator, Finished
from rtest_estimation.recording import (
    TYPES,
    Recording,
    read_recording,
    recorded_machine,
    recording_of,
    temperatures,
)
from rtest_estimation.records import CyclePlan, Kind, NestCalibration, NestKind
from rtest_identification.gap.effects import Effect, library
from rtest_identification.gap.model_file import Model, load_model
from rtest_identification.gap.scene import Scene
from rtest_identification.gap.user_effects import load_effects
from rtest_identification.location import Effects
from rtest_identification.machine import Machine, load_machine, parse_machine
from rtest_identification.observations import Observations
from rtest_identification.pipeline import Identification, identify
from rtest_identification.tolerance import Tolerances
from rtest_identification.uncertainty import load_priors

# Commands nearer than this are the same place [m].
SAME_PLACE = 1e-9


def estimate_recording(
    recording: Recording,
    rules: EstimationRules | None = None,
    progress: Callable[[str], None] = lambda line: None,
    nests: Mapping[str, NestCalibration] | None = None,
) -> list[Finished]:
    """Every cycle of a recording, as the estimator node finished them.

    Of a cycle that was measured more than once the attempt that counts.

    rules : those of the node, as far as the recording says, where they are not given
    nests : calibrations by set-up that are used instead of the recording's own
    """
    estimator = Estimator(rules or rules_of(recording), nests)
    done: list[Finished] = []

    def note(ready: Finished) -> None:
        if ready.nest is not None and nests:
            ready = replace(ready, nest=nests.get(ready.nest.setup, ready.nest))
        done.append(ready)
        cycle = ready.cycle
        poses = f'{len(cycle.points)} of {len(cycle.plan.commands)} poses'
        if cycle.plan.kind is Kind.DYNAMIC:
            poses = 'read while the axes move'
        progress(
            f'{cycle.plan.cycle}: {poses}' + (f' ({ready.problem})' if ready.problem else '')
        )

    for plan in recording.plans:
        estimator.add_plan(plan)
    for _, add, record in _in_order(estimator, recording):
        add(record)
        while (ready := estimator.finished()) is not None:
            note(ready)
    for ready in estimator.finish():
        note(ready)
    kept = {id(cycle) for cycle in counted(one.cycle for one in done)}
    return [one for one in done if id(one.cycle) in kept]


def rules_of(recording: Recording) -> EstimationRules:
    """Kind and sphere of the nest, as the recorded calibrations say.

    Where none was recorded: lasers are calibrated in a cube, contact gauges along single axes.
    """
    rules = EstimationRules()
    for message in reversed(recording.nests):
        if message.kind in tuple(NestKind):
            return replace(
                rules, nest=NestKind(message.kind), sphere_radius=float(message.sphere_radius)
            )
    if any(_through_cube(plan) for plan in recording.plans):
        rules = replace(rules, nest=NestKind.LASER)
    return rules


def _through_cube(plan: CyclePlan) -> bool:
    """Whether a nest calibration moves all its linear axes at once."""
    moved = np.abs(plan.commands - plan.commands[0]) > SAME_PLACE
    linear = [axis not in ROTARY_LETTERS for axis in plan.axes]
    return plan.kind is Kind.NEST_CALIBRATION and bool(moved[:, linear].all(axis=1).any())


def nests_of(path: Path | str, plans: Sequence[CyclePlan]) -> dict[str, NestCalibration]:
    """Nest calibrations of a recording by set-up.

    plans : of the session that they are for; raises UserError where a set-up of them is missing
    """
    finished = estimate_recording(read_recording(path))
    nests = {one.nest.setup: one.nest for one in finished if one.nest is not None}
    for plan in plans:
        if plan.setup not in nests:
            there = ', '.join(nests) or 'none'
            raise UserError(
                f'{path}: no nest calibration of set-up {plan.setup}, there is {there}; give a '
                'recording that has them all'
            )
    return nests


def lost_cycles(finished: Iterable[Finished]) -> list[str]:
    """Why cycles have no point, for example `1a-static 0-85: no gauge readings`."""
    lines = []
    for item in finished:
        if not item.cycle.points:
            name, reasons = item.cycle.plan.cycle, grouped(item.cycle.missing)
            told = item.problem in {missing.reason for missing in item.cycle.missing}
            lines += [f'{name} {line}' for line in reasons]
            lines += [f'{name}: {item.problem}'] if item.problem and not told else []
    return lines


def machine_of(
    bag: Bag, path: Path | str | None = None, topics: Mapping[str, str] | None = None
) -> Machine:
    """The machine of a recording, or that of another file.

    Raises UserError where there is none, and naming key and what is expected.
    """
    if path is not None:
        return load_machine(path)
    text = recorded_machine(bag, topics)
    if text is None:
        raise UserError(f'{bag.path}: no machine was recorded; give its file with --machine')
    return parse_machine(text, f'{bag.path}: /rtest/machine')


def identify_recording(
    path: Path | str,
    machine_path: Path | str | None = None,
    progress: Callable[[str], None] = lambda line: None,
    topics: Mapping[str, str] | None = None,
    priors_path: Path | str | None = None,
    model_path: Path | str | None = None,
    tolerances: Tolerances | None = None,
    effects_path: Path | str | None = None,
    nest_path: Path | str | None = None,
) -> Identification:
    """Identify the machine from a recording alone.

    The files are checked before the readings are looked at, which takes longest.

    machine_path : another machine file than the recorded one
    topics : role to topic name, as in `rtest_estimation.recording.read_recording`
    priors_path : file of what is known of the linear axes' error motions
    model_path : file of a model whose effects are free besides
    tolerances : by which the machine is to be judged afterwards
    effects_path : file of the user's own effects that the model has
    nest_path : another recording, whose nest calibrations are used

    Raises UserError naming file and what is expected.
    """
    model = load_model(model_path) if model_path is not None else None
    bag = read_bag(path, TYPES)
    machine = machine_of(bag, machine_path, topics)
    priors = load_priors(priors_path, machine) if priors_path is not None else None
    more, unread = [], []
    if effects_path is not None:
        if model is None:
            raise UserError(f'{effects_path}: effects are those of a model; give it with --model')
        more = load_effects(effects_path, machine, temperatures(bag, unread))
    if model:
        model.check(machine, more)
    if tolerances:
        tolerances.check(machine)
    recording = recording_of(bag, topics)
    given = nests_of(nest_path, recording.plans) if nest_path is not None else None
    finished = estimate_recording(recording, None, progress, given)
    nests = [f.nest for f in finished if f.nest is not None]
    directions = {nest.setup: nest.sensitive for nest in nests}
    effects = None
    if model:
        effects = _effects_of(model, more, recording.plans[0].stamp, directions)
    try:
        result = identify(machine, [f.cycle for f in finished], priors, effects, nests)
    except UserError as error:
        why = '; '.join(lost_cycles(finished))
        raise UserError(f'{path}: {error}' + (f' ({why})' if why else '')) from None
    problems = tuple(f'{f.cycle.plan.cycle}: {f.problem}' for f in finished if f.problem)
    warnings = (*recording.warnings, *unread, *problems, *result.warnings)
    return replace(result, warnings=warnings, session=result.session or recording.session,
                   model=model.name if model else None)


def _effects_of(
    model: Model, more: Sequence[Effect], start: int, directions: Mapping[str, np.ndarray]
) -> Effects:
    """The model's effects as columns for `location.fit`.

    more : effects of the user's own
    start : of the session [ns]; directions : of the gauges by set-up
    """

    def columns(
        observations: Observations, jacobian: np.ndarray, fitted: np.ndarray
    ) -> np.ndarray:
        scene = Scene(observations, jacobian, fitted, start, directions)
        chosen = model.resolve([*library(scene), *more])
        empty = np.zeros((len(observations), 3, 0))
        return np.concatenate([empty, *(e.columns(scene, s) for e, s in chosen)], axis=2)

    return columns


def _in_order(
    estimator: Estimator, recording: Recording
) -> Iterator[tuple[int, Callable[..., None], object]]:
    """Feedback and readings, a second at a time, merged by acquisition time."""
    feedback = ((int(p.stamps[0]), estimator.extend, p) for p in recording.feedback.pieces())
    gauges = ((p.stamp, estimator.add_gauges, p) for p in recording.gauges.pieces())
    return heapq.merge(feedback, gauges, key=lambda item: item[0])
