"""The session file: machine, sphere, cycle, set-ups, and what a plan is checked against (YAML)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, Kind
from rtest_identification.machine import Machine, load_machine
from rtest_identification.moves import Approach, Speeds
from rtest_identification.plan_check import Spindle, Table
from rtest_identification.plans import (
    UNEVEN_DEG,
    check_ranges,
    diagnostic,
    nest_calibration,
    spindle_runout,
    static,
)

STATIC, DIAGNOSTIC = 'static', 'diagnostic'
_BUILD = {STATIC: static, DIAGNOSTIC: diagnostic}
_KEYS = {
    'machine', 'sphere_radius_mm', 'cycle', 'nest_calibration', 'spindle_runout', 'setups',
    'moves', 'table', 'spindle',
}


@dataclass(frozen=True)
class SessionConfig:
    """What is to be measured in a session.

    sphere_radius : [m]
    plans : in order, each with stamp 0 and an empty session name until it is started
    kind : of the cycle, 'static' or 'diagnostic'
    stations : of each rotary axis [rad], outer one first
    speeds, approach : how the axes move between poses, and to the first pose
    table, spindle : bodies that must not touch; None where the file says nothing of them
    data : the mapping that was read
    """

    machine: Machine
    sphere_radius: float
    plans: tuple[CyclePlan, ...]
    kind: str
    stations: tuple[np.ndarray, ...]
    speeds: Speeds
    approach: Approach
    table: Table | None
    spindle: Spindle | None
    data: dict[str, Any]


def load_session(path: Path | str, kind: str | None = None) -> SessionConfig:
    """Read a session file: machine, sphere, cycle, set-ups.

    kind : of the cycle instead of the file's. Stations of a full turn that the file gives for
        another kind of cycle are then not used for a diagnostic one.

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
    kind, stations, dwell = _cycle(reader, machine, kind)
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
                count = round(section.number('stations', 24))
                plans.append(
                    spindle_runout(machine, name, sphere, count, section.number('dwell_s', 0.3))
                )
        plans.append(_BUILD[kind](machine, name, sphere, *stations, dwell))
    for plan in plans:
        check_ranges(machine, plan)
    return SessionConfig(
        machine, radius, tuple(plans), kind, stations, _speeds(reader), _approach(reader),
        _table(reader), _spindle(reader), data,
    )


def _cycle(
    reader: _Reader, machine: Machine, wanted: str | None
) -> tuple[str, tuple[np.ndarray, ...], float]:
    """Kind, stations of each rotary axis [rad], dwell [s]."""
    keys = {name: f'{name.lower()}_deg' for name in machine.rotary}
    cycle = reader.section('cycle', {'kind', 'dwell_s', *keys.values()})
    given = cycle.data.get('kind', STATIC)
    if given not in _BUILD:
        raise UserError(f'{cycle.where}: kind: expected {" or ".join(_BUILD)}, got {given!r}')
    kind = wanted or given
    stations = []
    for name, key in keys.items():
        if kind == DIAGNOSTIC and full_turn(machine, name) and (
            kind != given or key not in cycle.data
        ):
            stations.append(np.radians(UNEVEN_DEG))
        else:
            stations.append(np.radians(cycle.numbers(key)))
    return kind, tuple(stations), cycle.number('dwell_s', 0.3)


def full_turn(machine: Machine, name: str) -> bool:
    """Whether a rotary axis reaches the uneven stations of a full turn."""
    axis = machine.axes[name]
    return axis.lower <= 0.0 and axis.upper >= math.radians(max(UNEVEN_DEG))


def _speeds(reader: _Reader) -> Speeds:
    section = reader.section('moves', {'linear_mm_min', 'rotary_deg_min', 'clearance_mm',
                                       'approach_mm_min', 'direction'})
    default = Speeds()
    return Speeds(
        section.number('linear_mm_min', default.linear * 6e4) / 6e4,
        math.radians(section.number('rotary_deg_min', math.degrees(default.rotary) * 60.0)) / 60.0,
    )


def _approach(reader: _Reader) -> Approach:
    section = _Reader(f'{reader.where}: moves', reader.data.get('moves', {}))
    default = Approach()
    direction = default.direction
    if 'direction' in section.data:
        direction = tuple(section.numbers('direction', 3))
        length = math.hypot(*direction)
        if abs(length - 1.0) > 1e-6:
            raise UserError(
                f'{section.where}: direction: expected a unit vector, got length {length:.6g}'
            )
    return Approach(
        section.number('clearance_mm', default.clearance * 1e3) * 1e-3,
        section.number('approach_mm_min', default.speed * 6e4) / 6e4,
        direction,
    )


def _table(reader: _Reader) -> Table | None:
    if 'table' not in reader.data:
        return None
    section = reader.section(
        'table', {'radius_mm', 'surface_mm', 'nest_radius_mm', 'nest_height_mm', 'swing_mm'}
    )
    section.required('radius_mm')
    return Table(
        section.number('radius_mm', 0.0) * 1e-3,
        section.real('surface_mm') * 1e-3,
        section.number('nest_radius_mm', 1e-3) * 1e-3,
        section.number('nest_height_mm', 1e-3) * 1e-3,
        section.number('swing_mm', math.inf) * 1e-3,
    )


def _spindle(reader: _Reader) -> Spindle | None:
    if 'spindle' not in reader.data:
        return None
    section = reader.section('spindle', {'radius_mm', 'distance_mm'})
    for key in ('radius_mm', 'distance_mm'):
        section.required(key)
    return Spindle(*(section.number(k, 0.0) * 1e-3 for k in ('radius_mm', 'distance_mm')))


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

    def real(self, key: str) -> float:
        """A number of either sign."""
        value = self.required(key)
        if isinstance(value, bool) or not isinstance(value, int | float) or value - value != 0:
            raise UserError(f'{self.where}: {key}: expected a number, got {value!r}')
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
