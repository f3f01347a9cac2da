"""The library of dynamic effects, in radial, tangential and axial components."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rtest_identification.dynamic.blocks import Scene
from rtest_identification.gap.effects import Columns, Effect, Parameter

# Speed of the sphere along its circle at which a friction lag is stated [m/s].
REFERENCE_SPEED = 0.01
RADIAL, TANGENTIAL = 0, 1
SHRINK, LAG = 'radius-shrink', 'friction-lag'
CLOCK = 'clock-offset'
# How fast spikes die away [s]; how a friction lag may grow with speed, short of proportion.
_DECAYS = tuple((float(v),) for v in np.geomspace(0.005, 0.64, 8))
_POWERS = tuple((float(v),) for v in np.linspace(-0.2, 0.6, 9))
# Shorter spikes end before the first block after a start [s].
_SHORTEST = 0.002


def encoder_library(scene: Scene) -> list[Effect]:
    """What the drives may do, as the encoders show it while the axis runs at its feed."""
    return [_mismatch(scene), _shrink(scene), *_spikes(scene, scene.motion.machine.linear)]


def gauge_library(scene: Scene) -> list[Effect]:
    """What the gauges may show that the encoders do not."""
    axes = (*scene.motion.machine.linear, scene.motion.axis)
    found = [clock_offset(), _shrink(scene), *_spikes(scene, axes), *_backlash(scene, axes)]
    # Nothing rubs where nothing touches.
    return [friction_lag(), *found] if scene.contact else found


def clock_offset() -> Effect:
    """A tangential shift in proportion to speed that the encoders do not show."""
    return Effect(
        CLOCK, 'clocks of gauges and CNC differ',
        'tangential = v t0, and every feature late by t0', (), (Parameter('t0', 's'),),
        _along(TANGENTIAL, lambda scene: scene.path_speed),
    )


def friction_lag() -> Effect:
    """A lag that has another law than proportion to speed."""

    def columns(scene: Scene, shape: tuple[float, ...]) -> np.ndarray:
        passes = scene.motion.passes
        speed = scene.motion.radius * np.array([one.speed for one in passes])
        sign = np.array([one.sign for one in passes])
        return _single(TANGENTIAL, -(sign * (speed / REFERENCE_SPEED) ** shape[0])[scene.number])

    return Effect(
        LAG, 'contact probes trail the motion',
        'tangential = -lag (|v| / 10 mm/s)^p in the direction of the motion', (),
        (Parameter('lag', 'm'),), columns, (Parameter('p', '1'),), _POWERS,
    )


def lag_at(feed: int) -> Effect:
    """A lag at one feed alone, whatever it is at others."""
    return Effect(
        f'lag/{feed}', f'lag at feed {feed + 1}', 'tangential = -lag in the direction of motion',
        (), (Parameter('lag', 'm'),),
        _along(TANGENTIAL, lambda scene: -np.sign(scene.omega) * (scene.feed == feed)),
    )


def speed_in_transients(scene: Scene) -> np.ndarray:
    """(n, 3, k) a tangential shift, free to the second order in speed, at every start and stop.

    What friction does there is not known, so that starts and stops tell nothing of its law.
    """
    columns = []
    for number, one in enumerate(scene.motion.passes):
        mine = (scene.number == number) & ~scene.steady
        middle = 0.5 * (one.start + one.end)
        for part in (mine & (scene.time < middle), mine & (scene.time > middle)):
            if part.any():
                columns += [part * (scene.omega / one.speed) ** power for power in range(3)]
    found = np.zeros((len(scene), 3, len(columns)))
    for number, column in enumerate(columns):
        found[:, TANGENTIAL, number] = column
    return found


def _mismatch(scene: Scene) -> Effect:
    axis = scene.motion.axis
    return Effect(
        f'servo-mismatch/{axis}', f'{axis} and the linear axes follow their commands unequally',
        f'tangential = v (1/Kv_{axis} - 1/Kv_linear), in the encoders', (),
        (Parameter('1/Kv difference', 's'),),
        _along(TANGENTIAL, lambda scene: scene.path_speed),
    )


def _shrink(scene: Scene) -> Effect:
    half = 0.5 * scene.motion.radius
    return Effect(
        SHRINK, 'the circle of the linear axes shrinks with speed',
        'radial = -(omega T)^2 R / 2', (), (Parameter('T^2', 's^2'),),
        _along(RADIAL, lambda scene: -half * scene.omega**2),
    )


def _spikes(scene: Scene, axes: Sequence[str]) -> list[Effect]:
    """After an axis turned round it is off along itself, which dies away."""
    found = []
    for axis in axes:
        turns = scene.reversals(axis)
        if not turns:
            continue
        unit = 'rad' if axis == scene.motion.axis else 'm'
        # An axis that turns round to one side only does not show the two apart.
        both = len({sign for _, sign in turns}) > 1

        def columns(
            scene: Scene, shape: tuple[float, ...], axis: str = axis,
            turns: list[tuple[float, float]] = turns, both: bool = both,
        ) -> np.ndarray:
            decay = decaying(scene, turns, shape[0])[:, : 1 + both]
            return _slope(scene, axis)[:, :, None] * decay[:, None, :]

        size, parameters = 'A d', [Parameter('A', unit)]
        if both:
            size, parameters = '(A d + A_same)', [*parameters, Parameter('A_same', unit)]
        found.append(Effect(
            f'reversal-spike/{axis}', f'spikes where {axis} reverses',
            f'{axis} off by {size} exp(-(t - t_reversal)/tau), d = sign of the new direction', (),
            tuple(parameters), columns, (Parameter('tau', 's'),), _DECAYS,
        ))
    return found


def decaying(scene: Scene, turns: list[tuple[float, float]], tau: float) -> np.ndarray:
    """(n, 2) mean of exp(-(t - t_reversal)/tau) over the blocks, after each axis reversal.

    The first column has the sign of the new direction. A spike ends with the next reversal.
    """
    tau = max(tau, _SHORTEST)
    columns = np.zeros((len(scene), 2))
    ends = [when for when, _ in turns[1:]] + [np.inf]
    for (when, sign), end in zip(turns, ends, strict=True):
        rows = np.flatnonzero((scene.end > when) & (scene.time < min(end, when + 12.0 * tau)))
        begin = np.maximum(scene.begin[rows], when) - when
        whole = scene.end[rows] - scene.begin[rows]
        mean = tau / whole * (np.exp(-begin / tau) - np.exp(-(scene.end[rows] - when) / tau))
        columns[rows, 0] += sign * mean
        columns[rows, 1] += mean
    return columns


def _backlash(scene: Scene, axes: Sequence[str]) -> list[Effect]:
    found = []
    for axis in axes:
        unit = 'rad' if axis == scene.motion.axis else 'm'

        def columns(
            scene: Scene, shape: tuple[float, ...], axis: str = axis
        ) -> np.ndarray:
            speed = scene.omega if axis == scene.motion.axis else scene.axis_speed(axis)
            slow = np.abs(speed) < 1e-6 * max(np.abs(speed).max(), 1e-12)
            sign = np.where(slow, 0.0, np.sign(speed))
            return (0.5 * _slope(scene, axis) * sign[:, None])[:, :, None]

        found.append(Effect(
            f'backlash/{axis}', f'backlash of {axis}',
            f'{axis} off by h/2 times the sign of its motion, not in the encoders', (),
            (Parameter('h', unit),), columns,
        ))
    return found


def _slope(scene: Scene, axis: str) -> np.ndarray:
    """(n, 3) displacement per motion of an axis; the rotary one moves the nest away."""
    if axis == scene.motion.axis:
        return np.array([0.0, -scene.motion.radius, 0.0]) * np.ones((len(scene), 1))
    return scene.slopes[axis]


def _single(component: int, values: np.ndarray) -> np.ndarray:
    columns = np.zeros((len(values), 3, 1))
    columns[:, component, 0] = values
    return columns


def _along(component: int, function: Callable[[Scene], np.ndarray]) -> Columns:
    return lambda scene, shape: _single(component, function(scene))
