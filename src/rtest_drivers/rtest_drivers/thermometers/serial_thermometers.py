"""Real thermometers: backend 'serial' of the thermometer driver."""

from __future__ import annotations

import time
from typing import Any

from rtest_drivers.gauges.align import Sample
from rtest_drivers.gauges.lines import SerialLines
from rtest_drivers.thermometers.config import load_thermometers
from rtest_estimation.records import Status, Temperature

_WHAT = {
    Status.OUT_OF_RANGE: 'out of range',
    Status.NO_SIGNAL: 'no signal',
    Status.DEVICE_ERROR: 'no legal answer',
}


class SerialThermometers(SerialLines):
    """Sensors of a device file; what is no temperature is told and never given."""

    def __init__(self, address: str) -> None:
        """`address` is the path of the device file; raises UserError where it is wrong."""
        self.config = load_thermometers(address)
        super().__init__(self.config)
        self._readings: list[Temperature] = []
        self._status: dict[str, Status] = {}

    def read(self, timeout: float) -> list[Temperature]:
        """Readings since the last call, waiting up to `timeout` [s] for the first.

        Raises ConnectionError when every line is lost.
        """
        limit = time.monotonic() + timeout
        with self._changed:
            while not self._readings:
                self._check()
                left = limit - time.monotonic()
                if left <= 0.0:
                    break
                self._changed.wait(left)
            found, self._readings = self._readings, []
        return found

    def health(self) -> tuple[str, dict[str, Any]]:
        """What is wrong with lines and sensors, or '', and figures since the last call."""
        warning, values = super().health()
        with self._changed:
            bad = [
                f'{sensor}: {_WHAT[status]}'
                for sensor, status in self._status.items() if status is not Status.VALID
            ]
        return '; '.join(filter(None, [warning, *bad])), values

    def _deliver(self, number: int, query: int, sample: Sample) -> None:
        config = self.config[number]
        sensors = config.sensors_of(query)
        for sensor, value, status in zip(sensors, sample.values, sample.status, strict=True):
            self._status[sensor] = Status(status)
            if status == Status.VALID:
                self._readings.append(Temperature(sample.stamp, sensor, value, config.variance))
