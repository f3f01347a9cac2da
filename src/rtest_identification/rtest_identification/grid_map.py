"""Error map of the inner rotary axis over both rotary axes: C's six errors over (C, B).

At one pose of B and C the sphere positions of the set-ups move like points of a rigid body: their
displacement gives three shifts and three tilts when there are three of them off one line, five of
the six with two, and with one only what shift and tilt do together. What these spheres cannot tell
is left out, not guessed. The mean over the inner axis's stations is zero at every level of the
outer axis: it belongs to the outer axis's map (Table 2-4 lets C's errors depend on B for the same
reason).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_identification.error_map import coupled, stations, zero_mean
from rtest_identification.observations import Observations
from rtest_identification.symbols import (
    RANK_TOLERANCE,
    ErrorParameter,
    map_parameters,
    parameter,
)

# With fewer degrees of freedom a residual says little about the noise, and nothing about a map.
MIN_FREEDOM = 30
# Fewer stations of the inner axis at a level of the outer one make no map.
MIN_STATIONS = 3


@dataclass(frozen=True)
class GridMap:
    """Position-dependent errors of the inner rotary axis.

    outer : (b,) stations of the outer axis [rad]; inner : (c,) of the inner one [rad]
    value, stddev : (6, b, c) in the order of `parameters` [m] or [rad]; NaN where not determined
    undetermined : symbols that the sphere positions cannot tell from each other
    left_open : groups of symbols with shapes that look like offsets of the cycles at every pose
    rms : of what is left with this map, per component [m]
    freedom : degrees of freedom of that residual
    significance : probability of a map this large where there is none; 1 where too little is
        repeated to tell
    gain : (6 b c, n, 3) change of each value per displacement of each observation
    """

    axis: str
    parameters: tuple[ErrorParameter, ...]
    outer: np.ndarray
    inner: np.ndarray
    value: np.ndarray
    stddev: np.ndarray
    undetermined: tuple[str, ...]
    left_open: tuple[str, ...]
    rms: float
    freedom: int
    significance: float
    gain: np.ndarray


@dataclass(frozen=True)
class _Cell:
    """One pose of both axes: where its rows are, and its solution."""

    place: tuple[int, int]
    rows: np.ndarray
    basis: np.ndarray
    inverse: np.ndarray
    open: np.ndarray


def fit_grid(
    observations: Observations,
    jacobian: np.ndarray,
    residual: np.ndarray,
    explained: np.ndarray,
) -> GridMap | None:
    """Fit the inner axis's map to what location errors and outer map leave.

    Parameters
    ----------
    jacobian : (n, 3, 6 k) of `kinematics.predict`
    residual : (n, 3) of the fit so far [m]
    explained : (3 n, p) orthonormal basis of everything fitted so far, rows as the residual's

    None where there is no second rotary axis or too few stations.
    """
    machine = observations.machine
    if len(machine.rotary) != 2:
        return None
    outer_axis, inner_axis = machine.rotary
    outer, at_outer = stations(observations.axis(outer_axis))
    inner, at_inner = stations(observations.axis(inner_axis))
    parameters = map_parameters(machine, inner_axis)
    columns = [parameter(machine, inner_axis, p.letter).column for p in parameters]
    scale = np.array([p.scale for p in parameters])
    cells = []
    for place in sorted(set(zip(at_outer.tolist(), at_inner.tolist(), strict=True))):
        rows = np.flatnonzero((at_outer == place[0]) & (at_inner == place[1]))
        design = jacobian[rows][:, :, columns].reshape(-1, 6) * scale
        cells.append(_solve(place, rows, design, scale))
    levels = np.bincount([cell.place[0] for cell in cells], minlength=len(outer))
    cells = [cell for cell in cells if levels[cell.place[0]] >= MIN_STATIONS]
    if not cells:
        return None
    value = np.full((6, len(outer), len(inner)), np.nan)
    variance = np.full_like(value, np.nan)
    left = residual.copy()
    rank = 0
    for cell in cells:
        y = residual[cell.rows].reshape(-1)
        value[(slice(None), *cell.place)] = cell.inverse @ y
        variance[(slice(None), *cell.place)] = (cell.inverse**2).sum(axis=1)
        left[cell.rows] -= (cell.basis @ (cell.basis.T @ y)).reshape(-1, 3)
        rank += cell.basis.shape[1]
    shared = _shared(cells, explained, len(observations))
    added = rank - shared.shape[1]
    freedom = residual.size - explained.shape[1] - added
    if added <= 0 or freedom <= 0:
        return None
    before, after = float((residual**2).sum()), float((left**2).sum())
    unit = after / freedom
    ratio = (before - after) / added / unit if unit > 0 else np.inf
    value, variance = _mean_free(value, variance * unit)
    lost = np.zeros((6, len(outer), len(inner)), dtype=bool)
    for cell in cells:
        lost[(slice(None), *cell.place)] = cell.open
    value[lost], variance[lost] = np.nan, np.nan
    gone = lost.any(axis=(1, 2))
    return GridMap(
        inner_axis, parameters, outer, inner, value, np.sqrt(variance),
        tuple(p.symbol for p, out in zip(parameters, gone, strict=True) if out),
        _left_open(cells, explained @ shared, parameters, gone, value.shape),
        float(np.sqrt(unit)), freedom,
        float(stats.f.sf(ratio, added, freedom)) if freedom >= MIN_FREEDOM else 1.0,
        _gain(cells, value.shape, len(observations)),
    )


def contrasts(observations: Observations, jacobian: np.ndarray) -> np.ndarray:
    """(n, 3, k) columns of every map of the inner axis with mean zero at each outer level."""
    outer_axis, inner_axis = observations.machine.rotary
    outer, at_outer = stations(observations.axis(outer_axis))
    _, at_inner = stations(observations.axis(inner_axis))
    parameters = map_parameters(observations.machine, inner_axis)
    columns = [parameter(observations.machine, inner_axis, p.letter).column for p in parameters]
    slopes = jacobian[:, :, columns] * [p.scale for p in parameters]
    blocks = []
    for level in range(len(outer)):
        rows = np.flatnonzero(at_outer == level)
        places, place = np.unique(at_inner[rows], return_inverse=True)
        if len(places) < MIN_STATIONS:
            continue
        spread = zero_mean(len(places))[place]
        block = np.zeros((len(observations), 3, 6 * spread.shape[1]))
        block[rows] = np.einsum('nip,ns->nips', slopes[rows], spread).reshape(len(rows), 3, -1)
        blocks.append(block)
    return np.concatenate(blocks, axis=2)


def _solve(
    place: tuple[int, int], rows: np.ndarray, design: np.ndarray, scale: np.ndarray
) -> _Cell:
    u, s, vt = np.linalg.svd(design, full_matrices=False)
    rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
    kept = vt[:rank]
    inverse = scale[:, None] * ((kept.T / s[:rank]) @ u[:, :rank].T)
    missing = np.sqrt(np.maximum(1.0 - (kept**2).sum(axis=0), 0.0))
    return _Cell(place, rows, u[:, :rank], inverse, missing > 1e-2)


def _mean_free(value: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Take the mean over the inner stations off; stations are independent of each other."""
    count = np.sum(np.isfinite(value), axis=2, keepdims=True)
    count = np.where(count > 0, count, 1)
    mean = np.nansum(value, axis=2, keepdims=True) / count
    of_mean = np.nansum(variance, axis=2, keepdims=True) / count**2
    return value - mean, variance * (1.0 - 2.0 / count) + of_mean


def _gain(cells: list[_Cell], shape: tuple[int, int, int], count: int) -> np.ndarray:
    """(6 b c, n, 3): the solution of every cell, with the mean over the inner stations off."""
    gain = np.zeros((*shape, count, 3))
    measured = np.zeros(shape[1:])
    for cell in cells:
        rows = cell.inverse.reshape(6, len(cell.rows), 3)
        gain[:, cell.place[0], cell.place[1], cell.rows] = rows
        measured[cell.place] = 1.0
    number = np.maximum(measured.sum(axis=1), 1.0)[None, :, None, None]
    mean = gain.sum(axis=2) / number
    gain -= mean[:, :, None] * measured[None, :, :, None, None]
    return gain.reshape(-1, count, 3)


def _shared(cells: list[_Cell], explained: np.ndarray, count: int) -> np.ndarray:
    """Directions (p, s) of `explained` that a map of the inner axis could make as well."""
    within = np.zeros_like(explained)
    for cell in cells:
        rows = _flat(cell.rows, count)
        within[rows] = cell.basis @ (cell.basis.T @ explained[rows])
    gram = explained.T @ within
    values, vectors = np.linalg.eigh((gram + gram.T) / 2.0)
    return vectors[:, values > 1.0 - 1e-6]


def _flat(rows: np.ndarray, count: int) -> np.ndarray:
    return np.arange(3 * count).reshape(count, 3)[rows].reshape(-1)


def _left_open(
    cells: list[_Cell],
    shapes: np.ndarray,
    parameters: tuple[ErrorParameter, ...],
    gone: np.ndarray,
    shape: tuple[int, int, int],
) -> tuple[str, ...]:
    """Shapes with zero mean over the inner stations that the fit so far takes all of.

    Where symbols are not determined at all, that is said, and shapes of them are not.
    """
    if gone.any():
        return ()
    count = len(shapes) // 3
    as_map = np.zeros((*shape, shapes.shape[1]))
    for cell in cells:
        as_map[(slice(None), *cell.place)] = cell.inverse @ shapes[_flat(cell.rows, count)]
    measured = np.zeros(shape[1:], dtype=bool)
    for cell in cells:
        measured[cell.place] = True
    weight = measured[None, :, :, None]
    mean = (as_map * weight).sum(axis=2, keepdims=True) / np.maximum(
        weight.sum(axis=2, keepdims=True), 1
    )
    as_map = (as_map - mean) * weight
    scale = np.array([p.scale for p in parameters])
    flat = (as_map / scale[:, None, None, None]).reshape(-1, shapes.shape[1])
    u, s, _ = np.linalg.svd(flat, full_matrices=False)
    kept = u[:, s > 1e-3 * max(s.max(initial=0.0), 1e-12)]
    return coupled(parameters, kept * np.repeat(scale, shape[1] * shape[2])[:, None])
