"""`thermal.json` (schema in the README) of one session."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from rtest_identification.thermal.map_history import MapHistory
from rtest_identification.thermal.pipeline import History, Thermal
from rtest_identification.thermal.sensors import Dependence
from rtest_identification.thermal.time_constants import TimeConstant
from rtest_identification.thermal.within import Within
from rtest_identification.uncertainty import COVERAGE_FACTOR


def as_dict(result: Thermal) -> dict[str, Any]:
    """The result as JSON data; SI values, times in s since the reference cycle, unrounded."""
    location = result.reference.location
    start = dict(zip(location.symbols, zip(
        location.value.tolist(), location.stddev.tolist(), location.determined.tolist(),
        strict=True,
    ), strict=True))
    return {
        'session': result.session,
        'machine': result.machine.name,
        'setup': result.cycles[result.place].plan.setup,
        'reference': result.cycles[result.place].plan.cycle,
        'cycles': _cycles(result),
        'period_s': result.clock.period,
        'duration_s': result.clock.duration,
        'coverage_factor': COVERAGE_FACTOR,
        'noise': _number(result.changes.noise),
        'degrees_of_freedom': result.changes.freedom,
        'errors': {
            one.parameter.symbol: {
                'unit': one.parameter.unit, 'reference': _start(*start[one.parameter.symbol]),
                **_error(one),
            }
            for one in result.errors
        },
        'drifting': [one.parameter.symbol for one in result.drifting],
        'fitted_with_map': result.joint,
        'map_probability': result.map_probability,
        'error_map_change': _map(result.map),
        'phases': [{'start_s': p.start, 'end_s': p.end} for p in result.phases],
        'sensors': _sensors(result),
        'within_a_cycle': [_within(one) for one in result.within],
        'outliers': [
            {'cycle': o.cycle, 'pose': o.pose, 'reason': o.reason} for o in result.outliers
        ],
        'missing': [
            {'cycle': o.cycle, 'pose': o.pose, 'reason': o.reason} for o in result.missing
        ],
        'warnings': list(result.warnings),
        'notes': list(result.notes),
    }


def write(result: Thermal, out: Path) -> Path:
    """Write thermal.json into `out`, whole or not at all; returns its path."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / 'thermal.json'
    part = path.with_name('thermal.json.part')
    text = json.dumps(as_dict(result), indent=1, allow_nan=False)
    part.write_text(text + '\n', encoding='utf-8')
    os.replace(part, path)
    return path


def _cycles(result: Thermal) -> list[dict[str, Any]]:
    rows = []
    residual = np.nan_to_num(result.changes.residual)
    for number, cycle in enumerate(result.cycles):
        used = int(result.changes.used[number].sum())
        rows.append({
            'cycle': cycle.plan.cycle,
            'stamp': int(result.stamp[number]),
            'time_s': float(result.time[number]),
            'poses': len(cycle.points),
            'planned': len(cycle.plan.commands),
            'used': used,
            'residual_rms': float(np.sqrt((residual[number] ** 2).sum() / max(3 * used, 1))),
        })
    return rows


def _start(value: float, stddev: float, determined: bool) -> dict[str, float] | None:
    return {'value': value, 'stddev': stddev} if determined else None


def _error(one: History) -> dict[str, Any]:
    drift = one.drift
    return {
        'change': _numbers(one.series.value),
        'stddev': _numbers(one.series.stddev),
        'drift': {
            'significant': drift.significant,
            'probability': drift.probability,
            'adjusted_probability': drift.adjusted,
            'last': _pair(drift.last),
            'largest': _pair(drift.largest),
            'beyond_expanded_since_s': drift.beyond_since,
        },
        'time_constants': [_constant(c) for c in one.constants],
        'temperature': {d.sensor: _dependence(d) for d in one.dependence},
        'explained_by': None if one.best is None else {
            'sensor': one.best.sensor, 'rivals': list(one.best.rivals),
        },
    }


def _pair(pair: tuple[float, float]) -> dict[str, float | None]:
    return {'value': _number(pair[0]), 'stddev': _number(pair[1])}


def _constant(one: TimeConstant) -> dict[str, Any]:
    return {
        'phase': {'start_s': one.phase.start, 'end_s': one.phase.end},
        'start_s': one.start,
        'tau_s': None if one.undetermined else one.tau,
        'interval_s': [_number(v) for v in one.interval],
        'undetermined': one.undetermined or None,
        'size': {'value': one.rest, 'stddev': one.rest_stddev},
        'settled_change': one.level,
        'misfit_probability': one.misfit,
    }


def _dependence(one: Dependence) -> dict[str, Any]:
    return {
        'sensitivity_per_k': {'value': one.sensitivity, 'stddev': _number(one.stddev)},
        'correlation': {
            'value': _number(one.correlation), 'stddev': _number(one.correlation_stddev),
            'independent_values': _number(one.independent),
        },
        'lag': {
            'value_s': None if one.lag.undetermined else one.lag.value,
            'interval_s': [_number(v) for v in one.lag.interval],
            'undetermined': one.lag.undetermined or None,
        },
        'explained': {
            'part': one.explained, 'delay_s': one.delay,
            'sensitivity_per_k': {
                'value': one.delayed_sensitivity, 'stddev': _number(one.delayed_stddev),
            },
            'misfit_probability': one.misfit,
        },
        'cycles': one.cycles,
    }


def _map(found: MapHistory | None) -> dict[str, Any] | None:
    """Change of the map and of what the axis does at each station, [cycle][station] a symbol."""
    if found is None:
        return None
    symbols = [p.symbol for p in found.parameters]

    def named(values: np.ndarray) -> dict[str, Any]:
        return {s: [_numbers(row) for row in values[:, n]] for n, s in enumerate(symbols)}

    return {
        'axis': found.axis,
        'stations_rad': found.levels.tolist(),
        'change': named(found.value),
        'stddev': named(found.stddev),
        'with_constants': {
            'change': named(found.total), 'stddev': named(found.total_stddev),
        },
        'adjusted_probability': dict(zip(symbols, found.probability.tolist(), strict=True)),
    }


def _sensors(result: Thermal) -> dict[str, Any]:
    """Temperature during every cycle [degC], null where the sensor was silent."""
    found = {}
    for one in result.thermometers:
        celsius, stddev = result.during_cycles(one)
        found[one.sensor] = {'celsius': _numbers(celsius), 'stddev': _number(stddev)}
    return found


def _within(one: Within) -> dict[str, Any]:
    return {
        'error': one.parameter.symbol,
        'taken_for_map': _number(one.hidden),
        'inseparable': one.inseparable,
        'map_per_drift': {p.symbol: size for p, size in one.as_map},
        'constants_per_drift': {p.symbol: size for p, size in one.as_constants},
        'stddev_of_drift': one.stddev,
        'drift_over_reference': one.drift,
    }


def _numbers(values: np.ndarray) -> list[float | None]:
    return [_number(v) for v in values]


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
