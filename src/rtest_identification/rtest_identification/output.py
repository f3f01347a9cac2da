"""`identification.json` (schema in the README) and the report beside it."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from rtest_identification.error_map import AxisMap
from rtest_identification.field_sources import covariances_as_json
from rtest_identification.grid_map import GridMap
from rtest_identification.location import Estimate
from rtest_identification.pipeline import Identification, Unused
from rtest_identification.report import render
from rtest_identification.uncertainty import COVERAGE_FACTOR
from rtest_identification.verdict import Verdict
from rtest_identification.verdict_table import as_json


def as_dict(result: Identification, verdict: Verdict | None = None) -> dict[str, Any]:
    """The identification as JSON data; SI units, numbers unrounded."""
    location = result.location
    rotary = [p.axis in result.machine.rotary for p in location.parameters]
    return {
        'session': result.session,
        'machine': result.machine.name,
        'location_errors': _named(location, rotary),
        'squareness': _named(location, [not r for r in rotary]),
        'error_maps': _maps(result),
        'residual_rms': result.fit.rms,
        'residual_rms_location_errors_only': result.fit.rms_location,
        'noise': _number(result.noise),
        'degrees_of_freedom': location.freedom,
        'rank': location.rank,
        'condition': _number(location.condition),
        'uncertainty': _uncertainty(result),
        'undetermined': [
            s for s, good in zip(location.symbols, location.determined, strict=True) if not good
        ],
        'runout': None
        if result.runout is None
        else {
            'radius': result.runout.radius,
            'stddev': math.sqrt(result.runout.covariance[2, 2]),
            'residual': result.runout.residual,
        },
        'model': result.model,
        'fitted_with_map': result.fit.joint,
        'fitted_with_inner_map': result.fit.joint_inner,
        'poses': len(result.observations),
        'outliers': [_unused(item) for item in result.outliers],
        'missing': [_unused(item) for item in result.missing],
        'warnings': list(result.warnings),
        'notes': list(result.notes),
        'gauge_disagreement': dict(result.disagreement),
        **({'verdict': as_json(verdict)} if verdict else {}),
    }


def write(
    result: Identification, out: Path, verdict: Verdict | None = None
) -> dict[str, Path]:
    """Write identification.json and report.html into `out`; returns the paths by name.

    verdict : by a tolerance file, where one was given

    Each file appears whole or not at all.
    """
    out.mkdir(parents=True, exist_ok=True)
    paths = {'json': out / 'identification.json', 'report': out / 'report.html'}
    _atomic(paths['json'], json.dumps(as_dict(result, verdict), indent=1, allow_nan=False) + '\n')
    _atomic(paths['report'], render(result, out, verdict))
    return paths


def _atomic(path: Path, text: str) -> None:
    part = path.with_name(path.name + '.part')
    part.write_text(text, encoding='utf-8')
    os.replace(part, path)


def _uncertainty(result: Identification) -> dict[str, Any]:
    """Contributions (standard uncertainties), degrees of freedom, U (k = 2), correlations."""
    shares, symbols = result.budget, result.location.symbols

    def named(values: np.ndarray) -> dict[str, float]:
        return dict(zip(symbols, values.tolist(), strict=True))

    return {
        'symbols': list(symbols),
        'coverage_factor': COVERAGE_FACTOR,
        'expanded': named(COVERAGE_FACTOR * result.location.stddev),
        'contributions': {
            name: named(np.sqrt(np.diag(part))) for name, part in shares.parts.items()
        },
        'degrees_of_freedom': named(shares.freedom),
        'interval_factor_95': named(shares.interval_factor),
        'correlation': shares.correlation.tolist(),
        'covariance': shares.total.tolist(),
    }


def _named(location: Estimate, chosen: list[bool]) -> dict[str, Any]:
    stddev = location.stddev
    return {
        p.symbol: {
            'value': float(location.value[i]),
            'stddev': float(stddev[i]),
            'unit': p.unit,
        }
        for i, p in enumerate(location.parameters)
        if chosen[i] and location.determined[i]
    }


def _maps(result: Identification) -> dict[str, Any]:
    maps = {m.axis: _map(m) for m in result.maps} | _inner(result.inner_map)
    for axis, covariances in covariances_as_json(result).items():
        maps[axis].update(covariances)
    return maps


def _map(error_map: AxisMap) -> dict[str, Any]:
    symbols = [p.symbol for p in error_map.parameters]
    return {
        'b_rad': error_map.stations.tolist(),
        **dict(zip(symbols, error_map.value.tolist(), strict=True)),
        'stddev': dict(zip(symbols, error_map.stddev.tolist(), strict=True)),
        'rank': error_map.rank,
        'condition': _number(error_map.condition),
        'significance': error_map.significance,
        'left_open': list(error_map.left_open),
    }


def _inner(grid: GridMap | None) -> dict[str, Any]:
    """The inner axis's map, [b][c] a symbol; null where the data do not determine it."""
    if grid is None:
        return {}

    def rows(values: np.ndarray) -> list[list[float | None]]:
        return [[_number(v) for v in row] for row in values]

    symbols = [p.symbol for p in grid.parameters]
    return {
        grid.axis: {
            'b_rad': grid.outer.tolist(),
            'c_rad': grid.inner.tolist(),
            **dict(zip(symbols, map(rows, grid.value), strict=True)),
            'stddev': dict(zip(symbols, map(rows, grid.stddev), strict=True)),
            'residual_rms': grid.rms,
            'degrees_of_freedom': grid.freedom,
            'significance': grid.significance,
            'undetermined': list(grid.undetermined),
            'left_open': list(grid.left_open),
        }
    }


def _unused(item: Unused) -> dict[str, Any]:
    return {'cycle': item.cycle, 'pose': item.pose, 'reason': item.reason}


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
