"""The thermometer driver: temperatures on 'rtest/temperature'."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from typing import Any

from sensor_msgs.msg import Temperature

from rtest_drivers.backends import THERMOMETER_BACKENDS, ThermometerBackend
from rtest_drivers.nodes.driver import Driver, run
from rtest_estimation.nodes.publish import header
from rtest_estimation.records import Temperature as Record

# Thermometers may be asked every ten seconds only.
_SILENCE_S = 30.0


class Thermometers(Driver):
    """Lifecycle node 'thermometers'; a message for each reading, its frame names the sensor."""

    def __init__(self) -> None:
        super().__init__(
            'thermometers', 'rtest/temperature', Temperature, THERMOMETER_BACKENDS, _SILENCE_S
        )
        self.start()

    def start(self) -> None:
        """Count from zero."""
        self._last: dict[str, float] = {}
        self._count: Counter[str] = Counter()

    def messages(self, records: Sequence[Record]) -> list[Temperature]:
        """One message for each reading."""
        for record in records:
            self._last[record.sensor] = record.value
            self._count[record.sensor] += 1
        return [
            Temperature(
                header=header(record.stamp, record.sensor),
                temperature=record.value, variance=record.variance,
            )
            for record in records
        ]

    def health(self) -> tuple[str, dict[str, Any]]:
        """The last temperature of every sensor and how many there were."""
        return '', {
            sensor: f'{value:.2f} degC, {self._count[sensor]} readings'
            for sensor, value in self._last.items()
        }

    def told(self, backend: ThermometerBackend) -> tuple[str, dict[str, Any]]:
        """What the lines of the thermometers say."""
        return backend.health()


def main(args: list[str] | None = None) -> int:
    """Entry point of the node."""
    return run(Thermometers, args)


if __name__ == '__main__':
    sys.exit(main())
