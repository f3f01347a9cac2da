"""One Gauss-Newton step of the axes that takes the predicted error away.

The errors move the tool from where it was meant to be, as seen from the table, by a shift of its
point and a small rotation. The rotary axes take back the part of the rotation that tilts the tool,
the linear ones then what is left at its point:

    dq_r = -(da/dq_r)^+ (a - a0),        dq_l = -(dp/dq_l)^-1 (p - p0 + dp/dq_r dq_r),

p the point and a the axis of the tool with errors, p0 and a0 as commanded. Rotation about the tool
axis is left: there is no sixth axis. Where the tool points along the first rotary axis (a pole), a
turn of that axis does not tilt it in one direction, and near by it would take a large turn to tilt
it a little: within 5 degrees the correction in that direction fades to nothing, without a step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtest_identification.kinematics import predict
from rtest_identification.machine import Machine

# Tilt of the tool per turn of the rotary axes below which the correction fades [rad/rad].
POLE = math.sin(math.radians(5.0))
_SPINDLE = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Pose:
    """Where the tool is, seen from the table.

    point : (n, 3) frame ``table`` [m]
    turn : (n, 3, 3) axes of the last tool-side frame as columns, frame ``table``; the third is the
        tool's, into the spindle
    """

    point: np.ndarray
    turn: np.ndarray


@dataclass(frozen=True)
class Deviation:
    """Where the tool is, minus where it was meant to be; frame ``table``.

    shift : (n, 3) of its point [m]
    tilt : (n, 3) rotation across its axis [rad]
    spin : (n,) rotation about its axis [rad]
    """

    shift: np.ndarray
    tilt: np.ndarray
    spin: np.ndarray


@dataclass(frozen=True)
class Correction:
    """Commands and what to add to them.

    nominal, change : (n, k) in the order of ``machine.letters`` [m] or [rad]
    before, after : predicted deviations, by the exact kinematics
    near_pole : (n,) bool, where a part of the tilt is left on purpose
    """

    machine: Machine
    nominal: np.ndarray
    change: np.ndarray
    before: Deviation
    after: Deviation
    near_pole: np.ndarray

    @property
    def positions(self) -> np.ndarray:
        """(n, k) the corrected commands [m] or [rad]."""
        return self.nominal + self.change


def pose(machine: Machine, positions: np.ndarray, errors: np.ndarray | None = None) -> Pose:
    """Where the tool is at positions (n, k), with errors as `kinematics.predict` takes them."""
    point = predict(machine, positions, errors).centre
    ends = [
        predict(replace(machine, tool=machine.tool + unit), positions, errors).centre - point
        for unit in np.eye(3)
    ]
    return Pose(point, np.stack(ends, axis=2))


def deviation(wanted: Pose, reached: Pose) -> Deviation:
    """Of one pose from another, small."""
    turned = reached.turn @ wanted.turn.transpose(0, 2, 1)
    skew = 0.5 * (turned - turned.transpose(0, 2, 1))
    small = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    along = wanted.turn[:, :, 2]
    spin = np.einsum('ni,ni->n', small, along)
    return Deviation(reached.point - wanted.point, small - spin[:, None] * along, spin)


def axis_slopes(machine: Machine, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3, k) how the tool's point and axis go with the axes, frame ``table``.

    [m/rad] and [m/m]; [rad/rad] and [rad/m]. An axis moves as an error of it along its own
    direction does.
    """
    axis_end = replace(machine, tool=machine.tool + _SPINDLE)
    point, end = (_slope(one, positions) for one in (machine, axis_end))
    return point, end - point


def correct(machine: Machine, positions: np.ndarray, errors: np.ndarray) -> Correction:
    """Correct commanded positions.

    positions : (n, k) in the order of ``machine.letters`` [m] or [rad]
    errors : (n, k, 6) at these positions; after the step they are taken for the same
    """
    wanted, erring = pose(machine, positions), pose(machine, positions, errors)
    point, axis = axis_slopes(machine, positions)
    rotary = [k for k, name in enumerate(machine.letters) if machine.axes[name].rotary]
    linear = [k for k, name in enumerate(machine.letters) if not machine.axes[name].rotary]
    change = np.zeros_like(positions)
    tilted = erring.turn[:, :, 2] - wanted.turn[:, :, 2]
    u, s, vt = np.linalg.svd(axis[:, :, rotary], full_matrices=False)
    gain = np.where(s < POLE, s / POLE**2, 1.0 / np.maximum(s, POLE))
    change[:, rotary] = -np.einsum('nji,nj,nkj,nk->ni', vt, gain, u, tilted)
    left = erring.point - wanted.point
    left = left + np.einsum('nik,nk->ni', point[:, :, rotary], change[:, rotary])
    change[:, linear] = -np.linalg.solve(point[:, :, linear], left[:, :, None])[:, :, 0]
    return judged(machine, positions, change, errors, (s < POLE).any(axis=1))


def judged(
    machine: Machine, positions: np.ndarray, change: np.ndarray, errors: np.ndarray,
    near_pole: np.ndarray | None = None,
) -> Correction:
    """What a change (n, k) of commands does, arguments as in `correct`."""
    wanted = pose(machine, positions)
    before, after = (
        deviation(wanted, pose(machine, p, errors)) for p in (positions, positions + change)
    )
    if near_pole is None:
        near_pole = np.zeros(len(positions), dtype=bool)
    return Correction(machine, positions, change, before, after, near_pole)


def join(corrections: Sequence[Correction]) -> Correction:
    """Several corrections of one machine as one."""
    first, *_ = corrections
    deviations = (
        Deviation(*(
            np.concatenate([getattr(getattr(one, when), part) for one in corrections])
            for part in ('shift', 'tilt', 'spin')
        ))
        for when in ('before', 'after')
    )
    nominal, change, near = (
        np.concatenate([getattr(one, part) for one in corrections])
        for part in ('nominal', 'change', 'near_pole')
    )
    return Correction(first.machine, nominal, change, *deviations, near)


def _slope(machine: Machine, positions: np.ndarray) -> np.ndarray:
    """(n, 3, k) of the tool's point, from the Jacobian with respect to the errors."""
    jacobian = predict(machine, positions, jacobian=True).jacobian
    columns = []
    for number, name in enumerate(machine.letters):
        axis = machine.axes[name]
        first = 6 * number + (0 if axis.rotary else 3)
        along = axis.direction * (axis.sense if axis.rotary else 1)
        columns.append(jacobian[:, :, first : first + 3] @ along)
    return np.stack(columns, axis=2)
