"""Sphere centres of a laser nest against the closed form, SciPy, finite differences and noise."""

from dataclasses import replace

import numpy as np
import pytest
from laser_case import RADIUS, bisect, cube, directions, nest, spots
from scipy.optimize import least_squares

from rtest_estimation.average import Average, NoAverageError
from rtest_estimation.laser import CentreSolver, CentreStatus, centres
from rtest_estimation.laser.correction import THESIS
from rtest_estimation.laser.solver import MAX_STEPS, geometric_centres


def trilaterate(points, radius):
    """Centre of the sphere through three points, on the side of the origin, in closed form."""
    a, b, c = points
    u, v = b - a, c - a
    normal = np.cross(u, v)
    middle = a + np.cross(u @ u * v - v @ v * u, normal) / (2 * normal @ normal)
    height = np.sqrt(radius**2 - (middle - a) @ (middle - a)) * normal / np.linalg.norm(normal)
    return min((middle + height, middle - height), key=np.linalg.norm)


def some(count=200, size=4e-4):
    return np.random.default_rng(2).uniform(-size, size, (count, 3))


@pytest.mark.parametrize('count', [3, 4])
def test_readings_lead_back_to_the_centres(count):
    true = some()
    readings = bisect(spots(count), directions(count), true) + 1e-4
    found, status = centres(nest(count, zero=1e-4), readings)
    np.testing.assert_allclose(found, true, rtol=0, atol=1e-14)
    assert status.tolist() == [CentreStatus.VALID] * len(true)


def test_hand_case_orthogonal_lasers():
    # The sphere moves 7 mm along X: laser 1 reads 7 mm, the others lose 25 - 24 mm.
    found, solved = geometric_centres(
        RADIUS * np.eye(3), np.eye(3), RADIUS, np.array([[7e-3, -1e-3, -1e-3]])
    )
    assert solved.all()
    np.testing.assert_allclose(found, [[7e-3, 0, 0]], atol=1e-16)


def test_three_lasers_agree_with_trilateration_also_far_away():
    rng = np.random.default_rng(3)
    readings = rng.uniform(-3e-3, 3e-3, (100, 3))
    found, solved = geometric_centres(spots(), directions(), RADIUS, readings)
    assert solved.all()
    expected = [trilaterate(spots() + d[:, None] * directions(), RADIUS) for d in readings]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_four_contradicting_lasers_give_the_least_squares_centre():
    readings = bisect(spots(4), directions(4), some(20))
    readings += 5e-6 * np.random.default_rng(5).normal(size=readings.shape)
    found, solved = geometric_centres(spots(4), directions(4), RADIUS, readings)
    assert solved.all()
    for centre, d in zip(found, readings, strict=True):
        points = spots(4) + d[:, None] * directions(4)
        slow = least_squares(
            lambda x, p=points: np.linalg.norm(p - x, axis=1) - RADIUS, np.zeros(3),
            xtol=1e-15, ftol=1e-15, gtol=1e-15,
        )
        np.testing.assert_allclose(centre, slow.x, rtol=0, atol=1e-10)


def test_blocks_longer_than_a_chunk_are_solved_alike():
    true = np.tile(some(100), (90, 1))
    readings = bisect(spots(), directions(), true[:100])
    found, solved = geometric_centres(spots(), directions(), RADIUS, np.tile(readings, (90, 1)))
    assert solved.all()
    np.testing.assert_array_equal(found[:100], found[-100:])


def test_every_reading_has_its_own_status():
    solver = CentreSolver(nest())
    far = np.array([[9e-4, 0.0, 0.0]])
    readings = bisect(spots(), directions(), np.vstack([some(2), far]))
    lost = readings[:1].copy()
    lost[0, 1] = np.nan
    # Spots 55 mm out lie on no sphere of 25 mm radius: their circle alone has 39 mm.
    wide = np.full((1, 3), 30e-3)
    found, status = solver(np.vstack([readings, lost, wide]))
    assert status.tolist() == [
        CentreStatus.VALID, CentreStatus.VALID, CentreStatus.OUTSIDE, CentreStatus.NO_SIGNAL,
        CentreStatus.NO_SOLUTION,
    ]
    # Outside the centre is geometric and true; without one there is no number.
    np.testing.assert_allclose(found[2], far[0], atol=1e-14)
    assert np.isnan(found[3:]).all() and np.isfinite(found[:3]).all()


def test_an_empty_block_is_empty():
    found, status = CentreSolver(nest())(np.empty((0, 3)))
    assert found.shape == (0, 3) and status.shape == (0,)


def test_outside_nothing_is_added():
    nodes = cube()[1:]
    solver = CentreSolver(nest(nodes=nodes, values=1e-2 * nodes), THESIS)
    true = np.array([[2.5e-4, 0, 0], [8e-4, 0, 0]])
    found, status = solver(bisect(spots(), directions(), true))
    assert status.tolist() == [CentreStatus.VALID, CentreStatus.OUTSIDE]
    assert found[0, 0] == pytest.approx(2.525e-4, abs=5e-7)
    np.testing.assert_allclose(found[1], true[1], atol=1e-14)


def average(mean, covariance, gauges=None):
    gauges = np.arange(len(mean)) if gauges is None else np.array(gauges)
    return Average(gauges, np.asarray(mean), covariance, 10, 0)


@pytest.mark.parametrize('count', [3, 4])
def test_covariance_of_a_centre_matches_monte_carlo(count):
    rng = np.random.default_rng(6)
    mixed = 1e-7 * rng.normal(size=(count, count))
    covariance = mixed @ mixed.T
    true = np.array([[3e-4, -1e-4, 2e-4]])
    readings = bisect(spots(count), directions(count), true)
    solver = CentreSolver(nest(count))
    position, stated, disagreement = solver.centre(average(readings[0], covariance))
    np.testing.assert_allclose(position, true[0], atol=1e-14)
    assert disagreement < 1e-14
    drawn = rng.multivariate_normal(np.zeros(count), covariance, 20000)
    scatter = np.cov(solver(readings + drawn)[0].T)
    np.testing.assert_allclose(scatter, stated, atol=0.05 * stated.max())


def test_four_lasers_tell_their_disagreement():
    solver = CentreSolver(nest(4))
    readings = bisect(spots(4), directions(4), np.zeros((1, 3)))[0]
    readings[3] += 2e-6
    _, _, disagreement = solver.centre(average(readings, np.eye(4) * 1e-16))
    # The fit leaves half of one wrong reading at each of four lasers around: rms over 4 - 3.
    assert disagreement == pytest.approx(1e-6, rel=0.02)


def test_a_dwell_without_a_centre_says_why():
    solver = CentreSolver(nest(4))
    readings = bisect(spots(4), directions(4), np.array([[9e-4, 0, 0]]))[0]
    with pytest.raises(NoAverageError, match=r'\(0.900, .*outside the calibrated volume'):
        solver.centre(average(readings, np.eye(4)))
    with pytest.raises(NoAverageError, match='laser 2 without'):
        solver.centre(average(readings[[0, 2, 3]], np.eye(3), [0, 2, 3]))
    with pytest.raises(NoAverageError, match='no sphere'):
        CentreSolver(nest()).centre(average(np.full(3, 30e-3), np.eye(3)))


def test_a_nest_without_correction_nodes_is_refused():
    with pytest.raises(ValueError, match='no volume'):
        CentreSolver(replace(nest(), correction_nodes=np.empty((0, 3)),
                             correction_values=np.empty((0, 3))))


def test_the_iteration_needs_few_of_its_steps(monkeypatch):
    # Newton's convergence is quadratic: a quarter of the allowed steps is plenty.
    monkeypatch.setattr('rtest_estimation.laser.solver.MAX_STEPS', MAX_STEPS // 4)
    _, solved = geometric_centres(
        spots(), directions(), RADIUS, bisect(spots(), directions(), some())
    )
    assert solved.all()
