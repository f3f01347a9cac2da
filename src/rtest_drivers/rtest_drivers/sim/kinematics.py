"""Exact homogeneous transforms of the simulated machine.

Each axis contributes Da Db Dc Dx Dy Dz and then its motion; the table side runs from the bed to
the table, the tool side from the bed to the tool. Nothing is linearised.
"""

from __future__ import annotations

import numpy as np

from rtest_drivers.sim.errors import NO_ERRORS, GeometricErrors
from rtest_identification.machine import Axis, Machine

_X, _Y, _Z = np.eye(3)


def turn(direction: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """(n, 4, 4) rotations by `angle` (n,) [rad] about a unit vector through the origin."""
    angle = np.asarray(angle, dtype=float)
    x, y, z = direction
    c, s = np.cos(angle), np.sin(angle)
    v = 1.0 - c
    result = np.zeros((len(angle), 4, 4))
    result[:, 0, 0] = x * x * v + c
    result[:, 0, 1] = x * y * v - z * s
    result[:, 0, 2] = x * z * v + y * s
    result[:, 1, 0] = x * y * v + z * s
    result[:, 1, 1] = y * y * v + c
    result[:, 1, 2] = y * z * v - x * s
    result[:, 2, 0] = x * z * v - y * s
    result[:, 2, 1] = y * z * v + x * s
    result[:, 2, 2] = z * z * v + c
    result[:, 3, 3] = 1.0
    return result


def shift(vectors: np.ndarray) -> np.ndarray:
    """(n, 4, 4) translations by `vectors` (n, 3) [m]."""
    result = np.tile(np.eye(4), (len(vectors), 1, 1))
    result[:, :3, 3] = vectors
    return result


def error_transform(errors: np.ndarray) -> np.ndarray:
    """(n, 4, 4) Da Db Dc Dx Dy Dz of (n, 6) errors A B C X Y Z [rad] and [m]."""
    a, b, c = errors[:, 0], errors[:, 1], errors[:, 2]
    # Dx Dy Dz commute: they are one translation.
    return turn(_X, a) @ turn(_Y, b) @ turn(_Z, c) @ shift(errors[:, 3:])


def motion(axis: Axis, position: np.ndarray) -> np.ndarray:
    """(n, 4, 4) what an axis does at `position` (n,) [m] or [rad]."""
    if axis.rotary:
        return turn(axis.direction, axis.sense * position)
    return shift(np.outer(position, axis.direction))


def sphere_in_table(
    machine: Machine,
    positions: np.ndarray,
    errors: GeometricErrors = NO_ERRORS,
    runout: np.ndarray | None = None,
) -> np.ndarray:
    """The sphere centre in the table frame, (n, 3) [m]: (T_table)^-1 T_tool tool.

    Parameters
    ----------
    positions : (n, k) in the order of ``machine.letters`` [m] or [rad]
    errors : none when omitted
    runout : (n, 3) what the sphere is off the tool point, frame of the last tool-side axis [m]
    """
    positions = np.atleast_2d(np.asarray(positions, dtype=float))
    by_axis = {name: positions[:, k] for k, name in enumerate(machine.letters)}
    table, tool = (
        _side(machine, names, by_axis, errors) for names in (machine.table_side, machine.tool_side)
    )
    point = np.ones((len(positions), 4))
    point[:, :3] = machine.tool if runout is None else machine.tool + runout
    sphere = np.einsum('nij,nj->ni', tool, point)[:, :3]
    # The inverse of a rigid transform: R' (p - t).
    return np.einsum('nji,nj->ni', table[:, :3, :3], sphere - table[:, :3, 3])


def table_to_spindle(machine: Machine, positions: np.ndarray) -> np.ndarray:
    """(n, 3, 3) nominal rotations from the table to the last tool-side axis.

    positions : (n, k) in the order of ``machine.letters`` [m] or [rad]
    """
    by_axis = {name: positions[:, k] for k, name in enumerate(machine.letters)}
    table, tool = (
        _side(machine, names, by_axis, NO_ERRORS)[:, :3, :3]
        for names in (machine.table_side, machine.tool_side)
    )
    return np.swapaxes(tool, 1, 2) @ table


def table_to_sphere(machine: Machine, positions: np.ndarray) -> np.ndarray:
    """(n, 3, 3) nominal rotations from the table to the sphere, which turns with the spindle.

    positions : (n, k + 1) in the order of ``machine.letters``, then the spindle [m] or [rad]
    """
    spindle = turn(_Z, -positions[:, -1])[:, :3, :3]
    return spindle @ table_to_spindle(machine, positions[:, :-1])


def _side(
    machine: Machine,
    names: tuple[str, ...],
    positions: dict[str, np.ndarray],
    errors: GeometricErrors,
) -> np.ndarray:
    result = shift(np.zeros((len(positions[machine.letters[0]]), 3)))
    for name in names:
        if name in errors.axes:
            result = result @ error_transform(errors.of_axis(name, positions))
        result = result @ motion(machine.axes[name], positions[name])
    return result


def follow(machine: Machine, positions: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """Move the linear axes so that the nominal sphere centre is at `sphere` in the table frame.

    positions : (n, k) in the order of ``machine.letters``; the linear axes' values are ignored
    sphere : (n, 3) or (3,) frame ``table`` [m]

    Returns (n, k) positions. The error-free chain is affine in the linear axes: four evaluations
    give its offset and slope, and a 3x3 system the positions.
    """
    positions = np.array(positions, dtype=float, ndmin=2)
    count = len(positions)
    columns = [machine.letters.index(name) for name in machine.linear]
    positions[:, columns] = 0.0
    probes = np.tile(positions, (4, 1))
    for step, column in enumerate(columns):
        probes[(step + 1) * count : (step + 2) * count, column] = 1.0
    centres = sphere_in_table(machine, probes).reshape(4, count, 3)
    slopes = np.moveaxis(centres[1:] - centres[0], 0, 2)
    wanted = np.broadcast_to(sphere, (count, 3)) - centres[0]
    positions[:, columns] = np.linalg.solve(slopes, wanted[:, :, None])[:, :, 0]
    return positions
