"""Nest calibration and sphere centre against known directions and Monte Carlo."""

import numpy as np
import pytest

from rtest_estimation.average import Average
from rtest_estimation.nest import CalibrationError, calibrate, centre, centres

TILT = np.radians(45)


def directions(count):
    turn = np.arange(count) * 2 * np.pi / count + 0.3
    return np.column_stack(
        [np.sin(TILT) * np.cos(turn), np.sin(TILT) * np.sin(turn), np.full(count, np.cos(TILT))]
    )


def steps(size=1e-3):
    one = np.vstack([[np.zeros(3), size * e, -size * e] for e in np.eye(3)]).reshape(-1, 3)
    return np.vstack([one, one, one, [np.zeros(3)]])


def made(count=3, noise=0.0, seed=1, gain=1.0, zero=2e-5):
    rng = np.random.default_rng(seed)
    positions = steps()
    readings = gain * positions @ directions(count).T + zero
    return positions, readings + noise * rng.normal(size=readings.shape)


@pytest.mark.parametrize('count', [3, 4])
def test_exact_readings_give_exact_directions(count):
    nest = calibrate(*made(count), 'id', '1a', 5)
    np.testing.assert_allclose(nest.direction, directions(count), atol=1e-12)
    np.testing.assert_allclose(nest.zero, 2e-5, atol=1e-15)
    assert nest.residual < 1e-15
    assert (nest.calibration, nest.setup, nest.stamp) == ('id', '1a', 5)


def test_hand_case_orthogonal_gauges():
    # Gauges along the axes: a step of 1 mm along X is read by the first gauge alone.
    positions = steps()
    nest = calibrate(positions, positions.copy(), 'id', '1a', 0)
    np.testing.assert_allclose(nest.direction, np.eye(3), atol=1e-12)
    found = centres(nest, np.array([[1e-6, 0, 0]]))
    np.testing.assert_allclose(found, [[1e-6, 0, 0]], atol=1e-18)
    assert nest.condition == pytest.approx(1.0)


def test_stated_covariance_of_directions_matches_monte_carlo():
    found = []
    for seed in range(400):
        nest = calibrate(*made(noise=3e-7, seed=seed), 'id', '1a', 0)
        found.append((nest.direction - directions(3))[1])
    scatter = np.cov(np.array(found).T)
    np.testing.assert_allclose(
        np.sqrt(np.diag(scatter)), np.sqrt(np.diag(nest.covariance[1])), rtol=0.5
    )
    # The mean of the stated variances is less noisy than one: within Monte Carlo error.
    stated = np.mean(
        [np.trace(calibrate(*made(noise=3e-7, seed=s), 'i', 's', 0).covariance[1])
         for s in range(100)]
    )
    assert np.trace(scatter) == pytest.approx(stated, rel=0.15)


def test_gain_is_found_and_direction_stays_unit():
    nest = calibrate(*made(gain=1.01), 'id', '1a', 0)
    np.testing.assert_allclose(nest.gain, 1.01, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(nest.direction, axis=1), 1.0, rtol=1e-12)


def test_four_gauges_report_their_disagreement_and_survive_the_loss_of_one():
    nest = calibrate(*made(4), 'id', '1a', 0)
    moved = np.array([3e-6, -2e-6, 1e-6])
    readings = directions(4) @ moved + 2e-5
    readings[3] += 2e-6
    position, _, disagreement = centre(nest, average_of(readings, range(4)))
    # The residual of one surplus reading, 2 um times its share left by the fit (1/2 by symmetry).
    assert disagreement == pytest.approx(1e-6, rel=1e-6)
    position, _, disagreement = centre(nest, average_of(readings[:3], range(3)))
    np.testing.assert_allclose(position, moved, atol=1e-15)
    assert disagreement == 0.0


def average_of(mean, gauges):
    gauges = np.array(list(gauges))
    return Average(gauges, np.asarray(mean), np.eye(len(gauges)) * 1e-16, 10, 0)


def test_covariance_of_a_centre_matches_monte_carlo():
    nest = calibrate(*made(), 'id', '1a', 0)
    rng = np.random.default_rng(7)
    noise = 1e-7 * rng.normal(size=(20000, 3))
    scatter = np.cov(centres(nest, noise + 2e-5).T)
    _, stated, _ = centre(nest, Average(np.arange(3), np.zeros(3), 1e-14 * np.eye(3), 10, 0))
    np.testing.assert_allclose(scatter, stated, atol=0.05 * stated.max())


@pytest.mark.parametrize(
    ('positions', 'readings', 'words'),
    [
        (steps()[:5], np.zeros((5, 3)), 'at least 8'),
        (steps() * [1, 1, 0], np.zeros((28, 3)), 'span'),
        (steps(), steps() @ np.zeros((3, 3)), 'connected'),
        (steps(), steps() @ np.array([[1, 0, 0], [1, 1e-2, 0], [1, 0, 1e-2]]).T, 'one plane'),
        (steps(), np.zeros((28, 2)), 'three'),
    ],
)
def test_a_useless_calibration_is_refused(positions, readings, words):
    with pytest.raises(CalibrationError, match=words):
        calibrate(positions, readings, 'id', '1a', 0)


@pytest.mark.parametrize(
    ('factor', 'words'),
    [
        (25.4, 'gauge 2 moves 25.4 m per metre of the sphere; is its unit right .inch instead'),
        (1e-3, 'um instead of mm'), (0.1, 'one decimal too many'), (0.0, 'is it connected'),
        (1.3, 'does it touch'),
    ],
)
def test_a_wrong_unit_of_one_gauge_is_refused(factor, words):
    positions, readings = made()
    readings[:, 1] *= factor
    with pytest.raises(CalibrationError, match=words):
        calibrate(positions, readings, 'id', '1a', 0)


def test_a_gauge_that_does_not_follow_is_refused():
    positions, readings = made(noise=3e-7)
    # At its stop: half of the range is not shown.
    readings[:, 2] = np.maximum(readings[:, 2], 0.0)
    with pytest.raises(CalibrationError, match='gauge 3 .*(does not follow|moves)'):
        calibrate(positions, readings, 'id', '1a', 0)
    calibrate(*made(noise=2e-6), 'id', '1a', 0)
