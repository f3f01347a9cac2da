"""How the axes moved in a dynamic measurement, from the encoder feedback alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.kinematics import predict, rotation
from rtest_identification.machine import Machine

# An axis turns in a cycle when its feedback covers at least this angle [rad].
_TURNS = np.radians(20.0)
# Angular velocities are differences over this time to either side [s]: short, so that the ends of
# an acceleration stay where they are, and longer where motion is told from rest.
_HALF_SPAN = 0.002
_LONG_HALF_SPAN = 0.01
# The axis moves above this part of its cycle's highest angular velocity.
_MOVING = 0.01
# It is steady where its angular velocity is this near the pass's own.
_STEADY = 0.02
# Vibration after a start or before a stop belongs to the transient for so long [s].
SETTLING = 0.3
# Passes whose speeds are this near each other are of one feed.
_SAME_FEED = 0.05
_STEP = 1e-4
COMPONENTS = ('radial', 'tangential', 'axial')


@dataclass(frozen=True)
class Readings:
    """Continuous data of one dynamic cycle.

    sphere : (3,) nominal centre, frame ``table`` [m]
    time : (n,) of the gauge readings, gauges' clock [s]; any common zero
    centre : (n, 3) sphere centre relative to the nest, frame ``table`` [m]
    feedback_time : (m,) strictly increasing, CNC's clock [s]
    feedback : (m, axes) encoder positions in the order of ``machine.letters`` [m] or [rad]
    contact : whether the gauges touch the sphere
    """

    cycle: str
    setup: str
    sphere: np.ndarray
    time: np.ndarray
    centre: np.ndarray
    feedback_time: np.ndarray
    feedback: np.ndarray
    contact: bool = True


@dataclass(frozen=True)
class Pass:
    """One motion of the rotary axis in one direction at one feed. Times by the CNC's clock [s].

    cycle : index of its cycle; feed : index into the measurement's feeds
    sign : +1 or -1; speed : angular velocity of the steady part, without sign [rad/s]
    start, end : of the motion; steady : (begin, end) of constant velocity, settled
    reverses : whether the pass before went the other way
    """

    cycle: int
    feed: int
    sign: int
    speed: float
    start: float
    end: float
    steady: tuple[float, float]
    reverses: bool

    @property
    def label(self) -> str:
        """Feed and direction for a person: 358 deg/min +."""
        return f'{np.degrees(self.speed) * 60.0:,.0f} deg/min {"+" if self.sign > 0 else "-"}'


@dataclass(frozen=True)
class Track:
    """What the encoders say of one cycle, by the CNC's clock.

    time : (m,) [s]; angle : (m,) of the rotary axis [rad]; omega : (m,) its velocity [rad/s]
    servo : (m, 3) sphere centre by the encoders and the nominal kinematics, relative to its
        nominal place: radial, tangential, axial [m]
    positions : (m, axes)
    """

    time: np.ndarray
    angle: np.ndarray
    omega: np.ndarray
    servo: np.ndarray
    positions: np.ndarray


@dataclass(frozen=True)
class Motion:
    """The motion of a measurement: which axis turns, how the sphere follows.

    axis : the rotary axis; radius : of the circle on which the linear axes follow [m]
    frame : (3, 3) rows radial, tangential and axial, frame ``table``
    tracks : of the cycles; passes : in time; feeds : (k,) angular velocities [rad/s], ascending
    """

    machine: Machine
    axis: str
    sphere: np.ndarray
    radius: float
    frame: np.ndarray
    tracks: tuple[Track, ...]
    passes: tuple[Pass, ...]
    feeds: np.ndarray


def describe(machine: Machine, cycles: list[Readings]) -> Motion:
    """Find the turning axis, the directions and the passes of cycles at one sphere position.

    Raises UserError where not exactly one rotary axis of the table turns.
    """
    axis = turning_axis(machine, cycles)
    sphere = cycles[0].sphere
    radius, frame = components(machine, axis, cycles[0].feedback[0])
    tracks = tuple(_track(machine, axis, sphere, frame, one) for one in cycles)
    found = [item for number, track in enumerate(tracks) for item in _passes(number, track)]
    if not found:
        raise UserError(
            f'{cycles[0].cycle}: {axis} never turns at a constant speed; '
            'a dynamic measurement needs a synchronous motion at a constant feed'
        )
    feeds = _feeds(np.array([one.speed for one in found]))
    passes = []
    for one in found:
        feed = int(np.argmin(np.abs(feeds - one.speed)))
        passes.append(replace(one, feed=feed))
    return Motion(machine, axis, sphere, radius, frame, tracks, tuple(passes), feeds)


def turning_axis(machine: Machine, cycles: list[Readings]) -> str:
    """The rotary axis that turns in these cycles.

    Raises UserError where none or several do, or where it does not carry the table.
    """
    columns = {name: machine.letters.index(name) for name in machine.rotary}
    turning = [
        name for name, column in columns.items()
        if any(len(c.feedback) and np.ptp(c.feedback[:, column]) > _TURNS for c in cycles)
    ]
    where = ', '.join(c.cycle for c in cycles)
    if len(turning) != 1:
        raise UserError(
            f'{where}: {" and ".join(turning) or "no rotary axis"} turns; '
            'a dynamic measurement turns one rotary axis and holds the other'
        )
    if turning[0] not in machine.table_side:
        raise UserError(
            f'{where}: {turning[0]} carries the tool; dynamic measurements are evaluated for the '
            'rotary axes of the table'
        )
    return turning[0]


def components(machine: Machine, axis: str, position: np.ndarray) -> tuple[float, np.ndarray]:
    """Radius [m] and the radial, tangential and axial directions of Fig. 5-22.

    Tangential is where the linear axes carry the sphere when `axis` turns positively; axial is
    the axis's own direction; radial points away from it. Seen from the table none of them turns
    with the axis. Returns (radius, (3, 3) rows in frame ``table``).

    position : (axes,) with the sphere in the nest

    Raises UserError where the sphere lies on the axis.
    """
    column = machine.letters.index(axis)
    both = np.stack([position, position])
    both[:, column] += (-_STEP, _STEP)
    low, high = predict(machine, both).centre
    follow = (low - high) / (2.0 * _STEP)
    radius = float(np.linalg.norm(follow))
    if radius < 1e-3:
        raise UserError(
            f'the sphere lies {radius * 1e3:.2f} mm from the axis {axis}: nothing follows it; '
            'put it farther out'
        )
    one, turn = machine.axes[axis], np.eye(3)
    for name in machine.table_side[machine.table_side.index(axis) + 1 :]:
        outer = machine.axes[name]
        if outer.rotary:
            angle = outer.sense * position[machine.letters.index(name)]
            turn = turn @ rotation(outer.direction, np.asarray(angle))
    axial = turn.T @ one.direction
    tangential = follow / radius
    radial = one.sense * np.cross(tangential, axial)
    return radius, np.stack([radial, tangential, axial])


def velocity(time: np.ndarray, angle: np.ndarray, half: float) -> np.ndarray:
    """(m,) angular velocity from encoder samples `half` [s] to either side [rad/s]."""
    later, earlier = time + half, time - half
    step = np.interp(later, time, angle) - np.interp(earlier, time, angle)
    return step / (np.minimum(later, time[-1]) - np.maximum(earlier, time[0]))


def _track(
    machine: Machine, axis: str, sphere: np.ndarray, frame: np.ndarray, cycle: Readings
) -> Track:
    servo = (predict(machine, cycle.feedback).centre - sphere) @ frame.T
    angle = cycle.feedback[:, machine.letters.index(axis)]
    omega = velocity(cycle.feedback_time, angle, _HALF_SPAN)
    return Track(cycle.feedback_time, angle, omega, servo, cycle.feedback)


def _passes(number: int, track: Track) -> list[Pass]:
    """Passes of one cycle, not yet sorted into feeds."""
    time = track.time
    omega = velocity(time, track.angle, _LONG_HALF_SPAN)
    moving = np.abs(omega) > _MOVING * np.abs(omega).max()
    state = np.where(moving, np.sign(omega), 0.0)
    edges = np.flatnonzero(np.diff(state)) + 1
    found: list[Pass] = []
    last = 0
    for begin, end in zip(np.r_[0, edges], np.r_[edges, len(state)], strict=True):
        sign = int(state[begin])
        if not sign or abs(track.angle[end - 1] - track.angle[begin]) < _TURNS:
            continue
        # Over the middle half of the angle the axis runs at its feed, however it accelerates.
        share = (track.angle[begin:end] - track.angle[begin]) * sign
        middle = (share > 0.25 * share[-1]) & (share < 0.75 * share[-1])
        speed = float(np.median(np.abs(omega[begin:end][middle])))
        level = begin + np.flatnonzero(
            np.abs(np.abs(omega[begin:end]) - speed) < _STEADY * speed
        )
        steady = (float(time[level[0]]) + SETTLING, float(time[level[-1]]) - SETTLING)
        if steady[1] - steady[0] < SETTLING:
            continue
        part = np.abs(omega[begin:end]) / speed
        start = _standstill(time[begin:end], part)
        stop = -_standstill(-time[begin:end][::-1], part[::-1])
        found.append(Pass(number, 0, sign, speed, start, stop, steady, last == -sign))
        last = sign
    return found


def _standstill(time: np.ndarray, part: np.ndarray) -> float:
    """When a motion began [s], from the rise of its velocity, `part` of its feed, from 10 to 30 %.

    Velocities are means over a short time: at the very start they rise before the axis does.
    """
    low, high = (float(time[np.argmax(part > level)]) for level in (0.1, 0.3))
    return max(low - 0.5 * (high - low), float(time[0]))


def _feeds(speeds: np.ndarray) -> np.ndarray:
    """Different speeds, ascending: means of those that are near each other."""
    ordered = np.sort(speeds)
    groups = np.split(ordered, np.flatnonzero(np.diff(ordered) > _SAME_FEED * ordered[1:]) + 1)
    return np.array([group.mean() for group in groups])
