"""What is left of the gauges' rows after the named effects: is it more than noise, and where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_identification.dynamic.motion import COMPONENTS
from rtest_identification.dynamic.noise import waves
from rtest_identification.dynamic.rows import Rows

# It is described by free displacements of each pass with so many harmonics.
_ORDERS = 6


@dataclass(frozen=True)
class Rest:
    """What is left beyond the noise after the named effects, and where it is largest.

    probability : of as much where nothing is left
    place : of a free displacement per pass, for a person; size : its amplitude [m]
    """

    probability: float
    place: str
    size: float


def judge_rest(rows: Rows) -> Rest:
    """Test free displacements of every pass, with harmonics, and the rows of starts and stops."""
    scene, count = rows.scene, 2 * _ORDERS + 1
    y = rows.white(rows.residual)
    passes = scene.motion.passes
    columns = np.zeros((len(scene), 3, len(passes), 3, count))
    functions = waves(scene.angle, _ORDERS)
    for number in range(len(passes)):
        mine = np.flatnonzero((scene.number == number) & scene.steady)
        for component in range(3):
            columns[mine, component, number, component] = functions[mine]
    design = rows.white(columns.reshape(len(scene), 3, -1))
    design -= rows.basis @ (rows.basis.T @ design)
    gram, score = design.T @ design, design.T @ y
    gain, freedom, _ = _gain(gram, score)
    steady = float(stats.f.sf(gain / max(freedom, 1), max(freedom, 1), rows.noise.freedom))
    moving = y[~np.repeat(scene.steady, 3)]
    ratio = float(moving @ moving) / max(len(moving), 1)
    transient = float(stats.f.sf(ratio, max(len(moving), 1), rows.noise.freedom))
    if transient < steady:
        size = float(np.sqrt(np.mean(rows.residual[~scene.steady] ** 2)))
        return Rest(min(1.0, 2.0 * transient), 'starts and stops', size)
    place, best, size = '', -1.0, 0.0
    for part in range(3 * len(passes)):
        mine = slice(part * count, (part + 1) * count)
        strength, _, fit = _gain(gram[mine, mine], score[mine])
        if strength > best:
            one, word = passes[part // 3], COMPONENTS[part % 3]
            sizes = np.r_[abs(fit[0]), np.hypot(fit[1::2], fit[2::2])]
            order = int(np.argmax(sizes))
            place = (
                f'{word}, {one.label}, '
                + ('constant' if order == 0 else f'{order} a turn')
            )
            best, size = strength, float(sizes[order])
    return Rest(min(1.0, 2.0 * steady), place, size)


def _gain(gram: np.ndarray, score: np.ndarray) -> tuple[float, int, np.ndarray]:
    """By how much columns lower the sum of squares, how many they are, their coefficients."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    good = values > 1e-6
    seen = vectors[:, good].T @ (scale * score)
    fit = scale * (vectors[:, good] @ (seen / values[good]))
    return float((seen**2 / values[good]).sum()), int(good.sum()), fit
