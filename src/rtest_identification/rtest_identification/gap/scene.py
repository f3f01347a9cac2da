"""What effects are functions of: one stack of poses with everything known about them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rtest_identification.kinematics import ERROR_LETTERS
from rtest_identification.machine import Machine
from rtest_identification.observations import Observations


@dataclass(frozen=True)
class Scene:
    """The poses of a session, and the machine's response to errors at them.

    jacobian : (n, 3, 6 k) of `kinematics.predict`
    fitted : (n, 3) displacement that the model so far predicts, relative to the start of the
        cycle [m]. Instrument effects act on it: the measured one carries the noise they are
        tested against.
    start : of the session, of its first plan [ns]
    directions : (gauges, 3) of the nest by set-up, empty where they are not known
    """

    observations: Observations
    jacobian: np.ndarray
    fitted: np.ndarray
    start: int
    directions: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def machine(self) -> Machine:
        """The chain."""
        return self.observations.machine

    @property
    def time(self) -> np.ndarray:
        """(n,) time since the start of the session [s]."""
        return (self.observations.stamp - self.start) * 1e-9

    @property
    def gauges(self) -> int:
        """Gauges of the nest; 0 where their directions are not known for every set-up."""
        known = [self.directions.get(setup) for setup in self.observations.setups]
        if not known or any(d is None for d in known):
            return 0
        return min(len(d) for d in known)

    def position(self, axis: str) -> np.ndarray:
        """(n,) encoder position of an axis [m] or [rad]."""
        return self.observations.axis(axis)

    def span(self, axis: str) -> tuple[float, float]:
        """Lowest and highest position of an axis."""
        position = self.position(axis)
        return float(position.min()), float(position.max())

    def direction(self, axis: str) -> np.ndarray:
        """(n,) sign of the axis's last motion before the pose."""
        return self.observations.approach[:, self.machine.letters.index(axis)].astype(float)

    def slope(self, axis: str, letter: str) -> np.ndarray:
        """(n, 3) displacement per error `letter` of `axis`."""
        column = 6 * self.machine.letters.index(axis) + ERROR_LETTERS.index(letter)
        return self.jacobian[:, :, column]

    def slip_times(self) -> np.ndarray:
        """Times at which a step is looked for: between poses, within the cycles [s]."""
        found = []
        for number in range(len(self.observations.cycles)):
            times = np.sort(self.time[self.observations.cycle == number])
            if len(times) > 8:
                edges = np.linspace(3, len(times) - 4, 12).astype(int)
                found += [0.5 * (times[k] + times[k + 1]) for k in np.unique(edges)]
        return np.array(found)

    def gauge_gain(self, gauge: int) -> np.ndarray:
        """(n, 3) displacement per relative gain error of one gauge."""
        columns = np.zeros_like(self.fitted)
        for rows, direction, inverse in self._nests():
            reading = self.fitted[rows] @ direction[gauge]
            columns[rows] = reading[:, None] * inverse[:, gauge]
        return columns

    def gauge_turn(self, gauge: int) -> np.ndarray:
        """(n, 3, 2) displacement per small turn of one gauge about two directions across it."""
        columns = np.zeros((*self.fitted.shape, 2))
        for rows, direction, inverse in self._nests():
            v = direction[gauge]
            first = np.cross(v, np.eye(3)[int(np.argmin(np.abs(v)))])
            first /= np.linalg.norm(first)
            for column, across in enumerate((first, np.cross(v, first))):
                reading = self.fitted[rows] @ across
                columns[rows, :, column] = reading[:, None] * inverse[:, gauge]
        return columns

    def _nests(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        nests = []
        for number, setup in enumerate(self.observations.setups):
            direction = self.directions[setup]
            rows = np.flatnonzero(self.observations.cycle == number)
            nests.append((rows, direction, np.linalg.pinv(direction)))
        return nests
