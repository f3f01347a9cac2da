"""How much later the gauges' stamps are than the CNC's, from the data themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_identification.dynamic.blocks import TRANSIENT_TIME, Scene, make_scene
from rtest_identification.dynamic.motion import Motion, Readings, Track
from rtest_identification.dynamic.noise import orthonormal
from rtest_identification.dynamic.rows import gauge_rows, pass_shifts

# The clocks are first compared over this range, in steps [s].
_RANGE, _STEP = 0.25, 0.004
# Rest before a start and after a stop that is compared besides [s].
_REST = 0.1
# Of the geometric part so many powers of the angle are free in each comparison.
_POWERS = 3
_ITERATIONS = 6
# The offset is not determined where less than this part of its signature is its own, or less
# than so many times what the scatter of the encoders looks like.
_OWN, _CLEAR = 0.02, 10.0


@dataclass(frozen=True)
class TimeOffset:
    """How much later the gauges' stamps are than the CNC's.

    value, stddev : [s]; NaN and infinite where the data do not determine it
    why : what determines it, or what is missing
    """

    value: float
    stddev: float
    why: str

    @property
    def determined(self) -> bool:
        """Whether the data say anything."""
        return bool(np.isfinite(self.stddev))


def align(motion: Motion, cycles: list[Readings]) -> tuple[Scene, TimeOffset]:
    """Blocks by a common clock, and the offset that was between the two.

    The features that both show (starts, stops, reversals) and the geometric part, which comes at
    another time in the other direction and at another speed, determine it, beside a free
    displacement of every pass: a tangential shift in proportion to speed is not used.
    """
    offset = coarse_offset(motion, cycles)
    found, stddev = 0.0, float('inf')
    for _ in range(_ITERATIONS):
        scene = make_scene(motion, cycles, offset)
        rows = gauge_rows(scene)
        free = np.concatenate([rows.base[:, :, 1:], pass_shifts(scene)], axis=2)
        basis = orthonormal(rows.white(free))
        own = rows.white(rows.base[:, :, 0])
        left = own - basis @ (basis.T @ own)
        square = float(left @ left)
        scatter = 3.0 * float(((scene.change_noise / rows.sigma) ** 2).sum())
        if square <= max((_OWN * float(np.linalg.norm(own))) ** 2, _CLEAR * scatter):
            why = 'no start, stop, reversal or second speed shows how late the features are'
            return make_scene(motion, cycles), TimeOffset(float('nan'), float('inf'), why)
        y = rows.white(rows.value)
        found = float(left @ y) / square
        offset += found
        stddev = square**-0.5
        if abs(found) < 0.02 * stddev:
            break
    why = 'starts, stops, reversals and the geometric part at several speeds and directions'
    return make_scene(motion, cycles, offset), TimeOffset(offset, stddev, why)


def coarse_offset(motion: Motion, cycles: list[Readings]) -> float:
    """The offset to within the width of a transient [s], by search over starts and stops.

    At each of them the servo's own motion is compared with the measured one, beside what goes
    with the angle, with the motion and with its speed.
    """
    windows = []
    for one in motion.passes:
        cycle, track = cycles[one.cycle], motion.tracks[one.cycle]
        for begin, end in ((one.start - _REST, one.steady[0]), (one.steady[1], one.end + _REST)):
            times, means = _means(cycle, begin - _RANGE, end + _RANGE)
            if len(times) > 10 * _POWERS:
                windows.append((track, times, means @ motion.frame.T))
    tried = np.arange(-_RANGE, _RANGE + 0.5 * _STEP, _STEP)
    costs = np.array([sum(_misfit(*window, offset) for window in windows) for offset in tried])
    count = 3 * sum(len(times) for _, times, _ in windows)
    best = int(np.argmin(costs))
    # Where nothing tells the offsets apart the clocks are taken as they are.
    same = costs[np.argmin(np.abs(tried))] < costs[best] * (1.0 + 10.0 / max(count, 1))
    return 0.0 if same else float(tried[best])


def _means(cycle: Readings, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) and centres (n, 3) of readings over short blocks."""
    low, high = np.searchsorted(cycle.time, [begin, end])
    if high - low < 2:
        return np.empty(0), np.empty((0, 3))
    step = float(np.median(np.diff(cycle.time[low:high])))
    few = max(round(TRANSIENT_TIME / step), 1)
    usable = (high - low) // few * few
    part = slice(low, low + usable)
    times = cycle.time[part].reshape(-1, few).mean(axis=1)
    return times, cycle.centre[part].reshape(-1, few, 3).mean(axis=1)


def _misfit(track: Track, times: np.ndarray, measured: np.ndarray, offset: float) -> float:
    """Sum of squares [m2] that the servo leaves at one start or stop with this offset."""
    at = times - offset
    angle = np.interp(at, track.time, track.angle)
    angle = angle - angle.mean()
    speed = np.interp(at, track.time, track.omega)
    speed = speed / max(np.abs(speed).max(), 1e-12)
    columns = [angle**power for power in range(_POWERS + 1)]
    columns += [speed, np.where(np.abs(speed) > 0.05, np.sign(speed), 0.0)]
    servo = np.stack([np.interp(at, track.time, s) for s in track.servo.T], axis=1)
    free, left = np.stack(columns, axis=1), measured - servo
    left = left - free @ np.linalg.lstsq(free, left, rcond=1e-6)[0]
    return float((left**2).sum())
