"""The cycles in a session file: kind and stations, how often a thermal one, dynamic ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan
from rtest_identification.machine import Axis, Machine
from rtest_identification.plans import UNEVEN_DEG, check, diagnostic, static
from rtest_identification.session_nest import DWELL_S
from rtest_identification.session_reader import Reader

STATIC, DIAGNOSTIC, THERMAL, DYNAMIC = 'static', 'diagnostic', 'thermal', 'dynamic'
CHECK = 'check'
# Fewer do not tell offset, sine and cosine of an error over the axis from each other.
FEWEST_STATIONS = 3
# Closer ones are one pose for the machine and for who looks for its stops.
CLOSEST_DEG = 0.1
# Less of a turn than this shows no harmonics; nobody waits for more.
_TURNS = (0.25, 100.0)
# Who makes the plan of a kind of cycle.
BUILD: dict[str, Callable[..., CyclePlan]] = {
    STATIC: static, DIAGNOSTIC: diagnostic, THERMAL: static, CHECK: check,
}
# Of a thermal session: between the starts of its cycles, and from the first to the last of them.
_EVERY_MIN, _HOURS = (0.1, 24.0 * 60.0), (0.01, 24.0 * 14.0)
_MOST_CYCLES = 2000
PACE = ('every_min', 'hours')


def read_cycle(
    reader: Reader, machine: Machine, wanted: str | None
) -> tuple[str, tuple[np.ndarray, ...], float]:
    """Kind, stations of each rotary axis [rad], dwell [s]."""
    keys = {name: f'{name.lower()}_deg' for name in machine.rotary}
    cycle = reader.section('cycle', {'kind', 'dwell_s', *PACE, *keys.values()})
    given = cycle.data.get('kind', STATIC)
    if given not in BUILD:
        raise UserError(f'{cycle.where}: kind: expected {" or ".join(BUILD)}, got {given!r}')
    kind = wanted or given
    stations = []
    for name, key in keys.items():
        if kind == DIAGNOSTIC and full_turn(machine, name) and (
            kind != given or key not in cycle.data
        ):
            stations.append(np.radians(UNEVEN_DEG))
        else:
            stations.append(np.radians(_stations(cycle, key, machine.axes[name])))
    return kind, tuple(stations), cycle.number('dwell_s', 0.3, DWELL_S)


def repetition(reader: Reader, kind: str) -> tuple[float, int]:
    """Of the cycles of a thermal session: time from start to start [s], and how many."""
    cycle = Reader(f'{reader.where}: cycle', reader.data.get('cycle', {}))
    if kind != THERMAL:
        for key in PACE:
            if key in cycle.data and cycle.data.get('kind') != THERMAL:
                raise UserError(f'{cycle.where}: {key}: expected with kind: {THERMAL} only')
        return 0.0, 1
    every = cycle.number('every_min', 15.0, _EVERY_MIN)
    cycle.required('hours')
    minutes = 60.0 * cycle.number('hours', 0.0, _HOURS)
    # A whole number of intervals may be a little less in floating point.
    count = int(minutes / every + 1e-9) + 1
    if not 2 <= count <= _MOST_CYCLES:
        raise UserError(
            f'{cycle.where}: {minutes / 60.0:g} h with a cycle every {every:g} min are {count} '
            f'cycles; expected 2 to {_MOST_CYCLES}'
        )
    return 60.0 * every, count


def dynamic_cycles(reader: Reader, machine: Machine) -> list[tuple[str, float, float]]:
    """Axis, speed [rad/s] and turns each way of every dynamic cycle; none without the section."""
    if 'dynamic' not in reader.data:
        return []
    section = reader.section('dynamic', {'axis', 'speeds_deg_min', 'turns'})
    axis, tables = section.required('axis'), [
        name for name in machine.rotary if name in machine.table_side
    ]
    if axis not in tables:
        raise UserError(
            f'{section.where}: axis: expected a rotary axis of the table, {" or ".join(tables)}, '
            f'got {axis!r}'
        )
    speeds, turns = section.numbers('speeds_deg_min'), section.numbers('turns')
    if min(speeds) <= 0.0 or len(set(speeds)) < len(speeds):
        raise UserError(
            f'{section.where}: speeds_deg_min: expected different positive numbers, got {speeds}'
        )
    lower, upper = _TURNS
    if len(turns) != len(speeds) or not all(lower <= value <= upper for value in turns):
        raise UserError(
            f'{section.where}: turns: expected {lower:g} to {upper:g} for each of the '
            f'{len(speeds)} speeds, got {turns}'
        )
    return [(axis, math.radians(speed) / 60.0, turn)
            for speed, turn in zip(speeds, turns, strict=True)]


def _stations(cycle: Reader, key: str, axis: Axis) -> list[float]:
    """Stations of a rotary axis [deg] that it can reach, enough of them and each once."""
    degrees = cycle.numbers(key)
    if len(degrees) < FEWEST_STATIONS:
        raise UserError(
            f'{cycle.where}: {key}: expected {FEWEST_STATIONS} stations or more, got '
            f'{len(degrees)}: fewer do not tell the errors of {axis.name} from each other'
        )
    ordered = sorted(degrees)
    for first, second in pairwise(ordered):
        if second - first < CLOSEST_DEG:
            raise UserError(
                f'{cycle.where}: {key}: {first:g} and {second:g} are one and the same station; '
                f'expected {CLOSEST_DEG:g} deg between two or more'
            )
    lower, upper = math.degrees(axis.lower), math.degrees(axis.upper)
    for value in (ordered[0], ordered[-1]):
        if not lower - 1e-6 <= value <= upper + 1e-6:
            raise UserError(
                f'{cycle.where}: {key}: {value:g} is outside the range of {axis.name}, '
                f'{lower:g} to {upper:g} deg'
            )
    return degrees


def full_turn(machine: Machine, name: str) -> bool:
    """Whether a rotary axis reaches the uneven stations of a full turn."""
    axis = machine.axes[name]
    return axis.lower <= 0.0 and axis.upper >= math.radians(max(UNEVEN_DEG))
