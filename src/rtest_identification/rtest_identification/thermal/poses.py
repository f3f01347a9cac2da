"""The poses of a repeated cycle, and what each error changes at them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtest_estimation.records import CyclePlan
from rtest_identification.error_map import stations, zero_mean
from rtest_identification.kinematics import predict
from rtest_identification.least_squares import solve
from rtest_identification.machine import Machine
from rtest_identification.symbols import (
    ErrorParameter,
    location_parameters,
    map_parameters,
    parameter,
)

# Fewer stations of the outer axis make no map.
MIN_STATIONS = 3


@dataclass(frozen=True)
class Gains:
    """What each error changes per change of displacement at each pose; zero where not measured.

    alone : (p, m, 3) constant errors where the map does not change
    joint : (p, m, 3) constant errors fitted together with the map
    map : (6, s, m, 3) errors of the outer axis at its stations, mean zero over them
    constant, explained : (3 n, 3 n) projectors of the poses measured on what constants and offset
        make, and on what these and the map make
    rank : of that; map_rank : of the map alone
    determined : (p,) bool of the constants alone
    """

    alone: np.ndarray
    joint: np.ndarray
    map: np.ndarray
    constant: np.ndarray
    explained: np.ndarray
    rank: int
    map_rank: int
    determined: np.ndarray


@dataclass(frozen=True)
class Poses:
    """Every pose of the plan, measured or not, as a place in every array.

    constants : (p,) location errors and squareness
    parameters : (6,) of the outer rotary axis's map; empty where it has too few stations
    levels : (s,) its stations [rad]; level : (m,) which of them a pose is at
    jacobian : (m, 3, 6 k) of all errors of all axes at the commanded positions
    """

    machine: Machine
    plan: CyclePlan
    constants: tuple[ErrorParameter, ...]
    parameters: tuple[ErrorParameter, ...]
    levels: np.ndarray
    level: np.ndarray
    jacobian: np.ndarray

    def __len__(self) -> int:
        return len(self.plan.commands)

    @cached_property
    def full(self) -> Gains:
        """Gains where no pose is missing."""
        return self.gains(np.ones(len(self), dtype=bool))

    def columns(self) -> np.ndarray:
        """(m, 3, p) effect of each constant error."""
        return self.jacobian[:, :, [p.column for p in self.constants]]

    def gains(self, measured: np.ndarray) -> Gains:
        """Least squares over some poses, every pose with the same weight.

        measured : (m,) bool

        As in the identification of a session, what constants and the offset of the cycle explain
        is theirs, and of all maps that explain the rest equally well the smallest is taken.
        """
        rows = np.flatnonzero(measured)
        count, p = 3 * len(rows), len(self.constants)
        offset = np.tile(np.eye(3), (len(rows), 1))
        a = np.column_stack([self.columns()[rows].reshape(count, p), offset])
        first = solve(a, np.zeros(count), np.append([c.scale for c in self.constants], np.ones(3)))
        by_constants = a @ first.inverse
        alone = joint = first.inverse[:p]
        waves = zero_mean(len(self.levels)) if self.parameters else np.zeros((1, 0))
        columns = [
            parameter(self.machine, c.axis, c.letter).column for c in self.parameters
        ]
        b = np.einsum('nip,ns->nips', self.jacobian[rows][:, :, columns], waves[self.level[rows]])
        b = b.reshape(count, -1)
        on_map, explained, map_rank = np.zeros((0, count)), by_constants, 0
        if self.parameters:
            free = b - by_constants @ b
            scale = np.repeat([c.scale for c in self.parameters], waves.shape[1])
            second = solve(free, np.zeros(count), scale)
            inverse = second.inverse - second.inverse @ by_constants
            joint = alone - first.inverse[:p] @ b @ inverse
            on_map = np.kron(np.eye(len(self.parameters)), waves) @ inverse
            explained, map_rank = by_constants + free @ inverse, second.rank
        shape = (len(self.parameters), len(self.levels), len(self), 3)
        return Gains(
            self._placed(alone, rows), self._placed(joint, rows),
            self._placed(on_map, rows).reshape(shape),
            by_constants, explained, first.rank + map_rank, map_rank, first.determined[:p],
        )

    def _placed(self, gain: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """(q, 3 n) of the poses measured to (q, m, 3) of all."""
        placed = np.zeros((len(gain), len(self), 3))
        placed[:, rows] = gain.reshape(len(gain), len(rows), 3)
        return placed


def poses_of(machine: Machine, plan: CyclePlan) -> Poses:
    """Design at the commanded positions; a machine's errors change it by parts in 10,000."""
    positions = plan.commands[:, [plan.axes.index(name) for name in machine.letters]]
    jacobian = predict(machine, positions, jacobian=True).jacobian
    outer = machine.rotary[0] if machine.rotary else None
    levels, level = np.zeros(0), np.zeros(len(positions), dtype=int)
    if outer is not None:
        levels, level = stations(positions[:, machine.letters.index(outer)])
    some = outer is not None and len(levels) >= MIN_STATIONS
    on_map = map_parameters(machine, outer) if some else ()
    return Poses(machine, plan, location_parameters(machine), on_map, levels, level, jacobian)


def places(plan: CyclePlan, other: CyclePlan) -> np.ndarray:
    """(n,) pose of `plan` that each row of `other` visits; -1 where it visits none.

    A pose that is visited several times is another one each time.
    """
    seen: dict[tuple[bytes, int], int] = {}
    keys = _visits(plan, plan.axes)
    for row, key in enumerate(keys):
        seen[key] = row
    if set(plan.axes) - set(other.axes):
        return np.full(len(other.commands), -1)
    return np.array([seen.get(key, -1) for key in _visits(other, plan.axes)], dtype=int)


def _visits(plan: CyclePlan, axes: tuple[str, ...]) -> list[tuple[bytes, int]]:
    """Each command with how often it came before; a micrometre apart is the same command."""
    count: dict[bytes, int] = {}
    found = []
    for row in plan.commands[:, [plan.axes.index(axis) for axis in axes]]:
        # Adding zero turns -0.0 into 0.0, whose bytes differ.
        key = (np.round(row, 6) + 0.0).tobytes()
        count[key] = count.get(key, 0) + 1
        found.append((key, count[key]))
    return found
