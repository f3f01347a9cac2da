"""Control of LinuxCNC: start, home, run a program. Used by explicit command only."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from rtest_drivers.cnc.linuxcnc import LinuxCnc, LinuxCncFile
from rtest_drivers.cnc.linuxcnc_line import Line
from rtest_drivers.cnc.linuxcnc_protocol import STATE_WORDS, Refused, State, state
from rtest_drivers.cnc.sense import Move
from rtest_estimation.errors import UserError

_LOOK_S = 0.02
# Messages that the server keeps for whoever asks; asking for one costs 0.05 ms.
_MESSAGES = 64
# The axes have stopped where the position has been the same for so long.
_STILL_S = 0.3
# Motion modes that may stand in a block alone, distance modes, feed modes.
_RESTORED = ('G0', 'G1', 'G80', 'G90', 'G91', 'G93', 'G94', 'G95')
_RESTORE_S = 2.0


class Control:
    """Takes control from whatever other client of linuxcncrsh has it, and once more if it must.

    The driver's watchdog takes control when the driver connects again, without knowing of others.

    An acknowledged command is accepted, not done: what is wrong with it comes later, by `errors`.
    """

    def __init__(self, file: LinuxCncFile) -> None:
        if not file.enable_password:
            raise UserError(
                'device file: enable_password: missing, to control LinuxCNC it must be what '
                '--enablepw of linuxcncrsh says'
            )
        self._file = file
        self._line: Line | None = None

    def open(self) -> None:
        """Connect and take control; raises ConnectionError or UserError saying what to do."""
        self._line = Line(self._file.host, self._file.port, self._file.password)
        self._set(f'enable {self._file.enable_password}')

    def close(self) -> None:
        """Give control back and hang up; does nothing where it is not open."""
        line, self._line = self._line, None
        if line is not None:
            try:
                if line.get('enable') == 'ON':
                    line.set('set enable off')
            except ConnectionError:
                pass  # It has gone, and its control with it.
            line.close()

    def state(self) -> State:
        """What the controller says of itself."""
        line = self._open_line()
        return state([line.get(word) for word in STATE_WORDS])

    def errors(self) -> list[str]:
        """Error messages since the last call; they are then no longer on the operator's screen."""
        line = self._open_line()
        told = [line.get('error') for _ in range(_MESSAGES)]
        return [text for text in told if text != 'OK']

    def check_idle(self) -> None:
        """Raise UserError where a program runs or is paused."""
        if (now := self.state()).program != 'IDLE':
            raise UserError(f'LinuxCNC: a program is {now.program.lower()}; end it first')

    def modes(self) -> tuple[str, str]:
        """Blocks that restore the units, and distance, feed and motion mode as they are now."""
        codes = self._open_line().get('program_codes').split()
        units = [code for code in codes if code in ('G20', 'G21')]
        others = [code for code in codes if code in _RESTORED or code[:1] == 'F']
        return ' '.join(units), ' '.join(others)

    def machine_on(self) -> None:
        """E-stop off, machine on."""
        self._set('estop off')
        self.wait(lambda now: not now.estop, 2.0, 'E-stop did not go off')
        self._set('machine on')
        self.wait(lambda now: now.machine_on, 2.0, 'the machine did not switch on')

    def home(self, timeout: float = 120.0) -> None:
        """Home all joints of the device file, waiting up to `timeout` [s]."""
        self._set('mode manual')
        self._set('home -1')
        joints = [axis.source for axis in self._file.axes]
        self.wait(lambda now: all(now.homed[j] for j in joints), timeout, 'the axes did not home')

    def load(self, program: Path) -> None:
        """Load an NC program; the path is one of the controller's computer."""
        self._set('mode auto')
        self._set(f'open {program}')

    def run(self) -> None:
        """Run the program from the top."""
        self._set('run')

    def pause(self) -> None:
        """Pause the program."""
        self._set('pause')

    def resume(self) -> None:
        """Go on after a pause or an M0."""
        self._set('resume')

    def abort(self) -> None:
        """Stop the program or the move."""
        self._set('abort')

    def estop(self) -> None:
        """E-stop."""
        self._set('estop on')

    def mdi(self, block: str) -> None:
        """Command one block by manual data input."""
        self._set('mode mdi')
        self._set(f'mdi {block}')

    def wait(self, until: Callable[[State], bool], timeout: float, otherwise: str) -> State:
        """Wait for a state; raises UserError with what went wrong after `timeout` [s]."""
        limit = time.monotonic() + timeout
        while not until(now := self.state()):
            if time.monotonic() > limit:
                why = '; '.join(self.errors()) or 'no error message'
                raise UserError(f'LinuxCNC: {otherwise} in {timeout:g} s: {why}')
            time.sleep(_LOOK_S)
        return now

    def _set(self, command: str) -> None:
        line = self._open_line()
        try:
            try:
                line.set(f'set {command}')
            except Refused:
                if command.startswith('enable') or line.get('enable') == 'ON':
                    raise
                line.set(f'set enable {self._file.enable_password}')
                line.set(f'set {command}')
        except Refused:
            if command.startswith('enable'):
                why = 'set enable_password of the device file to what --enablepw says'
            elif line.get('enable') != 'ON':
                why = 'another client has taken control; end it and start again'
            else:
                why = 'E-stop is on or the machine is off, or LinuxCNC does not know the command'
            raise UserError(f'LinuxCNC refused {command.split()[0]!r}: {why}') from None

    def _open_line(self) -> Line:
        if self._line is None:
            raise ConnectionError('the control of LinuxCNC is not open')
        return self._line


def make_moves(
    control: Control, backend: LinuxCnc, moves: Sequence[Move], timeout: float = 20.0
) -> list[np.ndarray]:
    """Make every move and the way back, and record the feedback of it.

    The machine moves: at 300 mm/min and 300 deg/min, in the active coordinate system. `backend` is
    open. Units, feed, distance, feed and motion mode are afterwards as before, also when a move
    ends early, which stops the axes. Returns (n, k) feedback [m], [rad] for each move, for
    `sense.judge`. Raises UserError where a program is not at its end, an axis has not stopped
    after `timeout` [s] or LinuxCNC has an error.
    """
    control.check_idle()
    modes = control.modes()
    control.errors()
    recorded = []
    try:
        for move in moves:
            before = _until_still(backend, timeout)
            recorded.append(np.vstack([before, _moved(control, backend, move, timeout)]))
            _moved(control, backend, Move(move.axis, -move.distance), timeout)
            if errors := control.errors():
                raise UserError(f'LinuxCNC: {"; ".join(errors)}')
    except BaseException:
        # What went wrong is told, not that LinuxCNC cannot be reached for this.
        with contextlib.suppress(ConnectionError, UserError):
            control.abort()
            _restore(control, modes)
        raise
    _restore(control, modes)
    return recorded


def _restore(control: Control, modes: tuple[str, str]) -> None:
    # A feed is one in the units before the block.
    for block in filter(None, modes):
        control.mdi(block)
    control.wait(lambda now: control.modes() == modes, _RESTORE_S, 'its modes were not restored')


def _moved(control: Control, backend: LinuxCnc, move: Move, timeout: float) -> np.ndarray:
    control.mdi(f'G21 G91 G94 G1 {move.axis}{move.shown:.4f} F300')
    return _until_still(backend, timeout)


def _until_still(backend: LinuxCnc, timeout: float) -> np.ndarray:
    """(n, k) feedback until the axes have stood still for a while."""
    limit = time.monotonic() + timeout
    rows: list[np.ndarray] = []
    since = time.monotonic()
    while time.monotonic() - since < _STILL_S:
        for one in backend.read(0.1):
            if rows and np.abs(one.position - rows[-1]).max() > 1e-7:
                since = time.monotonic()
            rows.append(one.position)
        if time.monotonic() > limit:
            raise UserError(f'LinuxCNC: the axes have not stopped in {timeout:g} s; stop them')
    return np.array(rows)
