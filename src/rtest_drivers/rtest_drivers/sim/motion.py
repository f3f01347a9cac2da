"""Where the axes of the simulated machine are at a time: moves from pose to pose, and rests.

A move is smooth (quintic in time), limited by the speed of every axis. The rotary axes go straight
to their ends while the linear axes follow the nominal sphere in the table frame: where the sphere
is nominally at the same place at both ends this is the synchronous arc (tool centre point
control), and where no rotary axis turns it is a straight line. In a dynamic cycle the rotary axis
turns at a constant speed between its ramps instead.
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
# Nodes and weights of a mean over the past, in time constants (Gauss and Laguerre).
_PAST = np.polynomial.laguerre.laggauss(6)


@dataclass(frozen=True)
class Drives:
    """How the axes move.

    linear, rotary : largest speed [m/s], [rad/s]; shortest : time of the shortest move [s]
    settle : amplitude of the oscillation after a move [m]; frequency [Hz]; decay : time constant
        [s]; 0.3 um that is gone after 30 ms is what a well-tuned drive leaves
    acceleration : of a rotary axis to a constant speed [rad/s2]
    linear_lag, rotary_lag : time constants 1/Kv with which axes follow their commands [s]
    start : a rotary axis that starts to a constant speed swings about it by this time's way [s],
        at start_frequency [Hz], which dies away with start_decay [s]
    """

    linear: float = 0.5
    rotary: float = math.radians(400.0)
    shortest: float = 0.12
    settle: float = 0.0
    frequency: float = 60.0
    decay: float = 0.008
    acceleration: float = math.radians(500.0)
    linear_lag: float = 0.0
    rotary_lag: float = 0.0
    start: float = 0.0
    start_frequency: float = 15.0
    start_decay: float = 0.05


@dataclass(frozen=True)
class Leg:
    """A move and the rest after it, until the next leg starts.

    start : [ns]; duration : of the move [s], 0 where the axes only rest
    begin, end : (k,) positions of the machine's letters and the spindle [m] or [rad]
    sphere_begin, sphere_end : (3,) nominal sphere centre, frame ``table`` [m]
    nest : which mounting of the nest is on the table; -1 for none
    offset_begin, offset_end : (3,) what the sphere is off in this dwell, frame ``table`` [m]
    ramp : time to the constant speed, and from it to rest [s]; 0 where the move is smooth
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
    ramp: float = 0.0

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
        speed: float = 0.0,
        turning: bool = False,
    ) -> Leg:
        """Go to `target` (k,) from wherever the last leg ends, leaving at `start` [ns].

        speed : 0 for as fast as the drives do. Otherwise the constant one of the rotary axis that
            turns farthest [rad/s] where it is `turning`, else the largest of a linear axis [m/s]
        """
        last = self.last
        sphere = self._sphere(target)
        ramp = 0.0
        if speed and turning:
            travel = float(np.abs(target - last.end)[self._turning].max())
            ramp = min(speed / self._drives.acceleration, travel / speed)
            duration = travel / speed + ramp
        else:
            duration = self._duration(last.end, target, last.sphere_end, sphere, speed or None)
        leg = Leg(
            start, duration, last.end, np.array(target, dtype=float), last.sphere_end, sphere,
            nest, last.offset_end, np.asarray(offset, dtype=float), ramp,
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
        state = self._commanded(times)
        if self._drives.linear_lag or self._drives.rotary_lag:
            for columns, lag in (
                (self._linear, self._drives.linear_lag), (self._turning, self._drives.rotary_lag)
            ):
                # A first-order lag is the mean over the past with the weight exp(-s / lag) / lag.
                state.positions[:, columns] = sum(
                    weight * self._commanded(times - round(node * lag * 1e9)).positions[:, columns]
                    for node, weight in zip(*_PAST, strict=True)
                )
        return state

    def _commanded(self, times: np.ndarray) -> State:
        leg = np.maximum(np.searchsorted(self._starts, times, 'right') - 1, 0)
        elapsed = (times - self._starts[leg]) * 1e-9
        duration = self._durations[leg]
        moving = elapsed < duration
        share = np.where(moving, elapsed / np.where(duration > 0.0, duration, 1.0), 1.0)
        share = np.maximum(share, 0.0)
        ramp = self._ramps[leg]
        share = np.where(ramp > 0.0, _trapezoid(share, ramp), _quintic(share))[:, None]
        positions = self._begin[leg] + share * self._travel[leg]
        curved = np.flatnonzero(moving & self._curved[leg])
        if curved.size:
            positions[curved] = self._arc(positions[curved], share[curved], leg[curved])
        positions[:, self._linear] += self._settle(elapsed - duration, leg)
        if self._drives.start:
            positions[:, self._turning] += self._swing(elapsed, leg)
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

    def _swing(self, since: np.ndarray, leg: np.ndarray) -> np.ndarray:
        drives, ramp = self._drives, self._ramps[leg]
        straight = np.where(ramp > 0.0, self._durations[leg] * (1.0 - ramp), np.inf)
        swing = np.exp(-since / drives.start_decay) * np.sin(
            2.0 * math.pi * drives.start_frequency * since
        )
        speed = self._travel[leg][:, self._turning] / straight[:, None]
        return drives.start * swing[:, None] * speed

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
        # Parts of the duration.
        self._ramps = np.array([leg.ramp / leg.duration if leg.ramp else 0.0 for leg in legs])
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


def _trapezoid(share: np.ndarray, ramp: np.ndarray) -> np.ndarray:
    """Part of the way at a part of the time; `ramp` is the part to and from constant speed."""
    ramp = np.maximum(ramp, 1e-12)
    begun, left = np.minimum(share, ramp), np.minimum(1.0 - share, ramp)
    steady = share - begun
    # Where the last ramp has begun `steady` has gone on to count: what is not gone is taken off.
    way = 0.5 * begun**2 / ramp + steady - 0.5 * (ramp - left) ** 2 / ramp
    return way / (1.0 - ramp)
