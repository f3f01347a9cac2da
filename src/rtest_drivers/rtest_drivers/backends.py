"""Where the data come from: the backends of the gauge, the CNC and the thermometer driver.

A backend stamps at the read, in the clock of its device. It counts what the device has acquired in
`GaugeBlock.sequence`, so that a jump is a loss; the driver makes that start at zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from rtest_drivers.cell_link import (
    CNC,
    GAUGES,
    THERMOMETERS,
    CellCnc,
    CellGauges,
    CellThermometers,
)
from rtest_drivers.cnc.linuxcnc import LinuxCnc
from rtest_drivers.cnc.mtconnect import MtConnect
from rtest_drivers.cnc.opcua import OpcUa
from rtest_drivers.gauges.nest import SerialNest
from rtest_drivers.thermometers.serial_thermometers import SerialThermometers
from rtest_estimation.errors import UserError
from rtest_estimation.records import Feedback, GaugeBlock, Temperature

__all__ = [
    'CELL', 'CNC', 'CNC_BACKENDS', 'GAUGES', 'GAUGE_BACKENDS', 'THERMOMETERS',
    'THERMOMETER_BACKENDS', 'CncBackend', 'GaugeBackend', 'ThermometerBackend', 'make',
]


class GaugeBackend(Protocol):
    """A nest of gauges."""

    def open(self) -> None:
        """Connect; raises ConnectionError saying what failed and what to do."""

    def read(self, timeout: float) -> list[GaugeBlock]:
        """What was acquired since the last call, waiting up to `timeout` [s] for the first.

        Empty where nothing came in that time. Raises ConnectionError when the device is lost.
        """

    def close(self) -> None:
        """Disconnect; does nothing where it is not open."""

    def health(self) -> tuple[str, dict[str, Any]]:
        """What is wrong since the last call while readings go on, '' for nothing; figures."""


class CncBackend(Protocol):
    """A CNC's encoder feedback."""

    def open(self) -> None:
        """Connect; raises ConnectionError saying what failed and what to do."""

    def read(self, timeout: float) -> list[Feedback]:
        """What came since the last call, waiting up to `timeout` [s] for the first.

        Empty where nothing came in that time. Raises ConnectionError when the device is lost.
        """

    def close(self) -> None:
        """Disconnect; does nothing where it is not open."""

    def problem(self) -> str:
        """What is wrong while the connection stands, in one line; '' where all is well."""

    def uncertainty(self) -> float:
        """Of the stamps [s]; NaN where it is not known."""

    def told(self) -> dict[str, str]:
        """What diagnostics show.

        Where the controller says so: `program`, IDLE while no NC program runs, and `estop`, on or
        off.
        """


class ThermometerBackend(Protocol):
    """Thermometers."""

    def open(self) -> None:
        """Connect; raises ConnectionError saying what failed and what to do."""

    def read(self, timeout: float) -> list[Temperature]:
        """What came since the last call, waiting up to `timeout` [s] for the first.

        Empty where nothing came in that time. Raises ConnectionError when all are lost.
        """

    def close(self) -> None:
        """Disconnect; does nothing where it is not open."""

    def health(self) -> tuple[str, dict[str, Any]]:
        """What is wrong since the last call while readings go on, '' for nothing; figures."""


CELL = 'cell'
# Name of the parameter `backend` to what makes one from the parameter `address`: the socket of the
# simulated cell, or the path of a device file.
GAUGE_BACKENDS: dict[str, Callable[[str], GaugeBackend]] = {
    CELL: CellGauges, 'serial': SerialNest,
}
CNC_BACKENDS: dict[str, Callable[[str], CncBackend]] = {
    CELL: CellCnc, 'linuxcnc': LinuxCnc, 'mtconnect': MtConnect, 'opcua': OpcUa,
}
THERMOMETER_BACKENDS: dict[str, Callable[[str], ThermometerBackend]] = {
    CELL: CellThermometers, 'serial': SerialThermometers,
}

_Backend = TypeVar('_Backend')


def make(known: dict[str, Callable[[str], _Backend]], name: str, address: str) -> _Backend:
    """A backend by name; raises UserError where there is none or the address is missing."""
    if name not in known:
        raise UserError(f'parameter backend: expected one of {sorted(known)}, got {name!r}')
    if not address:
        raise UserError(f'parameter address: missing, backend {name!r} needs it')
    return known[name](address)
