"""The correction by radial basis functions: leaving out, choosing, borders; verification."""

import numpy as np
import pytest
from laser_case import bisect, cube, directions, nest, spots
from scipy.interpolate import RBFInterpolator

from rtest_estimation.laser import CentreSolver, CentreStatus
from rtest_estimation.laser.correction import (
    KERNELS,
    MARGIN,
    THESIS,
    Correction,
    Kernel,
    compare,
    leave_one_out,
    local_scatter,
)
from rtest_estimation.laser.verification import verification_positions, verify

HALF = 5e-4


def nodes(levels=3):
    moved = np.random.default_rng(1).normal(scale=3e-6, size=(levels**3, 3))
    return cube(HALF, levels)[1:] + moved


def saddle(x):
    """A smooth error of a few micrometres, product of two coordinates."""
    return 5e-6 * np.column_stack([x[:, 0] * x[:, 1], x[:, 2] ** 2, x[:, 0]]) / [
        HALF**2, HALF**2, HALF
    ]


@pytest.mark.parametrize('kernel', KERNELS, ids=str)
def test_leaving_out_in_closed_form_is_leaving_out(kernel):
    at = nodes()
    values = saddle(at) + 3e-7 * np.random.default_rng(2).normal(size=at.shape)
    found = leave_one_out(at, values, kernel)
    box = (at.min(axis=0) + at.max(axis=0)) / 2, np.ptp(at, axis=0).max() / 2
    scaled = (at - box[0]) / box[1]
    for row in (0, 4, 13, 26):
        rest = np.arange(27) != row
        other = RBFInterpolator(
            scaled[rest], values[rest], kernel=kernel.name, degree=kernel.degree,
            smoothing=kernel.smoothing,
        )
        np.testing.assert_allclose(
            found[row], values[row] - other(scaled[row : row + 1])[0], rtol=1e-6, atol=1e-14
        )


def test_kernels_the_nodes_do_not_determine_are_not_compared():
    # Centre and corners: no quadratic polynomial, x^2, y^2 and z^2 are alike there.
    at = np.vstack([np.zeros(3), [HALF * np.array([i, j, k]) for i in (-1, 1) for j in (-1, 1)
                                  for k in (-1, 1)]])
    found = compare(at, saddle(at))
    assert {kernel.degree for kernel, _ in found} == {-1, 0, 1}
    assert Correction(at, saddle(at)).inside(np.zeros((1, 3))).all()


def test_interpolation_meets_the_nodes_and_the_thesis_kernel_has_no_polynomial():
    at = nodes()
    np.testing.assert_allclose(Correction(at, saddle(at), THESIS)(at), saddle(at), atol=1e-15)
    # Kink at the nodes: halfway between two, a straight kernel follows no parabola.
    straight = Correction(at, saddle(at), THESIS)(np.array([[0, 0, HALF / 2]]))[0, 1]
    assert abs(straight - 5e-6 / 4) > 3e-7
    smooth = Correction(at, saddle(at), Kernel('cubic', 2))(np.array([[0, 0, HALF / 2]]))[0, 1]
    assert smooth == pytest.approx(5e-6 / 4, abs=1e-12)


def test_the_choice_predicts_new_points_better_than_the_thesis_kernel():
    at = nodes()
    values = saddle(at) + 2e-7 * np.random.default_rng(3).normal(size=at.shape)
    between = np.random.default_rng(4).uniform(-HALF, HALF, (500, 3))
    chosen, thesis = Correction(at, values), Correction(at, values, THESIS)
    assert chosen.kernel is not None and chosen.kernel.degree == 2
    assert chosen.error < 0.3 * thesis.error

    def mean(correction):
        return np.linalg.norm(correction(between) - saddle(between), axis=1).mean()

    assert mean(chosen) < 0.5 * mean(thesis)


def test_pure_noise_is_not_corrected():
    at = nodes()
    values = 3e-7 * np.random.default_rng(5).normal(size=at.shape)
    correction = Correction(at, values)
    assert correction.kernel is None
    assert correction.error == pytest.approx(np.sqrt((values**2).sum() / 27))
    assert not correction(at).any()


def test_inside_ends_a_margin_beyond_the_hull():
    correction = Correction(cube(HALF), np.zeros((28, 3)))
    edge = HALF * (1 + 2 * MARGIN)
    points = np.array([[0.999 * edge, 0, 0], [1.001 * edge, 0, 0], [0, 0, -1.001 * edge],
                       [HALF, -HALF, HALF], [0.0, 0.0, 0.0]])
    assert correction.inside(points).tolist() == [True, False, False, True, True]


def test_inside_is_the_hull_not_the_box():
    star = HALF * np.vstack([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    correction = Correction(star, np.zeros_like(star))
    corner = np.full((1, 3), 0.5 * HALF)
    assert not correction.inside(corner).any()
    assert correction.inside(0.6 * corner).all()


@pytest.mark.parametrize('at', [np.empty((0, 3)), cube()[:3], cube() * [1, 1, 0]])
def test_nodes_without_volume_are_refused(at):
    with pytest.raises(ValueError, match='no volume'):
        Correction(at, np.zeros_like(at))


def test_verification_positions_are_those_of_the_thesis():
    positions = verification_positions(1e-3)
    assert positions.shape == (1183, 3)
    assert len(np.unique(positions, axis=0)) == 1183
    np.testing.assert_allclose([positions.min(axis=0), positions.max(axis=0)],
                               [[-5e-4] * 3, [5e-4] * 3])


def test_verification_counts_and_deviations_by_hand():
    solver = CentreSolver(nest(nodes=cube()[1:], values=np.tile([0, 0, 3e-6], (27, 1))),
                          Kernel('linear', 0))
    true = np.array([[0, 0, 0], [1e-4, 0, 0], [9e-4, 0, 0]])
    readings = bisect(spots(), directions(), true)
    commanded = true + np.array([[0, 4e-6, 0], [0, 0, 3e-6], [0, 0, 0]])
    found = verify(solver, commanded, readings)
    # Without correction off by 4 and 3 um, with it by 5 (3-4-5) and 0 um.
    assert found.raw.mean == pytest.approx(3.5e-6, abs=1e-12)
    assert found.corrected.mean == pytest.approx(2.5e-6, abs=1e-12)
    assert found.corrected.std == pytest.approx(2.5e-6, abs=1e-12)
    assert found.corrected.max == pytest.approx(5e-6, abs=1e-12)
    assert found.count(CentreStatus.OUTSIDE) == 1
    nothing = verify(solver, commanded, np.full((3, 3), np.nan))
    assert nothing.raw is None and nothing.count(CentreStatus.NO_SIGNAL) == 3


def test_local_scatter_is_the_noise_and_not_the_smooth_error():
    at = nodes()
    found = []
    for seed in range(40):
        noise = 6e-7 * np.random.default_rng(seed).normal(size=at.shape)
        scatter, freedom = local_scatter(at, saddle(at) + noise)
        found.append(scatter**2)
    # 27 nodes less 10 terms of the second degree, three components.
    assert freedom == 51
    assert np.sqrt(np.mean(found)) == pytest.approx(6e-7, rel=0.05)
    assert np.isnan(local_scatter(at[:10], saddle(at[:10]))[0])
    assert local_scatter(at[:10], saddle(at[:10]))[1] == 0
