"""NC programs of a session's cycles: which one, and starting it on a LinuxCNC."""

from __future__ import annotations

from pathlib import Path

from rtest_drivers.cnc.linuxcnc import load_linuxcnc
from rtest_drivers.cnc.linuxcnc_control import Control
from rtest_estimation.errors import UserError
from rtest_identification.plans import program_name

# As `rtest plan` ends them.
_ENDINGS = ('.ngc', '.nc')
# Every program begins with an M0; the first block of a long one takes a moment [s].
_FIRST_STOP_S = 10.0


def program_of(cycle: str, folder: Path) -> Path | None:
    """The program of a cycle in the folder of its session file; None where there is none."""
    paths = (folder / f'{program_name(cycle)}{ending}' for ending in _ENDINGS)
    return next((path for path in paths if path.is_file()), None)


def start_program(device_file: str, program: Path, unattended: bool) -> None:
    """Load and start a program on the LinuxCNC of a device file.

    It comes to the M0 at which somebody is to see that the sphere is clear of the nest, and waits
    there; `unattended` goes on.

    Raises UserError or ConnectionError, saying what to do.
    """
    control = Control(load_linuxcnc(device_file))
    control.open()
    try:
        if (now := control.state()).program != 'IDLE':
            raise UserError(f'LinuxCNC: a program is {now.program.lower()}; end it first')
        control.errors()
        control.load(program)
        control.run()
        control.wait(
            lambda now: now.program == 'PAUSED', _FIRST_STOP_S,
            f'{program.name} did not come to its first stop',
        )
        if unattended:
            control.resume()
    finally:
        control.close()
