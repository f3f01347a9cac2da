"""A nest of real gauges: backend 'serial' of the gauge driver."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from rtest_drivers.clock import HostClock
from rtest_drivers.gauges.align import Aligner, Sample
from rtest_drivers.gauges.config import ControllerConfig, load_nest, range_text
from rtest_drivers.gauges.controller import Controller
from rtest_estimation.records import GaugeBlock

# Longest time from opening to an answer or a reason why there is none; a network takes longer [s].
_OPEN_S = 8.0
# The aligner is asked this often whether waiting for a stalled stream is over [s].
_LOOK_S = 0.05


class SerialNest:
    """Controllers of a device file as one nest, each asked in a thread of its own.

    While one of them is lost the others' readings go on, with NO_SIGNAL for its gauges; it is
    tried again in the background. Only when all are lost, so is the nest.

    Every block holds one reading of all gauges, as the times between them are not quite equal.
    """

    def __init__(self, address: str) -> None:
        """`address` is the path of the device file; raises UserError where it is wrong."""
        self.config = load_nest(address)
        # Not made anew when a lost nest is opened again: stamps of a session are of one clock.
        self._clock = HostClock()
        self._changed = threading.Condition()
        self._controllers: list[Controller] = []
        self._counts: list[tuple[int, int]] = []
        self._looked = 0.0

    def open(self) -> None:
        """Start asking; raises ConnectionError where no controller answers."""
        self.close()
        streams, self._controllers = [], []
        for config in self.config.controllers:
            first, channels = len(streams), list(config.channels)
            for query in config.protocol.queries:
                streams.append((tuple(channels[: query.outputs]), 1.0 / config.rate))
                del channels[: query.outputs]
            self._controllers.append(self._controller(config, range(first, len(streams))))
        self._aligner = Aligner(streams)
        self._counts, self._looked = [(0, 0)] * len(self._controllers), time.monotonic()
        for controller in self._controllers:
            controller.start()
        with self._changed:
            self._changed.wait_for(self._tried, _OPEN_S)
        try:
            self._check()
        except Exception:
            self.close()
            raise

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

    def close(self) -> None:
        """Stop asking and close the lines; does nothing where it is not open."""
        for controller in self._controllers:
            controller.stop()
        for controller in self._controllers:
            controller.join()
        self._controllers = []

    def health(self) -> tuple[str, dict[str, Any]]:
        """What went wrong since the last call, or '', and figures of that time to show."""
        if not self._controllers:
            return '', {}
        now = time.monotonic()
        elapsed, self._looked = now - self._looked, now
        warnings, values = [], {}
        for index, one in enumerate(self._controllers):
            counts = (one.answers, one.faults + one.others)
            answers, faults = (n - o for n, o in zip(counts, self._counts[index], strict=True))
            self._counts[index] = counts
            if one.problem:
                warnings.append(one.problem)
            elif faults:
                warnings.append(f'{one.name}: {one.note}')
            rate = answers / elapsed / len(one.config.protocol.queries) if elapsed else 0.0
            figures = {
                'state': 'answers' if one.problem == '' else 'lost',
                'rate_hz': f'{rate:.1f}',
                'unanswered': one.errors,
                'other_answers': one.others,
                'dropped_bytes': one.dropped,
                'reconnects': one.reconnects,
                'stamp_uncertainty_ms': f'{one.uncertainty * 1e3:.2f}',
            }
            values |= {f'{one.config.port} {key}': value for key, value in figures.items()}
            one.uncertainty = 0.0
        with self._changed:
            mean, largest = self._aligner.skew()
        if problem := self._clock.problem():
            warnings.append(problem)
        return '; '.join(warnings), {
            **values,
            'gauge_range_mm': range_text(self.config),
            'skew_mean_ms': f'{mean * 1e3:.2f}',
            'skew_max_ms': f'{largest * 1e3:.2f}',
        }

    def _controller(self, config: ControllerConfig, streams: range) -> Controller:
        """A controller whose queries are these streams of the aligner."""

        def deliver(index: int, sample: Sample) -> None:
            with self._changed:
                self._aligner.add(streams[index], sample)
                self._changed.notify_all()

        def changed() -> None:
            with self._changed:
                if controller.problem:
                    for stream in streams:
                        self._aligner.lose(stream)
                self._changed.notify_all()

        controller = Controller(config, self._clock, deliver, changed)
        return controller

    def _tried(self) -> bool:
        return all(one.problem is not None or one.failure for one in self._controllers)

    def _check(self) -> None:
        """Raise what ended a thread, or ConnectionError where no controller is left."""
        for one in self._controllers:
            if one.failure is not None:
                raise one.failure
        problems = [one.problem for one in self._controllers if one.problem != '']
        if len(problems) == len(self._controllers):
            raise ConnectionError('; '.join(p or 'no answer yet' for p in problems) or 'not open')
