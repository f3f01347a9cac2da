"""Which value of a controller is which axis, in which unit and sense."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# Unit to SI. What MTConnect and LinuxCNC call them is in their protocols.
LENGTHS = {'m': 1.0, 'mm': 1e-3, 'um': 1e-6, 'inch': 25.4e-3}
ANGLES = {'rad': 1.0, 'deg': math.pi / 180.0}
UNITS = {**LENGTHS, **ANGLES}
# No axis is as long or turns as far [m], [rad]: such a value is a fault, not a position.
_FARTHEST = {'length': 1e3, 'angle': math.radians(1e6)}


@dataclass(frozen=True)
class AxisSource:
    """One axis of the machine and where its position comes from.

    name : letter of the axis
    source : what the controller calls it: a joint number, a node id, the id of a data item
    unit : of the controller's value, a key of `UNITS`
    sign : -1 where the controller counts the other way than the machine file, else 1
    """

    name: str
    source: str | int
    unit: str
    sign: int = 1

    @property
    def scale(self) -> float:
        """Controller's value to [m] or [rad]."""
        return self.sign * UNITS[self.unit]

    def plausible(self, value: float) -> bool:
        """Whether a controller's value can be a position: finite, within 1 km or 1e6 deg."""
        farthest = _FARTHEST['length' if self.unit in LENGTHS else 'angle']
        return abs(value * self.scale) < farthest


def names(axes: Sequence[AxisSource]) -> tuple[str, ...]:
    """Letters of the axes, in the order of the feedback."""
    return tuple(axis.name for axis in axes)


def scales(axes: Sequence[AxisSource]) -> np.ndarray:
    """(k,) factors from the controller's values to [m] and [rad]."""
    return np.array([axis.scale for axis in axes])
