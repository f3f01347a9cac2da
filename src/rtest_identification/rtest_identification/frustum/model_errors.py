"""What the errors and effects of a model file do to a feature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.frustum.commands import Commands
from rtest_identification.frustum.contour import along_normal, contour_error, response
from rtest_identification.frustum.sources import (
    DRIFT,
    TRIALS,
    Errors,
    Part,
    constant_part,
    draw,
    scene_of,
)
from rtest_identification.gap.catalogue import every_effect
from rtest_identification.gap.effects import Effect
from rtest_identification.gap.model_file import Model, ModelEffect, Value
from rtest_identification.gap.scene import Scene
from rtest_identification.kinematics import ERROR_LETTERS, predict
from rtest_identification.machine import Machine
from rtest_identification.symbols import ErrorParameter, parameter

_OWN_RANGE = 'angular-two-slope'
_INSTRUMENT = ('nest-slip', 'gauge-gain', 'gauge-direction')


def of_model(
    commands: Commands, model: Model, effects: Sequence[Effect] = (), trials: int = TRIALS,
    seed: int = 1,
) -> Errors:
    """Of a model file. Its uncertainties are taken for independent: it has no correlations.

    effects : of the user's own, besides the library

    Raises UserError where the model is of another machine or has an error that this one has not.
    """
    machine = commands.machine
    if model.machine and model.machine != machine.name:
        raise UserError(
            f'model {model.name!r} is of machine {model.machine!r}, the machine file of '
            f'{machine.name!r}; give the right one with --machine'
        )
    constants = constant_values(model, machine)
    errors = np.zeros((len(machine.letters), 6))
    for p, value in constants:
        errors.flat[p.column] = value.value
    slope = response(commands)
    parts = [constant_part(p, value.value, slope) for p, value in constants]
    spread = [(value.stddev or 0.0) * slope[:, p.column] for p, value in constants]
    count = len(spread)
    notes = [
        f'{p.symbol}: the model has no uncertainty of it' for p, value in constants
        if value.stddev is None
    ]
    error = constant_error = contour_error(commands, errors)
    at = predict(machine, commands.positions, errors, jacobian=True).jacobian
    scene = scene_of(commands, at)
    kept, left = usable(model)
    notes += left
    for entry, (effect, shape) in zip(
        kept, replace(model, effects=kept).resolve([*every_effect(machine), *effects]), strict=True
    ):
        moved, spreads = _moved(entry, effect, shape, scene)
        error = error + moved
        parts.append(Part(
            entry.key, _sizes(entry), along_normal(commands, moved), None, False,
            formula=effect.formula,
        ))
        spread += [along_normal(commands, one) for one in spreads]
    rng = np.random.default_rng(seed)
    every = np.array(spread).reshape(-1, len(commands.feature)).T
    return Errors(
        tuple(parts), error, constant_error, draw(rng, every, trials),
        draw(rng, every[:, :count], trials), tuple(notes),
    )


def constant_values(model: Model, machine: Machine) -> list[tuple[ErrorParameter, Value]]:
    """The constants of a model with the errors they are; UserError where it is none of these."""
    known = {}
    for axis in machine.letters:
        for letter in ERROR_LETTERS:
            p = parameter(machine, axis, letter)
            known.setdefault(p.symbol, p)
    found = []
    for name, value in model.values.items():
        if name not in known:
            raise UserError(
                f'model {model.name!r}: {name}: machine {machine.name!r} has no such error'
            )
        if value.unit != known[name].unit:
            raise UserError(
                f'model {model.name!r}: {name}: unit {value.unit!r}, expected '
                f'{known[name].unit!r}'
            )
        found.append((known[name], value))
    return found


def usable(model: Model) -> tuple[tuple[ModelEffect, ...], list[str]]:
    """Effects that say something about a part, and why others do not."""
    kept, notes = [], []
    for entry in model.effects:
        family = entry.key.partition('/')[0]
        if family == DRIFT:
            notes.append(f'{entry.key} is left out: how warm the machine is then is not known')
        elif family == _OWN_RANGE:
            notes.append(
                f'{entry.key} is left out: it is a triangle over the range of its session, which '
                'the model does not hold'
            )
        elif family in _INSTRUMENT:
            notes.append(f'{entry.key} is left out: it is of the instrument, not of the machine')
        else:
            kept.append(entry)
    return tuple(kept), notes


def _moved(
    entry: ModelEffect, effect: Effect, shape: tuple[float, ...], scene: Scene
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Displacement (n, 3) by an effect, and by a standard uncertainty of each of its numbers."""
    names = [p.name for p in effect.parameters]
    if sorted(entry.parameters) != sorted(names):
        raise UserError(
            f'{entry.key}: parameters {sorted(entry.parameters)}, expected {sorted(names)}'
        )
    given = [entry.parameters[name] for name in names]
    values = np.array([value.value for value in given])
    columns = effect.columns(scene, shape)
    spreads = [columns[:, :, k] * (v.stddev or 0.0) for k, v in enumerate(given)]
    for k, p in enumerate(effect.shape):
        step = entry.shape[p.name].stddev
        if step:
            high, low = (
                effect.columns(scene, (*shape[:k], shape[k] + s, *shape[k + 1 :])) @ values
                for s in (step, -step)
            )
            spreads.append(0.5 * (high - low))
    return columns @ values, spreads


def _sizes(entry: ModelEffect) -> str:
    return ', '.join(f'{name} {v.value:.3g} {v.unit}' for name, v in entry.parameters.items())
