"""Every effect that a machine can have, to check names before there are data."""

from __future__ import annotations

import numpy as np

from rtest_estimation.messages import MAX_CHANNELS
from rtest_identification.gap.effects import Effect, library
from rtest_identification.gap.scene import Scene
from rtest_identification.machine import Machine
from rtest_identification.observations import Observations


def every_effect(machine: Machine) -> list[Effect]:
    """Every effect that the machine can have, wherever its poses are.

    The library offers harmonics or sags by how far an axis turns: one scene turns the rotary axes
    fully, the other one swivels them. The effects are good for their names alone.
    """
    found: dict[str, Effect] = {}
    for reach in (np.pi, 1.0):
        end = np.array([reach if machine.axes[n].rotary else 0.1 for n in machine.letters])
        none = np.zeros(2, dtype=np.int64)
        observations = Observations(
            machine, ('',), ('',), np.array([-end, end]), np.zeros((2, 3)), np.zeros((2, 3, 3)),
            np.zeros((2, 3)), none, none, np.zeros((2, len(end)), dtype=np.int8), none,
        )
        jacobian = np.zeros((2, 3, 6 * len(end)))
        nest = {'': np.ones((MAX_CHANNELS, 3))}
        for effect in library(Scene(observations, jacobian, np.zeros((2, 3)), 0, nest)):
            found.setdefault(effect.key, effect)
    return list(found.values())
