"""A nest of real gauges: backend 'serial' of the gauge driver."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from rtest_drivers.gauges.align import Aligner, Sample
from rtest_drivers.gauges.config import load_nest, range_text
from rtest_drivers.gauges.lines import SerialLines
from rtest_estimation.records import GaugeBlock

# The aligner is asked this often whether waiting for a stalled stream is over [s].
_LOOK_S = 0.05


class SerialNest(SerialLines):
    """Controllers of a device file as one nest.

    While one of them is lost its gauges have NO_SIGNAL. Every block holds one reading of all
    gauges, as the times between them are not quite equal.
    """

    def __init__(self, address: str) -> None:
        """`address` is the path of the device file; raises UserError where it is wrong."""
        self.config = load_nest(address)
        super().__init__(self.config.controllers)

    def open(self) -> None:
        """Start asking; raises ConnectionError where no controller answers."""
        # The aligner is made anew: nothing may come from before.
        self.close()
        streams, self._streams = [], []
        for config in self.config.controllers:
            first, channels = len(streams), list(config.channels)
            for query in config.protocol.queries:
                streams.append((tuple(channels[: query.outputs]), 1.0 / config.rate))
                del channels[: query.outputs]
            self._streams.append(range(first, len(streams)))
        self._aligner = Aligner(streams)
        super().open()

    def read(self, timeout: float) -> list[GaugeBlock]:
        """Readings since the last call, waiting up to `timeout` [s] for the first.

        Raises ConnectionError when every controller is lost.
        """
        limit = time.monotonic() + timeout
        with self._changed:
            while True:
                self._check()
                rows = self._aligner.take(self._clock.now())
                left = limit - time.monotonic()
                if rows or left <= 0.0:
                    break
                self._changed.wait(min(left, _LOOK_S))
        return [
            GaugeBlock(
                row.stamp,
                row.sequence,
                0.0,
                np.array([row.values]),
                np.array([row.status], dtype=np.uint8),
            )
            for row in rows
        ]

    def health(self) -> tuple[str, dict[str, Any]]:
        """What went wrong since the last call, or '', and figures of that time to show."""
        warning, values = super().health()
        if not values:
            return warning, values
        with self._changed:
            mean, largest = self._aligner.skew()
        return warning, {
            **values,
            'gauge_range_mm': range_text(self.config),
            'skew_mean_ms': f'{mean * 1e3:.2f}',
            'skew_max_ms': f'{largest * 1e3:.2f}',
        }

    def _deliver(self, number: int, query: int, sample: Sample) -> None:
        self._aligner.add(self._streams[number][query], sample)

    def _lost(self, number: int) -> None:
        for stream in self._streams[number]:
            self._aligner.lose(stream)
