"""Circle of the sphere about the spindle axis (Eq. 2-7)."""

import numpy as np
import pytest

from rtest_estimation.runout import fit


def circle(noise=0.0, seed=0, turn=2 * np.pi, count=24):
    angle = np.arange(count) * turn / count
    points = 3e-6 * np.column_stack([np.cos(angle), np.sin(angle)]) + [2e-6, -1e-6]
    return points + noise * np.random.default_rng(seed).normal(size=points.shape)


def test_exact_circle():
    result = fit(circle())
    np.testing.assert_allclose(result.centre, [2e-6, -1e-6], atol=1e-13)
    assert result.radius == pytest.approx(3e-6, rel=1e-7)
    assert result.residual < 1e-13


def test_stated_uncertainty_holds_the_truth():
    miss = []
    for seed in range(200):
        result = fit(circle(1e-7, seed))
        error = np.append(result.centre - [2e-6, -1e-6], result.radius - 3e-6)
        miss.append(error @ np.linalg.solve(result.covariance, error))
    # Chi-squared with three degrees of freedom, widened by the estimated variance (21 of them).
    assert 2.6 < np.mean(miss) < 3.9


def test_a_short_arc_is_refused():
    with pytest.raises(ValueError, match='half a turn'):
        fit(circle(1e-8, turn=2.0))
    with pytest.raises(ValueError, match='six'):
        fit(circle()[:5])
