"""Where the axes of the simulated machine are at a time: moves from pose to pose, and rests.

A move is smooth (quintic in time), limited by the speed of every axis. The rotary axes go straight
to their ends while the linear axes follow the nominal sphere in the table frame: where the sphere
is nominally at the same place at both ends this is the synchronous arc (tool centre point
control), and where no rotary axis turns it is a straight line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rtest_drivers.sim.kinematics import follow, sphere_in_table
from rtest_identification.machine import Machine

SPINDLE = 'S'
# Largest slope of the quintic 10 t^3 - 15 t^4 + 6 t^5.
_PEAK = 1.875
_NO_NEST = -1


@dataclass(frozen=True)
class Drives:
    """How the axes move.

    linear, rotary : largest speed [m/s], [rad/s]; shortest : time of the shortest move [s]
    settle : amplitude of the oscillation after a move [m]; frequency [Hz]; decay : time constant
        [s]; 0.3 um that is gone after 30 ms is what a well-tuned drive leaves
    """

    linear: float = 0.5
    rotary: float = math.radians(400.0)
    shortest: float = 0.12
    settle: float = 0.0
    frequency: float = 60.0
    decay: float = 0.008


@dataclass(frozen=True)
class Leg:
    """A move and the rest after it, until the next leg starts.

    start : [ns]; duration : of the move [s], 0 where the axes only rest
    begin, end : (k,) positions of the machine's letters and the spindle [m] or [rad]
    sphere_begin, sphere_end : (3,) nominal sphere centre, frame ``table`` [m]
    nest : which mounting of the nest is on the table; -1 for none
    offset_begin, offset_end : (3,) what the sphere is off in this dwell, frame ``table`` [m]
    """

    start: int
    duration: float
    begin: np.ndarray
    end: np.ndarray
    sphere_begin: np.ndarray
    sphere_end: np.ndarray
    nest: int
    offset_begin: np.ndarray
    offset_end: np.ndarray

    @property
    def arrival(self) -> int:
        """When the move ends [ns]."""
        return self.start + round(self.duration * 1e9)


@dataclass(frozen=True)
class State:
    """The machine at n instants: positions (n, k), offset (n, 3) [m], nest (n,) index or -1."""

    positions: np.ndarray
    offset: np.ndarray
    nest: np.ndarray


class Timeline:
    """All legs so far; rests at zero without a nest from `epoch` [ns] on."""

    def __init__(self, machine: Machine, drives: Drives, epoch: int) -> None:
        self._machine, self._drives = machine, drives
        self.axes = (*machine.letters, SPINDLE)
        rest = np.zeros(len(self.axes))
        sphere = self._sphere(rest)
        self._legs = [
            Leg(epoch, 0.0, rest, rest, sphere, sphere, _NO_NEST, np.zeros(3), np.zeros(3))
        ]
        self._linear = [self.axes.index(name) for name in machine.linear]
        self._turning = [k for k in range(len(self.axes)) if k not in self._linear]
        self._pack()

    @property
    def last(self) -> Leg:
        """The leg that ends all others."""
        return self._legs[-1]

    def append(
        self,
        start: int,
        target: np.ndarray,
        nest: int,
        offset: np.ndarray,
        feed: float | None = None,
    ) -> Leg:
        """Go to `target` (k,) from wherever the last leg ends, leaving at `start` [ns].

        feed : largest speed of a linear axis in place of that of the drives [m/s]
        """
        last = self.last
        sphere = self._sphere(target)
        duration = self._duration(last.end, target, last.sphere_end, sphere, feed)
        leg = Leg(
            start, duration, last.end, np.array(target, dtype=float), last.sphere_end, sphere,
            nest, last.offset_end, np.asarray(offset, dtype=float),
        )
        self._legs.append(leg)
        return leg

    def rest(self, start: int, nest: int, offset: np.ndarray) -> Leg:
        """Stay where the last leg ends, from `start` on with this nest."""
        last = self.last
        leg = Leg(
            start, 0.0, last.end, last.end, last.sphere_end, last.sphere_end, nest, offset, offset
        )
        self._legs.append(leg)
        return leg

    def at(self, times: np.ndarray) -> State:
        """The state at `times` (n,) int64 [ns]."""
        if len(self._legs) != len(self._starts):
            self._pack()
        leg = np.maximum(np.searchsorted(self._starts, times, 'right') - 1, 0)
        elapsed = (times - self._starts[leg]) * 1e-9
        duration = self._durations[leg]
        moving = elapsed < duration
        share = np.where(moving, elapsed / np.where(duration > 0.0, duration, 1.0), 1.0)
        share = _quintic(np.maximum(share, 0.0))[:, None]
        positions = self._begin[leg] + share * self._travel[leg]
        curved = np.flatnonzero(moving & self._curved[leg])
        if curved.size:
            positions[curved] = self._arc(positions[curved], share[curved], leg[curved])
        positions[:, self._linear] += self._settle(elapsed - duration, leg)
        offset = self._offset[leg] + share * self._offset_change[leg]
        return State(positions, offset, self._nest[leg])

    def _arc(self, positions: np.ndarray, share: np.ndarray, leg: np.ndarray) -> np.ndarray:
        letters = len(self._machine.letters)
        sphere = self._sphere_begin[leg] + share * self._sphere_change[leg]
        positions[:, :letters] = follow(self._machine, positions[:, :letters], sphere)
        return positions

    def _settle(self, since: np.ndarray, leg: np.ndarray) -> np.ndarray:
        since = np.maximum(since, 0.0)
        swing = np.exp(-since / self._drives.decay) * np.sin(
            2.0 * math.pi * self._drives.frequency * since
        )
        return self._drives.settle * swing[:, None] * self._direction[leg]

    def _sphere(self, positions: np.ndarray) -> np.ndarray:
        letters = len(self._machine.letters)
        return sphere_in_table(self._machine, positions[None, :letters])[0]

    def _duration(
        self,
        begin: np.ndarray,
        end: np.ndarray,
        sphere: np.ndarray,
        sphere_end: np.ndarray,
        feed: float | None,
    ) -> float:
        if np.abs(end - begin).max() < 1e-12:
            return 0.0
        share = np.linspace(0.0, 1.0, 33)[:, None]
        path = begin + share * (end - begin)
        letters = len(self._machine.letters)
        path[:, :letters] = follow(
            self._machine, path[:, :letters], sphere + share * (sphere_end - sphere)
        )
        slope = np.abs(np.diff(path, axis=0)).max(axis=0) * (len(share) - 1)
        limit = np.full(len(self.axes), self._drives.rotary)
        limit[self._linear] = self._drives.linear if feed is None else feed
        wanted = max(self._drives.shortest, float((slope / limit).max()) * _PEAK)
        # Whole microseconds: stamps are integers, and a leg must not end between two of them.
        return math.ceil(wanted * 1e6) * 1e-6

    def _pack(self) -> None:
        """Columns of the legs, for look-ups of many instants at once."""
        legs = self._legs
        self._starts = np.array([leg.start for leg in legs], dtype=np.int64)
        self._durations = np.array([leg.duration for leg in legs])
        self._begin = np.array([leg.begin for leg in legs])
        self._travel = np.array([leg.end for leg in legs]) - self._begin
        self._sphere_begin = np.array([leg.sphere_begin for leg in legs])
        self._sphere_change = np.array([leg.sphere_end for leg in legs]) - self._sphere_begin
        self._offset = np.array([leg.offset_begin for leg in legs])
        self._offset_change = np.array([leg.offset_end for leg in legs]) - self._offset
        self._nest = np.array([leg.nest for leg in legs])
        self._curved = np.abs(self._travel[:, self._turning]).max(axis=1) > 0.0
        linear = self._travel[:, self._linear]
        length = np.linalg.norm(linear, axis=1, keepdims=True)
        self._direction = np.divide(linear, length, out=np.zeros_like(linear), where=length > 1e-9)


def _quintic(share: np.ndarray) -> np.ndarray:
    return share**3 * (10.0 + share * (6.0 * share - 15.0))
