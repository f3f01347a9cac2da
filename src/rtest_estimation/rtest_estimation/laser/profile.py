"""Profile measurement of a sphere with one laser: what the laser is good for (section 5.3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

# Products of powers up to this degree follow the incidence error; what they leave is noise.
_DEGREE = 5
# Errors and flatness that count as none, section 5.3.3-(3) [m].
TOLERANCE = 1e-6


@dataclass(frozen=True)
class SphereProfile:
    """A sphere as a laser sees it, against the sphere as it is.

    top : (2,) position at which the beam points to the sphere centre [m]
    height : reading there [m]
    error : (n,) profile measurement error: reading minus best-fit sphere [m], NaN without signal
    smooth : (n,) its part that depends on the place on the sphere [m], NaN without signal
    noise : standard deviation of the rest [m]; the noise level of Table 5-2
    flat : area 1, the distance from the top within which the reading itself changes by less than
        the tolerance [m]
    accurate : area 2, within which the smooth error is smaller than the tolerance [m]
    measurable : area 3, within which every reading is valid [m]; area 4 is what lies beyond
    bounded : whether a reading without signal ended area 3; otherwise the scan did
    """

    top: np.ndarray
    height: float
    error: np.ndarray
    smooth: np.ndarray
    noise: float
    flat: float
    accurate: float
    measurable: float
    bounded: bool


def measure_profile(
    positions: np.ndarray,
    reading: np.ndarray,
    valid: np.ndarray,
    radius: float,
    tolerance: float = TOLERANCE,
) -> SphereProfile:
    """Evaluate a scan over the top of a sphere of known radius [m].

    Centre and height of the sphere are fitted. A beam that is not quite parallel to the normal
    of the scanned plane looks like a shift of the top, and changes nothing else that can be seen.

    Parameters
    ----------
    positions : (n, 2) of the sphere across the beam, from the encoders [m]
    reading : (n,) [m], larger where the surface is nearer
    valid : (n,) whether there was a signal
    tolerance : of areas 1 and 2 [m]

    Raises ValueError where too few readings are valid.
    """
    valid = valid & np.isfinite(reading)
    powers = [(i, k - i) for k in range(_DEGREE + 1) for i in range(k + 1)]
    if valid.sum() < 3 * len(powers):
        raise ValueError(
            f'{int(valid.sum())} readings with signal, {3 * len(powers)} are needed; scan the '
            'sphere in lines over its top'
        )
    place, value = positions[valid], reading[valid]
    top, height = _best_sphere(place, value, radius)
    error = np.full(len(reading), np.nan)
    error[valid] = value - _sphere(place, top, height, radius)
    scale = np.abs(place - top).max()
    u, v = ((place - top) / scale).T
    design = np.stack([u**i * v**k for i, k in powers], axis=1)
    coefficients, *_ = np.linalg.lstsq(design, error[valid], rcond=None)
    smooth = np.full(len(reading), np.nan)
    smooth[valid] = design @ coefficients
    left = error[valid] - smooth[valid]
    distance = np.linalg.norm(positions - top, axis=1)
    change = np.full(len(reading), np.inf)
    change[valid] = np.abs(_sphere(place, top, 0.0, radius) + smooth[valid] - coefficients[0])
    edge = distance[valid].max()
    measurable = _reach(distance, ~valid, edge)
    return SphereProfile(
        top, height, error, smooth,
        float(np.sqrt((left**2).sum() / (len(left) - len(powers)))),
        _reach(distance, change > tolerance, measurable),
        _reach(distance, ~(np.abs(smooth) <= tolerance), measurable),
        measurable,
        bool((~valid).any()),
    )


def _reach(distance: np.ndarray, bad: np.ndarray, farthest: float) -> float:
    """Distance of the nearest bad point; the farthest where there is none."""
    return float(min(distance[bad].min(initial=np.inf), farthest))


def _sphere(place: np.ndarray, top: np.ndarray, height: float, radius: float) -> np.ndarray:
    """(n,) reading over a perfect sphere."""
    across = ((place - top) ** 2).sum(axis=1)
    return height - across / (radius + np.sqrt(np.maximum(radius**2 - across, 0.0)))


def _best_sphere(
    place: np.ndarray, value: np.ndarray, radius: float
) -> tuple[np.ndarray, float]:
    """Top (2,) and height of the least-squares sphere."""
    highest = int(np.argmax(value))
    first, height = place[highest], float(value[highest])

    # Unknown is the way from the first guess: a step is limited by the size of what it starts
    # from, which must be zero and not next to it.
    def misfit(unknown: np.ndarray) -> np.ndarray:
        return value - _sphere(place, first + unknown[:2], height + unknown[2], radius)

    def slope(unknown: np.ndarray) -> np.ndarray:
        across = place - first - unknown[:2]
        rise = np.sqrt(np.maximum(radius**2 - (across**2).sum(axis=1), (0.1 * radius) ** 2))
        return -np.column_stack([across / rise[:, np.newaxis], np.ones(len(place))])

    found = least_squares(misfit, np.zeros(3), slope, method='lm', x_scale='jac')
    if not found.success:
        raise ValueError(f'the readings fit no sphere of {radius * 1e3:.3f} mm radius')
    return first + found.x[:2], height + float(found.x[2])
