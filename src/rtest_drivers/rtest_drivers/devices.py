"""The devices that a session file names, checked before anything is started."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtest_drivers.backends import CELL, CNC_BACKENDS, GAUGE_BACKENDS, THERMOMETER_BACKENDS, make
from rtest_drivers.cnc.linuxcnc import load_linuxcnc
from rtest_drivers.cnc.programs import program_of
from rtest_drivers.gauges.config import load_nest
from rtest_estimation.errors import UserError
from rtest_identification.plans import program_name
from rtest_identification.session_file import BY_HAND, SessionConfig

# What can be named in a session file: the simulated cell is given with --simulate.
BACKENDS: dict[str, dict[str, Callable[[str], Any]]] = {
    driver: {name: one for name, one in known.items() if name != CELL}
    for driver, known in (
        ('gauges', GAUGE_BACKENDS), ('cnc', CNC_BACKENDS), ('thermometers', THERMOMETER_BACKENDS),
    )
}


def check_devices(config: SessionConfig, path: Path) -> None:
    """Refuse unknown backends, wrong device files, and programs that are not there.

    path : of the session file

    Raises UserError naming file, key and what is expected.
    """
    for name, device in config.devices.items():
        where = f'{path}: devices: {name}'
        if device.backend not in BACKENDS[name]:
            raise UserError(
                f'{where}: backend: expected one of {sorted(BACKENDS[name])}, got '
                f'{device.backend!r}'
            )
        made = make(BACKENDS[name], device.backend, str(device.file))
        if name == 'cnc':
            _check_axes(device.file, made.axes, config.machine.letters)
        if name == 'gauges' and (count := load_nest(device.file).channels) < 3:
            raise UserError(
                f'{device.file}: controllers: {count} gauges, a sphere centre needs three'
            )
        if device.programs == BY_HAND:
            continue
        if device.backend != 'linuxcnc':
            raise UserError(f'{where}: run_programs: only the backend linuxcnc can start programs')
        if not load_linuxcnc(str(device.file)).enable_password:
            raise UserError(
                f'{device.file}: enable_password: missing, run_programs of {path} needs it'
            )
        for plan in config.plans:
            if program_of(plan.cycle, path.parent) is None:
                raise UserError(
                    f'{where}: run_programs: no program {program_name(plan.cycle)}.ngc beside the '
                    'session file; '
                    'write them with `rtest plan` and run the session file it wrote'
                )


def _check_axes(file: Path, told: tuple[str, ...], needed: tuple[str, ...]) -> None:
    """The feedback must have the machine's axes; others are not looked at, but mean a mistake."""
    for letter in needed:
        if letter not in told:
            raise UserError(f'{file}: axes: {letter}: missing, the machine has {" ".join(needed)}')
    for letter in told:
        if letter not in needed:
            raise UserError(
                f'{file}: axes: {letter}: the machine has no such axis, only {" ".join(needed)}'
            )
