"""Calibration of a laser nest against known beams, finite differences and Monte Carlo."""

from types import SimpleNamespace

import numpy as np
import pytest
from laser_case import RADIUS, bisect, cube, directions, nest, spots
from scipy.optimize import approx_fprime

from rtest_estimation import messages
from rtest_estimation.laser.calibration import _misfit, _project, calibrate, fit_beam
from rtest_estimation.nest import CalibrationError
from rtest_estimation.records import NestKind


def made(count=3, noise=0.0, seed=1, zero=1e-4, half=5e-4, levels=3):
    positions = cube(half, levels)
    readings = bisect(spots(count), directions(count), positions) + zero
    return positions, readings + noise * np.random.default_rng(seed).normal(size=readings.shape)


@pytest.mark.parametrize('count', [3, 4])
def test_exact_readings_give_the_beams_back(count):
    found = calibrate(*made(count), 'id', '1a', 5, RADIUS)
    np.testing.assert_allclose(found.spot, spots(count), atol=1e-12)
    np.testing.assert_allclose(found.direction, directions(count), atol=1e-8)
    np.testing.assert_allclose(found.zero, 1e-4, atol=1e-13)
    assert found.residual < 1e-13
    assert np.abs(found.correction_values).max() < 1e-13
    assert (found.calibration, found.setup, found.stamp) == ('id', '1a', 5)
    assert (found.kind, found.sphere_radius) == (NestKind.LASER, RADIUS)


def test_constraints_hold_exactly_whatever_the_readings():
    found = calibrate(*made(noise=5e-6), 'id', '1a', 0, RADIUS)
    np.testing.assert_allclose(np.linalg.norm(found.spot, axis=1), RADIUS, rtol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1.0, rtol=1e-15)


def test_condition_of_orthogonal_lasers_is_one():
    spot = RADIUS * np.eye(3)
    positions = cube()
    readings = bisect(spot, np.eye(3), positions)
    found = calibrate(positions, readings, 'id', '1a', 0, RADIUS)
    assert found.condition == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(found.spot, spot, atol=1e-11)


def test_jacobian_of_the_misfit_against_finite_differences():
    positions, readings = made()
    base = directions(1)[0]
    plane = np.linalg.svd(base[None])[2][1:].T
    at = np.array([0.03, -0.02, 0.05, 0.1, 2e-4])

    def misfit(unknown):
        return _misfit(positions, readings[:, 0], RADIUS, base, plane, unknown)[0]

    jacobian = _misfit(positions, readings[:, 0], RADIUS, base, plane, at)[1]
    for column, step in enumerate([1e-6, 1e-6, 1e-5, 1e-5, 1e-7]):
        up, down = (misfit(at + s * step * np.eye(5)[column]) for s in (1, -1))
        slope = (up - down) / (2 * step)
        np.testing.assert_allclose(
            jacobian[:, column], slope, atol=1e-6 * np.abs(slope).max() + 1e-13
        )


def test_derivative_of_the_projection_against_finite_differences():
    base = np.array([0.6, 0.0, 0.8])
    plane = np.linalg.svd(base[None])[2][1:].T
    slope = _project(base, plane, np.array([0.1, -0.2]))[1]
    numeric = approx_fprime(
        np.array([0.1, -0.2]), lambda step: _project(base, plane, step)[0], 1e-7
    )
    np.testing.assert_allclose(slope, numeric, atol=1e-6)


def test_stated_covariance_matches_monte_carlo():
    noise, runs = 3e-8, 300
    positions, exact = made()
    rng = np.random.default_rng(4)
    found, stated = [], []
    for _ in range(runs):
        beam = fit_beam(positions, exact[:, 0] + noise * rng.normal(size=len(exact)), RADIUS)
        found.append(np.concatenate([beam.spot, beam.direction, [beam.zero]]))
        stated.append(beam.covariance)
    scatter, mean = np.cov(np.array(found).T), np.mean(stated, axis=0)
    # 300 runs give a variance to 8 %: three of that. Spot, direction and zero apart.
    for part in (slice(0, 3), slice(3, 6), slice(6, 7)):
        assert np.trace(scatter[part, part]) == pytest.approx(
            np.trace(mean[part, part]), rel=0.25
        )
    # A fixed length leaves no variance along the vector.
    along = spots(1)[0] / RADIUS
    assert along @ mean[:3, :3] @ along < 1e-6 * np.trace(mean[:3, :3])
    # Spot and zero are correlated with the direction as stated.
    scale = np.sqrt(np.diag(mean))
    np.testing.assert_allclose(
        scatter / np.outer(scale, scale), mean / np.outer(scale, scale), atol=0.35
    )


def test_repeated_visits_become_one_node():
    positions, readings = made(noise=1e-7)
    again = np.vstack([positions, positions[:5] + 1e-7])
    found = calibrate(again, np.vstack([readings, readings[:5]]), 'id', '1a', 0, RADIUS)
    # The cube's middle is the start: 27 distinct positions of 33 visits.
    assert found.correction_nodes.shape == found.correction_values.shape == (27, 3)


def test_nodes_are_estimates_and_values_what_leads_to_the_command():
    positions, readings = made()
    readings = readings + 2e-3 * readings**2 / 1e-3
    found = calibrate(positions, readings, 'id', '1a', 0, RADIUS)
    reached = found.correction_nodes + found.correction_values
    np.testing.assert_allclose(
        sorted(map(tuple, reached.round(9))), sorted(map(tuple, np.unique(positions, axis=0))),
        atol=1e-9,
    )
    assert np.abs(found.correction_values).max() > 1e-7


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        (lambda p, r: (p[:8], r[:8], RADIUS), 'at least 9'),
        (lambda p, r: (p, r[:, :2], RADIUS), 'needs three'),
        (lambda p, r: (p, r, float('nan')), 'radius of the sphere'),
        (lambda p, r: (p * [1, 1, 0], r, RADIUS), 'span three directions'),
        (lambda p, r: (p, r * [1, 0, 1], RADIUS), 'laser 2: moves 0.000 m per metre'),
        (lambda p, r: (p, r * 1e3, RADIUS), 'laser 1: moves'),
        (lambda p, r: (p, r[:, [0, 0, 0]], RADIUS), 'one plane'),
    ],
)
def test_a_useless_calibration_is_refused(change, words):
    positions, readings, radius = change(*made())
    with pytest.raises(CalibrationError, match=words):
        calibrate(positions, readings, 'id', '1a', 0, radius)


def test_steps_along_the_axes_do_not_show_a_beam_along_an_axis():
    positions = np.vstack([k * s * np.eye(3) for k in (1, 2) for s in (5e-4, -5e-4)])
    readings = bisect(RADIUS * np.eye(3), np.eye(3), positions)
    with pytest.raises(CalibrationError, match='cube'):
        calibrate(positions, readings, 'id', '1a', 0, RADIUS)


def message(record):
    stamp = SimpleNamespace(sec=7, nanosec=5)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id='table'), calibration=record.calibration,
        kind=int(record.kind), sphere_radius=record.sphere_radius, residual=record.residual,
        **{
            name: getattr(record, name).ravel().tolist()
            for name in ('direction', 'spot', 'correction_nodes', 'correction_values')
        },
    )


def test_a_message_carries_the_laser_fields():
    sent = calibrate(*made(noise=1e-6), 'id', '1a', 0, RADIUS)
    back = messages.nest_calibration(message(sent), '1a')
    assert (back.kind, back.stamp) == (NestKind.LASER, 7_000_000_005)
    for name in ('direction', 'spot', 'correction_nodes', 'correction_values'):
        np.testing.assert_array_equal(getattr(back, name), getattr(sent, name))


@pytest.mark.parametrize('name', ['spot', 'correction_nodes', 'correction_values', 'direction'])
def test_a_message_whose_fields_do_not_fit_is_refused(name):
    bad = message(nest())
    setattr(bad, name, getattr(bad, name)[:-3])
    with pytest.raises(messages.MessageError, match=f'{name} has'):
        messages.nest_calibration(bad)
