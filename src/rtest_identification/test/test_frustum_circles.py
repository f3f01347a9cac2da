"""Circularity: known figures, brute force, linear programme, nonlinear least squares."""

from itertools import combinations

import numpy as np
import pytest
from scipy.optimize import least_squares, linprog

from rtest_identification.frustum.circles import (
    least_squares_circle,
    minimum_zone_circle,
    zone_width,
)

ANGLE = np.radians(np.arange(360.0))


def around(radius, angle=ANGLE, centre=(0.0, 0.0)):
    return np.asarray(centre) + (radius * np.array([np.cos(angle), np.sin(angle)])).T


def ring(points, centre):
    return np.ptp(np.linalg.norm(points - centre, axis=1))


def brute_force(points):
    """Thinnest ring: its centre is equally far from two pairs of points (or from three)."""
    best = np.inf
    pairs = list(combinations(range(len(points)), 2))
    # Perpendicular bisectors: n . x = d.
    normal = np.array([points[b] - points[a] for a, b in pairs])
    offset = np.array([(points[b] @ points[b] - points[a] @ points[a]) / 2 for a, b in pairs])
    for one, other in combinations(range(len(pairs)), 2):
        matrix = normal[[one, other]]
        if abs(np.linalg.det(matrix)) > 1e-9:
            centre = np.linalg.solve(matrix, offset[[one, other]])
            if np.linalg.norm(centre) < 0.5:
                best = min(best, ring(points, centre))
    return best


@pytest.mark.parametrize('seed', range(8))
def test_minimum_zone_is_that_of_brute_force(seed):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 4) / 6 + np.arange(4) * np.pi / 2)
    angle = np.concatenate([angle, rng.uniform(0, 2 * np.pi, 7)])
    # Far from small: 5 % of the radius, off the origin.
    points = around(1 + 0.05 * rng.uniform(-1, 1, 11), angle, (0.1, -0.05))
    found = minimum_zone_circle(points)
    assert found.circularity == pytest.approx(brute_force(points), rel=1e-9)
    assert ring(points, found.centre) == pytest.approx(found.circularity, rel=1e-12)


def test_minimum_zone_touches_in_turn_outside_and_inside():
    # The criterion of the thinnest ring (ISO 230-4: four points, alternating).
    rng = np.random.default_rng(3)
    points = around(0.065 + 1e-5 * rng.normal(size=360))
    found = minimum_zone_circle(points)
    arm = points - found.centre
    radius = np.linalg.norm(arm, axis=1)
    touching = np.flatnonzero(
        (radius > found.outer - 1e-15) | (radius < found.inner + 1e-15)
    )
    assert len(touching) == 4
    order = touching[np.argsort(np.arctan2(*arm[touching].T[::-1]))]
    outside = radius[order] > radius.mean()
    assert all(outside != np.roll(outside, 1))


@pytest.mark.parametrize('order', [2, 3, 7])
def test_lobes(order):
    points = around(0.05 + 1e-5 * np.cos(order * ANGLE), centre=(1e-3, 2e-3))
    for circle in (least_squares_circle(points), minimum_zone_circle(points)):
        assert circle.circularity == pytest.approx(2e-5, rel=1e-3)
        # One degree between points: extrema are met to their sagitta.
        np.testing.assert_allclose(circle.centre, [1e-3, 2e-3], atol=2e-9)


def test_least_squares_circle_is_that_of_a_general_solver():
    rng = np.random.default_rng(5)
    points = around(0.05 + 1e-3 * rng.normal(size=360), centre=(0.2, -0.1))

    def residual(x):
        return np.linalg.norm(points - x[:2], axis=1) - x[2]

    solved = least_squares(residual, [0.2, -0.1, 0.05], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    found = least_squares_circle(points)
    np.testing.assert_allclose(found.centre, solved.x[:2], atol=1e-9)
    assert found.circularity == pytest.approx(np.ptp(residual(solved.x)), rel=1e-6)


def test_many_profiles_at_once_are_those_of_a_linear_programme():
    rng = np.random.default_rng(7)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 120))
    waves = [1e-5 * np.cos(k * angle + rng.uniform(0, 6)) / k for k in range(1, 9)]
    profiles = np.array([
        sum(rng.normal() * wave for wave in waves) + rng.normal() * 1e-6 * rng.normal(size=120)
        for _ in range(40)
    ])
    basis = np.stack([np.ones(120), np.cos(angle), np.sin(angle)], axis=1)
    one = np.ones((120, 1))
    found = zone_width(angle, profiles)
    for profile, width in zip(profiles, found, strict=True):
        programme = linprog(
            [0, 0, 0, 1], np.block([[basis, -one], [-basis, -one]]),
            1e6 * np.concatenate([profile, -profile]), bounds=[(None, None)] * 4,
        )
        assert width == pytest.approx(2e-6 * programme.fun, rel=1e-7, abs=1e-12)
        exact = minimum_zone_circle(around(0.065 + profile, angle)).circularity
        assert width == pytest.approx(exact, abs=5e-9)
        assert width <= least_squares_circle(around(0.065 + profile, angle)).circularity
    # The order of the points does not matter.
    shuffled = rng.permutation(120)
    np.testing.assert_allclose(zone_width(angle[shuffled], profiles[:, shuffled]), found)


def test_perfect_and_hopeless():
    assert zone_width(ANGLE, np.zeros((2, 360))).tolist() == [0.0, 0.0]
    shifted = 1e-5 * np.cos(ANGLE)[None]
    assert zone_width(ANGLE, shifted)[0] < 1e-16
    assert minimum_zone_circle(around(0.05)).circularity < 1e-15
    with pytest.raises(ValueError, match='centre|direction|Singular'):
        minimum_zone_circle(np.array([[0.0, 0], [1, 0], [2, 0], [3, 0], [4, 0.0]]))
