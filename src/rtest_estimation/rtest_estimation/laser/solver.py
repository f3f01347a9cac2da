"""Sphere centres from the readings of a laser nest, whole blocks at once (Eqs. 5-4, 5-9)."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from rtest_estimation.average import Average, NoAverageError
from rtest_estimation.laser.correction import Correction, Kernel
from rtest_estimation.records import NestCalibration

# The last step of the iteration [m]. What is left after it is its square over R with three lasers,
# 1e-14 m and less, and its product with the lasers' disagreement over R with four, 1e-12 m.
CONVERGED = 1e-8
# Newton's steps shrink quadratically: three for a sphere within a millimetre of its initial place.
MAX_STEPS = 20
# Readings solved at a time: what fits into the processor's cache.
_CHUNK = 4096


class CentreStatus(IntEnum):
    """What a sphere centre is worth.

    VALID : in the calibrated volume, corrected
    OUTSIDE : outside of it; the centre is Eq. 5-4's, without correction
    NO_SIGNAL : a reading is missing, no centre
    NO_SOLUTION : no sphere of this radius touches all the spots, no centre
    """

    VALID = 0
    OUTSIDE = 1
    NO_SIGNAL = 2
    NO_SOLUTION = 3


class CentreSolver:
    """Turns readings of one calibrated laser nest into sphere centres.

    Choosing the correction's kernel takes some ten milliseconds: keep the solver of a nest.

    nest : a calibration of kind LASER
    kernel : of the correction; the best by leave-one-out where it is not given

    Raises ValueError where the nest has no correction nodes.
    """

    def __init__(self, nest: NestCalibration, kernel: Kernel | None = None) -> None:
        self.nest = nest
        self.correction = Correction(nest.correction_nodes, nest.correction_values, kernel)
        self._zero = nest.zero if nest.zero.size else np.zeros(len(nest.spot))

    def geometric(self, readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centres (n, 3) of Eq. 5-4 without correction, NaN where `solved` (n,) is false."""
        nest = self.nest
        return geometric_centres(
            nest.spot, nest.direction, nest.sphere_radius, readings - self._zero
        )

    def __call__(self, readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Sphere centres from readings (n, lasers) [m], NaN for a reading that is not valid.

        Returns centres (n, 3), frame ``table``, relative to the sphere's position at the start of
        the nest calibration [m], NaN where there is none, and their `CentreStatus` (n,) uint8.
        """
        found, solved = self.geometric(readings)
        inside = np.zeros(len(found), dtype=bool)
        inside[solved] = self.correction.inside(found[solved])
        found[inside] += self.correction(found[inside])
        status = np.where(inside, CentreStatus.VALID, CentreStatus.OUTSIDE)
        status[~solved] = CentreStatus.NO_SOLUTION
        status[~np.isfinite(readings).all(axis=1)] = CentreStatus.NO_SIGNAL
        return found, status.astype(np.uint8)

    def centre(self, mean: Average) -> tuple[np.ndarray, np.ndarray, float]:
        """Sphere centre of one dwell: (3,) position [m], (3, 3) covariance [m2], disagreement [m].

        The disagreement is the rms of what four lasers leave of each other, 0 with three.

        Raises NoAverageError where a laser is missing (the correction belongs to all of them) or
        the centre is not in the calibrated volume.
        """
        nest = self.nest
        lasers = len(nest.spot)
        if len(mean.gauges) < lasers:
            lost = sorted(set(range(lasers)) - set(mean.gauges.tolist()))
            names = ', '.join(str(number + 1) for number in lost)
            raise NoAverageError(f'laser {names} without valid readings, the nest needs all')
        (position,), (status,) = self(mean.mean[np.newaxis])
        if status == CentreStatus.NO_SOLUTION:
            raise NoAverageError('no sphere touches all the laser spots')
        if status == CentreStatus.OUTSIDE:
            place = ', '.join(f'{value * 1e3:.3f}' for value in position)
            raise NoAverageError(f'sphere at ({place}) mm, outside the calibrated volume')
        (raw,), _ = self.geometric(mean.mean[np.newaxis])
        ray = nest.spot + (mean.mean - self._zero)[:, np.newaxis] * nest.direction - raw
        length = np.linalg.norm(ray, axis=1)
        normal = ray / length[:, np.newaxis]
        # A reading moves its spot along the beam, and only the part along the normal counts.
        slope = np.linalg.pinv(normal) * np.einsum('ij,ij->i', normal, nest.direction)
        surplus = lasers - 3
        left = length - nest.sphere_radius
        disagreement = float(np.sqrt((left**2).sum() / surplus)) if surplus else 0.0
        return position, slope @ mean.covariance @ slope.T, disagreement


def centres(nest: NestCalibration, readings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres and status of readings (n, lasers), see `CentreSolver`, for one-time use."""
    return CentreSolver(nest)(readings)


def geometric_centres(
    spot: np.ndarray, direction: np.ndarray, radius: float, displacement: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least-squares solution x of |P_i0 + d_i V_i - x| = R for every reading (Eq. 5-4).

    Gauss-Newton with the analytic derivative, which for three lasers is Newton's method; every
    3 x 3 system is solved in closed form.

    Parameters
    ----------
    spot, direction : (lasers, 3) P_i0 [m] and unit vectors V_i
    radius : of the sphere [m]
    displacement : (n, lasers) d_i, readings without their zero [m]

    Returns
    -------
    centres (n, 3) [m], NaN where there is none, and (n,) whether the iteration converged to a
    centre less than a radius away from the initial position.
    """
    found = np.full((len(displacement), 3), np.nan)
    solved = np.zeros(len(displacement), dtype=bool)
    for start in range(0, len(displacement), _CHUNK):
        rows = start + np.flatnonzero(
            np.isfinite(displacement[start : start + _CHUNK]).all(axis=1)
        )
        # Coordinates first: every operation runs along the readings.
        spots = spot.T[:, :, None] + direction.T[:, :, None] * displacement[rows].T
        centre, good = _iterate(spots, radius)
        found[rows[good]] = centre.T[good]
        solved[rows] = good
    return found, solved


def _iterate(spots: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres (3, n) from spots (3, lasers, n), and (n,) whether each converged."""
    centre = np.zeros((3, spots.shape[2]))
    good = np.zeros(spots.shape[2], dtype=bool)
    # A reading without a solution may run to infinity; that it did not converge is its status.
    with np.errstate(all='ignore'):
        for _ in range(MAX_STEPS):
            step = _step(spots, centre, radius)
            centre += step
            good = (np.abs(step) < CONVERGED).all(axis=0)
            if good.all():
                break
        good &= (centre**2).sum(axis=0) < radius**2
    return centre, good


def _step(spots: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """(3, n) solution of the normal equations A step = g, by the adjugate of A."""
    ray = spots - centre[:, None]
    length = np.sqrt((ray**2).sum(axis=0))
    x, y, z = ray / length
    left = length - radius
    gx, gy, gz = (x * left).sum(axis=0), (y * left).sum(axis=0), (z * left).sum(axis=0)
    xx, yy, zz = (x * x).sum(axis=0), (y * y).sum(axis=0), (z * z).sum(axis=0)
    xy, xz, yz = (x * y).sum(axis=0), (x * z).sum(axis=0), (y * z).sum(axis=0)
    axx, axy, axz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    ayy, ayz, azz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    determinant = xx * axx + xy * axy + xz * axz
    return np.stack(
        [
            axx * gx + axy * gy + axz * gz,
            axy * gx + ayy * gy + ayz * gz,
            axz * gx + ayz * gy + azz * gz,
        ]
    ) / determinant
