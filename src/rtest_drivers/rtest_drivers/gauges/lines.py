"""Controllers on several lines, each asked in a thread of its own."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

from rtest_drivers.clock import HostClock
from rtest_drivers.gauges.align import Sample
from rtest_drivers.gauges.config import ControllerConfig
from rtest_drivers.gauges.controller import Controller

# Longest time from opening to an answer or a reason why there is none; a network takes longer [s].
_OPEN_S = 8.0


class SerialLines:
    """Controllers that are asked together.

    While one of them is lost the others' readings go on; it is tried again in the background. Only
    when all are lost, so is the whole.
    """

    def __init__(self, configs: Sequence[ControllerConfig]) -> None:
        self._configs = tuple(configs)
        # Not made anew when lost lines are opened again: stamps of a session are of one clock.
        self._clock = HostClock()
        self._changed = threading.Condition()
        self._controllers: list[Controller] = []
        self._counts: list[tuple[int, int]] = []
        self._looked = 0.0

    @abstractmethod
    def _deliver(self, number: int, query: int, sample: Sample) -> None:
        """What a controller gave; called in its thread, with the lock held."""

    def _lost(self, number: int) -> None:
        """A controller is lost; called in its thread, with the lock held."""

    def open(self) -> None:
        """Start asking; raises ConnectionError where no controller answers."""
        self.close()
        self._controllers = [
            self._controller(number, config) for number, config in enumerate(self._configs)
        ]
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
        if problem := self._clock.problem():
            warnings.append(problem)
        return '; '.join(warnings), values

    def _controller(self, number: int, config: ControllerConfig) -> Controller:

        def deliver(query: int, sample: Sample) -> None:
            with self._changed:
                self._deliver(number, query, sample)
                self._changed.notify_all()

        def changed() -> None:
            with self._changed:
                if controller.problem:
                    self._lost(number)
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
