"""Robust mean of the readings of one dwell, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_estimation.records import Status

# Readings farther from the median than this many robust standard deviations are left out. Of
# normal noise less than one in a million is; a spike of a contact gauge is many times farther.
OUTLIER_SIGMAS = 5.0
# Normal distribution: standard deviation over median absolute deviation, and over mean absolute
# deviation (the fallback where more than half of the readings are equal, coarse resolution).
_SIGMA_OF_MAD = 1.4826
_SIGMA_OF_MEAN_DEVIATION = 1.2533
# No gauge reads farther [m]; a recording may hold any number.
MAX_READING = 1.0
# Fewer readings than this give no covariance worth the name.
MIN_READINGS = 3


@dataclass(frozen=True)
class Average:
    """Mean of simultaneous readings.

    gauges : (m,) channels that were valid
    mean : (m,) [m]
    covariance : (m, m) of the mean [m2]
    readings : rows that were averaged; outliers : rows left out as outliers
    """

    gauges: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    readings: int
    outliers: int


class NoAverageError(ValueError):
    """The readings give no mean; the message is the reason, for a person to read."""


def average(displacement: np.ndarray, status: np.ndarray, needed: int = 3) -> Average:
    """Mean and covariance of the mean of the readings taken while nothing moved.

    A gauge takes part when most of its readings are valid numbers; a reading takes part when
    all these gauges are valid in it and none is an outlier.

    Parameters
    ----------
    displacement : (n, channels) [m]
    status : (n, channels), see `Status`
    needed : how many gauges a sphere centre needs

    Raises NoAverageError with the reason.
    """
    if not len(displacement):
        raise NoAverageError('no gauge readings')
    valid = (status == Status.VALID) & (np.abs(displacement) < MAX_READING)
    gauges = np.flatnonzero(valid.mean(axis=0) > 0.5)
    if len(gauges) < needed:
        raise NoAverageError(_why_invalid(displacement, status, valid))
    rows = valid[:, gauges].all(axis=1)
    values = displacement[rows][:, gauges]
    if len(values) < MIN_READINGS:
        raise NoAverageError(f'only {len(values)} valid readings, {MIN_READINGS} are needed')
    kept = values[inliers(values)]
    if len(kept) < MIN_READINGS:
        raise NoAverageError(f'only {len(kept)} of {len(values)} readings agree with each other')
    scatter = np.atleast_2d(np.cov(kept, rowvar=False))
    return Average(
        gauges, kept.mean(axis=0), scatter / len(kept), len(kept), len(values) - len(kept)
    )


def inliers(values: np.ndarray) -> np.ndarray:
    """(n,) whether a row of (n, m) is within `OUTLIER_SIGMAS` of the median in every column."""
    deviation = np.abs(values - np.median(values, axis=0))
    sigma = _SIGMA_OF_MAD * np.median(deviation, axis=0)
    coarse = _SIGMA_OF_MEAN_DEVIATION * deviation.mean(axis=0)
    sigma = np.where(sigma > 0.0, sigma, coarse)
    return (deviation <= OUTLIER_SIGMAS * sigma).all(axis=1)


def _why_invalid(displacement: np.ndarray, status: np.ndarray, valid: np.ndarray) -> str:
    words = {
        Status.OUT_OF_RANGE: 'out of range',
        Status.NO_SIGNAL: 'no signal',
        Status.DEVICE_ERROR: 'device error',
    }
    parts = []
    for gauge in np.flatnonzero(valid.mean(axis=0) <= 0.5):
        codes = status[:, gauge]
        code = int(np.bincount(codes[~valid[:, gauge]]).argmax())
        word = words.get(code, 'not a finite number') if code else 'not a finite number'
        parts.append(f'gauge {gauge + 1} {word} in {np.sum(~valid[:, gauge])} of {len(codes)}')
    return ', '.join(parts) + ' readings'
