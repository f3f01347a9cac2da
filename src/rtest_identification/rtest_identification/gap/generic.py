"""Tests for whatever no candidate describes: anything that a pose could depend on, freely."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.polynomial import legendre
from scipy import stats

from rtest_identification.error_map import stations
from rtest_identification.gap.rows import Rows
from rtest_identification.gap.size import Chosen


def generic_probability(rows: Rows, chosen: Sequence[Chosen]) -> float:
    """Probability that free functions improve on the model by this much where nothing is left.

    The most improbable of several kinds of function, times their number (Bonferroni).

    chosen : effects, with their shape, that the model has besides its base
    """
    columns = [rows.base, *(effect.columns(rows.scene, shape) for effect, shape in chosen)]
    base = _basis(rows.white(np.concatenate(columns, axis=2)))
    y = rows.white(rows.residual)
    y = y - base @ (base.T @ y)
    found = []
    for functions in _kinds(rows):
        extra = rows.white(functions)
        extra = _basis(extra - base @ (base.T @ extra))
        freedom = len(y) - base.shape[1] - extra.shape[1]
        if freedom < 10 or not extra.shape[1]:
            continue
        gain = float(((extra.T @ y) ** 2).sum())
        ratio = gain / extra.shape[1] / ((float(y @ y) - gain) / freedom)
        found.append(float(stats.f.sf(ratio, extra.shape[1], freedom)))
    return min(1.0, min(found) * len(found)) if found else 1.0


def _basis(design: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(design, axis=0)
    design = design[:, norm > 1e-9 * norm.max()]
    if not design.shape[1]:
        return design
    u, s, _ = np.linalg.svd(design / np.linalg.norm(design, axis=0), full_matrices=False)
    return u[:, s > 1e-4 * s[0]]


def _kinds(rows: Rows) -> Iterator[np.ndarray]:
    """(n, 3, p) columns of each kind of function."""
    scene = rows.scene
    outer, inner = scene.machine.rotary
    yield _displacements(_waves(rows))
    # The inner axis may do anything at every pose of the two, the same for all spheres: what is
    # left are contradictions between set-ups and visits.
    poses = np.stack([stations(scene.position(axis))[1] for axis in (outer, inner)], axis=1)
    cells = _indicators(np.unique(poses, axis=0, return_inverse=True)[1].ravel())
    for letters in ('XYZ', 'ABC'):
        yield _motions(rows, inner, letters, cells)
    for axis in (outer, inner):
        yield _motions(rows, axis, 'XYZABC', _indicators(stations(scene.position(axis))[1]))


def _indicators(groups: np.ndarray) -> np.ndarray:
    """(n, k) one in the column of the group."""
    return np.eye(groups.max() + 1)[groups]


def _motions(rows: Rows, axis: str, letters: str, functions: np.ndarray) -> np.ndarray:
    """(n, 3, p) errors of an axis, each any combination of functions (n, k)."""
    slopes = np.stack([rows.scene.slope(axis, letter) for letter in letters], axis=2)
    return np.einsum('nil,nk->nilk', slopes, functions).reshape(*slopes.shape[:2], -1)


def _displacements(functions: np.ndarray) -> np.ndarray:
    """(n, 3, p) displacements in the table frame that are any combination of functions (n, k)."""
    return np.einsum('ns,ij->nisj', functions, np.eye(3)).reshape(len(functions), 3, -1)


def _waves(rows: Rows) -> np.ndarray:
    """(n, p): orders to 3 in the outer axis times waves to 3 in the inner; time; directions."""
    scene = rows.scene
    outer, inner = scene.machine.rotary
    angle = scene.position(outer)
    low, high = scene.span(outer)
    place = 2.0 * (angle - low) / max(high - low, 1e-9) - 1.0
    along = legendre.legvander(place, 3)
    turn = scene.position(inner)
    around = np.stack(
        [np.ones_like(turn)] + [f(n * turn) for n in (1, 2, 3) for f in (np.cos, np.sin)], axis=1
    )
    tensor = np.einsum('na,nb->nab', along, around).reshape(len(angle), -1)
    time = scene.time - scene.time.mean()
    time = time / max(np.abs(time).max(), 1e-9)
    signs = [scene.direction(axis) for axis in scene.machine.letters]
    return np.column_stack([tensor, time, time**2, time**3, *signs])
