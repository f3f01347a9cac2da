"""What the gauges of a nest show: value, range and state of each, smallest and largest since."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rtest_drivers.view.devices import ERROR, IDLE, OK, WARN
from rtest_estimation.records import GaugeBlock, Status

_WORDS: dict[int, str] = {
    Status.OUT_OF_RANGE: 'out of range',
    Status.NO_SIGNAL: 'no signal',
    Status.DEVICE_ERROR: 'device error',
}
# A reading in this outermost part of the range is told before it leaves it.
_MARGIN = 0.05


def parse_ranges(text: str) -> list[tuple[float, float] | None]:
    """Ranges of the gauges [m] from '-3 3; -3 3; ?' [mm]; None where a gauge's is not known."""
    ranges: list[tuple[float, float] | None] = []
    for part in text.split(';'):
        words = part.split()
        try:
            low, high = (float(word) * 1e-3 for word in words)
        except ValueError:
            ranges.append(None)
        else:
            ranges.append((low, high) if math.isfinite(low + high) and low < high else None)
    return ranges


class Gauges:
    """The last readings, and how far they went since the page last looked."""

    def __init__(self) -> None:
        self.ranges: list[tuple[float, float] | None] = []
        self._value = np.empty(0)
        self._status = np.empty(0, dtype=np.uint8)
        self._low = np.empty(0)
        self._high = np.empty(0)

    def add(self, block: GaugeBlock) -> None:
        """A block of readings, of which the last one is shown."""
        valid = block.status == Status.VALID
        values = np.where(valid, block.displacement, np.nan)
        if self._value.shape != values[-1].shape:
            self._low = self._high = np.full(values.shape[1], np.nan)
        self._value, self._status = values[-1], block.status[-1]
        self._low = np.fmin(self._low, np.fmin.reduce(values))
        self._high = np.fmax(self._high, np.fmax.reduce(values))

    def spans(self) -> list[list[float] | None]:
        """Smallest and largest valid reading of each gauge since the last call [µm]."""
        spans = [_micrometres(pair) for pair in zip(self._low, self._high, strict=True)]
        self._low = self._high = np.full(self._value.shape, np.nan)
        return spans

    def shown(self, device: str) -> list[dict[str, Any]]:
        """Value [µm], range [µm] or None, level and state in words of each gauge.

        device : level of the gauge driver; its values are of now where it is ok or warned of
        """
        idle = bool((self._status == Status.NO_SIGNAL).all())
        rows = []
        for index, (value, status) in enumerate(zip(self._value, self._status, strict=True)):
            limits = self.ranges[index] if index < len(self.ranges) else None
            level, text = _judge(float(value), int(status), limits, idle)
            if device not in (OK, WARN):
                level, text = device, 'old value'
            rows.append({
                'name': f'gauge {index + 1}',
                'value': round(float(value) * 1e6, 3) if math.isfinite(value) else None,
                'range': _micrometres(limits) if limits else None,
                'level': level,
                'text': text,
            })
        return rows


def _judge(
    value: float, status: int, limits: tuple[float, float] | None, idle: bool
) -> tuple[str, str]:
    if idle:
        # As the driver says: no signal at any gauge means that the nest is not in use.
        return IDLE, 'no signal: no sphere in the nest'
    if status != Status.VALID:
        return ERROR, _WORDS.get(status, 'invalid')
    if limits:
        edge = _MARGIN * (limits[1] - limits[0])
        if not limits[0] + edge <= value <= limits[1] - edge:
            return WARN, 'near the end of its range'
    return OK, 'valid'


def _micrometres(pair: Sequence[float]) -> list[float] | None:
    low, high = (round(float(value) * 1e6, 3) for value in pair)
    return [low, high] if math.isfinite(low + high) else None
