"""A simulated dynamic measurement for the tests: plain numpy, none of the package's numerics.

C turns with X and Y following. Constant errors act through the 4x4 matrices of `independent`;
what the drives and the gauges do is written out by hand.
"""

from dataclasses import dataclass, field

import numpy as np
from independent import LETTERS, centre
from scipy.interpolate import CubicSpline

SLOW, FAST = np.radians(358.0) / 60.0, np.radians(3583.0) / 60.0
SPHERE = np.array([0.0002, -0.0839, 0.0405])
RADIUS = float(np.hypot(*SPHERE[:2]))
GAUGE_HZ, FEEDBACK_HZ = 1000, 500


@dataclass
class Hidden:
    """What is wrong with the machine and the gauges, SI. All zero: a clean measurement.

    errors : constant errors as in `independent.centre`
    runout2 : radial run-out of C, two a turn; a function of the angle alone
    mismatch : 1/Kv of C less that of X and Y [s]; the encoders see it
    shrink : T of the circle's shrinking [s]; shrink_seen whether encoders see it
    late : by how much the gauges' stamps are late [s]; shift_late : and shift the tangential by v
    lag : of touching probes at each feed [m], by feed
    spike : (axis, A [m], tau [s]); spike_seen whether encoders see it
    start : size of the servo's spike at every start at the fast feed [m]
    drift : random walk of the nest [m/sqrt(s)]; vibration : amplitude at 23 Hz [m]
    """

    errors: dict = field(default_factory=lambda: {'C': {'X': 12e-6, 'Y': -7e-6, 'A': 2e-5}})
    runout2: float = 1.5e-6
    mismatch: float = 0.0
    shrink: float = 0.0
    shrink_seen: bool = False
    late: float = 0.0
    shift_late: bool = False
    lag: dict = field(default_factory=dict)
    spike: tuple | None = None
    spike_seen: bool = False
    start: float = 5e-6
    noise: float = 0.25e-6
    encoder: float = 1e-8
    drift: float = 0.0
    vibration: float = 0.0


def profile(turns, speed, acceleration=8.0, rest=0.5):
    """C(t), omega(t) and duration of: rest, turns forward, rest, turns back, rest."""
    ramp = speed / acceleration
    run = 2.0 * np.pi * turns / speed
    knots = np.cumsum([0.0, rest, ramp, run - ramp, ramp, rest, ramp, run - ramp, ramp, rest])
    speeds = np.array([0.0, 0.0, speed, speed, 0.0, 0.0, -speed, -speed, 0.0, 0.0])
    whole = np.r_[0.0, np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(knots))]

    def omega(t):
        return np.interp(t, knots, speeds)

    def angle(t):
        t = np.clip(t, 0.0, knots[-1])
        k = np.clip(np.searchsorted(knots, t, 'right') - 1, 0, len(knots) - 2)
        s = t - knots[k]
        slope = (speeds[k + 1] - speeds[k]) / np.diff(knots)[k]
        return whole[k] + speeds[k] * s + 0.5 * slope * s * s

    starts = [(knots[1], 1.0), (knots[5], -1.0)]
    return angle, omega, float(knots[-1]), starts


def geometric(hidden):
    """C to (n, 3) displacement in the table frame of the constant errors, as a spline."""
    grid = np.linspace(0.0, 2.0 * np.pi, 361)
    x, y, z = SPHERE
    values = []
    for c in grid:
        place = (x * np.cos(c) - y * np.sin(c), x * np.sin(c) + y * np.cos(c), z)
        values.append(centre(*place, 0.0, c, hidden.errors) - SPHERE)
    values = np.array(values)
    values += hidden.runout2 * np.outer(np.cos(2 * grid + 0.4), SPHERE * [1, 1, 0] / RADIUS)
    values[-1] = values[0]
    return CubicSpline(grid, values, bc_type='periodic')


def cycle(hidden, speed, turns, seed=0, begin=0.0, **profile_options):
    """One cycle to and fro: dict of gauge times, centres, feedback times and positions."""
    rng = np.random.default_rng(seed)
    angle, omega, length, starts = profile(turns, speed, **profile_options)
    radial = SPHERE * [1, 1, 0] / RADIUS
    tangential = np.array([-radial[1], radial[0], 0.0])
    start_angle = np.arctan2(SPHERE[1], SPHERE[0])
    t_cnc = np.arange(0.0, length, 1.0 / FEEDBACK_HZ)
    t_true = np.arange(0.0, length, 1.0 / GAUGE_HZ)

    # Drives: deviation of the true positions of X, Y [m] and C [rad] from the command.
    def drives(t):
        c, w = angle(t), omega(t)
        ring = np.zeros_like(t)
        for when, sign in starts:
            s = t - when
            after = s > 0
            ring[after] += sign * np.exp(-s[after] / 0.05) * np.sin(2 * np.pi * 15 * s[after])
        ring *= hidden.start * speed / FAST
        phase = c + start_angle
        # C late by m: the nest lies behind, the sphere before it.
        return {
            'C': -w * hidden.mismatch + ring / RADIUS,
            'ring': ring, 'phase': phase, 'omega': w, 'angle': c,
        }

    def spikes(t):
        """Displacement of the axis [m] after its reversals, and its index."""
        if hidden.spike is None:
            return np.zeros_like(t), 0
        axis, size, tau = hidden.spike
        fine = np.arange(0.0, length, 1e-4)
        phase = angle(fine) + start_angle
        velocity = omega(fine) * (-np.sin(phase) if axis == 'X' else np.cos(phase))
        sign = np.sign(np.where(np.abs(velocity) < 1e-9, 0.0, velocity))
        moving = np.flatnonzero(sign)
        turn = moving[1:][sign[moving][1:] != sign[moving][:-1]]
        last = np.searchsorted(fine[turn], t, 'right') - 1
        since = np.where(last >= 0, t - fine[turn][np.maximum(last, 0)], np.inf)
        new = np.where(last >= 0, sign[turn][np.maximum(last, 0)], 0.0)
        return size * new * np.exp(-np.maximum(since, 0.0) / tau), 'XY'.index(axis)

    def table_frame(c, shift):
        """Machine-frame shift (n, 2) of the sphere as the table sees it."""
        turned = np.zeros((len(c), 3))
        turned[:, 0] = np.cos(c) * shift[:, 0] + np.sin(c) * shift[:, 1]
        turned[:, 1] = -np.sin(c) * shift[:, 0] + np.cos(c) * shift[:, 1]
        return turned

    # What the gauges see at true times.
    state = drives(t_true)
    seen = geometric(hidden)(np.mod(state['angle'], 2.0 * np.pi))
    seen -= np.outer(RADIUS * state['C'], tangential)
    seen -= np.outer(0.5 * (state['omega'] * hidden.shrink) ** 2 * RADIUS, radial)
    spike, column = spikes(t_true)
    seen += table_frame(state['angle'], np.eye(2)[column] * spike[:, None])
    lag = hidden.lag.get(round(speed, 6), 0.0)
    seen -= np.outer(np.sign(state['omega']) * lag, tangential)
    if hidden.shift_late:
        seen += np.outer(state['omega'] * RADIUS * hidden.late, tangential)
    seen += hidden.noise * rng.normal(size=seen.shape)

    walk = np.cumsum(rng.normal(size=seen.shape), axis=0) / np.sqrt(GAUGE_HZ)
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    seen += hidden.drift * walk
    seen += hidden.vibration * np.sin(2.0 * np.pi * 23.0 * t_true[:, None] + phases)

    # What the encoders see.
    state = drives(t_cnc)
    scale = RADIUS
    if hidden.shrink_seen:
        scale = RADIUS * (1.0 - 0.5 * (state['omega'] * hidden.shrink) ** 2)
    spike, column = spikes(t_cnc)
    feedback = np.zeros((len(t_cnc), 5))
    feedback[:, 0] = scale * np.cos(state['phase'])
    feedback[:, 1] = scale * np.sin(state['phase'])
    if hidden.spike_seen:
        feedback[:, column] += spike
    feedback[:, 2] = SPHERE[2]
    feedback[:, 4] = state['angle'] + state['C']
    feedback[:, :3] += hidden.encoder * rng.normal(size=(len(t_cnc), 3))
    feedback[:, 4] += hidden.encoder / RADIUS * rng.normal(size=len(t_cnc))
    return {
        'time': begin + t_true + hidden.late, 'centre': seen,
        'feedback_time': begin + t_cnc, 'feedback': feedback, 'length': length,
    }


def measurement(hidden, feeds=((SLOW, 1.2), (FAST, 3.2)), seed=0, **profile_options):
    """Cycles at several (speed, turns), one after the other."""
    found, begin = [], 0.0
    for number, (speed, turns) in enumerate(feeds):
        found.append(cycle(hidden, speed, turns, seed * 100 + number, begin, **profile_options))
        begin += found[-1]['length'] + 5.0
    return found


assert LETTERS == ('X', 'Y', 'Z', 'B', 'C')
