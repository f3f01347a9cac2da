"""Measurement cycles: what the machine is commanded to do (sections 2.2.2, 3.3 and 3.7.1)."""

from __future__ import annotations

import math
from itertools import cycle, islice
from typing import Any

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, Kind
from rtest_identification.kinematics import linear_positions
from rtest_identification.machine import Machine

SPINDLE = 'S'
# To the first pose of a check.
VISITS = 10
# Twelve uneven stations of a full turn. Even ones show harmonic n and 12 - n as one and the same;
# of these the sum of exp(i n C) is at most 0.33 of the number of stations for every n up to 22, so
# that no harmonic up to 11 looks like another (cosine at most 0.83 beside location errors), and
# the first five are still found together (condition 3.4). Found by search over multiples of 5 deg
# with gaps of 10 to 50 deg.
UNEVEN_DEG = (0, 50, 60, 80, 110, 145, 160, 200, 240, 270, 315, 335)
# How far an outermost level is overrun before it is approached from outside: more than any
# backlash and enough to be a pose of its own, less than what counts as another station [rad].
OVERRUN = math.radians(0.05)


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
) -> CyclePlan:
    return CyclePlan(
        0, '', f'{setup}-{suffix}', kind, setup, np.asarray(sphere, dtype=float),
        machine.letters, np.array(commands, dtype=float), dwell,
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
