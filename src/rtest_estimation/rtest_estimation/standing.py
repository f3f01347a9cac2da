"""Readings while everything stands still: how much they scatter, at which frequencies.

A line in their spectrum has a cause that can be mended: mains hum, a spindle or a pump that runs.
Frequencies above half the rate of the readings appear folded below it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal, stats

from rtest_estimation.records import Feedback, GaugeBlock, Status

# Feedback that moves by no more from one message to the next stands still [m], [rad].
STILL = 2e-6
# A line of this height or more is chance in one of so many spectra.
_CHANCE = 0.01
# Drifts and what a window of Hann smears out of them lie in the first bins.
_FIRST_BIN = 4
# Around a motion readings still swing, or move already by less than the feedback shows [ns].
_SETTLE_NS = 500_000_000
# Parts of a stretch whose means show how sure a drift is.
_BLOCKS = 10


@dataclass(frozen=True)
class Line:
    """A line of a spectrum. frequency : [Hz]; amplitude : half of peak to peak [m]."""

    frequency: float
    amplitude: float


@dataclass(frozen=True)
class Standing:
    """Readings of all gauges over a stretch in which all axes stood still.

    rate : [1/s]; readings : (n, gauges) [m], evenly spaced
    steps : (gauges,) smallest difference of two readings of the whole recording, the resolution
        of a gauge whose noise is below it [m]; infinite of one that always read the same
    """

    rate: float
    readings: np.ndarray
    steps: np.ndarray

    @property
    def duration(self) -> float:
        """[s]."""
        return len(self.readings) / self.rate

    @property
    def resolution(self) -> float:
        """Distance of two frequencies that a window of Hann still separates [Hz]."""
        return 2.0 / self.duration

    @property
    def noise(self) -> np.ndarray:
        """(gauges,) standard deviation of single readings about a straight line [m].

        At least that of rounding to the resolution, which the readings need not show.
        """
        return np.maximum(self._scatter, self.steps / np.sqrt(12.0))

    @property
    def change(self) -> np.ndarray:
        """(gauges,) change over the stretch, by a straight line [m]."""
        times = np.arange(len(self.readings)) / self.rate
        return np.polyfit(times, self.readings, 1)[0] * self.duration

    @property
    def change_spread(self) -> np.ndarray:
        """(gauges,) expanded uncertainty of the change at 95 % [m].

        From the scatter of the means of `_BLOCKS` parts about a line: readings next to each other
        are not independent where there is hum. Beside it a step of the resolution.
        """
        length = len(self.readings) // _BLOCKS
        means = self.readings[: _BLOCKS * length].reshape(_BLOCKS, length, -1).mean(axis=1)
        times = np.arange(_BLOCKS) * length / self.rate
        _, covariance = np.polyfit(times, means, 1, cov=True)
        slope = stats.t.ppf(0.975, _BLOCKS - 2) * np.sqrt(covariance[0, 0])
        return slope * self.duration + np.where(self.steps > self._scatter, self.steps, 0.0)

    @property
    def _scatter(self) -> np.ndarray:
        return signal.detrend(self.readings, axis=0).std(axis=0, ddof=2)

    def lines(self, gauge: int) -> list[Line]:
        """Lines that stand out of a gauge's noise, the strongest first.

        The periodogram of white noise is exponentially distributed about its mean, which is its
        median over ln 2. A line is a local maximum so high that one of n bins reaches it by
        chance with `_CHANCE`: mean times ln(n / chance).
        """
        frequency, power = signal.periodogram(
            signal.detrend(self.readings[:, gauge]), self.rate, 'hann', scaling='spectrum'
        )
        power = power[_FIRST_BIN:]
        if len(power) < 8:
            return []
        threshold = np.median(power) / np.log(2.0) * np.log(len(power) / _CHANCE)
        peaks, _ = signal.find_peaks(
            np.concatenate([[0.0], power, [0.0]]), height=threshold, distance=3
        )
        found = [
            Line(float(frequency[p - 1 + _FIRST_BIN]), float(np.sqrt(2.0 * power[p - 1])))
            for p in peaks
        ]
        return sorted(found, key=lambda line: -line.amplitude)


def folded(frequency: float, rate: float) -> float:
    """Where a frequency appears in readings at this rate [Hz]."""
    return abs(frequency - rate * round(frequency / rate))


def longest_standing(
    gauges: Sequence[GaugeBlock], feedback: Sequence[Feedback]
) -> Standing | None:
    """The longest stretch with all axes still and all gauges valid; None without any.

    Readings are brought to even spacing by linear interpolation, which serial lines need.
    """
    times = np.array([one.stamp for one in feedback], dtype=np.int64)
    if len(times) < 2 or not gauges:
        return None
    positions = np.array([one.position for one in feedback])
    moving = times[1:][np.abs(np.diff(positions, axis=0)).max(axis=1) > STILL]
    channels = gauges[0].displacement.shape[1]
    blocks = [one for one in gauges if one.displacement.shape[1] == channels]
    stamps = np.concatenate([one.stamps for one in blocks])
    readings = np.concatenate([one.displacement for one in blocks])
    valid = np.concatenate([(one.status == Status.VALID).all(axis=1) for one in blocks])
    inside = (stamps >= times[0]) & (stamps <= times[-1])
    good = valid & inside & np.isfinite(readings).all(axis=1)
    good &= _away(stamps, moving) >= _SETTLE_NS
    # A stretch ends with a motion and with a reading that is not good.
    part = np.searchsorted(moving, stamps) + np.cumsum(~good)
    part, stamps, readings = part[good], stamps[good], readings[good]
    if not len(part):
        return None
    steps = np.array([_step(column) for column in readings.T])
    names, counts = np.unique(part, return_counts=True)
    chosen = part == names[counts.argmax()]
    stamps, readings = (stamps[chosen] - stamps[chosen][0]) * 1e-9, readings[chosen]
    if len(stamps) < 16 or stamps[-1] <= 0.0:
        return None
    even = np.linspace(0.0, stamps[-1], len(stamps))
    return Standing(
        (len(stamps) - 1) / float(stamps[-1]),
        np.column_stack([np.interp(even, stamps, column) for column in readings.T]),
        steps,
    )


def _step(readings: np.ndarray) -> float:
    """Smallest difference of two different readings [m]; infinite where there are none."""
    values = np.unique(readings)
    return float(np.diff(values).min()) if len(values) > 1 else np.inf


def _away(stamps: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """(n,) how far in time from the nearest of the instants `moving` (m,), in order [ns]."""
    if not len(moving):
        return np.full(len(stamps), np.iinfo(np.int64).max)
    after = np.searchsorted(moving, stamps)
    last, following = moving[np.maximum(after - 1, 0)], moving[np.minimum(after, len(moving) - 1)]
    return np.minimum(np.abs(stamps - last), np.abs(following - stamps))
