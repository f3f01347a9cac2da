"""Interpolation over the stations of a rotary axis, linear in the values at the stations.

A cubic spline is used because error maps are smooth: over stations 25 degrees apart it meets
sin 2B five times closer than a monotone (PCHIP) or Akima interpolant, which flatten every
extremum, and the true extremum may well lie beyond the highest station. And it is linear in the
values, so that their covariance carries over exactly. What it may be wrong by is judged by its
difference to PCHIP (`Stations.doubt`). Nothing is ever extrapolated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from rtest_identification.error_map import STATION

TURN = 2.0 * np.pi
# The stations cover the turn where no two neighbours are further apart [rad].
MAX_GAP = np.pi / 2 + STATION


@dataclass(frozen=True)
class Stations:
    """Sorted stations of one axis, on the turn or on the part of it that they cover.

    knots : (s,) increasing [rad], within one turn
    average : (s, m) from values at the m measured stations to the knots: stations a whole number
        of turns apart are one knot
    periodic : whether the turn closes; otherwise the range is that of the knots
    """

    knots: np.ndarray
    average: np.ndarray
    periodic: bool

    @classmethod
    def of(cls, measured: np.ndarray) -> Stations:
        """From measured stations (m,) [rad], in any order and over any number of turns."""
        measured = np.asarray(measured, dtype=float)
        # Start behind the widest gap, so that it lies at the seam.
        angle = np.sort(measured % TURN)
        gaps = np.diff(angle, append=angle[0] + TURN)
        widest = int(np.argmax(gaps))
        start = angle[(widest + 1) % len(angle)] - STATION
        angle = (measured - start) % TURN + start
        order = np.argsort(angle, kind='stable')
        group = np.empty(len(angle), dtype=int)
        group[order] = np.concatenate([[0], np.cumsum(np.diff(angle[order]) > STATION)])
        members = group == np.arange(group.max() + 1)[:, None]
        average = members / members.sum(axis=1, keepdims=True)
        knots = average @ angle
        # Prefer the stations' own numbers: -75 rather than 285 degrees.
        knots = knots - TURN * np.round((knots.mean() - measured.mean()) / TURN)
        return cls(knots, average, len(knots) > 2 and bool(gaps[widest] <= MAX_GAP))

    def place(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angles (n,) [rad] turned into the range of the knots; (n,) bool, False outside it.

        An angle outside is moved to an end of the range.
        """
        start = self.knots[0] - (0.0 if self.periodic else STATION)
        placed = start + (np.asarray(angle, dtype=float) - start) % TURN
        if self.periodic:
            return placed, np.ones(len(placed), dtype=bool)
        inside = placed <= self.knots[-1] + STATION
        return np.clip(placed, self.knots[0], self.knots[-1]), inside

    def weights(self, angle: np.ndarray) -> np.ndarray:
        """(n, m) such that weights @ values at the measured stations is the spline at `angle`."""
        if len(self.knots) == 1:
            return np.broadcast_to(self.average, (len(angle), self.average.shape[1]))
        x, values = self._closed(self.average)
        kind = 'periodic' if self.periodic else 'not-a-knot'
        return CubicSpline(x, values, bc_type=kind)(self.place(angle)[0])

    def doubt(self, values: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """How far the spline through values (m, ...) may be off: (n, ...), 0 at the stations.

        In every interval a parabola as high as the largest difference between spline and PCHIP.
        PCHIP converges a power or two slower, so that for a smooth map the difference is about
        PCHIP's own error and bounds the spline's; where a map has a corner the spline rings and
        PCHIP does not, so that it shows as well. Leaving one station out at a time would say five
        to ten times too much, because it doubles the spacing. What is narrower than the spacing
        of the stations no rule can see from them.
        """
        if len(self.knots) == 1:
            return np.zeros((len(angle), *values.shape[1:]))
        x, y = self._closed(np.tensordot(self.average, values, axes=1))
        kind = 'periodic' if self.periodic else 'not-a-knot'
        inner = np.linspace(0.0, 1.0, 9)[1:-1]
        fine = (x[:-1, None] + np.diff(x)[:, None] * inner).ravel()
        spline = CubicSpline(x, y, bc_type=kind)(fine)
        placed, _ = self.place(angle)
        interval = np.clip(np.searchsorted(x, placed, side='right') - 1, 0, len(x) - 2)
        part = (placed - x[interval]) / (x[interval + 1] - x[interval])
        if self.periodic:
            # PCHIP looks at the neighbours of an interval: one more on each side.
            x = np.concatenate([[x[-2] - TURN], x, [x[1] + TURN]])
            y = np.concatenate([y[-2:-1], y, y[1:2]])
        apart = np.abs(spline - PchipInterpolator(x, y)(fine))
        highest = apart.reshape(-1, len(inner), *values.shape[1:]).max(axis=1)
        hump = np.clip(4.0 * part * (1.0 - part), 0.0, 1.0)
        return highest[interval] * hump.reshape(-1, *[1] * (values.ndim - 1))

    def _closed(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Knots and values, with the first repeated a turn later where the turn closes."""
        if not self.periodic:
            return self.knots, values
        return (
            np.append(self.knots, self.knots[0] + TURN),
            np.concatenate([values, values[:1]]),
        )
