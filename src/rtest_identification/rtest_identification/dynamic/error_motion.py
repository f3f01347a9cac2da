"""What is in the components: servo, geometric and dynamic parts, turn by turn (ISO 230-7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_identification.dynamic.blocks import STEADY_ANGLE, Scene
from rtest_identification.dynamic.effects import lag_at
from rtest_identification.dynamic.rows import Rows, cycle_shifts, geometric
from rtest_identification.gap.size import visible

# Angles at which turns are compared.
STATIONS = round(2.0 * np.pi / STEADY_ANGLE)
ORDERS = 10
# A transient is over when the displacement stays this near its steady mean [m], or within three
# standard deviations of the readings where they scatter more.
_QUIET = 1e-6
# Less of a turn than this is none.
_ENOUGH = np.radians(300.0)


@dataclass(frozen=True)
class Parts:
    """Displacement of every block, split; radial, tangential, axial, (n, 3) each [m].

    measured : as the gauges show it, without the zeros, the drift and the centre offset
    servo : what the encoders show of it, less its mean zero
    geometric : what depends on the angle alone
    dynamic : the rest; explained : what the named effects are of it
    centre_offset : (2,) of the axis, towards the start of the machine angle and a quarter turn on,
        which is taken out of radial and tangential together [m]
    """

    measured: np.ndarray
    servo: np.ndarray
    geometric: np.ndarray
    dynamic: np.ndarray
    explained: np.ndarray
    centre_offset: np.ndarray


@dataclass(frozen=True)
class Lag:
    """Tangential delay at one feed: half the difference of the two directions [m].

    gauges, encoders, beyond : of the sphere behind the nest as the gauges show it, as the encoders
        show it, and the difference of the two; each (value, stddev), infinite where open
    """

    feed: int
    gauges: tuple[float, float]
    encoders: tuple[float, float]
    beyond: tuple[float, float]


@dataclass(frozen=True)
class TurnMotion:
    """Error motion of one pass over its full turns (ISO 230-7:2015, 3.2).

    angle : (k,) [rad]; turns : (t, k, 3) displacement at it, NaN where the last of several turns
        is not complete; mean : (k, 3)
    covered : part of the turn that was run at the feed; less than one where a pass is shorter
    synchronous : (3,) width of the mean over the turn [m]
    asynchronous : (3,) largest width over the turns at one angle; NaN with a single turn
    harmonics : (orders + 1, 3) amplitudes of the mean [m]
    """

    number: int
    covered: float
    angle: np.ndarray
    turns: np.ndarray
    mean: np.ndarray
    synchronous: np.ndarray
    asynchronous: np.ndarray
    harmonics: np.ndarray


@dataclass(frozen=True)
class Transient:
    """How a motion starts: tangential deviation from its steady mean [m].

    time : (k,) since the start [s]; gauges, encoders : (k,)
    settled : when it stays within a micrometre, or within the noise where that is more [s]
    """

    number: int
    reverses: bool
    time: np.ndarray
    gauges: np.ndarray
    encoders: np.ndarray
    settled: float

    @property
    def peak(self) -> tuple[float, float]:
        """Largest deviation of gauges and of encoders, with its sign [m]."""
        return tuple(float(v[np.argmax(np.abs(v))]) for v in (self.gauges, self.encoders))


def split(gauges: Rows, encoders: Rows, effects: int = 0) -> Parts:
    """Split every block's displacement.

    gauges, encoders : rows of each, with the effects that were named in them as last columns
    effects : how many of these columns the gauges' rows have
    """
    scene, rows = gauges.scene, gauges
    fit, zero_servo = rows.fit(), encoders.fit()[:3]
    # Columns: lateness, geometric with the zero first, drift and zeros of cycles, starts and
    # stops, effects.
    columns, zeros = geometric(scene).shape[2], cycle_shifts(scene).shape[2]
    shape, drift = slice(4, 1 + columns), slice(1 + columns, 4 + columns + zeros)
    named = slice(len(fit) - effects, len(fit))
    free = slice(drift.stop, named.start)
    zero = fit[1:4]
    late, shape, drift, free, explained = (
        rows.base[:, :, part] @ fit[part] for part in (slice(1), shape, drift, free, named)
    )
    offset, circle = centre_offset(scene, shape)
    return Parts(
        scene.measured - zero - zero_servo - drift - circle, scene.servo - zero_servo,
        shape - circle, rows.residual + late + free + explained, explained, offset,
    )


def centre_offset(scene: Scene, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offset (2,) of the axis and what it shows (n, 3), the once-a-turn circle of a part.

    An offset that stands still in the machine turns as the table sees it: once a turn in radial
    and, a quarter turn apart, in tangential (Section 3.4 takes it out in the same way).
    """
    c, s = np.cos(scene.machine_angle), np.sin(scene.machine_angle)
    sense = scene.motion.machine.axes[scene.motion.axis].sense
    none = np.zeros_like(c)
    columns = np.stack(
        [np.stack([c, -sense * s, none], 1), np.stack([s, sense * c, none], 1)], axis=2
    )
    steady = scene.steady
    design = np.concatenate([columns, np.tile(np.eye(3), (len(c), 1, 1))], axis=2)[steady]
    fit = np.linalg.lstsq(design.reshape(-1, 5), shape[steady].ravel(), rcond=None)[0][:2]
    # The axis moved one way shows the sphere moved the other way.
    return -fit, columns @ fit


def lags(gauges: Rows, encoders: Rows) -> tuple[Lag, ...]:
    """Constant tangential delay at every feed, with standard uncertainty."""
    feeds = range(len(gauges.scene.motion.feeds))
    chosen = [(lag_at(feed), ()) for feed in feeds]
    found = []
    for rows in (gauges, encoders):
        value, cofactor, _ = visible(rows, chosen)
        found.append((value, np.sqrt(np.diag(cofactor))))
    (beyond, spread), (servo, servo_spread) = found
    return tuple(
        Lag(
            feed, (float(beyond[feed] + servo[feed]),
                   float(np.hypot(spread[feed], servo_spread[feed]))),
            (float(servo[feed]), float(servo_spread[feed])),
            (float(beyond[feed]), float(spread[feed])),
        )
        for feed in feeds
    )


def turn_motions(scene: Scene, values: np.ndarray) -> tuple[TurnMotion, ...]:
    """Error motions of every pass that has nearly a turn. values : (n, 3) a part of the whole."""
    found = []
    for number, one in enumerate(scene.motion.passes):
        mine = scene.of_pass(number)
        mine = mine[scene.steady[mine]]
        travel = (scene.angle[mine] - scene.angle[mine[0]]) * one.sign
        if travel[-1] < _ENOUGH:
            continue
        turns = max(int((travel[-1] - _ENOUGH) / (2.0 * np.pi)) + 1, 1)
        grid = (np.arange(turns * STATIONS) + 0.5) * (2.0 * np.pi / STATIONS)
        # Means over the station, so that every feed is smoothed alike.
        place = np.floor(travel / (2.0 * np.pi / STATIONS)).astype(int)
        place, first, share = np.unique(place, return_index=True, return_counts=True)
        means = np.add.reduceat(values[mine], first, axis=0) / share[:, None]
        where = np.add.reduceat(travel, first) / share
        each = np.stack([np.interp(grid, where, column) for column in means.T], axis=1)
        if turns > 1:
            each[grid > where[-1] + STEADY_ANGLE] = np.nan
        each = each.reshape(turns, STATIONS, 3)
        mean, spread = np.nanmean(each, axis=0), np.full(3, np.nan)
        if turns > 1:
            spread = (np.nanmax(each, axis=0) - np.nanmin(each, axis=0)).max(axis=0)
        covered = float(travel[-1] + STEADY_ANGLE) / (2.0 * np.pi)
        angle = scene.angle[mine[0]] + one.sign * grid[:STATIONS]
        waves = np.abs(np.fft.rfft(mean, axis=0))[: ORDERS + 1] * 2.0 / STATIONS
        waves[0] *= 0.5
        found.append(
            TurnMotion(
                number, min(covered, 1.0), angle, each, mean, np.ptp(mean, axis=0), spread, waves
            )
        )
    return tuple(found)


def transients(scene: Scene, parts: Parts) -> tuple[Transient, ...]:
    """How every pass starts."""
    found = []
    for number, one in enumerate(scene.motion.passes):
        mine = scene.of_pass(number)
        steady = mine[scene.steady[mine]]
        start = mine[scene.time[mine] < one.steady[0] + 0.5]
        # What the geometric part does while the axis starts is no transient.
        gauges = (parts.measured - parts.geometric)[:, 1]
        off = [values[start] - values[steady].mean() for values in (gauges, parts.servo[:, 1])]
        time = scene.time[start] - one.start
        noise = scene.white[number] / np.sqrt(np.median(scene.count[start]))
        loud = time[(np.abs(off[0]) > max(_QUIET, 3.5 * noise)) & (time > 0.0)]
        found.append(
            Transient(number, one.reverses, time, off[0], off[1],
                      float(loud[-1]) if loud.size else 0.0)
        )
    return tuple(found)
