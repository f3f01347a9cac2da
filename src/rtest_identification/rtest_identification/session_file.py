"""The session file: machine, sphere, cycle, set-ups, and what a plan is checked against (YAML)."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, Kind, NestKind
from rtest_estimation.yaml_text import read_yaml
from rtest_identification.machine import Machine, load_machine
from rtest_identification.moves import Approach, Speeds
from rtest_identification.plan_check import Spindle, Table
from rtest_identification.plans import (
    check_ranges,
    dynamic,
    program_name,
    spindle_runout,
    standing,
    thermal,
)
from rtest_identification.session_cycle import (
    BUILD,
    CHECK,
    DYNAMIC,
    THERMAL,
    dynamic_cycles,
    read_cycle,
    repetition,
)
from rtest_identification.session_nest import DWELL_S, calibration_plan, laser_checks, nest_kind
from rtest_identification.session_reader import Reader

_RADIUS_MM = (1.0, 100.0)
# Six points tell a circle from noise.
_RUNOUT_STATIONS = (6, 360)
_NAME = re.compile(r'[A-Za-z0-9][A-Za-z0-9._-]*')
_KEYS = {
    'machine', 'sphere_radius_mm', 'cycle', 'dynamic', 'nest_calibration', 'spindle_runout',
    'setups', 'moves', 'table', 'spindle', 'devices', 'nest', 'verification', 'scan',
}
# The drivers that a session can start; what their backends are is the drivers' affair.
_DRIVERS = ('gauges', 'cnc', 'thermometers')
# Who starts the NC programs: a person, or the session; the latter goes on after their first stop
# (M0) where that is wanted.
BY_HAND, STARTED, UNATTENDED = 'by hand', 'started', 'unattended'


@dataclass(frozen=True)
class Device:
    """What a driver reads from.

    backend : its name; file : the device file
    programs : who starts the NC programs, 'by hand', 'started' or 'unattended'
    """

    backend: str
    file: Path
    programs: str = BY_HAND


@dataclass(frozen=True)
class SessionConfig:
    """What is to be measured in a session.

    sphere_radius : [m]
    nest : of contact gauges or of lasers
    plans : in order, each with stamp 0 and an empty session name until it is started
    kind : of the cycle, 'static', 'diagnostic', 'thermal' or 'check'; 'dynamic' where there are
        dynamic ones only
    stations : of each rotary axis [rad], outer one first; none where there is no static cycle
    speeds, approach : how the axes move between poses, and to the first pose
    table, spindle : bodies that must not touch; None where the file says nothing of them
    devices : of the drivers 'gauges', 'cnc' and 'thermometers'; a driver that is not in it is
        started elsewhere
    data : the mapping that was read
    every : from start to start of the cycles of a thermal session [s]; 0 for other sessions
    """

    machine: Machine
    sphere_radius: float
    nest: NestKind
    plans: tuple[CyclePlan, ...]
    kind: str
    stations: tuple[np.ndarray, ...]
    speeds: Speeds
    approach: Approach
    table: Table | None
    spindle: Spindle | None
    devices: dict[str, Device]
    data: dict[str, Any]
    every: float = 0.0

    @property
    def distinct(self) -> tuple[CyclePlan, ...]:
        """The plans, of a repeated cycle the first."""
        named = {program_name(plan.cycle): plan for plan in reversed(self.plans)}
        return tuple(reversed(named.values()))

    @property
    def repetitions(self) -> int:
        """How often the last of them is there."""
        return len(self.plans) - len(self.distinct) + 1

    @property
    def checks(self) -> bool:
        """Whether the session checks the measuring chain and identifies nothing."""
        return self.kind == CHECK

    def reads_temperatures(self, simulated: bool) -> bool:
        """Whether the session starts the thermometer driver and needs it."""
        return self.kind == THERMAL if simulated else 'thermometers' in self.devices


def load_session(path: Path | str, kind: str | None = None) -> SessionConfig:
    """Read a session file: machine, sphere, cycle, set-ups.

    kind : of the cycle instead of the file's. Stations of a full turn that the file gives for
        another kind of cycle are then not used for a diagnostic one.

    Raises UserError naming file, key and what is expected.
    """
    path = Path(path)
    data = read_yaml(path, 'the session file')
    if not isinstance(data, dict):
        raise UserError(f'{path}: expected a mapping with machine, cycle and setups')
    if 'cycle' not in data and 'dynamic' not in data:
        raise UserError(f'{path}: cycle: missing; expected cycle, dynamic or both')
    reader = Reader(str(path), data)
    reader.only(_KEYS)
    machine = load_machine(path.parent / str(reader.required('machine')))
    radius = reader.number('sphere_radius_mm', 12.7, _RADIUS_MM) * 1e-3
    turning = dynamic_cycles(reader, machine)
    if 'cycle' in data:
        kind, stations, dwell = read_cycle(reader, machine, kind)
    elif kind is not None:
        raise UserError(f'{path}: cycle: missing; a {kind} cycle needs its stations')
    else:
        kind, stations, dwell = DYNAMIC, (), 0.0
    nest = nest_kind(reader)
    every, repetitions = repetition(reader, kind)
    plans: list[CyclePlan] = []
    setups = reader.required('setups')
    if not isinstance(setups, dict) or not setups:
        raise UserError(f'{path}: setups: expected a mapping of names to sphere_mm')
    if kind == THERMAL and len(setups) > 1:
        raise UserError(
            f'{path}: setups: expected one, which a thermal session repeats, got {len(setups)}'
        )
    for name, spec in zip(_names(f'{path}: setups', setups), setups.values(), strict=True):
        setup = Reader(f'{path}: setups: {name}', spec if isinstance(spec, dict) else {})
        setup.only({'sphere_mm'})
        sphere = np.array(setup.numbers('sphere_mm', 3)) * 1e-3
        plans.append(calibration_plan(reader, nest, machine, name, sphere))
        if len(plans) == 1:
            plans += laser_checks(reader, nest, machine, name, sphere)
        if not any(plan.kind is Kind.SPINDLE_RUNOUT for plan in plans):
            runout = data.get('spindle_runout')
            if runout is not None:
                section = reader.section('spindle_runout', {'stations', 'dwell_s'})
                count = section.integer('stations', 24, _RUNOUT_STATIONS)
                runout_dwell = section.number('dwell_s', 0.3, DWELL_S)
                plans.append(spindle_runout(machine, name, sphere, count, runout_dwell))
        if kind in BUILD:
            cycle = BUILD[kind](machine, name, sphere, *stations, dwell)
            plans += thermal(cycle, repetitions) if kind == THERMAL else [cycle]
            plans += [standing(machine, name, sphere)] if kind == CHECK else []
        try:
            plans += [dynamic(machine, name, sphere, *each) for each in turning]
        except UserError as error:
            raise UserError(f'{path}: setups: {name}: {error}') from None
    for plan in plans:
        try:
            check_ranges(machine, plan)
        except UserError as error:
            raise UserError(f'{path}: setups: {plan.setup}: {error}') from None
    return SessionConfig(
        machine, radius, nest, tuple(plans), kind, stations, _speeds(reader), _approach(reader),
        _table(reader), _spindle(reader), _devices(reader, path.parent), data, every,
    )


def _names(where: str, setups: dict) -> list[str]:
    """Names of the set-ups as texts; they become names of cycles and files."""
    names: list[str] = []
    for key in setups:
        name = '' if key is None else str(key)
        if not _NAME.fullmatch(name):
            raise UserError(
                f'{where}: {key!r}: expected a name of letters, digits, dot, dash, underscore'
            )
        if name in names:
            raise UserError(f'{where}: {name}: given twice')
        names.append(name)
    return names


def _speeds(reader: Reader) -> Speeds:
    section = reader.section('moves', {'linear_mm_min', 'rotary_deg_min', 'clearance_mm',
                                       'approach_mm_min', 'direction'})
    default = Speeds()
    return Speeds(
        section.number('linear_mm_min', default.linear * 6e4) / 6e4,
        math.radians(section.number('rotary_deg_min', math.degrees(default.rotary) * 60.0)) / 60.0,
    )


def _approach(reader: Reader) -> Approach:
    section = Reader(f'{reader.where}: moves', reader.data.get('moves', {}))
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


def _table(reader: Reader) -> Table | None:
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


def _spindle(reader: Reader) -> Spindle | None:
    if 'spindle' not in reader.data:
        return None
    section = reader.section('spindle', {'radius_mm', 'distance_mm'})
    for key in ('radius_mm', 'distance_mm'):
        section.required(key)
    return Spindle(*(section.number(k, 0.0) * 1e-3 for k in ('radius_mm', 'distance_mm')))


def _devices(reader: Reader, folder: Path) -> dict[str, Device]:
    """The section `devices`, for example gauges: {backend: serial, file: nest.yaml}."""
    section = reader.section('devices', set(_DRIVERS))
    devices = {}
    for name in section.data:
        known = {'backend', 'file'} | ({'run_programs'} if name == 'cnc' else set())
        entry = section.section(name, known)
        for key in ('backend', 'file'):
            if not (isinstance(entry.required(key), str) and entry.data[key]):
                raise UserError(f'{entry.where}: {key}: expected a text, got {entry.data[key]!r}')
        run = entry.data.get('run_programs', False)
        if run not in (False, True, UNATTENDED):
            raise UserError(
                f'{entry.where}: run_programs: expected true, false or {UNATTENDED}, got {run!r}'
            )
        programs = {False: BY_HAND, True: STARTED}.get(run, UNATTENDED)
        file = (folder / entry.data['file']).absolute()
        devices[name] = Device(entry.data['backend'], file, programs)
    return devices
