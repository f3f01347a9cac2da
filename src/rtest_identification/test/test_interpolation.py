"""Interpolation between stations: why a spline, where it closes, and what it refuses."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from rtest_identification.interpolation import Stations

B = np.radians([-75, -50, -25, 0, 25, 50, 75])
C = np.radians(np.arange(12) * 30)
BETWEEN = np.linspace(B[0], B[-1], 601)
SMOOTH = {
    'square': np.square,
    'sin B': np.sin,
    'sin 2B': lambda b: np.sin(2 * b + 0.3),
    'bump': lambda b: np.exp(-((b / 0.9) ** 2)),
}


@pytest.mark.parametrize('truth', SMOOTH.values(), ids=SMOOTH.keys())
def test_a_spline_meets_smooth_maps_better_than_pchip(truth):
    spline = Stations.of(B).weights(BETWEEN) @ truth(B)
    pchip = PchipInterpolator(B, truth(B))(BETWEEN)
    off, off_pchip = np.abs(spline - truth(BETWEEN)), np.abs(pchip - truth(BETWEEN))
    assert off.max() < 0.8 * off_pchip.max()
    assert off.max() < 0.02 * np.ptp(truth(BETWEEN))


@pytest.mark.parametrize('truth', SMOOTH.values(), ids=SMOOTH.keys())
def test_the_doubt_holds_what_a_smooth_map_does_between_stations(truth):
    stations = Stations.of(B)
    off = np.abs(stations.weights(BETWEEN) @ truth(B) - truth(BETWEEN))
    doubt = stations.doubt(truth(B), BETWEEN)
    # Half-width of a rectangular distribution: U (k = 2) is 1.15 of it.
    assert np.mean(off <= 2 / np.sqrt(3) * doubt + 1e-12) > 0.95
    assert np.sqrt(np.mean(off**2)) < np.sqrt(np.mean(doubt**2))
    assert stations.doubt(truth(B), B).max() < 1e-12


@pytest.mark.parametrize('measured', [B, C, C + 3.0, np.radians([0, 25, 70, 95, 150, 200, 290])])
def test_values_at_the_stations_are_met(measured):
    assert np.allclose(Stations.of(measured).weights(measured), np.eye(len(measured)))


def test_a_turn_that_is_covered_closes():
    stations = Stations.of(C)
    values = np.sin(C + 0.4) + 0.5 * np.cos(2 * C)
    angle = np.linspace(-7.0, 7.0, 300)
    found = stations.weights(angle) @ values
    assert stations.periodic
    np.testing.assert_allclose(found, stations.weights(angle + 2 * np.pi) @ values, atol=1e-12)
    np.testing.assert_allclose(found, np.sin(angle + 0.4) + 0.5 * np.cos(2 * angle), atol=4e-3)
    # No kink at the seam: the slope from both sides is the same.
    step = 1e-4
    seam = stations.knots[0]
    ends = stations.weights(np.array([seam - step, seam, seam + step])) @ values
    assert abs(ends[2] - 2 * ends[1] + ends[0]) < 1e-7
    assert stations.place(angle)[1].all()


def test_uneven_stations_close_too():
    uneven = np.radians([0, 17, 55, 80, 120, 160, 171, 220, 260, 300, 330])
    stations = Stations.of(uneven)
    angle = np.linspace(0, 2 * np.pi, 300)
    assert stations.periodic
    assert np.abs(stations.weights(angle) @ np.cos(uneven) - np.cos(angle)).max() < 3e-3


def test_both_ends_of_a_turn_are_one_station():
    stations = Stations.of(np.radians([0, 90, 180, 270, 360]))
    assert len(stations.knots) == 4 and stations.periodic
    found = stations.weights(np.array([0.0, 2 * np.pi])) @ np.array([1.0, 0, 0, 0, 3.0])
    np.testing.assert_allclose(found, 2.0)


def test_a_part_of_a_turn_is_a_range():
    stations = Stations.of(B)
    np.testing.assert_allclose(stations.knots, B)
    assert not stations.periodic
    angle = np.radians([-75.01, -75.2, 75.01, 75.2, 180, 285, 360])
    assert stations.place(angle)[1].tolist() == [True, False, True, False, False, True, True]


def test_a_range_over_the_zero_of_the_axis():
    stations = Stations.of(np.radians([300, 330, 0, 30, 60]))
    assert not stations.periodic
    assert stations.place(np.radians([-60, -20, 350, 60, 90]))[1].tolist() == [True] * 4 + [False]


def test_one_station_is_a_point():
    stations = Stations.of(np.array([0.5]))
    assert stations.place(np.array([0.5, 0.6]))[1].tolist() == [True, False]
    assert stations.weights(np.array([0.5])).tolist() == [[1.0]]
    assert stations.doubt(np.array([[7.0]]), np.array([0.5])).tolist() == [[0.0]]
