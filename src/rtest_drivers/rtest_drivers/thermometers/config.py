r"""The device file of thermometers: which sensors answer on which lines (YAML).

.. code-block:: yaml

    controllers:
      - port: /dev/ttyUSB0        # or socket://host:port, rfc2217://host:port
        unit: degC                # degC, K or degF, as the device says it
        range_c: [0, 60]          # what can be meant; beyond it there is no temperature [deg C]
        stddev_k: 0.1             # standard uncertainty of a reading, for the messages
        rate_hz: 0.2              # times a second that every question is asked
        terminator: "\r"           # no_signal, over_range: texts that are no number, for all
        questions:                # asked one after the other
          - {query: "#010\r", pattern: '>([+-][0-9.]{6})', sensors: [ambient]}
        baud: 9600                # with bytesize, parity and stopbits
        timeout_s: 0.5            # longest wait for an answer

A pattern has one group for each sensor of its question.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rtest_drivers.gauges import line_protocol
from rtest_drivers.gauges.config import (
    ControllerConfig,
    choice,
    controller_entries,
    different_ports,
    line_settings,
    port_of,
)
from rtest_drivers.gauges.frames import Protocol
from rtest_estimation.errors import UserError
from rtest_identification.session_reader import Reader

# [K] of one unit, and 0 of it [deg C].
UNITS = {'degC': (1.0, 0.0), 'K': (1.0, -273.15), 'degF': (5.0 / 9.0, -160.0 / 9.0)}
_KEYS = {
    'port', 'unit', 'range_c', 'stddev_k', 'rate_hz', 'terminator', 'no_signal', 'over_range',
    'questions', 'baud', 'bytesize', 'parity', 'stopbits', 'timeout_s',
}
_QUESTION = {'query', 'pattern', 'sensors'}
# Of a machine shop, where the file gives none [deg C].
_RANGE_C = (-20.0, 120.0)
_RATE_HZ, _TIMEOUT_S = (0.1, 10.0), (0.01, 2.0)


@dataclass(frozen=True)
class ThermometerConfig(ControllerConfig):
    """One line; `unit` is degC, K or degF, `limits` are in deg C.

    sensors : names, in the order of the questions and their groups
    variance : of a reading [K2]; 0 where it is not known
    """

    sensors: tuple[str, ...]
    variance: float

    def physical(self, output: int, value: float) -> tuple[float, str]:
        """Temperature [deg C], and why it is out of range, '' where it is not."""
        scale, zero = UNITS[self.unit]
        celsius = zero + scale * value
        if not self.limits[0] <= celsius <= self.limits[1]:
            return math.nan, f'{self.sensors[output]}: {value:g} {self.unit} is beyond range_c'
        return celsius, ''

    def sensors_of(self, query: int) -> tuple[str, ...]:
        """Those that one question is for."""
        first = sum(one.outputs for one in self.protocol.queries[:query])
        return self.sensors[first : first + self.protocol.queries[query].outputs]


def load_thermometers(path: Path | str) -> tuple[ThermometerConfig, ...]:
    """Read a device file; raises UserError naming file, key and what is expected."""
    lines = tuple(_line(reader) for reader in controller_entries(path))
    different_ports(str(path), lines)
    names = [name for line in lines for name in line.sensors]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f'{path}: controllers: sensor {name} is given twice')
    return lines


def _line(reader: Reader) -> ThermometerConfig:
    reader.only(_KEYS)
    port, unit = port_of(reader), choice(reader, 'unit', UNITS)
    limits = tuple(reader.numbers('range_c', 2)) if 'range_c' in reader.data else _RANGE_C
    if limits[0] >= limits[1]:
        raise UserError(f'{reader.where}: range_c: expected [lower, upper], got {list(limits)}')
    entries = reader.required('questions')
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries or [0]):
        raise UserError(f'{reader.where}: questions: expected a list of {sorted(_QUESTION)}')
    shared = {key: reader.data[key] for key in line_protocol.OPTIONS if key in reader.data}
    sensors, protocols = [], []
    for number, entry in enumerate(entries, 1):
        question = Reader(f'{reader.where}: questions: {number}', entry)
        question.only(_QUESTION)
        names = _sensors(question)
        whole = Reader(question.where, {**shared, **entry})
        protocols.append(line_protocol.line(len(names), unit, whole))
        sensors += names
    protocol = _together(protocols)
    return ThermometerConfig(
        'thermometers', protocol, port, line_settings(reader, protocol.line),
        tuple(range(len(sensors))), unit, (1,) * len(sensors), limits,
        reader.number('rate_hz', 1.0, _RATE_HZ), reader.number('timeout_s', 0.5, _TIMEOUT_S),
        tuple(sensors), reader.number('stddev_k', 0.0) ** 2,
    )


def _together(protocols: Sequence[Protocol]) -> Protocol:
    """One protocol that asks the questions of all."""
    return replace(protocols[0], queries=tuple(q for one in protocols for q in one.queries))


def _sensors(question: Reader) -> list[str]:
    names = question.required('sensors')
    good = isinstance(names, list) and names and all(
        isinstance(name, str) and name.isascii() and name.isidentifier() for name in names
    )
    if not good:
        raise UserError(
            f'{question.where}: sensors: expected a list of names of letters, digits and _, '
            f'got {names!r}'
        )
    return names
