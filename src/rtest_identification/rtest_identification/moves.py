"""The way of the axes through a plan: synchronous arcs in straight pieces, and their time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rtest_estimation.dwell import turns
from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan
from rtest_identification.kinematics import linear_positions, predict
from rtest_identification.machine import Machine

# How far the sphere may be from its place in the nest while the axes move [m].
ARC_TOLERANCE = 5e-5
# The same in a dynamic cycle, where blocks are not too short for it [m].
_DYNAMIC_TOLERANCE = 1e-6
# Shortest time of a piece [s]: controllers take no shorter block.
_SHORTEST = 0.02
# One of a dynamic cycle turns by this at most: at the ends and middles of full turns the sphere
# looks as if it never left its place [rad].
_PIECE = math.radians(60.0)


@dataclass(frozen=True)
class Speeds:
    """How fast the axes move between poses: linear [m/s], rotary [rad/s].

    3 m/min and 10 deg/s: what any machine can do with a sphere in a nest.
    """

    linear: float = 0.05
    rotary: float = math.radians(10.0)


@dataclass(frozen=True)
class Approach:
    """How the sphere comes into the nest and leaves it.

    clearance : distance from which it comes straight in [m]
    speed : at which it does [m/s]
    direction : (3,) unit vector, frame ``table``, from the nest to where the sphere comes from
    """

    clearance: float = 0.05
    speed: float = 0.5 / 60.0
    direction: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class AxisPath:
    """The ends of straight pieces (all axes together), the first one being the first pose.

    positions : (m, k) in the plan's axes [m] or [rad]
    pose : (m,) row of the plan that is reached, -1 between poses
    time : (m,) of the piece that ends here [s]; 0 for the first
    """

    positions: np.ndarray
    pose: np.ndarray
    time: np.ndarray

    @property
    def arrival(self) -> np.ndarray:
        """(poses,) time in motion from the first pose until each one [s]."""
        return np.cumsum(self.time)[self.pose >= 0]

    def signs(self) -> np.ndarray:
        """(poses, k) sign of each axis's last motion at each pose, 0 before its first one.

        Along a synchronous arc that is the direction at arrival, not the sign of the whole move.
        """
        steps = np.diff(self.positions, axis=0, prepend=self.positions[:1])
        sign = np.where(np.abs(steps) > 1e-9, np.sign(steps), 0.0)
        last = np.maximum.accumulate(
            np.where(sign != 0.0, np.arange(len(sign))[:, None], 0), axis=0
        )
        return np.take_along_axis(sign, last, axis=0)[self.pose >= 0]


def synchronous_path(
    machine: Machine,
    plan: CyclePlan,
    speeds: Speeds | None = None,
    tolerance: float = ARC_TOLERANCE,
) -> AxisPath:
    """The pieces in which the axes go from pose to pose.

    The rotary axes go straight to their ends and the linear ones so that the sphere goes straight,
    as seen from the table, from one nominal place to the next, which is the same one in a static
    cycle. There are as many pieces as it takes to keep the sphere within `tolerance` [m] of that.
    Each takes as long as its slowest axis; in a dynamic cycle, as its rotary axis at the feed, and
    no shorter than the feed allows where only linear axes move.
    """
    speeds, fewest, most = speeds or Speeds(), 1, math.inf
    turning = turns(plan)
    if turning:
        speeds, tolerance = Speeds(math.inf, plan.feed), min(tolerance, _DYNAMIC_TOLERANCE)
    count = len(machine.letters)
    if plan.axes[:count] != machine.letters:
        raise UserError(
            f'{plan.cycle}: the plan has axes {" ".join(plan.axes)}, the machine '
            f'{" ".join(machine.letters)}'
        )
    spheres = predict(machine, plan.commands[:, :count]).centre
    rows, poses = [plan.commands[:1]], [np.zeros(1, dtype=int)]
    for number in range(1, len(plan.commands)):
        pair = slice(number - 1, number + 1)
        if turning:
            travel = np.abs(np.diff(plan.commands[pair], axis=0)).max()
            fewest = math.ceil(travel / _PIECE)
            most = max(fewest, math.floor(travel / (plan.feed * _SHORTEST)))
        pieces = _pieces(machine, plan.commands[pair], spheres[pair], tolerance, fewest, most)
        rows.append(pieces)
        poses.append(np.r_[np.full(len(pieces) - 1, -1), number])
    positions = np.vstack(rows)
    rotary = [machine.axes[name].rotary if name in machine.axes else True for name in plan.axes]
    limit = np.where(rotary, speeds.rotary, speeds.linear)
    steps = np.diff(positions, axis=0)
    time = np.maximum((np.abs(steps) / limit).max(axis=1), _SHORTEST)
    if plan.feed > 0.0 and not turning:
        time = np.maximum(time, np.linalg.norm(steps, axis=1) / plan.feed)
    return AxisPath(positions, np.concatenate(poses), np.r_[0.0, time])


def clear_of_nest(
    machine: Machine, row: np.ndarray, approach: Approach
) -> tuple[np.ndarray, float]:
    """Where the axes are when the sphere is clear of the nest, and how far that is [m].

    row : (k,) a pose with the sphere in the nest. It is less than the clearance wanted where an
    axis ends before it.
    """
    count = len(machine.letters)
    sphere = predict(machine, row[:count]).centre[0]
    away = sphere + np.array(approach.direction)
    step = linear_positions(machine, away, row[:count])[0] - row[:count]
    reach = approach.clearance
    for name, start, slope in zip(machine.letters, row, step, strict=False):
        axis = machine.axes[name]
        if not axis.rotary and abs(slope) > 1e-9:
            reach = min(reach, ((axis.upper if slope > 0 else axis.lower) - start) / slope)
    reach = max(reach, 0.0)
    return np.r_[row[:count] + reach * step, row[count:]], reach


def deviation(machine: Machine, ends: np.ndarray) -> np.ndarray:
    """(m - 1,) how far the sphere leaves its straight way, as seen from the table [m].

    ends : (m, k) positions, in the order of ``machine.letters``, between which all axes go
    straight.
    """
    share = np.array([0.25, 0.5, 0.75])[:, None, None]
    between = ends[:-1] + share * np.diff(ends, axis=0)
    spheres = predict(machine, ends).centre
    wanted = spheres[:-1] + share * np.diff(spheres, axis=0)
    reached = predict(machine, between.reshape(-1, ends.shape[1])).centre.reshape(wanted.shape)
    return np.linalg.norm(reached - wanted, axis=2).max(axis=0)


def _pieces(
    machine: Machine, ends: np.ndarray, spheres: np.ndarray, tolerance: float, fewest: int,
    most: float,
) -> np.ndarray:
    """Ends of the pieces of one move, without its start, and how many there may be."""
    letters, count = len(machine.letters), fewest
    while True:
        share = np.linspace(0.0, 1.0, count + 1)[:, None]
        rows = ends[0] + share * (ends[1] - ends[0])
        if count > 1:
            place = spheres[0] + share * (spheres[1] - spheres[0])
            rows[1:-1, :letters] = linear_positions(machine, place, rows[:, :letters])[1:-1]
        worst = float(deviation(machine, rows[:, :letters]).max())
        if worst <= tolerance or count >= most:
            return rows[1:]
        # The sagitta of a piece goes with the square of its length.
        count = min(max(count + 1, math.ceil(count * math.sqrt(worst / tolerance))), most)
