"""Contact sensors nest: its calibration and the sphere centre (section 2.2.2)."""

from __future__ import annotations

import numpy as np

from rtest_estimation.average import Average
from rtest_estimation.records import NestCalibration

# A nest whose gauges look into nearly one plane turns noise into displacement; the usual nest
# (three gauges tilted 45 degrees) has a condition number of 1.4.
MAX_CONDITION = 20.0
MIN_POSITIONS = 8
# A contact gauge shows what the sphere moves along it. What is further off is no gain of a gauge
# but a wrong unit or decimal point, or a gauge that does not touch.
_GAIN = (0.8, 1.25)
# A gauge in its range that touches and is fixed follows the steps better than this share of them;
# a ball as its tip rolls over the sphere and leaves some hundredths.
_MISFIT = 0.1
# What a wrong setting would make of a gain of one.
_FACTORS = {
    25.4: 'inch instead of mm', 1 / 25.4: 'mm instead of inch', 1000.0: 'mm instead of um',
    0.001: 'um instead of mm', 10.0: 'one decimal too few', 0.1: 'one decimal too many',
    100.0: 'two decimals too few', 0.01: 'two decimals too many', 2.0: 'diameter, not radius',
    0.5: 'radius, not diameter',
}


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
    for gauge, one in enumerate(gain, 1):
        if not _GAIN[0] < one < _GAIN[1]:
            raise CalibrationError(
                f'gauge {gauge} moves {one:.3g} m per metre of the sphere; {_reason(one)}'
            )
    direction = vectors / gain[:, None]
    condition = float(np.linalg.cond(direction))
    if condition > MAX_CONDITION:
        raise CalibrationError(
            f'the gauges look nearly into one plane (condition {condition:.0f}); realign the nest'
        )
    left = readings - design @ solution
    misfit = np.sqrt((left**2).mean(axis=0))
    worst = int(np.argmax(misfit))
    if misfit[worst] > _MISFIT * spread[0] / np.sqrt(count):
        raise CalibrationError(
            f'gauge {worst + 1} does not follow the steps of the sphere, '
            f'{misfit[worst] * 1e6:.1f} µm are left; does it touch the sphere, is it fixed, '
            'is it in its range?'
        )
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


def _reason(gain: float) -> str:
    """What may have made a gain that a gauge does not have."""
    for factor, words in _FACTORS.items():
        if abs(gain / factor - 1.0) < 0.03:
            return f'is its unit right ({words})?'
    return 'is it connected, does it touch the sphere, is its unit right?'


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
