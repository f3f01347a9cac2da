"""Rows of the search for dynamic effects.

The gauges' rows are the measured sphere centre less what the encoders say; free beside the
effects are what depends on the angle alone (geometric, independent of speed and direction), a slow
drift, the zero of each cycle, and the time between the clocks of gauges and CNC. The encoders'
rows are the circle deviation of the feedback itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtest_identification.dynamic.blocks import Scene
from rtest_identification.dynamic.effects import TANGENTIAL, speed_in_transients
from rtest_identification.dynamic.noise import Noise, estimate, orthonormal, waves
from rtest_identification.gap.effects import Effect
from rtest_identification.least_squares import RANK_TOLERANCE

# The geometric part has this many harmonics of a full turn.
ORDERS = 12
# A derivative along the acceleration is a difference over this time to either side [s].
_DIFFERENCE = 1e-4

Chosen = tuple[Effect, tuple[float, ...]]


@dataclass(frozen=True)
class Rows:
    """One channel against its base model, as `gap.projection.Projection` takes it.

    residual : (n, 3) what the base model leaves [m]
    base : (n, 3, r) columns of everything that is free in it
    noise : scatter, correlation and drift of the rows
    value : (n, 3) the channel itself [m]
    """

    scene: Scene
    value: np.ndarray
    residual: np.ndarray
    base: np.ndarray
    noise: Noise

    @property
    def sigma(self) -> np.ndarray:
        """(n,) standard deviation of a row, per component [m]."""
        return self.noise.sigma

    def white(self, values: np.ndarray) -> np.ndarray:
        """(n, 3) or (n, 3, p) to (3 n,) or (3 n, p) of unit variance, uncorrelated."""
        return self.noise.white(self.scene, values)

    def fit(self) -> np.ndarray:
        """(r,) coefficients of the base model; the smallest where the data leave them open."""
        design = self.white(self.base)
        scale = 1.0 / np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        # Without the covariance that `least_squares.solve` gives, which takes twice as long.
        found = np.linalg.lstsq(design * scale, self.white(self.value), rcond=RANK_TOLERANCE)[0]
        return scale * found

    @cached_property
    def basis(self) -> np.ndarray:
        """(3 n, r) orthonormal: what the base model can do."""
        return orthonormal(self.white(self.base))


def geometric(scene: Scene, orders: int = ORDERS) -> np.ndarray:
    """(n, 3, 3 (2 orders + 1)) columns of what depends on the angle alone."""
    return _each(waves(scene.angle, orders))


def gauge_rows(
    scene: Scene, extra: Sequence[Chosen] = (), noise: Noise | None = None
) -> Rows:
    """Measured less encoders.

    extra : effects that are free besides; noise : of the same rows, where it is known
    """
    value = scene.measured - scene.servo
    noise = noise or estimate(scene, value)
    time = scene.time - scene.time.mean()
    drift = _each(time[:, None] / max(np.abs(time).max(), 1e-9))
    fixed = np.concatenate(
        [geometric(scene), drift, cycle_shifts(scene), speed_in_transients(scene)], axis=2
    )
    base = np.concatenate([lateness(scene, fixed, noise), fixed], axis=2)
    return _rows(scene, value, base, extra, noise)


def encoder_rows(
    scene: Scene, extra: Sequence[Chosen] = (), noise: Noise | None = None
) -> Rows:
    """Circle deviation of the encoder feedback against the command, in the steady part.

    Encoders are far less noisy than gauges: they are judged by what the gauges can show.
    """
    part = scene.keep(scene.steady)
    if noise is None:
        gauges = estimate(part, part.measured - part.servo, drifts=False)
        noise = estimate(part, part.servo, drifts=False)
        noise = replace(noise, sigma=np.hypot(noise.sigma, gauges.sigma))
    return _rows(part, part.servo, geometric(part), extra, noise)


def lateness(scene: Scene, fixed: np.ndarray, noise: Noise) -> np.ndarray:
    """(n, 3, 1) change of the gauges' rows per second by which they are later [m/s].

    Every feature comes late: the servo's own (`Scene.change`), the geometric part's, and what
    goes with the speed at starts and stops. The slopes of these two are taken from their fit,
    beside a free displacement of every pass.

    fixed : columns of `geometric` first and of `speed_in_transients` last
    """
    columns = np.concatenate([pass_shifts(scene), fixed], axis=2)
    fit = _rows(scene, scene.measured - scene.servo, columns, (), noise).fit()
    fit = fit[-fixed.shape[2] :]
    count = 3 * (2 * ORDERS + 1)
    slope = _each(_wave_slopes(scene.angle, ORDERS)) @ fit[:count] * scene.omega[:, None]
    later, earlier = (
        speed_in_transients(replace(scene, omega=scene.omega + step * scene.alpha))
        for step in (_DIFFERENCE, -_DIFFERENCE)
    )
    number = later.shape[2]
    moving = (later - earlier) @ fit[len(fit) - number :] / (2.0 * _DIFFERENCE)
    return -(scene.change + slope + moving)[:, :, None]


def cycle_shifts(scene: Scene) -> np.ndarray:
    """(n, 3, k) columns of the zero of every cycle after the first.

    Tangentially only of cycles that go both ways: in others the zero would be the lag itself.
    """
    passes = scene.motion.passes
    cycle = np.array([one.cycle for one in passes])[scene.number]
    columns = []
    for number in np.unique(cycle)[1:]:
        signs = {one.sign for one in passes if one.cycle == number}
        for component in range(3):
            if component != TANGENTIAL or len(signs) > 1:
                column = np.zeros((len(scene), 3))
                column[cycle == number, component] = 1.0
                columns.append(column)
    return np.stack(columns, axis=2) if columns else np.empty((len(scene), 3, 0))


def pass_shifts(scene: Scene) -> np.ndarray:
    """(n, 3, 3 passes) columns of a free displacement of every pass."""
    return _each(np.eye(len(scene.motion.passes))[scene.number])


def _rows(
    scene: Scene, value: np.ndarray, base: np.ndarray, extra: Sequence[Chosen], noise: Noise
) -> Rows:
    more = [effect.columns(scene, shape) for effect, shape in extra]
    rows = Rows(scene, value, value, np.concatenate([base, *more], axis=2), noise)
    return replace(rows, residual=value - rows.base @ rows.fit())


def _wave_slopes(angle: np.ndarray, orders: int) -> np.ndarray:
    """Derivative of `waves` with respect to the angle."""
    columns = [np.zeros_like(angle)]
    for order in range(1, orders + 1):
        columns += [-order * np.sin(order * angle), order * np.cos(order * angle)]
    return np.stack(columns, axis=1)


def _each(functions: np.ndarray) -> np.ndarray:
    """(n, 3, 3 k): every function (n, k) in each component; functions vary slowest."""
    return np.einsum('nk,ij->nikj', functions, np.eye(3)).reshape(len(functions), 3, -1)
