"""The gauge driver: readings of a sensors nest on 'rtest/gauges'."""

from __future__ import annotations

import sys
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from rtest_msgs.msg import GaugeSamples

from rtest_drivers.backends import GAUGE_BACKENDS, GaugeBackend
from rtest_drivers.nodes.driver import Driver, run
from rtest_drivers.rate import Rate
from rtest_drivers.sequence import Sequence as Counter
from rtest_estimation.nodes.publish import header
from rtest_estimation.records import GaugeBlock, Status

_WHAT = {
    Status.OUT_OF_RANGE: 'out of range',
    Status.NO_SIGNAL: 'without signal',
    Status.DEVICE_ERROR: 'with a device error',
}


class Gauges(Driver):
    """Lifecycle node 'gauges'."""

    def __init__(self) -> None:
        super().__init__('gauges', 'rtest/gauges', GaugeSamples, GAUGE_BACKENDS)
        self._parameter('frame_id', 'nest', 'frame of the readings')
        self.start()

    def start(self) -> None:
        """Count from zero."""
        self._counter, self._rate = Counter(), Rate()
        self._readings = self._idle = 0
        self._bad: dict[str, set[int]] = {}

    def messages(self, records: Sequence[GaugeBlock]) -> list[GaugeSamples]:
        """One message for each block."""
        return [self._message(block) for block in records]

    def _message(self, block: GaugeBlock) -> GaugeSamples:
        count, channels = block.displacement.shape
        message = GaugeSamples(
            header=header(block.stamp, self.get_parameter('frame_id').value),
            sequence=self._counter.number(block.sequence, count),
            period=block.period,
            channels=channels,
        )
        message.displacement = array('d', np.ascontiguousarray(block.displacement).tobytes())
        message.status = array('B', np.ascontiguousarray(block.status).tobytes())
        self._readings += count
        self._rate.add(block.stamp, count)
        # No signal at any gauge: the nest is not in use, as when it is being moved. No fault.
        idle = (block.status == Status.NO_SIGNAL).all(axis=1)
        self._idle += int(idle.sum())
        for status, what in _WHAT.items():
            self._note(what, block.status[~idle] == status)
        good = block.status == Status.VALID
        self._note('that are not numbers', good & ~np.isfinite(block.displacement))
        return message

    def _note(self, what: str, bad: np.ndarray) -> None:
        if bad.any():
            self._bad.setdefault(what, set()).update(np.flatnonzero(bad.any(axis=0)).tolist())

    def health(self) -> tuple[str, dict[str, Any]]:
        """Gauges with bad readings since the last call, losses."""
        parts = [
            f'readings of gauge {", ".join(str(index + 1) for index in sorted(which))} {what}'
            for what, which in self._bad.items()
        ]
        self._bad = {}
        counter = self._counter
        if counter.losses:
            parts.append(f'{counter.losses} readings lost since the start')
        return '; '.join(parts), {
            'rate_hz': self._rate.take(),
            'readings': self._readings,
            'readings_without_signal': self._idle,
            'losses': counter.losses,
            'device_restarts': counter.restarts,
        }

    def told(self, backend: GaugeBackend) -> tuple[str, dict[str, Any]]:
        """What the controllers of the nest say."""
        return backend.health()


def main(args: list[str] | None = None) -> int:
    """Entry point of the node."""
    return run(Gauges, args)


if __name__ == '__main__':
    sys.exit(main())
