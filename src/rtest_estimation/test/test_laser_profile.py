"""Profile measurement of a sphere against spheres with a known error."""

import numpy as np
import pytest

from rtest_estimation.laser.profile import measure_profile

R = 12.7e-3
TOP = np.array([3e-5, -2e-5])


def scan(half=6e-4, lines=13, points=241):
    x, y = np.linspace(-half, half, points), np.linspace(-half, half, lines)
    return np.stack(np.meshgrid(x, y, indexing='ij'), axis=-1).reshape(-1, 2)


def sphere(place, top=TOP):
    return 2e-4 - R + np.sqrt(R**2 - ((place - top) ** 2).sum(axis=1))


def everywhere(place):
    return np.ones(len(place), dtype=bool)


def test_a_perfect_sphere_has_no_error_and_a_flat_top():
    place = scan()
    found = measure_profile(place, sphere(place), everywhere(place), R)
    np.testing.assert_allclose(found.top, TOP, atol=1e-10)
    assert found.height == pytest.approx(2e-4, abs=1e-12)
    assert np.abs(found.error).max() < 1e-12
    # The surface falls by 1 um at sqrt(2 R 1 um) = 0.159 mm: the 0.1 mm of Table 5-2.
    assert found.flat == pytest.approx(np.sqrt(2 * R * 1e-6), abs=5e-6)
    farthest = np.linalg.norm(place - TOP, axis=1).max()
    assert found.accurate == found.measurable == pytest.approx(farthest)
    assert not found.bounded


def test_area_2_ends_where_a_known_error_exceeds_the_tolerance():
    # k (x^2 - y^2) is no shift, no height and no sphere: nothing of it is fitted away.
    place = scan(lines=121, points=121)
    k = 1e-6 / 4e-4**2
    error = k * (place[:, 0] ** 2 - place[:, 1] ** 2)
    found = measure_profile(place, sphere(place, 0 * TOP) + error, everywhere(place), R)
    np.testing.assert_allclose(found.error, error, atol=2e-9)
    assert found.accurate == pytest.approx(4e-4, abs=1e-5)
    assert found.noise < 1e-10
    wide = measure_profile(place, sphere(place, 0 * TOP) + error, everywhere(place), R, 2e-6)
    assert wide.accurate == pytest.approx(4e-4 * np.sqrt(2), abs=1e-5)


def test_the_top_is_found_from_next_to_zero():
    # The highest reading lies at zero but for rounding, the top does not.
    place = scan()
    place[np.abs(place) < 1e-12] = 1e-19
    bump = 1e-6 * np.exp(-((place**2).sum(axis=1)) / (2e-5) ** 2)
    found = measure_profile(place, sphere(place) + bump, everywhere(place), R)
    np.testing.assert_allclose(found.top, TOP, atol=2e-7)


def test_noise_level_is_the_noise():
    place = scan(points=601)
    noise = 8e-7 * np.random.default_rng(1).normal(size=len(place))
    found = measure_profile(place, sphere(place) + noise, everywhere(place), R)
    assert found.noise == pytest.approx(8e-7, rel=0.03)
    np.testing.assert_allclose(found.top, TOP, atol=2e-6)


def test_area_3_ends_at_the_nearest_reading_without_signal():
    place = scan()
    distance = np.linalg.norm(place - TOP, axis=1)
    valid = distance < 4.5e-4
    reading = np.where(valid, sphere(place), 0.0)
    found = measure_profile(place, reading, valid, R)
    assert found.bounded
    assert 4.4e-4 < found.measurable < 4.5e-4
    assert np.isnan(found.error[~valid]).all() and np.isnan(found.smooth[~valid]).all()


def test_too_few_readings_are_refused():
    place = scan()
    with pytest.raises(ValueError, match='63 are needed'):
        measure_profile(place, sphere(place), np.arange(len(place)) < 50, R)
