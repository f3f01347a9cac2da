"""Sensors-nest positions for drawing: what an R-test measured, as motion of the table (3.4).

The displacement of the sphere relative to the nest, with its sign turned, is that of the nest
relative to the sphere; turned by the nominal rotary axes (``sense`` included) it is an error of
the nest's position in the machine frame (Eq. 3-3). What the initial reset of the gauges and the
offsets of the rotary axes put into it is taken out (Eqs. 3-5 and 3-6), as they follow from the
identification, with the exact kinematics of the chain.

Three things differ from the printed equations, because these do not fit each other:

- Eq. 3-4 has the order of an inverse wrong, and its sign: a nest that an axis carries too far in
  +X sees the sphere displaced in -X. With the sign as printed, Eq. 3-6 would double what it is to
  remove.
- Eqs. 3-4 to 3-6 take the offset of C against B as fixed in the machine; it turns with B.
- The reset takes out all that was there at the first pose (Eq. 3-2), not only an offset of C; each
  cycle's reset is the one that the identification fitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_identification.error_map import stations
from rtest_identification.kinematics import rotation
from rtest_identification.machine import Machine
from rtest_identification.pipeline import Identification

# A sphere this near to the axis that turns is on it: its circle would say nothing of a tilt [m].
CENTRE_RADIUS = 5e-3


@dataclass(frozen=True)
class Setup:
    """Where the sphere of one cycle is.

    name : of the set-up, of the cycle where several cycles share it
    radius : distance from the axis that turns [m]; height : along it [m]
    """

    name: str
    radius: float
    height: float

    @property
    def outer(self) -> bool:
        """Whether the sphere runs on a circle (set-ups 1 of Fig. 3-2) and not on the axis."""
        return self.radius > CENTRE_RADIUS


@dataclass(frozen=True)
class Presentation:
    """Positions of the nest (or of the sphere) at every pose that took part in the fit.

    Vectors are in the axes of the machine frame [m]; positions count from the nominal intersection
    of the rotary axes. ``measured``, ``reset``, ``offsets`` and ``squareness`` are displacements
    from the nominal position: as measured, and what the three causes contribute to that.

    seen : 'sensors nest'; 'sphere' where no rotary axis carries the table, so that it is the head
        that turns
    turning : axis whose turning makes the circles (C); stepping : the other one (B), or ''
    direction : (3,) of the turning axis at all axes zero
    levels : (s,) stations of the stepping axis [rad]; level : (n,) index into them
    turned : (n,) position of the turning axis [rad]; angle : the same with its sense
    cycle, pose : (n,) as in the observations
    nominal : (n, 3) nominal positions
    carrier : (n, 3, 3) turn of what carries the turning axis (the B frame) into the machine frame
    """

    seen: str
    turning: str
    stepping: str
    direction: np.ndarray
    setups: tuple[Setup, ...]
    levels: np.ndarray
    level: np.ndarray
    turned: np.ndarray
    angle: np.ndarray
    cycle: np.ndarray
    pose: np.ndarray
    nominal: np.ndarray
    carrier: np.ndarray
    measured: np.ndarray
    reset: np.ndarray
    offsets: np.ndarray
    squareness: np.ndarray

    def error(self, offsets: bool = False, squareness: bool = True) -> np.ndarray:
        """(n, 3) displacement without the initial reset (Eq. 3-5).

        offsets : whether those of the rotary axes stay in (Eq. 3-5) or are removed (Eq. 3-6)
        squareness : whether that of the linear axes stays in (Fig. 3-10) or is removed (Fig. 3-13)
        """
        error = self.measured - self.reset
        if not offsets:
            error = error - self.offsets
        return error if squareness else error - self.squareness

    def rows(self, cycle: int, level: int) -> np.ndarray:
        """Rows of one turn, in the order of the turning axis."""
        rows = np.flatnonzero((self.cycle == cycle) & (self.level == level))
        return rows[np.argsort(self.turned[rows], kind='stable')]

    def normal(self, level: int) -> np.ndarray:
        """(3,) nominal direction of the turning axis at a level."""
        return self.frame(level) @ self.direction

    def frame(self, level: int) -> np.ndarray:
        """(3, 3) nominal turn of the stepping axis's frame (the B frame) at a level."""
        return self.carrier[np.flatnonzero(self.level == level)[0]]

    def in_level_frame(self, vectors: np.ndarray) -> np.ndarray:
        """(n, 3) vectors in the frame that the stepping axis carries: the B frame (6.6.4)."""
        return np.einsum('nji,nj->ni', self.carrier, vectors)


def present(result: Identification) -> Presentation | None:
    """Positions of a session's static cycles; None for a machine without a rotary axis."""
    data = result.observations
    data = data.keep(np.setdiff1d(np.arange(len(data)), result.fit.outliers))
    machine = data.machine
    if not machine.rotary:
        return None
    turning, stepping, seen = _roles(machine)
    carried = _side(machine, turning)
    place = carried.index(turning)
    carrier = _turn(machine, carried[:place], data.positions)
    whole = _turn(machine, carried, data.positions)
    table = _turn(machine, machine.table_side, data.positions)
    # From the displacement of the sphere in the table frame to that of what is seen.
    towards = table if seen == 'sphere' else -table

    def shown(displacement: np.ndarray) -> np.ndarray:
        return np.einsum('nij,nj->ni', towards, displacement)

    fitted = _errors(result)
    none = np.zeros_like(fitted)
    nominal = data.predict(none)[0]
    model = _with_map(result, fitted, data.axis(machine.rotary[0]))
    left = data.displacement - data.predict(model)[0]
    resets = np.array([left[data.cycle == c].mean(axis=0) for c in range(len(data.cycles))])
    only_offsets, only_square = none.copy(), none.copy()
    for name in machine.letters:
        row = machine.letters.index(name)
        if machine.axes[name].rotary:
            only_offsets[row, 3:] = fitted[row, 3:]
        else:
            only_square[row] = fitted[row]
    spheres = np.array([data.sphere[data.cycle == c][0] for c in range(len(data.cycles))])
    direction = machine.axes[turning].direction
    points = data.sphere if seen != 'sphere' else np.broadcast_to(machine.tool, data.sphere.shape)
    if stepping:
        levels, level = stations(data.axis(stepping))
    else:
        levels, level = np.zeros(1), np.zeros(len(data), dtype=int)
    turned = data.axis(turning)
    return Presentation(
        seen, turning, stepping, direction,
        _setups(result, spheres if seen != 'sphere' else [machine.tool] * len(spheres), direction),
        levels, level, turned, machine.axes[turning].sense * turned, data.cycle, data.pose,
        np.einsum('nij,nj->ni', whole, points), carrier,
        shown(data.displacement - nominal),
        shown(resets[data.cycle]),
        shown(data.predict(only_offsets)[0] - nominal),
        shown(data.predict(only_square)[0] - nominal),
    )


def _roles(machine: Machine) -> tuple[str, str, str]:
    """Axis that makes the circles, the other rotary axis, and what is seen on the circles."""
    on_table = [n for n in machine.table_side if machine.axes[n].rotary]
    on_tool = [n for n in machine.tool_side if machine.axes[n].rotary]
    if not on_table:
        return on_tool[-1], (on_tool[-2] if len(on_tool) > 1 else ''), 'sphere'
    others = on_table[:-1] + on_tool
    return on_table[-1], (others[-1] if others else ''), 'sensors nest'


def _side(machine: Machine, axis: str) -> tuple[str, ...]:
    return machine.table_side if axis in machine.table_side else machine.tool_side


def _turn(machine: Machine, names: tuple[str, ...], positions: np.ndarray) -> np.ndarray:
    """(n, 3, 3) product of the nominal turns of these axes, from the bed outwards."""
    turn = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    for name in names:
        axis = machine.axes[name]
        if axis.rotary:
            angle = axis.sense * positions[:, machine.letters.index(name)]
            turn = turn @ rotation(axis.direction, angle)
    return turn


def _errors(result: Identification) -> np.ndarray:
    """(axes, 6) constant errors A B C X Y Z as `kinematics.predict` takes them."""
    errors = np.zeros((len(result.machine.letters), 6))
    errors.flat[[p.column for p in result.location.parameters]] = result.location.value
    return errors


def _with_map(result: Identification, errors: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(n, axes, 6) the same with the outer axis's map, where the constants were fitted with it."""
    errors = np.repeat(errors[None], len(position), axis=0)
    found = result.fit.error_map
    if found is None or not result.fit.joint:
        return errors
    station = np.abs(position[:, None] - found.stations).argmin(axis=1)
    flat = errors.reshape(len(position), -1)
    for p, value in zip(found.parameters, found.value, strict=True):
        flat[:, p.column] += value[station]
    return errors


def _setups(
    result: Identification, spheres: np.ndarray | list[np.ndarray], direction: np.ndarray
) -> tuple[Setup, ...]:
    data = result.observations
    several = len(set(data.setups)) < len(data.setups) or '' in data.setups
    names = data.cycles if several else data.setups
    setups = []
    for name, sphere in zip(names, spheres, strict=True):
        height = float(sphere @ direction)
        radius = float(np.linalg.norm(sphere - height * direction))
        setups.append(Setup(name, radius, height))
    return tuple(setups)
