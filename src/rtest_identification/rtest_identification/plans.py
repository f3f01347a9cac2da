"""What the machine is commanded to do in a cycle (sections 2.2.2, 3.3, 3.7.1 and 5.7.2)."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from itertools import cycle, islice
from typing import Any

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.laser.verification import cube, verification_positions
from rtest_estimation.records import CyclePlan, Kind
from rtest_identification.kinematics import linear_positions
from rtest_identification.machine import Machine

SPINDLE = 'S'
# To the first pose of a check.
VISITS = 10
# How long the sphere stands still for the noise of the gauges [s], at each of two places so far
# above and below its nominal one [m]: lines of 50 and 60 Hz and of a spindle are then apart.
STANDING_S, _STANDING_STEP = 30.0, 1e-4
# Twelve uneven stations of a full turn. Even ones show harmonic n and 12 - n as one and the same;
# of these the sum of exp(i n C) is at most 0.33 of the number of stations for every n up to 22, so
# that no harmonic up to 11 looks like another (cosine at most 0.83 beside location errors), and
# the first five are still found together (condition 3.4). Found by search over multiples of 5 deg
# with gaps of 10 to 50 deg.
UNEVEN_DEG = (0, 50, 60, 80, 110, 145, 160, 200, 240, 270, 315, 335)
# How far an outermost level is overrun before it is approached from outside: more than any
# backlash and enough to be a pose of its own, less than what counts as another station [rad].
OVERRUN = math.radians(0.05)
_REPEATED = re.compile(r'(.*-thermal)-\d+')
# A dynamic cycle rests so long where it turns round: the readings have settled, and the end of the
# cycle is seen by half of it [s].
DYNAMIC_REST = 1.0
# Nearer to the axis the sphere makes no circle to speak of [m].
_NEAREST = 1e-3


def nest_calibration(
    machine: Machine, setup: str, sphere: np.ndarray, step: float = 1e-3, dwell: float = 0.3
) -> CyclePlan:
    """The 28 positions of section 2.2.2: +-step on each linear axis, three times, rotaries at 0.

    step, sphere in m, dwell in s.
    """
    start = linear_positions(machine, sphere, np.zeros(len(machine.letters)))[0]
    rows = []
    for _ in range(3):
        for name in machine.linear:
            offset = step * np.eye(len(start))[machine.letters.index(name)]
            rows += [start, start + offset, start - offset]
    return _plan(machine, Kind.NEST_CALIBRATION, setup, 'nest', sphere, [*rows, start], dwell)


def laser_calibration(
    machine: Machine, setup: str, sphere: np.ndarray, edge: float = 1e-3, dwell: float = 0.3
) -> CyclePlan:
    """The 27 points of a cube (section 5.4.3), its middle also first and last; rotaries at 0.

    edge, sphere in m, dwell in s.
    """
    commands = _stepped(machine, sphere, cube(edge, (3, 3, 3)))
    return _plan(machine, Kind.NEST_CALIBRATION, setup, 'nest', sphere, commands, dwell)


def laser_verification(
    machine: Machine, setup: str, sphere: np.ndarray, edge: float = 1e-3, dwell: float = 0.2
) -> CyclePlan:
    """The 1,183 points of section 5.6.3, the middle of their cube also first and last.

    A static cycle in which no rotary axis moves: `observations.stack` leaves it out.
    """
    commands = _stepped(machine, sphere, verification_positions(edge))
    return _plan(machine, Kind.STATIC, setup, 'verification', sphere, commands, dwell)


def laser_scan(
    machine: Machine,
    setup: str,
    sphere: np.ndarray,
    number: int,
    direction: np.ndarray,
    half: float,
    pitch: float,
    feed: float,
) -> CyclePlan:
    """Lines over the top of the sphere, across the beam of one laser (section 5.3.3-(2)).

    number : of the laser, from 1
    direction : (3,) unit vector from the sphere to the laser, frame ``table`` at B = C = 0
    half : half the length of the lines and half the width of all [m]; pitch : between them [m]
    feed : [m/s]
    """
    level = np.cross(direction, [0.0, 0.0, 1.0])
    # Along the plane of the optics of a laser that stands level; of a vertical one along X.
    along = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-3 else np.eye(3)[0]
    across = np.cross(direction, along)
    lines = np.linspace(-half, half, 2 * round(half / pitch) + 1)
    ends = [
        sign * half * along + line * across
        for row, line in enumerate(lines)
        for sign in ((-1, 1) if row % 2 == 0 else (1, -1))
    ]
    commands = _stepped(machine, sphere, np.array(ends))
    return _plan(
        machine, Kind.DYNAMIC, setup, f'scan-{number}', sphere, commands, 0.0, feed
    )


def _stepped(machine: Machine, sphere: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """(n + 2, axes) rotaries at 0, the sphere at its nominal place, off it by (n, 3) [m], back."""
    places = np.asarray(sphere, dtype=float) + np.vstack([np.zeros(3), offsets, np.zeros(3)])
    return linear_positions(machine, places, np.zeros((len(places), len(machine.letters))))


def spindle_runout(
    machine: Machine, setup: str, sphere: np.ndarray, stations: int = 24, dwell: float = 0.3
) -> CyclePlan:
    """One turn of the spindle in equal steps, everything else standing still (section 2.2.2 (4)).

    The first position is repeated at the end.
    """
    start = linear_positions(machine, sphere, np.zeros(len(machine.letters)))[0]
    spindle = np.arange(stations + 1) * (2.0 * math.pi / stations)
    commands = np.column_stack([np.tile(start, (stations + 1, 1)), spindle])
    return CyclePlan(
        0, '', f'{setup}-runout', Kind.SPINDLE_RUNOUT, setup, np.asarray(sphere, dtype=float),
        (*machine.letters, SPINDLE), commands, dwell,
    )


def static(
    machine: Machine,
    setup: str,
    sphere: np.ndarray,
    outer: np.ndarray,
    inner: np.ndarray,
    dwell: float = 0.3,
) -> CyclePlan:
    """Every station of the outer rotary axis with every station of the inner one.

    outer, inner : stations [rad] of the machine's two rotary axes, the one nearer the bed first
        (B and C of Table 3-1). The inner axis goes to and fro, so that it need not rewind. The
        cycle starts and ends with both at zero.
    """
    poses = [(0.0, 0.0), *_sweep(outer, inner), (0.0, 0.0)]
    commands = linear_positions(machine, sphere, _rotary(machine, poses))
    return _plan(machine, Kind.STATIC, setup, 'static', sphere, commands, dwell)


def thermal(static_cycle: CyclePlan, count: int) -> list[CyclePlan]:
    """A static cycle again and again while the machine warms up (section 4.3).

    They are named SETUP-thermal-01 and so on.
    """
    digits = max(2, len(str(count)))
    return [
        replace(static_cycle, cycle=f'{static_cycle.setup}-thermal-{number:0{digits}}')
        for number in range(1, count + 1)
    ]


def program_name(cycle: str) -> str:
    """Name of the NC program of a cycle: repeated ones share theirs."""
    repeated = _REPEATED.fullmatch(cycle)
    return repeated[1] if repeated else cycle


def diagnostic(
    machine: Machine,
    setup: str,
    sphere: np.ndarray,
    outer: np.ndarray,
    inner: np.ndarray,
    dwell: float = 0.3,
) -> CyclePlan:
    """A cycle that separates what the thesis's static one leaves together.

    All levels of the outer axis upwards, then all downwards, so that every level is approached
    from both sides (backlash); in the second pass the inner axis goes the other way at each level.
    The first pose is visited again between the passes and at the end (drift, which is then no
    function of the outer axis). Before the outermost levels the outer axis overruns them by
    `OVERRUN`, a measured pose of the same station.

    outer, inner : as in `static`; uneven stations of a full turn (`UNEVEN_DEG`) separate its
        harmonics. They are visited in ascending order.
    """
    outer, inner = np.sort(outer), np.sort(inner)
    upward = _sweep(outer, inner)
    downward = upward[::-1]
    zero = (0.0, 0.0)
    below = (outer[0] - OVERRUN, upward[0][1])
    above = (outer[-1] + OVERRUN, downward[0][1])
    poses = [zero, below, *upward, zero, above, *downward, zero]
    commands = linear_positions(machine, sphere, _rotary(machine, poses))
    return _plan(machine, Kind.STATIC, setup, 'diagnostic', sphere, commands, dwell)


def check(
    machine: Machine,
    setup: str,
    sphere: np.ndarray,
    outer: np.ndarray,
    inner: np.ndarray,
    dwell: float = 0.3,
) -> CyclePlan:
    """Ten visits to the first pose, from nine others in between, for `rtest check`.

    outer, inner : stations as in `static`, from which the others are taken in turn
    """
    zero = (0.0, 0.0)
    others = [
        (float(outer[n % len(outer)]), float(inner[n % len(inner)]))
        for n in range(len(outer) * len(inner))
    ]
    away = islice(cycle([one for one in others if one != zero]), VISITS - 1)
    poses = [zero, *(pose for one in away for pose in (one, zero))]
    commands = linear_positions(machine, sphere, _rotary(machine, poses))
    return _plan(machine, Kind.STATIC, setup, 'check', sphere, commands, dwell)


def standing(machine: Machine, setup: str, sphere: np.ndarray) -> CyclePlan:
    """The sphere stands still in the nest, for the noise of the gauges.

    A static cycle in which no rotary axis moves: `observations.stack` leaves it out.
    """
    # Neither where another cycle may have ended: a stand of its own begins with a motion.
    ends = _STANDING_STEP * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    commands = _stepped(machine, sphere, ends)[1:-1]
    return _plan(machine, Kind.STATIC, setup, 'standing', sphere, commands, STANDING_S)


def dynamic(
    machine: Machine, setup: str, sphere: np.ndarray, axis: str, speed: float, turns: float
) -> CyclePlan:
    """One rotary axis to and fro at a constant speed, the linear axes following (section 5.7.2).

    speed : [rad/s]; turns : each way, from zero upwards where the range allows it, else as far on
        both sides of zero

    Raises UserError where the sphere lies on the axis.
    """
    travel = 2.0 * math.pi * turns
    start = 0.0 if travel <= machine.axes[axis].upper + 1e-9 else -0.5 * travel
    rows = np.zeros((3, len(machine.letters)))
    rows[:, machine.letters.index(axis)] = start, start + travel, start
    half = np.zeros((2, len(machine.letters)))
    half[1, machine.letters.index(axis)] = math.pi
    radius = 0.5 * float(np.linalg.norm(np.diff(linear_positions(machine, sphere, half), axis=0)[
        0, [machine.letters.index(name) for name in machine.linear]
    ]))
    if radius < _NEAREST:
        raise UserError(
            f'the sphere lies {radius * 1e3:.2f} mm from the axis {axis}: nothing follows it; put '
            'it farther out'
        )
    # The path speed of a motion that a rotary axis leads, for a person in deg/min.
    name = f'dynamic-{math.degrees(speed) * 60.0:.0f}'
    commands = linear_positions(machine, sphere, rows)
    plan = _plan(machine, Kind.DYNAMIC, setup, name, sphere, commands, 0.0)
    return replace(plan, feed=speed)


def _sweep(outer: np.ndarray, inner: np.ndarray) -> list[tuple[float, float]]:
    """Every level of the outer axis in turn, the inner axis to and fro."""
    return [
        (float(angle), float(station))
        for level, angle in enumerate(outer)
        for station in (inner if level % 2 == 0 else inner[::-1])
    ]


def _rotary(machine: Machine, poses: list[tuple[float, float]]) -> np.ndarray:
    """(n, axes) with the two rotary axes at these poses, the others at zero."""
    names = machine.rotary
    if len(names) != 2:
        raise UserError(f'machine: a static cycle needs two rotary axes, got {list(names)}')
    rows = np.zeros((len(poses), len(machine.letters)))
    rows[:, [machine.letters.index(name) for name in names]] = poses
    return rows


def _plan(
    machine: Machine,
    kind: Kind,
    setup: str,
    suffix: str,
    sphere: np.ndarray,
    commands: Any,
    dwell: float,
    feed: float = 0.0,
) -> CyclePlan:
    return CyclePlan(
        0, '', f'{setup}-{suffix}', kind, setup, np.asarray(sphere, dtype=float),
        machine.letters, np.array(commands, dtype=float), dwell, feed,
    )


def check_ranges(machine: Machine, plan: CyclePlan) -> None:
    """Refuse a plan that leaves an axis's range.

    Raises UserError naming axis, pose and range.
    """
    for column, name in enumerate(plan.axes):
        axis = machine.axes.get(name)
        if axis is None:
            continue
        values = plan.commands[:, column]
        # A station at the very end of the range is reachable, whatever degrees became in rad.
        slack = 1e-9
        outside = np.flatnonzero((values < axis.lower - slack) | (values > axis.upper + slack))
        if outside.size:
            scale, unit = (180 / math.pi, 'deg') if axis.rotary else (1e3, 'mm')
            row = int(outside[0])
            raise UserError(
                f'{plan.cycle}: pose {row}: {name} = {values[row] * scale:.3f} {unit} is outside '
                f'{axis.lower * scale:.3f} to {axis.upper * scale:.3f} {unit}; '
                'change the stations or the sphere position'
            )
