"""Run-out of the sphere: its offset from the axis of the spindle (Eq. 2-7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares


@dataclass(frozen=True)
class Runout:
    """Circle on which the sphere runs when the spindle turns.

    centre : (2,) of the circle, where the spindle axis is, relative to the zero of the points [m]
    radius : [m]
    covariance : (3, 3) of centre and radius [m2]
    residual : rms radial distance from the circle [m]
    """

    centre: np.ndarray
    radius: float
    covariance: np.ndarray
    residual: float


def fit(points: np.ndarray) -> Runout:
    """Least-squares circle through (n, 2) points across the spindle axis [m] (Eq. 2-7).

    Raises ValueError with fewer than six points, or points that cover less than half a turn about
    the centre, where centre and radius cannot be told apart.
    """
    if len(points) < 6:
        raise ValueError(f'{len(points)} points, at least six are needed')
    # The algebraic circle (Kasa) is linear and a good start for the geometric one.
    design = np.column_stack([points, np.ones(len(points))])
    scale = float(np.abs(points - points.mean(axis=0)).max()) or 1.0
    start, *_ = np.linalg.lstsq(design / scale, (points**2).sum(axis=1) / scale**2, rcond=None)
    first = start[:2] / 2.0 * scale
    radius = float(np.sqrt(((points - first) ** 2).sum(axis=1).mean()))

    def distances(unknown: np.ndarray) -> np.ndarray:
        return np.hypot(*(points - unknown[:2] * scale).T) / scale - unknown[2]

    solution = least_squares(distances, [*(first / scale), radius / scale], method='lm')
    centre, radius = solution.x[:2] * scale, abs(float(solution.x[2])) * scale
    angles = np.sort(np.arctan2(*(points - centre).T[::-1]))
    largest = np.diff([*angles, angles[0] + 2.0 * np.pi]).max()
    if largest > np.pi:
        raise ValueError('the points cover less than half a turn; turn the spindle once around')
    variance = 2.0 * solution.cost * scale**2 / (len(points) - 3)
    covariance = variance * np.linalg.inv(solution.jac.T @ solution.jac)
    residual = float(np.sqrt(2.0 * solution.cost / len(points)) * scale)
    return Runout(centre, radius, covariance, residual)
