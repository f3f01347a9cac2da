"""How well a laser nest finds known positions (section 5.6.3, Table 5-5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_estimation.laser.solver import CentreSolver, CentreStatus

# 1,183 positions, Fig. 5-16(b); how the thesis divides the cube is not printed.
_LEVELS = (13, 13, 7)


@dataclass(frozen=True)
class Deviation:
    """Distances between commanded and estimated positions [m]: mean, standard deviation, max."""

    mean: float
    std: float
    max: float


@dataclass(frozen=True)
class Verification:
    """Estimated against commanded positions.

    raw : without correction; corrected : with it. Both over the positions whose centre is valid;
        None where there is none
    error : (n, 3) estimated minus commanded position [m], NaN where there is no centre
    raw_error : the same without correction
    status : (n,) `CentreStatus`
    """

    raw: Deviation | None
    corrected: Deviation | None
    error: np.ndarray
    raw_error: np.ndarray
    status: np.ndarray

    def count(self, status: CentreStatus) -> int:
        """How many positions have this status."""
        return int((self.status == status).sum())


def cube(edge: float, levels: tuple[int, int, int]) -> np.ndarray:
    """(n, 3) positions that fill a cube around the initial one, X slowest [m]."""
    axes = [np.linspace(-edge / 2.0, edge / 2.0, count) for count in levels]
    return np.stack(np.meshgrid(*axes, indexing='ij'), axis=-1).reshape(-1, 3)


def verification_positions(edge: float = 1e-3) -> np.ndarray:
    """(1183, 3) positions of section 5.6.3 in a cube of this edge [m]."""
    return cube(edge, _LEVELS)


def verify(solver: CentreSolver, positions: np.ndarray, readings: np.ndarray) -> Verification:
    """Deviations at known positions (n, 3) [m] from readings (n, lasers) [m] there."""
    found, status = solver(readings)
    raw, _ = solver.geometric(readings)
    valid = status == CentreStatus.VALID
    return Verification(
        deviation((raw - positions)[valid]), deviation((found - positions)[valid]),
        found - positions, raw - positions, status,
    )


def deviation(error: np.ndarray) -> Deviation | None:
    """Deviation of errors (n, 3) [m]; None where there is none."""
    if not len(error):
        return None
    distance = np.linalg.norm(error, axis=1)
    return Deviation(float(distance.mean()), float(distance.std()), float(distance.max()))
