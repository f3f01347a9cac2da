"""A plan checked before a machine runs it: ranges along the moves, the table's swing, duration.

The table is a cylinder about Z of the table frame, with the nest as a second, upright one on it;
the spindle is a cylinder about Z of the last axis of the tool side, from its nose upwards. The
distance is that of these bodies and nothing else: `NOT_CHECKED` says what it leaves out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan
from rtest_identification.kinematics import predict
from rtest_identification.machine import Machine
from rtest_identification.moves import Approach, AxisPath, clear_of_nest

# Bodies nearer than this are warned of [m].
MARGIN = 0.01
# Of a spindle from its nose, and of a table from its surface [m].
_SPINDLE_LENGTH, _TABLE_DEPTH = 0.5, 0.1
# Projections in turn until two bodies' nearest points are found.
_ROUNDS = 400
NOT_CHECKED = (
    "the sphere's shank, fixtures and cables, housings and guards of table, head and slides, "
    'tool changer; the way from where the machine stands to the clearance position'
)


@dataclass(frozen=True)
class Table:
    """The table and the nest on it, frame ``table`` [m].

    radius : of the table; surface : its height, Z in the table frame
    nest_radius, nest_height : of the nest, about the sphere, from the surface upwards
    swing : largest radius that is free about the axis that tilts the table
    """

    radius: float
    surface: float
    nest_radius: float = 1e-6
    nest_height: float = 1e-6
    swing: float = math.inf


@dataclass(frozen=True)
class Spindle:
    """The spindle [m]. distance : from the sphere's centre to the nose of the spindle."""

    radius: float
    distance: float


@dataclass(frozen=True)
class PlanCheck:
    """What was found.

    duration : of the cycle with its approach [s]
    extent : of each axis along the moves (lower, upper) [m] or [rad]
    distance : smallest one of spindle and table or nest [m]; None where not checked
    swing : radius that table and nest sweep about the tilting axis [m]; None where not checked,
        and where no rotary axis moves
    """

    duration: float
    extent: dict[str, tuple[float, float]]
    distance: float | None
    swing: float | None
    warnings: tuple[str, ...]


def check_plan(
    machine: Machine,
    plan: CyclePlan,
    path: AxisPath,
    approach: Approach,
    table: Table | None = None,
    spindle: Spindle | None = None,
) -> PlanCheck:
    """Check one cycle with its moves.

    Raises UserError where an axis leaves its range or the spindle meets table or nest.
    """
    extent = _ranges(machine, plan, path)
    warnings = []
    reach = min(clear_of_nest(machine, plan.commands[end], approach)[1] for end in (0, -1))
    if reach < approach.clearance - 1e-9:
        warnings.append(
            f'{plan.cycle}: the sphere clears the nest by {reach * 1e3:.1f} mm of '
            f'{approach.clearance * 1e3:.1f} mm only, then an axis is at its end'
        )
    distance = swept = None
    turns = any(extent[name][1] > extent[name][0] for name in machine.rotary)
    if table is not None and turns:
        swept = swing(machine, plan.sphere, table)
        if swept is not None and swept > table.swing:
            warnings.append(
                f'{plan.cycle}: table and nest sweep a radius of {swept * 1e3:.1f} mm, '
                f'{table.swing * 1e3:.1f} mm are free'
            )
    if table is not None and spindle is not None:
        distance = _nearest(machine, plan, path, table, spindle, warnings)
    return PlanCheck(duration(plan, path, approach), extent, distance, swept, tuple(warnings))


def duration(plan: CyclePlan, path: AxisPath, approach: Approach) -> float:
    """Time of a cycle [s]: moves at their speeds, dwells, the way into the nest and out of it.

    Without the time in which the axes gain speed, which depends on the machine.
    """
    ways = 2.0 * approach.clearance / approach.speed
    return float(path.time.sum()) + len(plan.commands) * plan.dwell + ways


def swing(machine: Machine, sphere: np.ndarray, table: Table) -> float | None:
    """Largest distance of table and nest from the axis that tilts the table [m].

    None where no rotary axis tilts the table.
    """
    turning = [machine.axes[n] for n in machine.table_side if machine.axes[n].rotary]
    if len(turning) < 2:
        return None
    angle = np.linspace(0.0, 2.0 * math.pi, 360, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(360)])
    # Turned by the inner axis every point of a ring about it comes everywhere on it.
    top = table.surface + table.nest_height
    out = math.hypot(*np.asarray(sphere)[:2]) + table.nest_radius
    points = np.vstack([
        table.radius * ring + [0.0, 0.0, table.surface],
        table.radius * ring + [0.0, 0.0, table.surface - _TABLE_DEPTH],
        out * ring + [0.0, 0.0, top],
    ])
    return float(np.linalg.norm(np.cross(points, turning[0].direction), axis=1).max())


def _ranges(machine: Machine, plan: CyclePlan, path: AxisPath) -> dict[str, tuple[float, float]]:
    extent = {}
    for column, name in enumerate(plan.axes):
        values = path.positions[:, column]
        extent[name] = (float(values.min()), float(values.max()))
        axis = machine.axes.get(name)
        if axis is None:
            continue
        outside = np.flatnonzero((values < axis.lower - 1e-9) | (values > axis.upper + 1e-9))
        if outside.size:
            row = int(outside[0])
            after = int(path.pose[:row][path.pose[:row] >= 0].max(initial=0))
            scale, unit = (180 / math.pi, 'deg') if axis.rotary else (1e3, 'mm')
            raise UserError(
                f'{plan.cycle}: on the way from pose {after} to the next {name} = '
                f'{values[row] * scale:.3f} {unit} leaves {axis.lower * scale:.3f} to '
                f'{axis.upper * scale:.3f} {unit}; change the stations or the sphere position'
            )
    return extent


def _nearest(
    machine: Machine,
    plan: CyclePlan,
    path: AxisPath,
    table: Table,
    spindle: Spindle,
    warnings: list[str],
) -> float:
    """Smallest distance of the spindle from table and nest along the moves [m]."""
    count = len(machine.letters)
    # Only a change of the rotary axes, and of the sphere's place, brings the bodies nearer.
    positions = path.positions[:, :count]
    sphere = predict(machine, positions).centre
    longer = replace(machine, tool=machine.tool + np.array([0.0, 0.0, 1.0]))
    upward = predict(longer, positions).centre - sphere
    nose = _Cylinder(
        sphere + spindle.distance * upward, upward, _SPINDLE_LENGTH, spindle.radius
    )
    normal = np.array([0.0, 0.0, 1.0])
    foot = np.array([plan.sphere[0], plan.sphere[1], table.surface])
    bodies = {
        'table': _Cylinder(
            (table.surface - _TABLE_DEPTH) * normal, normal, _TABLE_DEPTH, table.radius
        ),
        'nest': _Cylinder(foot, normal, table.nest_height, table.nest_radius),
    }
    nearest = math.inf
    for name, body in bodies.items():
        gap = distance(body, nose)
        row = int(np.argmin(gap))
        pose = int(path.pose[: row + 1].max())
        nearest = min(nearest, float(gap[row]))
        if gap[row] < 1e-5:
            raise UserError(
                f'{plan.cycle}: the spindle meets the {name} after pose {pose}; change the '
                'stations, the sphere position or the length of its shank'
            )
        if gap[row] < MARGIN:
            warnings.append(
                f'{plan.cycle}: the spindle comes within {gap[row] * 1e3:.1f} mm of the {name} '
                f'after pose {pose}'
            )
    return nearest


@dataclass(frozen=True)
class _Cylinder:
    """Cylinders from `foot` (n, 3) along unit vectors `along` (n, 3)."""

    foot: np.ndarray
    along: np.ndarray
    length: float
    radius: float

    def nearest(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) point of each cylinder nearest to a point."""
        from_foot = points - self.foot
        height = (from_foot * self.along).sum(axis=-1, keepdims=True)
        across = from_foot - height * self.along
        size = np.linalg.norm(across, axis=-1, keepdims=True)
        across = across * np.minimum(1.0, self.radius / np.maximum(size, 1e-12))
        return self.foot + np.clip(height, 0.0, self.length) * self.along + across


def distance(one: _Cylinder, other: _Cylinder) -> np.ndarray:
    """(n,) distance of cylinders [m], 0 where they meet.

    Projecting on one and the other in turn goes to the nearest points of two convex bodies.
    """
    a = one.nearest(other.foot)
    for _ in range(_ROUNDS):
        b = other.nearest(a)
        a = one.nearest(b)
    return np.linalg.norm(a - b, axis=-1)
