"""Average circles and centres against hand cases and Monte Carlo."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtest_identification.circles import fit_centre, fit_circle

Z = np.array([0.0, 0.0, 1.0])
EVEN = np.radians(np.arange(12) * 30.0)
UNEVEN = np.radians([0, 17, 62, 95, 118, 151, 203, 222, 268, 299, 331, 349])
ARC = np.radians(np.linspace(-60.0, 60.0, 9))


def circle(angles, radius=0.09, centre=(0.0, 0.0, 0.04), tilt=(0.0, 0.0)):
    """Points of a circle whose normal is Z turned by the rotation vector (a, b, 0)."""
    flat = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
    return np.array(centre) + radius * Rotation.from_rotvec([*tilt, 0.0]).apply(flat)


@pytest.mark.parametrize('angles', [EVEN, UNEVEN, ARC], ids=['even', 'uneven', 'arc'])
def test_an_exact_circle_is_found(angles):
    found = fit_circle(circle(angles, 0.09, (3e-6, -2e-6, 0.04), (2e-5, -3e-5)), Z)
    np.testing.assert_allclose(found.centre, [3e-6, -2e-6, 0.04], atol=1e-13)
    # Rotation about +X by a takes Z to (0, -a, 1), about +Y by b to (b, 0, 1).
    np.testing.assert_allclose(found.normal[:2], [-3e-5, -2e-5], atol=1e-11)
    assert found.radius == pytest.approx(0.09, abs=1e-13)


def test_the_normal_points_to_the_side_asked_for():
    points = circle(EVEN)
    np.testing.assert_allclose(fit_circle(points, Z).normal, Z, atol=1e-12)
    np.testing.assert_allclose(fit_circle(points, -Z).normal, -Z, atol=1e-12)


def test_what_is_off_along_the_circumference_does_not_count():
    points = circle(EVEN + 1e-3 * np.sin(3 * EVEN))
    assert fit_circle(points, Z).squares < 1e-24


@pytest.mark.parametrize('angles', [EVEN, UNEVEN, ARC], ids=['even', 'uneven', 'arc'])
def test_covariance_is_that_of_monte_carlo(angles):
    rng = np.random.default_rng(31)
    noise, points = 3e-7, circle(angles, tilt=(0.3, -0.2))
    runs = [fit_circle(points + noise * rng.normal(size=points.shape), Z) for _ in range(2000)]
    values = np.array([[*c.centre, *c.normal, c.radius] for c in runs])
    sampled = np.cov(values.T)
    stated = fit_circle(points, Z).cofactor * noise**2
    # Compared in the coordinates in which the stated one is the unit matrix (rank six).
    scale = np.sqrt(np.diag(stated))
    size, vectors = np.linalg.eigh(stated / np.outer(scale, scale))
    assert np.sum(size > 1e-9) == 6
    scaled = sampled / np.outer(scale, scale)
    kept = vectors[:, size > 1e-9] / np.sqrt(size[size > 1e-9])
    # 2,000 runs: a variance is good to 3 %, six of them and their correlations to 4 sigma.
    np.testing.assert_allclose(kept.T @ scaled @ kept, np.eye(6), atol=0.13)
    own = np.mean([c.squares / c.freedom for c in runs])
    assert own == pytest.approx(noise**2, rel=0.02)


def test_an_ellipse_is_no_scatter():
    points = circle(EVEN)
    sheared = points @ np.array([[1.0, 2e-5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    found = fit_circle(sheared, Z)
    assert found.squares < 1e-18
    np.testing.assert_allclose(found.normal, Z, atol=1e-12)


@pytest.mark.parametrize(
    ('points', 'reason'),
    [
        (circle(EVEN[:3]), '3 points'),
        (np.zeros((6, 3)), 'coincide'),
        (np.outer(np.arange(6.0), [1.0, 2.0, 3.0]), 'on a line'),
        (circle(np.radians(np.linspace(0.0, 40.0, 8))), '40 degrees'),
        (circle(EVEN) * np.array([1.0, 2.0, 1.0]), 'not lie on a circle'),
    ],
)
def test_what_is_no_circle_is_refused_with_its_reason(points, reason):
    with pytest.raises(ValueError, match=reason):
        fit_circle(points, Z)


@pytest.mark.parametrize('angles', [EVEN, UNEVEN, ARC], ids=['even', 'uneven', 'arc'])
def test_the_centre_of_a_turn_without_what_turns_with_the_table(angles):
    c, s = np.cos(angles), np.sin(angles)
    eccentric = 5e-6 * np.column_stack([c - 0.4 * s, s + 0.4 * c, np.zeros_like(c)])
    exact = np.array([2e-6, -1e-6, 4e-6]) + eccentric
    found = fit_centre(exact, angles, Z)
    np.testing.assert_allclose(found.displacement, [2e-6, -1e-6, 4e-6], atol=1e-15)
    rng = np.random.default_rng(32)
    noisy = [fit_centre(exact + 3e-7 * rng.normal(size=exact.shape), angles, Z)
             for _ in range(2000)]
    sampled = np.cov(np.array([n.displacement for n in noisy]).T)
    np.testing.assert_allclose(
        sampled, 9e-14 * found.cofactor, atol=0.12 * 9e-14 * found.cofactor.max()
    )


def test_a_centre_from_a_few_degrees_is_refused():
    with pytest.raises(ValueError, match='10 degrees of a turn'):
        fit_centre(np.zeros((5, 3)), np.radians(np.linspace(0.0, 10.0, 5)), Z)
