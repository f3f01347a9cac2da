"""Where a laser's beam meets the sphere and what the laser reads (Eq. 5-2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_estimation.records import NestCalibration, Status


@dataclass(frozen=True)
class Limits:
    """What a laser can measure.

    lower, upper : readings [m]
    incidence : largest angle between beam and surface normal that still returns light [rad]
    """

    lower: float
    upper: float
    incidence: float


@dataclass(frozen=True)
class Strike:
    """Where beams meet spheres; NaN where a beam misses.

    reading : (n, lasers) [m]
    normal : (n, lasers, 3) outward unit normal of the sphere at the spot: the spot's place on it
    incidence : (n, lasers) angle between beam and normal [rad]
    """

    reading: np.ndarray
    normal: np.ndarray
    incidence: np.ndarray


def strike(nest: NestCalibration, centres: np.ndarray) -> Strike:
    """Readings of a nest for sphere centres (n, 3), relative to the initial position [m].

    |P_i0 + d_i V_i - x| = R is quadratic in d_i. Of its two solutions the laser sees the one on
    the side that V_i points to: the sphere moves along V_i towards the laser.
    """
    ray = nest.spot - centres[:, np.newaxis]
    along = np.einsum('nij,ij->ni', ray, nest.direction)
    across = ray - along[..., np.newaxis] * nest.direction
    square = nest.sphere_radius**2 - np.einsum('nij,nij->ni', across, across)
    half = np.sqrt(np.where(square >= 0.0, square, np.nan))
    normal = (across + half[..., np.newaxis] * nest.direction) / nest.sphere_radius
    incidence = np.arccos(np.minimum(half / nest.sphere_radius, 1.0))
    return Strike(half - along + _zero(nest), normal, incidence)


def readings(
    nest: NestCalibration, centres: np.ndarray, limits: Limits
) -> tuple[np.ndarray, np.ndarray]:
    """Readings (n, lasers) [m], NaN without signal, and their status (n, lasers) uint8."""
    found = strike(nest, centres)
    lost = ~(found.incidence <= limits.incidence)
    beyond = (found.reading < limits.lower) | (found.reading > limits.upper)
    status = np.where(beyond, Status.OUT_OF_RANGE, Status.VALID)
    status = np.where(lost, Status.NO_SIGNAL, status).astype(np.uint8)
    return np.where(lost, np.nan, found.reading), status


def _zero(nest: NestCalibration) -> np.ndarray | float:
    return nest.zero if nest.zero.size else 0.0
