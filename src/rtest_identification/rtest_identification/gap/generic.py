"""A test for whatever no candidate describes: low orders of everything a pose depends on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import legendre
from scipy import stats

from rtest_identification.gap.effects import Effect
from rtest_identification.gap.rows import Rows


def generic_probability(
    rows: Rows, chosen: Sequence[tuple[Effect, tuple[float, ...]]]
) -> float:
    """Probability that low-order waves improve on the model by this much where nothing is left.

    chosen : effects, with their shape, that the model has besides its base
    """
    model = rows.white(
        np.concatenate([rows.base, *(e.columns(rows.scene, s) for e, s in chosen)], axis=2)
    )
    base = _basis(model)
    y = rows.white(rows.residual)
    y = y - base @ (base.T @ y)
    waves = rows.white(_waves(rows))
    waves = waves - base @ (base.T @ waves)
    extra = _basis(waves)
    gain = float(((extra.T @ y) ** 2).sum())
    freedom = len(y) - base.shape[1] - extra.shape[1]
    if freedom < 10 or not extra.shape[1]:
        return 1.0
    rest = float(y @ y) - gain
    return float(stats.f.sf(gain / extra.shape[1] / (rest / freedom), extra.shape[1], freedom))


def _basis(design: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(design, axis=0)
    design = design[:, norm > 1e-9 * norm.max()]
    u, s, _ = np.linalg.svd(design / np.linalg.norm(design, axis=0), full_matrices=False)
    return u[:, s > 1e-4 * s[0]]


def _waves(rows: Rows) -> np.ndarray:
    """(n, 3, p): orders to 3 in the outer axis times waves to 3 in the inner, and more."""
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
    scalars = np.column_stack([tensor, time, time**2, time**3, *signs])
    return np.einsum('ns,ij->nisj', scalars, np.eye(3)).reshape(len(angle), 3, -1)
