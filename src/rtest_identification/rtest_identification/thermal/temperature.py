"""What a thermometer says at the times of the cycles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

# The temperature at rest is that at the first reading, by a straight line through so much [s].
_REST_S = 300.0


@dataclass(frozen=True)
class Thermometer:
    """Readings of one sensor, in order of time.

    stamp : (n,) int64 [ns]; celsius : (n,) temperature [degC], as in sensor_msgs/Temperature;
        readings that are not finite are left out
    """

    sensor: str
    stamp: np.ndarray
    celsius: np.ndarray

    @staticmethod
    def of(sensor: str, stamp: np.ndarray, celsius: np.ndarray) -> Thermometer:
        """Sort by time, leave out what is no temperature and what was delivered twice."""
        stamp = np.asarray(stamp, dtype=np.int64)
        celsius = np.asarray(celsius, dtype=float)
        good = np.isfinite(celsius)
        unique, first = np.unique(stamp[good], return_index=True)
        return Thermometer(sensor, unique, celsius[good][first])

    def __len__(self) -> int:
        return len(self.stamp)

    @property
    def noise(self) -> float:
        """Standard deviation of a reading, from successive differences (von Neumann) [K]."""
        # They differ by twice the variance of one, whatever the temperature does meanwhile.
        return float(np.sqrt(0.5 * np.mean(np.diff(self.celsius) ** 2)))

    @property
    def resolution(self) -> float:
        """Smallest step between readings [K]; 0 where none differ."""
        steps = np.abs(np.diff(self.celsius))
        return float(steps[steps > 0.0].min(initial=np.inf)) if steps.any() else 0.0

    @cached_property
    def rest(self) -> float:
        """Temperature when the readings begin, less noisy than the first of them [degC]."""
        time = (self.stamp - self.stamp[0]) * 1e-9
        some = time <= _REST_S
        if some.sum() < 3:
            return float(self.celsius[0])
        return float(np.polyfit(time[some], self.celsius[some], 1)[1])

    def mean(self, stamps: np.ndarray, window: float) -> np.ndarray:
        """Mean over `window` [s] about each time [ns], linear between readings [degC].

        Before the first reading the machine is taken to have been at rest, at `rest`. After the
        last one nothing is known: a mean is over what there is of its window, NaN where none is.
        """
        if not len(self):
            return np.full(np.shape(stamps), np.nan)
        origin = int(self.stamp[0])
        time = (self.stamp - origin) * 1e-9
        asked = (np.asarray(stamps, dtype=np.int64) - origin) * 1e-9
        left, right = asked - 0.5 * window, np.minimum(asked + 0.5 * window, time[-1])
        known = right > left
        length = np.where(known, right - left, 1.0)
        # The mean of straight lines is a difference of their integral.
        mean = (self._integral(time, right) - self._integral(time, left)) / length
        return np.where(known, mean, np.nan)

    def mean_stddev(self, window: float) -> float:
        """Standard uncertainty of such a mean, by scatter and resolution of the readings [K]."""
        if len(self) < 2:
            return float('nan')
        step = float(np.median(np.diff(self.stamp))) * 1e-9
        # Averaging helps against noise, not against steps that hide it.
        return float(np.hypot(
            self.noise / np.sqrt(max(window / step, 1.0)), self.resolution / np.sqrt(12.0)
        ))

    def covers(self, stamps: np.ndarray, window: float) -> np.ndarray:
        """Whether there are readings not further than `window` [s] away from each time [ns]."""
        if not len(self):
            return np.zeros(np.shape(stamps), dtype=bool)
        after = np.clip(np.searchsorted(self.stamp, stamps), 1, max(len(self) - 1, 1))
        near = np.minimum(
            np.abs(self.stamp[np.minimum(after, len(self) - 1)] - stamps),
            np.abs(stamps - self.stamp[after - 1]),
        )
        return near <= window * 1e9

    def _integral(self, time: np.ndarray, until: np.ndarray) -> np.ndarray:
        """Integral of the temperature from the first reading to times up to the last [K s]."""
        if len(time) < 2:
            return self.rest * until
        celsius = self.celsius
        steps = 0.5 * (celsius[1:] + celsius[:-1]) * np.diff(time)
        total = np.concatenate([[0.0], np.cumsum(steps)])
        left = np.clip(np.searchsorted(time, until, side='right') - 1, 0, len(time) - 2)
        ahead = until - time[left]
        slope = (celsius[left + 1] - celsius[left]) / (time[left + 1] - time[left])
        inside = total[left] + ahead * (celsius[left] + 0.5 * slope * ahead)
        return np.where(until < 0.0, self.rest * until, inside)
