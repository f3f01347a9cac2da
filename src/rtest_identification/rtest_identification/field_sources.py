"""Where an error field comes from: an identification, or its identification.json."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.field_maps import InnerMap, OuterMap
from rtest_identification.location import MAP_SIGNIFICANCE
from rtest_identification.machine import Machine
from rtest_identification.pipeline import Identification
from rtest_identification.symbols import ErrorParameter, location_parameters, map_parameters


@dataclass(frozen=True)
class Sources:
    """Values and covariance of everything identified; fields as in `ErrorField`."""

    parameters: tuple[ErrorParameter, ...]
    value: np.ndarray
    covariance: np.ndarray
    outer: OuterMap | None
    inner: InnerMap | None
    undetermined: tuple[str, ...]


def from_result(result: Identification, every_map: bool) -> Sources:
    """Of an identification; every_map : also those that do not stand out from the noise."""
    location, outer, grid = result.location, result.fit.error_map, result.fit.inner_map
    outer, grid = (m if m and (every_map or _stands_out(m.significance)) else None
                   for m in (outer, grid))
    lost = [s for s, good in zip(location.symbols, location.determined, strict=True) if not good]
    covariance = location.covariance
    if outer:
        across = outer_cross(result)
        covariance = np.block([[covariance, across], [across.T, outer.covariance]])
    return Sources(
        location.parameters,
        location.value,
        covariance,
        outer and OuterMap(outer.axis, outer.parameters, outer.stations, outer.value),
        grid and InnerMap(
            grid.axis, grid.parameters, grid.outer, grid.inner, grid.value, grid_covariance(result)
        ),
        tuple(lost),
    )


def _stands_out(significance: float) -> bool:
    return significance < MAP_SIGNIFICANCE


def outer_cross(result: Identification) -> np.ndarray:
    """(p, 6 s) covariance of the location errors with the outer axis's map."""
    first, second = result.location.gain, result.fit.error_map.gain
    both = np.concatenate([first, second])
    sources = sum(result.sources.carry(both).values())
    return result.fit.across + sources[: len(first), len(first) :]


def grid_covariance(result: Identification) -> np.ndarray:
    """(b, c, 6, 6) covariance of the inner axis's six errors at each station.

    NaN where an error is not determined.
    """
    grid = result.fit.inner_map
    shape = grid.value.shape
    gain = grid.gain.reshape(*shape, -1)
    covariance = grid.rms**2 * np.einsum('ibcn,jbcn->bcij', gain, gain)
    if result.sources.priors:
        sources = sum(result.sources.carry(grid.gain).values()).reshape(*shape, *shape)
        covariance += np.einsum('ibcjbc->bcij', sources)
    lost = np.moveaxis(np.isnan(grid.stddev), 0, -1)
    covariance[lost[..., :, None] | lost[..., None, :]] = np.nan
    return covariance


def covariances_as_json(result: Identification) -> dict[str, dict[str, Any]]:
    """What the maps in identification.json need besides their stddev, by axis.

    Outer axis: covariance (6 s, 6 s), errors first, and covariance_with_location_errors (p, 6 s).
    Inner axis: covariance [b][c][6][6], null where not determined.
    """
    outer, grid = result.fit.error_map, result.fit.inner_map
    found: dict[str, dict[str, Any]] = {}
    if outer:
        found[outer.axis] = {
            'covariance': outer.covariance.tolist(),
            'covariance_with_location_errors': outer_cross(result).tolist(),
        }
    if grid:
        covariance = grid_covariance(result)
        known = np.isfinite(covariance)
        found[grid.axis] = {'covariance': np.where(known, covariance, None).tolist()}
    return found


def from_file(path: Path | str, machine: Machine, every_map: bool) -> Sources:
    """Of an identification.json; every_map as in `from_result`.

    Raises UserError where the file is not one, or its symbols are not those of the machine.
    """
    try:
        data = json.loads(Path(path).read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise UserError(f'{path}: cannot read the identification: {error}') from None
    try:
        return _from_data(data, machine, every_map)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f'{path}: not an identification.json of the machine {machine.name!r}: '
            f'{type(error).__name__}: {error}'
        ) from None


def _from_data(data: dict[str, Any], machine: Machine, every_map: bool) -> Sources:
    parameters = location_parameters(machine)
    symbols = [p.symbol for p in parameters]
    if data['uncertainty']['symbols'] != symbols:
        raise ValueError(f'its errors are {", ".join(data["uncertainty"]["symbols"])}')
    given = {**data['location_errors'], **data['squareness']}
    known = {p.symbol: _value(p, given[p.symbol]) for p in parameters
             if given.get(p.symbol) and given[p.symbol]['value'] is not None}
    value = np.array([known.get(s, 0.0) for s in symbols])
    covariance = _array(data['uncertainty']['covariance'])
    _check_variance(covariance, 'uncertainty')
    outer = inner = None
    if not isinstance(data['error_maps'], dict):
        raise ValueError('error_maps: expected maps by axis, {} where there is none')
    for axis, given in data['error_maps'].items():
        if not every_map and not _stands_out(given['significance']):
            continue
        errors = map_parameters(machine, axis)
        values = _array([given[p.symbol] for p in errors])
        stddev = _array([given['stddev'][p.symbol] for p in errors])
        if axis == machine.rotary[0]:
            outer = OuterMap(axis, errors, _array(given['b_rad']), values)
            size = (len(symbols), values.size)
            own = _array(given.get('covariance', np.diag(stddev.ravel() ** 2)))
            across = _array(given.get('covariance_with_location_errors', np.zeros(size)))
            if not np.isfinite(values).all():
                raise ValueError(f'error_maps of {axis}: expected finite numbers')
            _check_variance(own, f'error_maps of {axis}')
            covariance = np.block([[covariance, across], [across.T, own]])
        else:
            diagonal = np.moveaxis(stddev, 0, -1)[..., None] ** 2 * np.eye(6)
            own = _array(given.get('covariance', diagonal))
            _check_variance(own, f'error_maps of {axis}')
            inner = InnerMap(
                axis, errors, _array(given['b_rad']), _array(given['c_rad']), values, own
            )
    lost = tuple(s for s in symbols if s not in known)
    return Sources(parameters, value, covariance, outer, inner, lost)


def _value(p: ErrorParameter, given: dict[str, Any]) -> float:
    value, unit = given['value'], given.get('unit', p.unit)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f'{p.symbol}: value {value!r}, expected a finite number of {p.unit}')
    if unit != p.unit:
        raise ValueError(f'{p.symbol}: unit {unit!r}, expected {p.unit!r}')
    return float(value)


def _check_variance(covariance: np.ndarray, what: str) -> None:
    """Refuse negative variances in (..., n, n)."""
    if (np.einsum('...ii->...i', covariance) < 0.0).any():
        raise ValueError(f'{what}: a variance in covariance is negative')


def _array(values: Any) -> np.ndarray:
    """Numbers; null is NaN."""
    return np.array(values, dtype=float)
