"""The devices that a session file names, checked before anything is started."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtest_drivers.backends import CELL, CNC_BACKENDS, GAUGE_BACKENDS, THERMOMETER_BACKENDS, make
from rtest_drivers.cnc.linuxcnc import load_linuxcnc
from rtest_drivers.cnc.programs import program_of
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
        make(BACKENDS[name], device.backend, str(device.file))
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
