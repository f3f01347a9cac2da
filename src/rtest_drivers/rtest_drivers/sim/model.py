"""Effects of a model file as error motions of the simulated machine.

What an effect is, the library or the user's file of effects says; here it is only evaluated.
Effects that hang on time, on the direction of motion or on the instrument are no functions of the
position and are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.gap.effects import Effect, library
from rtest_identification.gap.model_file import load_model
from rtest_identification.gap.scene import Scene
from rtest_identification.gap.user_effects import RESERVED, load_effects, of_positions
from rtest_identification.machine import Machine
from rtest_identification.observations import Observations

# Families that are not functions of the axes' positions alone, or of the range of a session.
NOT_SIMULATED = ('backlash', 'drift', 'nest-slip', 'gauge-gain', 'gauge-direction',
                 'angular-two-slope')
# Swivel by which the library tells an axis that turns fully from one that does not [rad].
_SWIVEL = 1.3


@dataclass(frozen=True)
class ModelMotions:
    """Error motions of a model.

    terms : effect, its shape and its parameters, SI
    """

    machine: Machine
    terms: tuple[tuple[Effect, tuple[float, ...], np.ndarray], ...]

    @property
    def axes(self) -> set[str]:
        """Axes whose errors the model has."""
        return {symbol[-1] for effect, _, _ in self.terms for symbol in effect.symbols}

    def of_axis(self, axis: str, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, 6) errors A B C X Y Z of one axis [rad] and [m]; positions as (n,) arrays."""
        scene = _scene(self.machine, positions)
        place = 6 * self.machine.letters.index(axis)
        total = np.zeros((len(scene.jacobian), scene.jacobian.shape[1]))
        for effect, shape, value in self.terms:
            total += effect.columns(scene, shape) @ value
        return total[:, place : place + 6]


def load_motions(
    path: Path, machine: Machine, effects_path: Path | None = None
) -> ModelMotions:
    """Read a model file for the simulation.

    effects_path : file of the user's own effects that the model has

    Raises UserError naming file, effect and what is expected.
    """
    model = load_model(path)
    if model.machine and model.machine != machine.name:
        raise UserError(
            f'{path}: model {model.name!r} is of machine {model.machine!r}, the simulated one is '
            f'{machine.name!r}; give the model of this machine'
        )
    more = load_effects(effects_path, machine) if effects_path else []
    moving = {effect.key for effect in more if not of_positions(effect)}
    known = {effect.key: effect for effect in more}
    for entry in model.effects:
        if entry.key not in known and entry.key.split('/')[0] not in RESERVED:
            raise UserError(
                f'{path}: no effect {entry.key!r} in the library; if it is your own, give its '
                'file as effects: beside model: in the truth file'
            )
    for reach in (_SWIVEL, np.pi):
        ends = {name: np.array([-reach, reach]) for name in machine.letters}
        known |= {effect.key: effect for effect in library(_scene(machine, ends))}
    terms = []
    for entry, (effect, shape) in zip(model.effects, model.resolve(list(known.values())),
                                      strict=True):
        if entry.key.split('/')[0] in NOT_SIMULATED or entry.key in moving:
            raise UserError(f'{path}: {entry.key}: not a function of the axes, not simulated')
        names = [p.name for p in effect.parameters]
        if sorted(entry.parameters) != sorted(names):
            raise UserError(f'{path}: {entry.key}: parameters: expected {", ".join(names)}')
        terms.append((effect, shape, np.array([entry.parameters[n].value for n in names])))
    return ModelMotions(machine, tuple(terms))


def _scene(machine: Machine, positions: Mapping[str, np.ndarray]) -> Scene:
    """A scene whose response is the errors themselves: what an effect moves, it returns."""
    columns = [np.asarray(positions[name], dtype=float) for name in machine.letters]
    stack = np.stack(columns, axis=1)
    count, size = len(stack), 6 * len(machine.letters)
    none = np.zeros(count, dtype=np.int64)
    observations = Observations(
        machine, ('',), ('',), stack, np.zeros((count, 3)), np.zeros((count, 3, 3)),
        np.zeros((count, 3)), none, none, np.zeros(stack.shape, dtype=np.int8), none,
    )
    response = np.broadcast_to(np.eye(size), (count, size, size))
    return Scene(observations, response, np.zeros((count, 3)), 0)
