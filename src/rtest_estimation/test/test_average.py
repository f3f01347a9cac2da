"""Robust mean of a dwell."""

import numpy as np
import pytest

from rtest_estimation.average import NoAverageError, average


def readings(seed=3, count=15, channels=3):
    return 1e-7 * np.random.default_rng(seed).normal(size=(count, channels)) + 2e-5


def test_clean_readings_give_the_mean_and_its_covariance():
    values = readings(count=4000)
    result = average(values, np.zeros(values.shape, dtype=np.uint8))
    np.testing.assert_allclose(result.mean, 2e-5, atol=1e-8)
    np.testing.assert_allclose(np.diag(result.covariance), 1e-14 / 4000, rtol=0.1)
    assert (result.readings, result.outliers) == (4000, 0)


def test_spikes_do_not_move_the_mean():
    values = readings()
    clean = average(values, np.zeros(values.shape, dtype=np.uint8)).mean
    values[4, 1] += 5e-5
    values[9, 2] -= 5e-5
    result = average(values, np.zeros(values.shape, dtype=np.uint8))
    assert result.outliers == 2
    np.testing.assert_allclose(result.mean, clean, atol=4e-8)


def test_coarse_gauges_are_not_outliers_of_themselves():
    values = np.full((15, 3), 2e-5)
    values[::4] += 1e-7
    assert average(values, np.zeros(values.shape, dtype=np.uint8)).outliers == 0


def test_half_of_the_readings_lost_is_still_a_mean():
    values, status = readings(), np.zeros((15, 3), dtype=np.uint8)
    status[:7, 0] = 1
    values[:7, 0] = np.nan
    assert average(values, status).readings == 8


def test_a_fourth_gauge_that_fails_is_left_out():
    values, status = readings(channels=4), np.zeros((15, 4), dtype=np.uint8)
    status[:, 2] = 2
    np.testing.assert_array_equal(average(values, status).gauges, [0, 1, 3])


@pytest.mark.parametrize(
    ('code', 'value', 'words'),
    [(1, 0.0, 'gauge 2 out of range in 15 of 15'), (2, 0.0, 'no signal'), (3, 0.0, 'device error'),
     (0, np.nan, 'not a finite number'), (0, np.inf, 'not a finite number')],
)
def test_the_reason_names_gauge_and_cause(code, value, words):
    values, status = readings(), np.zeros((15, 3), dtype=np.uint8)
    status[:, 1], values[:, 1] = code, value
    with pytest.raises(NoAverageError, match=words):
        average(values, status)


def test_no_readings_and_too_few():
    with pytest.raises(NoAverageError, match='no gauge readings'):
        average(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8))
    with pytest.raises(NoAverageError, match='only 2 valid'):
        average(readings(count=2), np.zeros((2, 3), dtype=np.uint8))
