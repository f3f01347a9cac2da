"""Circularity about the least-squares circle and about the minimum-zone circle (ISO 230-4).

The minimum-zone circle (minimum radial separation) has its centre where the ring between two
concentric circles that holds all points is thinnest. Seen from near its centre the radii are
a + x cos t + y sin t but for what is left, and the ring is thinnest where the largest of that is
smallest (Chebyshev). 1, cos and sin are a Haar system on the turn, so that this best fit is known
by four points, in turn out, in, out, in, and found by exchanging one of them at a time (Remez).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

_ALTERNATING = np.array([1.0, -1.0, 1.0, -1.0])
# Steps of the centre and exchanges: far more than there are ever (4 and 15).
_STEPS, _EXCHANGES = 50, 500
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Circle:
    """Concentric circles about points.

    centre : (2,) [m]; inner, outer : radii of the circles that hold all points between them [m]
    """

    centre: np.ndarray
    inner: float
    outer: float

    @property
    def circularity(self) -> float:
        """Difference between largest and smallest radius [m]."""
        return self.outer - self.inner


def least_squares_circle(points: np.ndarray) -> Circle:
    """Least-squares circle of points (n, 2) [m]: the sum of squared radial distances is least."""

    def fit(basis: np.ndarray, radius: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(basis, radius, rcond=None)[0]

    return _centred(points, fit)


def minimum_zone_circle(points: np.ndarray) -> Circle:
    """Minimum-zone circle of points (n, 2) [m] around a centre.

    Exact for points that no two of lie in one direction from it. Raises ValueError where they do
    not lie around a centre.
    """

    def fit(basis: np.ndarray, radius: np.ndarray) -> np.ndarray:
        return _chebyshev(basis, radius[None] - radius.mean())[0][0]

    return _centred(points, fit)


def zone_width(angle: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Minimum-zone circularity of many profiles of small radial deviations.

    angle : (n,) of the points, no two alike [rad]; deviation : (m, n) [m]

    Returns (m,) [m]. Exact to the order of deviation squared over radius.
    """
    order = np.argsort(angle)
    return 2.0 * np.abs(_chebyshev(_basis(angle[order]), deviation[:, order])[1])


def _basis(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=1)


def _centred(
    points: np.ndarray, fit: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> Circle:
    """Move the centre by the first harmonic of the radii until there is none."""
    points = np.asarray(points, dtype=float)
    centre = points.mean(axis=0)
    for _ in range(_STEPS):
        arm = points - centre
        angle = np.arctan2(arm[:, 1], arm[:, 0])
        order = np.argsort(angle)
        radius = np.linalg.norm(arm, axis=1)
        step = fit(_basis(angle[order]), radius[order])[1:]
        centre = centre + step
        if np.linalg.norm(step) <= _ROUNDING * radius.max():
            radius = np.linalg.norm(points - centre, axis=1)
            return Circle(centre, float(radius.min()), float(radius.max()))
    raise ValueError('the points do not lie around a centre')


def _chebyshev(basis: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Best fits in the largest absolute residual.

    basis : (n, 3) rows by increasing angle; values : (m, n)

    Returns coefficients (m, 3) and the signed largest residual (m,).
    """
    count, points = values.shape
    found, level = np.empty((count, 3)), np.empty(count)
    tolerance = _ROUNDING * np.abs(values).max(axis=1, initial=0.0)
    reference = np.tile(np.linspace(0, points, 4, endpoint=False).astype(int), (count, 1))
    todo = np.arange(count)
    system = np.empty((count, 4, 4))
    system[:, :, 3] = _ALTERNATING
    for _ in range(_EXCHANGES):
        mine = reference[todo]
        system = system[: len(todo)]
        system[:, :, :3] = basis[mine]
        chosen = np.take_along_axis(values[todo], mine, axis=1)
        solved = np.linalg.solve(system, chosen[:, :, None])[:, :, 0]
        found[todo], level[todo] = solved[:, :3], solved[:, 3]
        left = values[todo] - solved[:, :3] @ basis.T
        worst = np.argmax(np.abs(left), axis=1)
        size = left[np.arange(len(todo)), worst]
        more = np.abs(size) > np.abs(solved[:, 3]) + tolerance[todo]
        if not more.any():
            return found, level
        todo, mine, worst = todo[more], mine[more], worst[more]
        # The new point takes the place of the neighbour on its own side of the circle.
        after = (mine < worst[:, None]).sum(axis=1) % 4
        signs = np.where(solved[more, 3] < 0.0, -1.0, 1.0)[:, None] * _ALTERNATING
        rows = np.arange(len(todo))
        same = signs[rows, after] == np.sign(size[more])
        mine[rows, np.where(same, after, (after - 1) % 4)] = worst
        reference[todo] = np.sort(mine, axis=1)
    raise ValueError('no best fit: several points lie in one direction')
