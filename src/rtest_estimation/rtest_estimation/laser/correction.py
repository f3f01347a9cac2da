"""Correction of the error that inclined surfaces cause, by radial basis functions (section 5.5).

At the calibration positions the difference between where the sphere was and where it was
estimated to be is known; in between it is interpolated (Eqs. 5-5 to 5-9).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import ConvexHull
from scipy.special import xlogy

# Centres farther outside the hull of the nodes than this share of its size are not corrected.
MARGIN = 0.02
# A polynomial the nodes do not determine (three levels show no cubes): no answer.
_MAX_CONDITION = 1e12


@dataclass(frozen=True)
class Kernel:
    """A radial basis function of `scipy.interpolate.RBFInterpolator`.

    degree : of the polynomial added to it, -1 for none
    smoothing : 0 interpolates; larger values trust single nodes less. For nodes scaled to half the
        size of the calibrated volume
    """

    name: str
    degree: int
    smoothing: float = 0.0


# The distance itself and nothing else, Eqs. 5-6 and 5-7.
THESIS = Kernel('linear', -1)
_SHAPES = (
    ('linear', 0), ('linear', 2), ('thin_plate_spline', 1), ('thin_plate_spline', 2),
    ('cubic', 1), ('cubic', 2), ('quintic', 2),
)
# Kernels with a shape parameter (Gaussian, multiquadric) are left out: on few nodes their
# leave-one-out error is smallest where they are nearly polynomials of a high degree, and says
# little about the points in between.
KERNELS = (
    THESIS,
    *(Kernel(*shape, smoothing) for shape in _SHAPES for smoothing in (0.0, 0.1, 1.0, 10.0)),
)
_PROFILE = {
    'linear': lambda r: -r,
    'thin_plate_spline': lambda r: xlogy(r**2, r),
    'cubic': lambda r: r**3,
    'quintic': lambda r: -(r**5),
}


class Correction:
    """What to add to an estimated sphere centre.

    nodes : (n, 3) estimated centres at the calibration positions [m]
    values : (n, 3) what to add there [m]
    kernel : by default the best of `compare`; none where correcting predicts a left-out node no
        better than leaving it as it is

    Its `error` is the rms error at left-out nodes [m], NaN where the kernel cannot tell.

    Raises ValueError where the nodes enclose no volume.
    """

    def __init__(
        self, nodes: np.ndarray, values: np.ndarray, kernel: Kernel | None = None
    ) -> None:
        if len(nodes) < 4 or np.linalg.matrix_rank(nodes - nodes[0], tol=_tolerance(nodes)) < 3:
            raise ValueError(f'{len(nodes)} correction nodes enclose no volume; calibrate again')
        self.kernel = kernel
        if kernel is None:
            best, self.error = compare(nodes, values)[0]
            self.kernel = best if self.error < _rms(values) else None
            self.error = min(self.error, _rms(values))
        else:
            errors = leave_one_out(nodes, values, kernel)
            self.error = float('nan') if errors is None else _rms(errors)
        self._middle, self._half = _scaling(nodes)
        scaled = (nodes - self._middle) / self._half
        self._walls = ConvexHull(scaled).equations
        self._values = None
        if self.kernel is not None:
            self._values = RBFInterpolator(
                scaled, values, kernel=self.kernel.name, degree=self.kernel.degree,
                smoothing=self.kernel.smoothing,
            )

    def inside(self, centres: np.ndarray) -> np.ndarray:
        """(n,) whether estimated centres (n, 3) lie in the calibrated volume, `MARGIN` added."""
        scaled = (centres - self._middle) / self._half
        height = scaled @ self._walls[:, :3].T + self._walls[:, 3]
        return (height <= 2.0 * MARGIN).all(axis=1)

    def __call__(self, centres: np.ndarray) -> np.ndarray:
        """(n, 3) what to add to estimated centres (n, 3) [m]; ask `inside` first."""
        if self._values is None or not len(centres):
            return np.zeros_like(centres)
        return self._values((centres - self._middle) / self._half)


def leave_one_out(nodes: np.ndarray, values: np.ndarray, kernel: Kernel) -> np.ndarray | None:
    """(n, 3) error at each node of the correction made from the others [m].

    In closed form (S. Rippa, Adv. Comput. Math. 11, 1999): the coefficient of a node over the
    diagonal of the inverse. None where the nodes do not determine the kernel's polynomial.
    """
    middle, half = _scaling(nodes)
    scaled = (nodes - middle) / half
    distance = np.linalg.norm(scaled[:, np.newaxis] - scaled, axis=2)
    count = len(nodes)
    powers = _powers(scaled, kernel.degree)
    size = count + len(powers)
    if count <= len(powers):
        return None
    matrix = np.zeros((size, size))
    matrix[:count, :count] = _PROFILE[kernel.name](distance) + kernel.smoothing * np.eye(count)
    for column, power in enumerate(powers, start=count):
        matrix[:count, column] = matrix[column, :count] = power
    if np.linalg.cond(matrix) > _MAX_CONDITION:
        return None
    inverse = np.linalg.inv(matrix)
    diagonal = np.diag(inverse)[:count]
    # A node that alone determines a part of the polynomial cannot be left out.
    if (np.abs(diagonal) < np.abs(inverse).max() / _MAX_CONDITION).any():
        return None
    return (inverse[:count, :count] @ values) / diagonal[:, np.newaxis]


def compare(nodes: np.ndarray, values: np.ndarray) -> list[tuple[Kernel, float]]:
    """Every kernel that the nodes allow and its rms leave-one-out error [m], the best first.

    Most nodes of a small cube lie on its surface, where leaving one out asks for more than
    interpolation does: the errors rank the kernels, they are no bound of what is left.
    """
    found = []
    for kernel in KERNELS:
        errors = leave_one_out(nodes, values, kernel)
        if errors is not None:
            found.append((kernel, _rms(errors)))
    return sorted(found, key=lambda pair: pair[1])


def local_scatter(nodes: np.ndarray, values: np.ndarray) -> tuple[float, int]:
    """What no smooth correction can know: standard deviation per component [m], freedom.

    Scatter of the correction about a polynomial of the second degree: speckle, noise and the
    machine's positioning. On the 27 points of a cube a little of the inclination error is in it.
    NaN and 0 where there are no more nodes than the polynomial has terms.
    """
    middle, half = _scaling(nodes)
    powers = np.column_stack(_powers((nodes - middle) / half, 2))
    freedom = len(nodes) - powers.shape[1]
    if freedom < 1:
        return float('nan'), 0
    left = values - powers @ np.linalg.lstsq(powers, values, rcond=None)[0]
    return float(np.sqrt((left**2).sum() / (3 * freedom))), 3 * freedom


def _powers(scaled: np.ndarray, degree: int) -> list[np.ndarray]:
    """(n,) each: products of the coordinates up to a degree; none for degree -1."""
    return [
        np.prod(scaled[:, list(columns)], axis=1)
        for order in range(degree + 1)
        for columns in combinations_with_replacement(range(3), order)
    ]


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def _scaling(nodes: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle (3,) and half the size of the nodes' box: kernels are well conditioned on +-1."""
    lower, upper = nodes.min(axis=0), nodes.max(axis=0)
    return (lower + upper) / 2.0, float((upper - lower).max()) / 2.0


def _tolerance(nodes: np.ndarray) -> float:
    return 0.01 * float(np.ptp(nodes, axis=0).max())
