"""Measurement cycles: what the machine is commanded to do (sections 2.2.2, 3.3 and 3.7.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, Kind
from rtest_identification.kinematics import linear_positions
from rtest_identification.machine import Machine, load_machine

SPINDLE = 'S'
_KEYS = {
    'machine', 'sphere_radius_mm', 'cycle', 'nest_calibration', 'spindle_runout', 'setups',
}


@dataclass(frozen=True)
class SessionConfig:
    """What is to be measured in a session.

    sphere_radius : [m]
    plans : in order, each with stamp 0 and an empty session name until it is started
    """

    machine: Machine
    sphere_radius: float
    plans: tuple[CyclePlan, ...]


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
    names = machine.rotary
    if len(names) != 2:
        raise UserError(f'machine: a static cycle needs two rotary axes, got {list(names)}')
    first, second = (machine.letters.index(name) for name in names)
    rows = [np.zeros(len(machine.letters))]
    for level, angle in enumerate(outer):
        for station in inner if level % 2 == 0 else inner[::-1]:
            row = np.zeros(len(machine.letters))
            row[first], row[second] = angle, station
            rows.append(row)
    rows.append(rows[0])
    commands = linear_positions(machine, sphere, np.array(rows))
    return _plan(machine, Kind.STATIC, setup, 'static', sphere, commands, dwell)


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


def load_session(path: Path | str) -> SessionConfig:
    """Read a session file: machine, sphere, cycle, set-ups.

    Raises UserError naming file, key and what is expected.
    """
    path = Path(path)
    try:
        data = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'{path}: cannot read the session file: {error}') from None
    except yaml.YAMLError as error:
        raise UserError(f'{path}: not valid YAML: {" ".join(str(error).split())}') from None
    if not isinstance(data, dict):
        raise UserError(f'{path}: expected a mapping with machine, cycle and setups')
    reader = _Reader(str(path), data)
    reader.only(_KEYS)
    machine = load_machine(path.parent / str(reader.required('machine')))
    radius = reader.number('sphere_radius_mm', 12.7) * 1e-3
    cycle = reader.section('cycle', {'b_deg', 'c_deg', 'dwell_s'})
    outer, inner = (np.radians(cycle.numbers(key)) for key in ('b_deg', 'c_deg'))
    dwell = cycle.number('dwell_s', 0.3)
    nest = reader.section('nest_calibration', {'step_mm', 'dwell_s'})
    step, nest_dwell = nest.number('step_mm', 1.0) * 1e-3, nest.number('dwell_s', 0.3)
    plans: list[CyclePlan] = []
    setups = reader.required('setups')
    if not isinstance(setups, dict) or not setups:
        raise UserError(f'{path}: setups: expected a mapping of names to sphere_mm')
    for name, spec in setups.items():
        setup = _Reader(f'{path}: setups: {name}', spec if isinstance(spec, dict) else {})
        setup.only({'sphere_mm'})
        sphere = np.array(setup.numbers('sphere_mm', 3)) * 1e-3
        name = str(name)
        plans.append(nest_calibration(machine, name, sphere, step, nest_dwell))
        if not any(plan.kind is Kind.SPINDLE_RUNOUT for plan in plans):
            runout = data.get('spindle_runout')
            if runout is not None:
                section = reader.section('spindle_runout', {'stations', 'dwell_s'})
                stations = round(section.number('stations', 24))
                plans.append(
                    spindle_runout(machine, name, sphere, stations, section.number('dwell_s', 0.3))
                )
        plans.append(static(machine, name, sphere, outer, inner, dwell))
    for plan in plans:
        check_ranges(machine, plan)
    return SessionConfig(machine, radius, tuple(plans))


class _Reader:
    """Typed look-ups in a YAML mapping whose errors name file and key."""

    def __init__(self, where: str, data: dict) -> None:
        self.where, self.data = where, data

    def only(self, known: set[str]) -> None:
        for key in self.data:
            if key not in known:
                raise UserError(
                    f'{self.where}: unknown key {key!r}, expected one of {sorted(known)}'
                )

    def required(self, key: str) -> Any:
        if key not in self.data:
            raise UserError(f'{self.where}: {key}: missing')
        return self.data[key]

    def section(self, key: str, known: set[str]) -> _Reader:
        value = self.data.get(key, {})
        if not isinstance(value, dict):
            raise UserError(f'{self.where}: {key}: expected a mapping of {sorted(known)}')
        section = _Reader(f'{self.where}: {key}', value)
        section.only(known)
        return section

    def number(self, key: str, default: float) -> float:
        value = self.data.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise UserError(f'{self.where}: {key}: expected a positive number, got {value!r}')
        return float(value)

    def numbers(self, key: str, count: int | None = None) -> list[float]:
        value = self.required(key)
        good = isinstance(value, list) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)
            for v in value
        )
        if not good or not value or (count and len(value) != count):
            wanted = f'{count} numbers' if count else 'a list of numbers'
            raise UserError(f'{self.where}: {key}: expected {wanted}, got {value!r}')
        return [float(v) for v in value]
