"""The files of a plan: poses, NC programs, `plan.json`, and the session file that measures it."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan
from rtest_identification.foresight import NOISE, Expected, ExpectedMap, Foresight, foresee
from rtest_identification.moves import AxisPath, synchronous_path
from rtest_identification.nc_program import NcSettings, nc_program
from rtest_identification.plan_check import NOT_CHECKED, PlanCheck, check_plan
from rtest_identification.plans import program_name
from rtest_identification.session_cycle import DYNAMIC, PACE
from rtest_identification.session_file import SessionConfig

COVERAGE_FACTOR = 2.0


@dataclass(frozen=True)
class CheckedPlan:
    """A session's cycles with their moves, checked, and what they will determine.

    paths, checks : of every distinct cycle; a repeated one is there once, and foreseen once
    foresight : of the static cycles; None where there is none
    """

    config: SessionConfig
    paths: tuple[AxisPath, ...]
    checks: tuple[PlanCheck, ...]
    foresight: Foresight | None

    @property
    def duration(self) -> float:
        """Of all cycles [s], without mounting."""
        waiting = (self.config.repetitions - 1) * self.config.every
        return sum(check.duration for check in self.checks) + waiting

    @property
    def warnings(self) -> tuple[str, ...]:
        """What somebody should know before measuring."""
        checks = tuple(text for check in self.checks for text in check.warnings)
        if self.foresight is None:
            return checks
        location = self.foresight.location
        lost = [p.symbol for p, good in zip(location.parameters, location.determined, strict=True)
                if not good]
        found = [f'not determined: {", ".join(lost)}'] if lost else []
        for one in (self.foresight.outer_map, self.foresight.inner_map):
            if one is not None and one.undetermined:
                found.append(
                    f'map of {one.axis}: these spheres do not tell {", ".join(one.undetermined)} '
                    'from each other at every pose'
                )
        every = self.config.every
        if every and self.checks[-1].duration > every:
            found.append(
                f'a cycle takes {self.checks[-1].duration / 60.0:.1f} min and is to be repeated '
                f'every {every / 60.0:g} min: the cycles will be late'
            )
        return (*found, *checks)

    @property
    def unchecked(self) -> str:
        """What the collision check leaves out."""
        if self.config.table is None or self.config.spindle is None:
            return 'spindle against table and nest (the session file has no table and spindle)'
        return NOT_CHECKED


def check_session(
    config: SessionConfig, settings: NcSettings, noise: float = NOISE
) -> CheckedPlan:
    """Moves, checks and foresight of every cycle.

    Raises UserError where the plan cannot be run or measures nothing.
    """
    machine = config.machine
    paths = tuple(
        synchronous_path(machine, plan, config.speeds, settings.chord) for plan in config.distinct
    )
    checks = tuple(
        check_plan(machine, plan, path, config.approach, config.table, config.spindle)
        for plan, path in zip(config.distinct, paths, strict=True)
    )
    foresight = None
    if config.kind != DYNAMIC:
        foresight = foresee(machine, config.distinct, paths, noise)
    return CheckedPlan(config, paths, checks, foresight)


def write_plan(
    checked: CheckedPlan, out: Path, session: str, settings: NcSettings, tcp: bool
) -> Path:
    """Write a plan's files into `out`, a new or empty folder; returns the path of plan.json.

    tcp : write the programs in TCP mode too

    Raises UserError where the folder has something in it: an old program beside new ones could be
    run by mistake.
    """
    if out.is_dir() and any(out.iterdir()):
        raise UserError(f'{out}: is not empty; choose another --out')
    config = checked.config
    variants = {'nc': NcSettings(**{**vars(settings), 'tcp': False})}
    if tcp:
        variants['nc_tcp'] = NcSettings(**{**vars(settings), 'tcp': True})
    files: dict[str, str] = {}
    cycles, number = [], 1
    for plan, path, check in zip(config.distinct, checked.paths, checked.checks, strict=True):
        name = program_name(plan.cycle)
        entry = _cycle(replace(plan, cycle=name), check)
        entry['poses_file'] = f'{name}.csv'
        files[entry['poses_file']] = _poses(config, plan, path)
        for key, variant in variants.items():
            end = '.nc' if variant.controller == 'iso' else '.ngc'
            entry[key] = f'{name}{"-tcp" if variant.tcp else ""}{end}'
            files[entry[key]] = nc_program(
                config.machine, replace(plan, cycle=name), path, config.approach, variant, session,
                config.sphere_radius, number,
            )
            number += 1
        cycles.append(entry)
    if checked.foresight is not None:
        files['error_motions.csv'] = _error_motions(checked.foresight)
    files['machine.yaml'] = config.machine.text
    files['session.yaml'] = _session(config)
    data = _as_dict(checked, session) | {'cycles': cycles}
    files['plan.json'] = json.dumps(data, indent=1, allow_nan=False) + '\n'
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (out / name).write_text(text, encoding='utf-8')
    except OSError as error:
        raise UserError(f'{out}: cannot be written: {error.strerror}') from None
    return out / 'plan.json'


def _cycle(plan: CyclePlan, check: PlanCheck) -> dict[str, Any]:
    return {
        'cycle': plan.cycle,
        'kind': plan.kind.name.lower(),
        'setup': plan.setup,
        'sphere': np.asarray(plan.sphere).tolist(),
        'poses': len(plan.commands),
        'dwell': plan.dwell,
        'duration': check.duration,
        'extent': {axis: list(limits) for axis, limits in check.extent.items()},
        'distance': check.distance,
        'swing': check.swing,
    }


def _poses(config: SessionConfig, plan: CyclePlan, path: AxisPath) -> str:
    """CSV: pose, time of arrival [s], axes [mm] and [deg]."""
    axes = config.machine.axes
    linear = [name in axes and not axes[name].rotary for name in plan.axes]
    units = [f'{n}_{"mm" if k else "deg"}' for n, k in zip(plan.axes, linear, strict=True)]
    shown = np.where(linear, plan.commands * 1e3, np.degrees(plan.commands))
    arrival = path.arrival + np.arange(len(plan.commands)) * plan.dwell
    lines = [','.join(['pose', 'time_s', *units])]
    for pose, (time, row) in enumerate(zip(arrival, shown, strict=True)):
        values = [f'{round(v, 6) + 0.0:.6f}' for v in row]
        lines.append(','.join([str(pose), f'{time:.2f}', *values]))
    return '\n'.join(lines) + '\n'


def _error_motions(seen: Foresight) -> str:
    """CSV: the part of each error motion that is left by constants, and by them and the map."""
    head = 'key,name,shapes,hidden,left_least,left_most,left_by_map_least,left_by_map_most'
    lines = [f'{head},verdict,taken_by']
    for o in seen.outlooks:
        parts = ','.join(f'{v:.3f}' for v in (*o.left, *o.left_by_map))
        taken = ' and '.join(o.taken_by)
        lines.append(
            f'{o.key},"{o.name}",{o.shapes},{o.hidden},{parts},"{o.verdict}","{taken}"'
        )
    return '\n'.join(lines) + '\n'


def _session(config: SessionConfig) -> str:
    """The session file with the cycle as it was planned, beside its machine file."""
    data = config.data | {'machine': 'machine.yaml'}
    if config.kind != DYNAMIC:
        cycle = dict(config.data.get('cycle', {})) | {'kind': config.kind}
        for name, stations in zip(config.machine.rotary, config.stations, strict=True):
            degrees = np.degrees(stations).tolist()
            cycle[f'{name.lower()}_deg'] = [round(v, 9) + 0.0 for v in degrees]
        if not config.every:
            cycle = {key: value for key, value in cycle.items() if key not in PACE}
        data['cycle'] = cycle
    if config.devices:
        # Their files stay where they are.
        data['devices'] = {
            name: config.data['devices'][name] | {'file': str(device.file)}
            for name, device in config.devices.items()
        }
    head = '# Measures this plan: rtest session --config session.yaml\n'
    return head + yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=95)


def _as_dict(checked: CheckedPlan, session: str) -> dict[str, Any]:
    config, seen = checked.config, checked.foresight
    common = {
        'session': session,
        'machine': config.machine.name,
        'kind': config.kind,
        'repeated': {'every': config.every, 'cycles': config.repetitions}
        if config.every else None,
        'duration': checked.duration,
        'not_checked': checked.unchecked,
        'warnings': list(checked.warnings),
    }
    if seen is None:
        return common
    rotary = [p.axis in config.machine.rotary for p in seen.location.parameters]
    maps = [m for m in (seen.outer_map, seen.inner_map) if m is not None]
    return common | {
        'stations': {
            name: values.tolist()
            for name, values in zip(config.machine.rotary, config.stations, strict=True)
        },
        'noise': seen.noise,
        'coverage_factor': COVERAGE_FACTOR,
        'poses': seen.poses,
        'location_errors': _errors(seen.location, rotary),
        'squareness': _errors(seen.location, [not r for r in rotary]),
        'error_maps': {m.axis: _map(m, config.machine.rotary) for m in maps},
        'error_motions': [
            {
                'key': o.key, 'name': o.name, 'verdict': o.verdict, 'shapes': o.shapes,
                'hidden': o.hidden, 'left': list(o.left), 'left_by_map': list(o.left_by_map),
                'taken_by': list(o.taken_by), 'like': list(o.like),
            }
            for o in seen.outlooks
        ],
    }


def _errors(location: Expected, chosen: list[bool]) -> dict[str, Any]:
    return {
        p.symbol: {
            'stddev': float(location.stddev[k]),
            'stddev_with_map': float(location.stddev_with_map[k]),
            'unit': p.unit,
            'determined': bool(location.determined[k]),
        }
        for k, p in enumerate(location.parameters)
        if chosen[k]
    }


def _map(one: ExpectedMap, rotary: tuple[str, ...]) -> dict[str, Any]:
    stations = {f'{rotary[0].lower()}_rad': one.outer.tolist()}
    if one.inner is not None:
        stations[f'{rotary[1].lower()}_rad'] = one.inner.tolist()
    return stations | {
        'stddev': {
            p.symbol: _numbers(values)
            for p, values in zip(one.parameters, one.stddev, strict=True)
        },
        'undetermined': list(one.undetermined),
        'left_open': list(one.left_open),
    }


def _numbers(values: np.ndarray) -> Any:
    """Nested lists, None where not determined."""
    if values.ndim:
        return [_numbers(row) for row in values]
    return float(values) if math.isfinite(values) else None
