"""The simulated gauges as a device: noise, outliers, faults and blocks of readings."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rtest_drivers.sim.faults import Window, active
from rtest_drivers.sim.gauges import GaugeData
from rtest_estimation.records import GaugeBlock, Status


class GaugeReadings:
    """Readings in order of time: every one draws its noise, and takes its place in the sequence.

    noise, outliers : where the numbers come from
    """

    def __init__(
        self, data: GaugeData, noise: np.random.Generator, outliers: np.random.Generator
    ) -> None:
        self._data, self._noise, self._outliers = data, noise, outliers
        self._sequence = 0

    def noise(self, count: int) -> np.ndarray:
        """(count, gauges) of the next readings [m]."""
        data = self._data
        shape = (count, len(data.tilt))
        noise = data.noise * self._noise.standard_normal(shape)
        if data.outliers:
            hit = self._outliers.random((*shape, 2))
            # Two uniform numbers: whether it is one, and how large (either way, up to the size).
            noise += (hit[..., 0] < data.outliers) * data.outlier * (2.0 * hit[..., 1] - 1.0)
        return noise

    def blocks(
        self, times: np.ndarray, values: np.ndarray, status: np.ndarray, windows: Iterable[Window]
    ) -> list[GaugeBlock]:
        """The next readings as they arrive, a block of `batch` after the other.

        times : (n,) [ns], n a multiple of `batch`; values : (n, gauges) [m] and their status, both
            are changed; windows : of the faults
        """
        data = self._data
        self._spoil(times, values, status, windows)
        silent = active(windows, 'gauge_silent', times)
        lost = active(windows, 'lost_block', times)
        blocks = []
        for first in range(0, len(times), data.batch):
            part = slice(first, first + data.batch)
            if silent[part].any():
                continue
            if not lost[part].any():
                blocks.append(
                    GaugeBlock(
                        int(times[first]) + round(data.late * 1e9),
                        self._sequence,
                        data.period * 1e-9 if data.batch > 1 else 0.0,
                        values[part],
                        status[part],
                    )
                )
            self._sequence += data.batch
        return blocks

    def _spoil(
        self, times: np.ndarray, values: np.ndarray, status: np.ndarray, windows: Iterable[Window]
    ) -> None:
        for item in windows:
            kind = item.fault.kind
            if kind not in ('gauge_out_of_range', 'gauge_nan', 'gauge_error'):
                continue
            rows = np.flatnonzero((times >= item.start) & (times < item.end))
            which = slice(None) if item.fault.gauge is None else slice(
                item.fault.gauge, item.fault.gauge + 1
            )
            if kind == 'gauge_out_of_range':
                values[rows, which], status[rows, which] = self._data.upper, Status.OUT_OF_RANGE
            elif kind == 'gauge_nan':
                values[rows, which] = np.nan
            else:
                values[rows, which], status[rows, which] = 0.0, Status.DEVICE_ERROR
