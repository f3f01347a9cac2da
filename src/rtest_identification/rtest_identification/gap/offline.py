"""The model gap of a recording, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from rtest_estimation.bagfile import read_bag
from rtest_estimation.recording import TYPES, recording_of, temperatures
from rtest_estimation.records import Cycle
from rtest_identification.gap.confusions import described
from rtest_identification.gap.effects import Effect, library
from rtest_identification.gap.model_file import Model, ModelEffect, Value
from rtest_identification.gap.rows import nest_spread
from rtest_identification.gap.size import Found
from rtest_identification.gap.user_effects import load_effects
from rtest_identification.gap.workflow import Carried, GapResult, analyse
from rtest_identification.machine import Machine
from rtest_identification.observations import stack
from rtest_identification.offline import estimate_recording, machine_of
from rtest_identification.pipeline import refuse_other_machine


@dataclass(frozen=True)
class SessionGap:
    """The gap of one session and the model that closes it as far as it could be closed.

    confusions : which effects of the library the user's own look like in these data
    """

    session: str
    result: GapResult
    model: Model
    warnings: tuple[str, ...] = ()
    confusions: tuple[str, ...] = ()


def gap_recording(
    path: Path | str,
    model: Model | None = None,
    effects_path: Path | str | None = None,
    machine_path: Path | str | None = None,
    progress: Callable[[str], None] = lambda line: None,
    topics: Mapping[str, str] | None = None,
) -> SessionGap:
    """Run the workflow on a recording alone.

    The files are checked before the readings are looked at, which takes longest.

    model : what is known of the machine; effects_path : the user's own effects
    machine_path : another machine file than the recorded one
    topics : role to topic name, as in `rtest_estimation.recording.read_recording`

    Raises UserError naming file and what is expected.
    """
    bag = read_bag(path, TYPES)
    machine = machine_of(bag, machine_path, topics)
    more, warnings = [], []
    if effects_path is not None:
        more = load_effects(effects_path, machine, temperatures(bag, warnings))
    if model:
        model.check(machine, more)
        model.free(machine)  # Raises where it lists an error that the machine does not have.
    recording = recording_of(bag, topics)
    finished = estimate_recording(recording, None, progress)
    directions = {f.nest.setup: f.nest.sensitive for f in finished if f.nest is not None}
    progress('comparing model and measurement')
    session = gap_session(machine, [f.cycle for f in finished], directions, model, more)
    known = library(session.result.rows.scene)
    told = (described(effect, session.result.rows, known) for effect in more)
    alike = [line for line in told if line]
    planned = sum(len(f.cycle.plan.commands) for f in finished)
    missing = sum(len(f.cycle.missing) for f in finished)
    if missing:
        warnings.append(f'{missing} of {planned} poses are missing; `rtest info` says why')
    return replace(
        session, warnings=(*recording.warnings, *warnings), confusions=tuple(alike)
    )


def gap_session(
    machine: Machine,
    cycles: Sequence[Cycle],
    directions: Mapping[str, np.ndarray],
    model: Model | None = None,
    more: Sequence[Effect] = (),
) -> SessionGap:
    """Run the workflow on the finished cycles of a session: for command and node alike."""
    if model:
        model.check(machine, more)
    cycles = sorted(cycles, key=lambda c: (c.plan.stamp, c.plan.cycle))
    observations = stack(machine, cycles)
    start = min(cycle.plan.stamp for cycle in cycles)
    name = next((c.plan.session for c in cycles if c.plan.session), '')
    result = analyse(observations, start, directions, model, more, spread=nest_spread(cycles))
    refuse_other_machine(
        machine, result.constants.parameters, result.constants.value, result.gap.before
    )
    return SessionGap(name, result, extend(model, machine, result, name, start))


def extend(
    model: Model | None, machine: Machine, result: GapResult, session: str, start: int
) -> Model:
    """The model with what was found, and where that is from."""
    when = datetime.fromtimestamp(start / 1e9, timezone.utc).isoformat(timespec='seconds')
    values = {
        p.symbol: Value(float(v), _known(s), p.unit)
        for p, v, s in zip(
            result.constants.parameters, result.constants.value, result.constants.stddev,
            strict=True,
        )
    }
    missing = [f for f in result.found if f.effect.key.startswith('location/')]
    for found in missing:
        # An error that the model left out is freed like the others from now on.
        (parameter,) = found.effect.parameters
        values[found.effect.symbols[0]] = Value(
            float(found.value[0]), _known(found.stddev[0]), parameter.unit
        )
    old = [
        _again(entry, now, session, when)
        for entry, now in zip(model.effects if model else (), result.carried, strict=True)
    ]
    return Model(
        model.name if model else f'{machine.name or "machine"} after {session}', machine.name,
        values,
        (*old, *(_entry(f, result, session, when) for f in result.found if f not in missing)),
    )


def _again(entry: ModelEffect, now: Carried, session: str, when: str) -> ModelEffect:
    """An effect of the model as large as it was in this session."""
    sizes = {
        p.name: Value(float(v), _known(s), p.unit)
        for p, v, s in zip(now.effect.parameters, now.value, now.stddev, strict=True)
    }
    origin = {**entry.provenance, 'identified again': f'{session}, {when}'}
    return replace(entry, parameters=sizes, provenance=origin)


def _known(stddev: float) -> float | None:
    """None of a value that the data leave open."""
    return float(stddev) if np.isfinite(stddev) else None


def _entry(found: Found, result: GapResult, session: str, when: str) -> ModelEffect:
    linear, shape = found.effect.parameters, found.effect.shape
    pairs = [
        Value(float(v), _known(s), p.unit)
        for p, v, s in zip((*linear, *shape), found.value, found.stddev, strict=True)
    ]
    gap = result.gap
    why = (
        f'{found.effect.name}: gap {gap.before * 1e6:.2f} to {gap.after * 1e6:.2f} µm, noise '
        f'{gap.noise * 1e6:.2f} µm'
    )
    return ModelEffect(
        found.effect.key,
        dict(zip([p.name for p in linear], pairs[: len(linear)], strict=True)),
        dict(zip([p.name for p in shape], pairs[len(linear) :], strict=True)),
        found.confidence, found.rivals, {'session': session, 'when': when, 'why': why},
    )
