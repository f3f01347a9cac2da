"""The device file of a nest: which controllers, on which lines, for which gauges (YAML).

.. code-block:: yaml

    controllers:
      - protocol: keyence-lkg     # what it speaks, see PROTOCOLS
        port: /dev/ttyUSB0        # or socket://host:port, rfc2217://host:port
        channels: [1, 2]          # its gauges in the nest, in the order of its outputs
        unit: mm                  # mm, um or inch, as the controller shows it
        sign: 1                   # -1: the controller counts against the gauge's direction;
                                  # a list gives one for each channel
        range_mm: [-1, 1]         # of the controller's value; beyond it is out of range
        rate_hz: 100              # questions a second
        baud: 115200              # with bytesize, parity and stopbits: other than factory
        timeout_s: 0.25           # longest wait for an answer
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtest_drivers.addresses import split_url
from rtest_drivers.gauges import heidenhain, keyence, line_protocol, mitutoyo
from rtest_drivers.gauges.frames import UNITS, Line, Protocol
from rtest_estimation.errors import UserError
from rtest_estimation.messages import MAX_CHANNELS
from rtest_estimation.yaml_text import read_yaml
from rtest_identification.session_reader import Reader

# Name to what makes the protocol, and the keys of the device file that are its own.
PROTOCOLS: dict[str, tuple[Callable[[int, str, Reader], Protocol], set[str]]] = {
    'keyence-lkg': (keyence.lkg, keyence.LKG_OPTIONS),
    'keyence-lkg5000': (keyence.lkg5000, set()),
    'heidenhain-nd287': (heidenhain.nd287, heidenhain.OPTIONS),
    'mitutoyo-mux10': (mitutoyo.mux10, set()),
    'mitutoyo-digimatic': (mitutoyo.digimatic, mitutoyo.DIGIMATIC_OPTIONS),
    'line': (line_protocol.line, line_protocol.OPTIONS),
}
_KEYS = {
    'protocol', 'port', 'channels', 'unit', 'sign', 'range_mm', 'rate_hz', 'timeout_s',
    'baud', 'bytesize', 'parity', 'stopbits',
}
_RATE_HZ = (0.1, 1000.0)
_TIMEOUT_S = (0.01, 0.3)


@dataclass(frozen=True)
class ControllerConfig:
    """One controller.

    name : of its protocol
    channels : of the nest, from 0, in the order of its outputs
    unit : 'mm', 'um' or 'inch'
    signs : of each channel, +1 or -1
    limits : range of the controller's value [m]; None where the file gives none
    rate : questions a second [1/s]; timeout : longest wait for an answer [s]
    """

    name: str
    protocol: Protocol
    port: str
    line: Line
    channels: tuple[int, ...]
    unit: str
    signs: tuple[int, ...]
    limits: tuple[float, float] | None
    rate: float
    timeout: float

    def physical(self, output: int, value: float) -> tuple[float, str]:
        """What the controller's value means: displacement in the nest's sense [m].

        Beside it why it is out of range, '' where it is not.
        """
        metres = value * UNITS[self.unit]
        if self.limits is not None and not self.limits[0] <= metres <= self.limits[1]:
            return math.nan, f'{value:g} {self.unit} is beyond range_mm'
        return self.signs[output] * metres, ''


@dataclass(frozen=True)
class NestConfig:
    """A nest: its controllers and how many gauges they have together."""

    controllers: tuple[ControllerConfig, ...]

    @property
    def channels(self) -> int:
        """How many gauges."""
        return sum(len(controller.channels) for controller in self.controllers)


def range_text(config: NestConfig) -> str:
    """Ranges of the gauges as diagnostics tell them [mm]: '-1 1; -3 3; ?', in the nest's sense."""
    texts = ['?'] * config.channels
    for one in config.controllers:
        for channel, sign in zip(one.channels, one.signs, strict=True):
            if one.limits is not None:
                low, high = sorted(sign * limit * 1e3 for limit in one.limits)
                texts[channel] = f'{low:g} {high:g}'
    return '; '.join(texts)


def load_nest(path: Path | str) -> NestConfig:
    """Read a device file; raises UserError naming file, key and what is expected."""
    controllers = tuple(_controller(reader) for reader in controller_entries(path))
    _check(str(path), controllers)
    return NestConfig(controllers)


def controller_entries(path: Path | str) -> list[Reader]:
    """The mappings in the list `controllers` of a device file.

    Raises UserError naming file, key and what is expected.
    """
    data = read_yaml(path, 'the device file')
    if not isinstance(data, dict):
        raise UserError(f'{path}: expected a mapping with the key controllers')
    reader = Reader(str(path), data)
    reader.only({'controllers'})
    entries = reader.required('controllers')
    if not isinstance(entries, list) or not entries:
        raise UserError(f'{path}: controllers: expected a list of mappings')
    for number, entry in enumerate(entries, 1):
        if not isinstance(entry, dict):
            raise UserError(f'{path}: controllers: {number}: expected a mapping of a controller')
    return [
        Reader(f'{path}: controllers: {number}', entry) for number, entry in enumerate(entries, 1)
    ]


def port_of(reader: Reader) -> str:
    """The key `port`."""
    port = reader.required('port')
    if not isinstance(port, str) or not _port_is_good(port):
        raise UserError(
            f'{reader.where}: port: expected a device, socket://HOST:PORT or rfc2217://HOST:PORT, '
            f'got {port!r}'
        )
    return port


def different_ports(path: str, controllers: Sequence[ControllerConfig]) -> None:
    """Raise UserError where two controllers are to be at one port."""
    ports = [controller.port for controller in controllers]
    for port in ports:
        if ports.count(port) > 1:
            raise UserError(f'{path}: controllers: port {port} is given twice')


def _controller(reader: Reader) -> ControllerConfig:
    name = choice(reader, 'protocol', PROTOCOLS)
    make, options = PROTOCOLS[name]
    reader.only(_KEYS | options)
    port = port_of(reader)
    channels = _whole_numbers(reader, 'channels')
    unit = choice(reader, 'unit', UNITS)
    protocol = make(len(channels), unit, reader)
    return ControllerConfig(
        name,
        protocol,
        port,
        line_settings(reader, protocol.line),
        tuple(channel - 1 for channel in channels),
        unit,
        _signs(reader, len(channels)),
        _limits(reader),
        reader.number('rate_hz', protocol.rate, _RATE_HZ),
        reader.number('timeout_s', 0.25, _TIMEOUT_S),
    )


def _port_is_good(port: str) -> bool:
    """A path, or one of the two kinds of URL that are a line; pyserial knows others."""
    if '://' not in port:
        return bool(port) and port.isprintable()
    parts = split_url(port)
    return parts is not None and parts.scheme in ('socket', 'rfc2217') and parts.port is not None


def _check(path: str, controllers: tuple[ControllerConfig, ...]) -> None:
    """What must fit between the controllers."""
    different_ports(path, controllers)
    channels = sorted(channel + 1 for one in controllers for channel in one.channels)
    if channels != list(range(1, len(channels) + 1)):
        raise UserError(
            f'{path}: controllers: channels: expected 1 to {len(channels)}, each once, '
            f'got {channels}'
        )
    if len(channels) > MAX_CHANNELS:
        raise UserError(f'{path}: controllers: expected at most {MAX_CHANNELS} channels')


def line_settings(reader: Reader, factory: Line) -> Line:
    """The keys baud, bytesize, parity and stopbits; the factory settings where not given."""
    parity = factory.parity
    if 'parity' in reader.data:
        parity = choice(reader, 'parity', ('none', 'even', 'odd'))
    return Line(
        reader.integer('baud', factory.baud, (50, 4_000_000)),
        reader.integer('bytesize', factory.bytesize, (7, 8)),
        parity,
        reader.integer('stopbits', factory.stopbits, (1, 2)),
    )


def _signs(reader: Reader, count: int) -> tuple[int, ...]:
    value = reader.data.get('sign', 1)
    signs = value if isinstance(value, list) else [value] * count
    good = all(type(sign) is int and sign in (-1, 1) for sign in signs)
    if not good or len(signs) != count:
        raise UserError(
            f'{reader.where}: sign: expected 1 or -1, or one for each of {count} channels, '
            f'got {value!r}'
        )
    return tuple(signs)


def _limits(reader: Reader) -> tuple[float, float] | None:
    if 'range_mm' not in reader.data:
        return None
    lower, upper = reader.numbers('range_mm', 2)
    if lower >= upper:
        raise UserError(f'{reader.where}: range_mm: expected [lower, upper], got {[lower, upper]}')
    return lower * 1e-3, upper * 1e-3


def _whole_numbers(reader: Reader, key: str) -> list[int]:
    value = reader.required(key)
    if not isinstance(value, list) or not value or any(type(item) is not int for item in value):
        raise UserError(f'{reader.where}: {key}: expected a list of whole numbers, got {value!r}')
    return value


def choice(reader: Reader, key: str, known: Any) -> str:
    """One of the names in `known`, which must be given."""
    value = reader.required(key)
    if not isinstance(value, str) or value not in known:
        raise UserError(f'{reader.where}: {key}: expected one of {sorted(known)}, got {value!r}')
    return value
