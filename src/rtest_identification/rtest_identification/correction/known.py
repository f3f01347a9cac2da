"""The errors of every axis at any positions, from an identification or a model file."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.error_field import ErrorField
from rtest_identification.frustum.model_errors import constant_values, usable
from rtest_identification.gap.catalogue import every_effect
from rtest_identification.gap.effects import Effect
from rtest_identification.gap.model_file import Model
from rtest_identification.gap.scene import Scene
from rtest_identification.machine import Machine
from rtest_identification.observations import Observations

_ONE_POINT = (
    'an R-test follows one point: the spindle is taken to stand as its axis carries it, so that '
    'the tilt of the tool is known without that of the spindle against its slide'
)
_OFFSET = (
    'an error that is the same at all poses, seen from the table, does not show in an R-test: set '
    'the zero of the workpiece with the correction on'
)


@dataclass(frozen=True)
class KnownErrors:
    """What is known of the errors of a machine; what is not known is zero.

    at : (positions (n, k), approach (n, k) signs of the last motions) to (n, k, 6) errors
        A B C X Y Z of every axis, as `kinematics.predict` takes them [rad], [m]
    inside : positions (n, k) to (n,) bool, False outside measured stations, where `at` raises
        UserError
    stations : measured ones by rotary axis [rad], where something is known over them
    spread : positions (n, k) to (n,) standard uncertainty of the tool point, of its length [m],
        NaN where a part is not known; None where nothing is known
    """

    machine: Machine
    at: Callable[[np.ndarray, np.ndarray], np.ndarray]
    inside: Callable[[np.ndarray], np.ndarray]
    stations: dict[str, np.ndarray] = field(default_factory=dict)
    spread: Callable[[np.ndarray], np.ndarray] | None = None
    notes: tuple[str, ...] = ()

    def named(
        self, positions: np.ndarray, approach: np.ndarray, name: Callable[[int], str]
    ) -> np.ndarray:
        """As `at`; the UserError of a pose outside the measured stations starts with its name."""
        inside = self.inside(positions)
        if not inside.all():
            row = int(np.argmin(inside))
            try:
                self.at(positions[row : row + 1], approach[row : row + 1])
            except UserError as error:
                raise UserError(f'{name(row)}: {error}') from None
        return self.at(positions, approach)


def of_file(path: Path, machine: Machine) -> KnownErrors:
    """Of an identification.json.

    Raises UserError where the file is not one, or of another machine.
    """
    known = of_field(ErrorField.from_json(path, machine))
    data = json.loads(path.read_text(encoding='utf-8'))
    name = data.get('machine')
    if name and name != machine.name:
        raise UserError(
            f'{path}: is of machine {name!r}, not {machine.name!r}; give its file with --machine'
        )
    warned = tuple(f'the identification warns: {text}' for text in data.get('warnings', ()))
    return replace(known, notes=warned + known.notes)


def of_field(errors: ErrorField) -> KnownErrors:
    """Of an identified machine."""
    machine = errors.machine
    columns = [p.column for p in errors.parameters]
    lost = [p.symbol in errors.undetermined for p in errors.parameters]
    constants = np.where(lost, 0.0, errors.value)
    maps = [nodes for nodes in (errors.outer, errors.inner) if nodes is not None]

    def at(positions: np.ndarray, approach: np.ndarray) -> np.ndarray:
        errors.errors(positions)  # refuses what is outside
        value = np.zeros((len(positions), 6 * len(machine.letters)))
        value[:, columns] = constants
        for nodes in maps:
            value[:, nodes.columns] += nodes.read(positions).weights @ nodes.value.T
        return value.reshape(len(positions), -1, 6)

    def spread(positions: np.ndarray) -> np.ndarray:
        return np.sqrt(np.trace(errors.at(positions).covariance, axis1=1, axis2=2))

    stations = {}
    if errors.outer is not None:
        stations[errors.outer.axis] = errors.outer.stations.knots
    if errors.inner is not None:
        stations |= {
            machine.rotary[0]: errors.inner.levels.knots,
            errors.inner.axis: errors.inner.grid.knots,
        }
    missing = [f'{symbol} was not determined and is taken for zero'
               for symbol in errors.undetermined]
    return KnownErrors(
        machine, at, lambda p: errors.errors(p, outside='nan').inside, stations, spread,
        (*missing, _OFFSET, _ONE_POINT),
    )


def of_model(model: Model, machine: Machine, effects: Sequence[Effect] = ()) -> KnownErrors:
    """Of a model file.

    effects : of the user's own, besides the library

    Raises UserError where the model is of another machine or has an error that this one has not.
    """
    model.check(machine, effects)
    constants = np.zeros((len(machine.letters), 6))
    for p, value in constant_values(model, machine):
        constants.flat[p.column] = value.value
    entries, notes = usable(model)
    probe = np.random.default_rng(0).uniform(-1.0, 1.0, (8, len(machine.letters)))
    motions = []
    for entry, (effect, shape) in zip(
        entries, replace(model, effects=entries).resolve([*every_effect(machine), *effects]),
        strict=True,
    ):
        names = [p.name for p in effect.parameters]
        if sorted(entry.parameters) != sorted(names):
            raise UserError(
                f'{entry.key}: parameters {sorted(entry.parameters)}, expected {sorted(names)}'
            )
        values = np.array([entry.parameters[name].value for name in names])
        if effect.columns(_scene(machine, probe, np.sign(probe), constants[:0]), shape).any():
            notes.append(f'{entry.key} is left out: it moves the table, no axis')
        else:
            motions.append((effect, shape, values))

    def at(positions: np.ndarray, approach: np.ndarray) -> np.ndarray:
        count = len(positions)
        value = np.tile(constants.reshape(-1), (count, 1))
        unit = np.eye(constants.size)
        # An effect gives what it does to a point: let three errors at a time be its coordinates.
        for part in range(0, len(unit), 3):
            scene = _scene(machine, positions, approach, unit[part : part + 3])
            for effect, shape, values in motions:
                value[:, part : part + 3] += effect.columns(scene, shape) @ values
        return value.reshape(count, -1, 6)

    return KnownErrors(
        machine, at, lambda p: np.ones(len(p), dtype=bool), notes=(*notes, _OFFSET, _ONE_POINT)
    )


def _scene(
    machine: Machine, positions: np.ndarray, approach: np.ndarray, response: np.ndarray
) -> Scene:
    """Poses that respond to errors with `response` (3, 6 k); with nothing where it is empty."""
    count, size = len(positions), 6 * len(machine.letters)
    none, zero = np.zeros(count, dtype=np.int64), np.zeros((count, 3))
    observations = Observations(
        machine, ('',), ('',), positions, zero, np.zeros((count, 3, 3)), zero, none, none,
        approach, none,
    )
    if not len(response):
        response = np.zeros((3, size))
    return Scene(observations, np.broadcast_to(response, (count, 3, size)), zero, 0)
