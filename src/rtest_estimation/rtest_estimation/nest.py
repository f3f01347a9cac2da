"""Contact sensors nest: its calibration and the sphere centre (section 2.2.2)."""

from __future__ import annotations

import numpy as np

from rtest_estimation.average import Average
from rtest_estimation.records import NestCalibration

# A nest whose gauges look into nearly one plane turns noise into displacement; the usual nest
# (three gauges tilted 45 degrees) has a condition number of 1.4.
MAX_CONDITION = 20.0
MIN_POSITIONS = 8


class CalibrationError(ValueError):
    """The positions do not calibrate the nest; the message says why and what to do."""


def calibrate(
    positions: np.ndarray,
    readings: np.ndarray,
    calibration: str,
    setup: str,
    stamp: int,
    sphere_radius: float = float('nan'),
) -> NestCalibration:
    """Directions of the gauges from known steps of the sphere (Eq. 2-5).

    d_ij = V_i . x_j + z_i is linear in V_i and in the reading z_i at the initial position (gauges
    are incremental: Eq. 2-5 has z_i = 0). V_i is then made a unit vector; how far it was from one
    is the gain of the gauge against the machine's scales.

    Parameters
    ----------
    positions : (n, 3) encoder positions of the sphere relative to the first, frame ``table``
        at B = C = 0 [m]
    readings : (n, gauges) mean readings there [m]

    Raises CalibrationError.
    """
    count, gauges = readings.shape
    if count < MIN_POSITIONS:
        raise CalibrationError(
            f'{count} valid positions, at least {MIN_POSITIONS} are needed; repeat the calibration'
        )
    if gauges < 3:
        raise CalibrationError(f'{gauges} gauges, a sphere centre needs three')
    design = np.column_stack([positions, np.ones(count)])
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    if spread[-1] < 0.05 * spread[0] or not spread[0] > 0.0:
        raise CalibrationError('the positions do not span three directions; check the plan')
    solution, *_ = np.linalg.lstsq(design, readings, rcond=None)
    vectors, zero = solution[:3].T, solution[3]
    gain = np.linalg.norm(vectors, axis=1)
    if not (gain > 0.1).all():
        dead = int(np.argmin(gain)) + 1
        raise CalibrationError(
            f'gauge {dead} moves {gain.min():.3f} m per metre of the sphere; is it connected?'
        )
    direction = vectors / gain[:, None]
    condition = float(np.linalg.cond(direction))
    if condition > MAX_CONDITION:
        raise CalibrationError(
            f'the gauges look nearly into one plane (condition {condition:.0f}); realign the nest'
        )
    left = readings - design @ solution
    variance = (left**2).sum(axis=0) / (count - 4)
    cofactor = np.linalg.inv(design.T @ design)[:3, :3]
    along = np.einsum('gi,ij,gj->g', direction, cofactor, direction)
    # Only what turns a unit vector can be wrong with it.
    across = np.eye(3) - np.einsum('gi,gj->gij', direction, direction)
    covariance = variance[:, None, None] * (across @ cofactor @ across)
    estimated = (readings - zero) @ np.linalg.pinv(direction).T
    residual = float(np.sqrt(((estimated - positions) ** 2).sum(axis=1).mean()))
    return NestCalibration(
        calibration, setup, stamp, direction, residual, sphere_radius,
        covariance=covariance, zero=zero, gain=gain,
        gain_stddev=np.sqrt(variance * along), condition=condition,
    )


def centres(nest: NestCalibration, readings: np.ndarray) -> np.ndarray:
    """Sphere centres from readings of all gauges (Eq. 2-6; least squares with four).

    readings : (n, gauges) [m]. Returns (n, 3), frame ``table``, relative to the sphere's position
    at the start of the nest calibration [m].
    """
    zero = nest.zero if nest.zero.size else 0.0
    return (readings - zero) @ np.linalg.pinv(nest.direction).T


def centre(nest: NestCalibration, mean: Average) -> tuple[np.ndarray, np.ndarray, float]:
    """Sphere centre of one dwell: (3,) position [m], (3, 3) covariance [m2], disagreement [m].

    Works on the gauges that were valid, at least three. The disagreement is the rms of what four
    gauges leave of each other, 0 with three.
    """
    direction = nest.direction[mean.gauges]
    zero = nest.zero[mean.gauges] if nest.zero.size else 0.0
    inverse = np.linalg.pinv(direction)
    position = inverse @ (mean.mean - zero)
    surplus = len(mean.gauges) - 3
    left = mean.mean - zero - direction @ position
    disagreement = float(np.sqrt((left**2).sum() / surplus)) if surplus else 0.0
    return position, inverse @ mean.covariance @ inverse.T, disagreement
