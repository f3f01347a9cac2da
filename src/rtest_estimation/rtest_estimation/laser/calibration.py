"""Calibration of a laser nest from known positions of the sphere (Eq. 5-3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from rtest_estimation.laser.solver import geometric_centres
from rtest_estimation.nest import MAX_CONDITION, CalibrationError
from rtest_estimation.records import NestCalibration, NestKind

# Centre and corners of a cube, as in section 5.4.3; a beam has five unknowns.
MIN_POSITIONS = 9
# A reading changes by 1/cos(incidence) per metre along the surface normal. Below one half the
# laser does not follow the sphere, above two its unit or its aim is wrong.
_GAIN = (0.5, 2.0)
# A direction shows in the curvature alone: turning the beam by one radian moves the spots off the
# sphere by about the square of the positions' spread over R. Below this share the positions do not
# show it.
_MIN_TURN = 0.1
# Positions nearer to each other than this share of the calibrated volume are one node of the
# correction: visits of the same position would otherwise make its equations singular.
_SAME_POSITION = 0.02


@dataclass(frozen=True)
class Beam:
    """One calibrated laser.

    spot : (3,) P_i0, where the beam meets the sphere at its initial position [m]
    direction : (3,) unit vector V_i
    zero : reading at the initial position [m]
    covariance : (7, 7) of spot, direction and zero; of rank five, for both vectors have a fixed
        length. To first order: too small for the direction where its standard uncertainty is not
        well below the angle of incidence
    residuals : (n,) distance of each spot from the sphere's surface [m]
    """

    spot: np.ndarray
    direction: np.ndarray
    zero: float
    covariance: np.ndarray
    residuals: np.ndarray


def fit_beam(positions: np.ndarray, reading: np.ndarray, radius: float) -> Beam:
    """Beam of one laser from its readings (n,) at sphere positions (n, 3) [m] (Eq. 5-3).

    |P_i0| = R and |V_i| = 1 hold exactly: each is a point of a sphere, moved in the plane that
    touches it at the first guess and projected back. The reading at the initial position is a
    fifth unknown; the thesis takes it as exact.

    Raises CalibrationError.
    """
    design = np.column_stack([positions, np.ones(len(positions))])
    linear, *_ = np.linalg.lstsq(design, reading, rcond=None)
    gain = float(np.linalg.norm(linear[:3]))
    if not _GAIN[0] < gain < _GAIN[1]:
        raise CalibrationError(
            f'moves {gain:.3f} m per metre of the sphere; is it connected and aimed at the sphere?'
        )
    first = linear[:3] / gain
    # Two unit vectors across the first guess.
    plane = np.linalg.svd(first[np.newaxis])[2][1:].T
    unknown = np.append(np.zeros(4), linear[3])

    def misfit(values: np.ndarray) -> np.ndarray:
        return _misfit(positions, reading, radius, first, plane, values)[0]

    def slope(values: np.ndarray) -> np.ndarray:
        return _misfit(positions, reading, radius, first, plane, values)[1]

    found = least_squares(
        misfit, unknown, slope, method='lm', x_scale='jac', ftol=1e-14, xtol=1e-14, gtol=1e-14
    )
    turn = np.linalg.svd(found.jac[:, 2:4], compute_uv=False)[-1] / np.sqrt(len(reading))
    if not turn > _MIN_TURN * positions.var(axis=0).mean() / radius:
        raise CalibrationError(
            'the positions do not show the direction of its beam; move the sphere over a cube'
        )
    if not found.success:
        raise CalibrationError(f'the readings fit no sphere of {radius * 1e3:.3f} mm radius')
    normal, normal_slope = _project(first, plane, found.x[:2])
    direction, direction_slope = _project(first, plane, found.x[2:4])
    variance = 2.0 * found.cost / (len(reading) - 5)
    length = np.linalg.norm(found.jac, axis=0)
    scaled = found.jac / length
    cofactor = np.linalg.inv(scaled.T @ scaled) / np.outer(length, length)
    spread = np.zeros((7, 5))
    spread[:3, :2] = radius * normal_slope
    spread[3:6, 2:4] = direction_slope
    spread[6, 4] = 1.0
    return Beam(
        radius * normal, direction, float(found.x[4]), variance * spread @ cofactor @ spread.T,
        found.fun,
    )


def calibrate(
    positions: np.ndarray,
    readings: np.ndarray,
    calibration: str,
    setup: str,
    stamp: int,
    sphere_radius: float = float('nan'),
) -> NestCalibration:
    """Beams of a laser nest and the nodes of its correction (Eqs. 5-3, 5-5).

    The residual of the result is the rms distance between commanded and estimated positions
    without the correction: at the nodes themselves the corrected one would say nothing.

    Parameters
    ----------
    positions : (n, 3) encoder positions of the sphere relative to the first, frame ``table``
        at B = C = 0 [m]; the 27 points of a cube or more
    readings : (n, lasers) mean readings there [m]
    sphere_radius : [m]

    Raises CalibrationError.
    """
    count, lasers = readings.shape
    if not sphere_radius > 0.0:
        raise CalibrationError('a laser nest needs the radius of the sphere; configure it')
    if count < MIN_POSITIONS:
        raise CalibrationError(
            f'{count} valid positions, at least {MIN_POSITIONS} are needed; repeat the calibration'
        )
    if lasers < 3:
        raise CalibrationError(f'{lasers} lasers, a sphere centre needs three')
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if spread[-1] < 0.05 * spread[0] or not spread[0] > 0.0:
        raise CalibrationError('the positions do not span three directions; check the plan')
    beams = []
    for number, reading in enumerate(readings.T, start=1):
        try:
            beams.append(fit_beam(positions, reading, sphere_radius))
        except CalibrationError as error:
            raise CalibrationError(f'laser {number}: {error}') from None
    spot = np.array([beam.spot for beam in beams])
    condition = float(np.linalg.cond(spot))
    if condition > MAX_CONDITION:
        raise CalibrationError(
            f'the lasers look nearly into one plane (condition {condition:.0f}); realign the nest'
        )
    direction = np.array([beam.direction for beam in beams])
    zero = np.array([beam.zero for beam in beams])
    estimated, solved = geometric_centres(spot, direction, sphere_radius, readings - zero)
    if not solved.all():
        raise CalibrationError(
            f'no sphere centre at {int((~solved).sum())} of {count} positions; is one reading '
            'of another moment or of another surface?'
        )
    group = _same_positions(positions)
    nodes = np.array([estimated[group == g].mean(axis=0) for g in range(group.max() + 1)])
    visited = np.array([positions[group == g].mean(axis=0) for g in range(group.max() + 1)])
    residual = float(np.sqrt(((estimated - positions) ** 2).sum(axis=1).mean()))
    return NestCalibration(
        calibration, setup, stamp, direction, residual, sphere_radius, NestKind.LASER,
        covariance=np.array([beam.covariance[3:6, 3:6] for beam in beams]), zero=zero,
        condition=condition, spot=spot, correction_nodes=nodes, correction_values=visited - nodes,
    )


def _project(
    base: np.ndarray, plane: np.ndarray, step: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unit vector (3,) at a step (2,) in the touching plane, and its derivative (3, 2)."""
    vector = base + plane @ step
    length = np.linalg.norm(vector)
    unit = vector / length
    return unit, (plane - np.outer(unit, unit @ plane)) / length


def _misfit(
    positions: np.ndarray,
    reading: np.ndarray,
    radius: float,
    base: np.ndarray,
    plane: np.ndarray,
    unknown: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) of the spots from the sphere [m] and the derivative (n, 5).

    unknown : steps of the spot's normal (2) and of the beam's direction (2) [rad], zero [m].
    """
    normal, normal_slope = _project(base, plane, unknown[:2])
    direction, direction_slope = _project(base, plane, unknown[2:4])
    along = reading - unknown[4]
    ray = radius * normal + np.multiply.outer(along, direction) - positions
    length = np.linalg.norm(ray, axis=1)
    unit = ray / length[:, np.newaxis]
    jacobian = np.column_stack(
        [
            radius * unit @ normal_slope,
            along[:, np.newaxis] * (unit @ direction_slope),
            -unit @ direction,
        ]
    )
    return length - radius, jacobian


def _same_positions(positions: np.ndarray) -> np.ndarray:
    """(n,) number of the distinct position each one belongs to, in order of the first visit."""
    near = _SAME_POSITION * np.ptp(positions, axis=0).max()
    first: list[np.ndarray] = []
    group = np.empty(len(positions), dtype=int)
    for row, position in enumerate(positions):
        distance = [np.linalg.norm(position - one) for one in first]
        if distance and min(distance) < near:
            group[row] = int(np.argmin(distance))
        else:
            group[row] = len(first)
            first.append(position)
    return group
