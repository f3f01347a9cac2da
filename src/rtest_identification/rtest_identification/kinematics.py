"""Exact kinematics of a chain of axes with geometric errors, and its analytic Jacobian.

Every axis k contributes T_k = Da(a) Db(b) Dc(c) Dx(x) Dy(y) Dz(z) M_k(q), its six errors acting in
the frame of the axis that carries it, before its own motion M_k (Eqs. 2-10 and 2-12 to 2-15). The
sphere centre in the table frame is

    w = (T_table side)^-1 (T_tool side) p,      p the sphere in the last tool-side frame.

The Jacobian uses that each error's elementary transform is an exponential D(e) = exp(e xi): the
derivative of the chain with respect to e is the twist xi carried into the machine frame by what
stands before D(e), exact at any size of the errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_identification.machine import Axis, Machine

# The order in which the errors of one axis act (Eqs. 2-13, 2-14).
ERROR_LETTERS = 'ABCXYZ'
_UNIT = np.eye(3)


@dataclass(frozen=True)
class Prediction:
    """Sphere centres and their derivatives.

    centre : (n, 3) frame ``table`` [m]
    jacobian : (n, 3, 6 k) with respect to the six errors A B C X Y Z of every axis, axes in the
        order of ``Machine.letters`` [m/rad] or [m/m]; None where it was not asked for
    """

    centre: np.ndarray
    jacobian: np.ndarray | None


def rotation(direction: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotation matrices about one unit vector (Rodrigues): (..., 3, 3) for angles (...)."""
    x, y, z = direction
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine = np.sin(angle)[..., None, None]
    versine = 1.0 - np.cos(angle)[..., None, None]
    return _UNIT + sine * cross + versine * (cross @ cross)


def predict(
    machine: Machine,
    positions: np.ndarray,
    errors: np.ndarray | None = None,
    jacobian: bool = False,
) -> Prediction:
    """Where the sphere centre is in the table frame.

    Parameters
    ----------
    machine : the chain
    positions : (n, k) axis positions in the order of ``machine.letters`` [m] or [rad]
    errors : (k, 6) or (n, k, 6) errors A B C X Y Z of every axis, in the same order of axes
        [rad] and [m]; none when omitted
    jacobian : whether to differentiate with respect to the errors

    Source: Eqs. 2-9 to 2-15 of the thesis, generalised to any chain.
    """
    positions = np.atleast_2d(np.asarray(positions, dtype=float))
    count, letters = len(positions), machine.letters
    if errors is None:
        errors = np.zeros((len(letters), 6))
    errors = np.broadcast_to(errors, (count, len(letters), 6))
    index = {name: column for column, name in enumerate(letters)}
    twists = np.zeros((count, 2, 3, 6 * len(letters))) if jacobian else None

    def walk(names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
        turn = np.broadcast_to(_UNIT, (count, 3, 3))
        shift = np.zeros((count, 3))
        for name in names:
            column = index[name]
            turn, shift = _errors(turn, shift, errors[:, column], twists, 6 * column)
            turn, shift = _motion(machine.axes[name], turn, shift, positions[:, column])
        return turn, shift

    table_turn, table_shift = walk(machine.table_side)
    tool_turn, tool_shift = walk(machine.tool_side)
    sphere = tool_turn @ machine.tool + tool_shift
    centre = np.einsum('nji,nj->ni', table_turn, sphere - table_shift)
    if twists is None:
        return Prediction(centre, None)
    # A twist (v, w) of the tool side moves the sphere by v + w x r; one of the table side moves
    # the table frame, so that the sphere moves by the opposite as seen from it.
    linear, angular = twists[:, 0], twists[:, 1]
    moved = linear + np.cross(angular, sphere[:, :, None], axis=1)
    for name in machine.table_side:
        moved[:, :, 6 * index[name] : 6 * index[name] + 6] *= -1.0
    return Prediction(centre, np.einsum('nji,njk->nik', table_turn, moved))


def _errors(
    turn: np.ndarray,
    shift: np.ndarray,
    errors: np.ndarray,
    twists: np.ndarray | None,
    column: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Append the six elementary error transforms; note the twist of each in the machine frame."""
    for letter in range(3):
        if twists is not None:
            axis = turn[:, :, letter]
            twists[:, 0, :, column + letter] = np.cross(shift, axis)
            twists[:, 1, :, column + letter] = axis
        turn = turn @ rotation(_UNIT[letter], errors[:, letter])
    if twists is not None:
        twists[:, 0, :, column + 3 : column + 6] = turn
    return turn, shift + np.einsum('nij,nj->ni', turn, errors[:, 3:])


def _motion(
    axis: Axis, turn: np.ndarray, shift: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    if axis.rotary:
        return turn @ rotation(axis.direction, axis.sense * position), shift
    return turn, shift + np.einsum('nij,nj->ni', turn, position[:, None] * axis.direction)


def linear_positions(machine: Machine, sphere: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Fill in the linear axes so that the nominal sphere centre stays where it is.

    Parameters
    ----------
    sphere : (3,) or (n, 3) nominal sphere centre, frame ``table`` [m]
    positions : (n, k) in the order of ``machine.letters``; the linear axes' values are ignored

    Returns
    -------
    (n, k) with the linear axes at their nominal positions (Eq. 3-1 with the axes' sense). The
    nominal chain is affine in the linear axes, so that three differences solve it exactly.
    """
    positions = np.array(positions, dtype=float, ndmin=2)
    columns = [machine.letters.index(name) for name in machine.linear]
    positions[:, columns] = 0.0
    origin = predict(machine, positions).centre
    slopes = np.empty((len(positions), 3, 3))
    for step, column in enumerate(columns):
        moved = positions.copy()
        moved[:, column] = 1.0
        slopes[:, :, step] = predict(machine, moved).centre - origin
    wanted = (np.asarray(sphere, dtype=float) - origin)[:, :, None]
    positions[:, columns] = np.linalg.solve(slopes, wanted)[:, :, 0]
    return positions
