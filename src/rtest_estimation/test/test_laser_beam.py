"""Forward model of a laser on a sphere against cases worked out by hand and bisection."""

import numpy as np
import pytest
from laser_case import RADIUS, bisect, directions, nest, spots

from rtest_estimation.laser.beam import Limits, readings, strike
from rtest_estimation.records import NestCalibration, NestKind, Status

WIDE = Limits(-1.0, 1.0, 1.5)


def along_x(beside=0.0, zero=0.0):
    """One laser that looks at a sphere of 50 mm along -X, its beam `beside` the centre in Y."""
    spot = [np.sqrt(RADIUS**2 - beside**2), beside, 0.0]
    return NestCalibration(
        'id', '1a', 0, np.array([[1.0, 0, 0]]), 0.0, RADIUS, NestKind.LASER,
        zero=np.array([zero]), spot=np.array([spot]),
    )


@pytest.mark.parametrize(
    ('centre', 'reading'),
    [
        ((0.0, 0.0, 0.0), 0.0),
        # The sphere comes 1 mm nearer.
        ((1e-3, 0.0, 0.0), 1e-3),
        # It goes 7 mm aside: the surface recedes by R - sqrt(R^2 - 7^2) = 25 - 24 mm.
        ((0.0, 7e-3, 0.0), -1e-3),
        ((0.0, 0.0, -7e-3), -1e-3),
        # Aside along Y and Z: 25^2 - 15^2 = 20^2.
        ((2e-3, 9e-3, 12e-3), 2e-3 - 5e-3),
    ],
)
def test_hand_cases_of_a_beam_through_the_centre(centre, reading):
    found = strike(along_x(), np.array([centre]))
    assert found.reading[0, 0] == pytest.approx(reading, abs=1e-17)


def test_place_and_incidence_of_the_spot():
    found = strike(along_x(), np.array([[0.0, 7e-3, 0.0]]))
    # The spot sits 7 mm on the other side of the top: sine of the incidence 7/25.
    np.testing.assert_allclose(found.normal[0, 0], [24 / 25, -7 / 25, 0], atol=1e-15)
    assert found.incidence[0, 0] == pytest.approx(np.arcsin(7 / 25), rel=1e-12)


def test_a_beam_beside_the_centre_reads_a_shift_across_it():
    # Slope -y/x of the circle at the spot (24, 7) mm: 7/24 of a small shift along Y.
    found = strike(along_x(beside=7e-3), np.array([[0.0, 1e-7, 0.0], [1e-7, 0.0, 0.0]]))
    np.testing.assert_allclose(found.reading[:, 0], [7 / 24 * 1e-7, 1e-7], rtol=1e-5)


def test_a_zero_is_added_to_the_reading():
    assert strike(along_x(zero=3e-4), np.zeros((1, 3))).reading[0, 0] == 3e-4


@pytest.mark.parametrize('count', [3, 4])
def test_readings_of_a_whole_nest_agree_with_bisection(count):
    centres = np.random.default_rng(1).uniform(-2e-3, 2e-3, (50, 3))
    found = strike(nest(count, zero=1e-4), centres).reading
    expected = bisect(spots(count), directions(count), centres)
    np.testing.assert_allclose(found, expected + 1e-4, rtol=0, atol=1e-15)


def test_beyond_the_range_too_steep_and_missed_are_told_apart():
    centres = np.array([[0, 0, 0], [2e-3, 0, 0], [0, 4.9e-3, 0], [0, 5.1e-3, 0], [0, 26e-3, 0]])
    limits = Limits(-1e-3, 1e-3, np.arcsin(5 / 25))
    found, status = readings(along_x(), centres, limits)
    assert status[:, 0].tolist() == [
        Status.VALID, Status.OUT_OF_RANGE, Status.VALID, Status.NO_SIGNAL, Status.NO_SIGNAL
    ]
    assert np.isfinite(found[:3]).all() and np.isnan(found[3:]).all()
    # With light at any incidence only the miss is lost.
    assert readings(along_x(), centres, WIDE)[1][:, 0].tolist() == [0, 0, 0, 0, Status.NO_SIGNAL]
