"""LinuxCNC through linuxcncrsh: backend 'linuxcnc' of the CNC driver.

`get joint_pos` is what the encoders of the joints say (motion.joint[].input), whatever the
kinematics do: the positions of the machine's axes. `get abs_act_pos` is the same only while the
kinematics are the identity; in TCP mode it is where the tool is. Both are actual, not commanded.
A value is as old as [TASK] CYCLE_TIME and two servo periods: 2 ms, 3 at most, was measured where
all are 1 ms.

A device file:

    host: 127.0.0.1
    port: 5007
    password: EMC               # --connectpw
    rate_hz: 200
    still_s: 5                  # longest stop of a program that is not suspicious
    enable_password: EMCTOO     # --enablepw; only to let this driver watch the task process
    axes:
      X: {index: 0, unit: mm}   # joint number
      B: {index: 3, unit: deg, sign: -1}
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any

from rtest_drivers.addresses import host_is_good
from rtest_drivers.clock import HostClock
from rtest_drivers.cnc.axes import AxisSource, names, scales
from rtest_drivers.cnc.clock import Recent
from rtest_drivers.cnc.device_file import load
from rtest_drivers.cnc.linuxcnc_line import Line
from rtest_drivers.cnc.linuxcnc_protocol import (
    STATE_WORDS,
    UNIT_WORDS,
    ReplyError,
    State,
    positions,
    state,
)
from rtest_drivers.cnc.linuxcnc_watchdog import Watchdog
from rtest_estimation.errors import UserError
from rtest_estimation.records import Feedback

_POSITIONS = 'joint_pos'
_STATE_S = 0.25
# A reply that took longer does not say well enough when the axes were there [ns].
_LATE_NS = 50_000_000
# How long what happened once is told.
_TOLD_S = 2.0
_KEYS = {
    'host', 'port', 'password', 'enable_password', 'rate_hz', 'still_s', 'axes',
}


@dataclass(frozen=True)
class LinuxCncFile:
    """A device file.

    enable_password : '' where control is never taken
    rate : of the feedback [1/s]
    still : longest stop of a running program [s]
    """

    host: str
    port: int
    password: str
    enable_password: str
    rate: float
    still: float
    axes: tuple[AxisSource, ...]


def load_linuxcnc(path: str) -> LinuxCncFile:
    """Read a device file; raises UserError naming file, key and what is expected."""
    reader = load(path, _KEYS)
    passwords = [reader.text('password', 'EMC'), reader.text('enable_password', '')]
    for key, word in zip(('password', 'enable_password'), passwords, strict=True):
        if any(character.isspace() for character in word):
            raise UserError(f'{path}: {key}: linuxcncrsh takes no password with spaces')
    host = reader.text('host', '127.0.0.1')
    if not host_is_good(host):
        raise UserError(f'{path}: host: expected the name or address of a host, got {host!r}')
    return LinuxCncFile(
        host,
        reader.integer('port', 5007, (1, 65535)),
        *passwords,
        reader.number('rate_hz', 200.0, (1.0, 1000.0)),
        reader.number('still_s', 5.0, (0.1, 3600.0)),
        reader.axes('index', int),
    )


class LinuxCnc:
    """Polls the positions of the axes; stamps midway between request and reply.

    Without `enable_password` it only looks on, and a dead task process, which leaves the last
    values standing for ever, can be told by a running program that stands still longer than
    `still_s` only. With it a watchdog tells, and what cannot be trusted is held back.
    """

    def __init__(self, address: str) -> None:
        """Read the device file; raises UserError."""
        self._file = load_linuxcnc(address)
        self._names, self._scales = names(self._file.axes), scales(self._file.axes)
        self._joints = [axis.source for axis in self._file.axes]
        self._clock = HostClock()
        self._line: Line | None = None
        self._watchdog: Watchdog | None = None
        self._state: State | None = None
        self._round_trip = Recent()

    @property
    def axes(self) -> tuple[str, ...]:
        """Letters of the axes in the device file."""
        return names(self._file.axes)

    @property
    def rate(self) -> float:
        """What the device file asks for [1/s]."""
        return self._file.rate

    def open(self) -> None:
        """Connect; raises ConnectionError saying what failed and what to do."""
        self.close()
        file = self._file
        try:
            self._line = Line(file.host, file.port, file.password)
            self._check_axes(self._line)
            if file.enable_password:
                self._watchdog = Watchdog(
                    lambda: Line(file.host, file.port, file.password), file.enable_password
                )
        except BaseException:
            self.close()
            raise
        self._held: list[Feedback] = []
        self._next = self._changed = time.monotonic()
        self._looked = self._late = -math.inf
        self._state = None
        self._said: tuple[Any, ...] = ()
        self._last = 0

    def read(self, timeout: float) -> list[Feedback]:
        """Feedback, waiting up to `timeout` [s]; raises ConnectionError when LinuxCNC is lost."""
        if self._line is None:
            raise ConnectionError('LinuxCNC is not open')
        try:
            return self._read(self._line, timeout)
        except ConnectionError:
            self.close()
            raise

    def close(self) -> None:
        """Hang up; does nothing where it is not open."""
        for one in (self._watchdog, self._line):
            if one is not None:
                one.close()
        self._watchdog = self._line = None

    def problem(self) -> str:
        """What is wrong while feedback goes on, in one line; '' where all is well."""
        known = self._state
        if self._line is None or known is None:
            return ''
        if known.estop:
            return 'LinuxCNC: E-stop is on; release it, switch the machine on, run the cycle again'
        if not known.machine_on:
            return 'LinuxCNC: the machine is off; switch it on and run the cycle again'
        unhomed = [
            axis.name for axis in self._file.axes
            if not (axis.source < len(known.homed) and known.homed[axis.source])
        ]
        if unhomed:
            return f'LinuxCNC: {", ".join(unhomed)} not homed, positions mean nothing; home first'
        stood = time.monotonic() - self._changed
        if known.program == 'RUNNING' and stood > self._file.still:
            return (
                f'LinuxCNC: the program runs but nothing has changed for {stood:.1f} s; if no '
                'dwell is as long its task process is dead: start LinuxCNC again'
            )
        if time.monotonic() - self._late < _TOLD_S:
            return (
                f'linuxcncrsh took more than {_LATE_NS / 1e6:g} ms for an answer, which is thrown '
                'away; look what else keeps the controller or the network busy'
            )
        return self._clock.problem()

    def uncertainty(self) -> float:
        """Of the stamps: half the longest round trip of the last moments [s]."""
        return self._round_trip.largest * 0.5e-9

    def told(self) -> dict[str, str]:
        """What diagnostics show."""
        known, watchdog = self._state, self._watchdog
        return {
            'stamp_uncertainty_ms': f'{self.uncertainty() * 1e3:.3f}',
            'program': known.program if known else '',
            'estop': 'on' if known and known.estop else 'off',
            'watchdog': 'off' if watchdog is None else watchdog.told(),
        }

    def _read(self, line: Line, timeout: float) -> list[Feedback]:
        wait = self._next - time.monotonic()
        time.sleep(min(max(wait, 0.0), timeout))
        feedback = []
        if wait <= timeout:
            # What was missed is not caught up.
            self._next = max(self._next + 1.0 / self._file.rate, time.monotonic())
            feedback = self._poll(line)
        if time.monotonic() - self._looked >= _STATE_S:
            self._look(line)
        if self._watchdog is None:
            return feedback
        self._held += feedback
        trusted = self._watchdog.alive_until(self._clock)
        feedback = [one for one in self._held if one.stamp <= trusted]
        self._held = self._held[len(feedback) :]
        return feedback

    def _poll(self, line: Line) -> list[Feedback]:
        sent = self._clock.now()
        told = line.get(_POSITIONS)
        came = self._clock.now()
        values = positions(told)
        if len(values) != self._count:
            raise ReplyError(f'{line.where} told {len(values)} joints instead of {self._count}')
        for axis in self._file.axes:
            if not axis.plausible(values[axis.source]):
                raise ReplyError(
                    f'axis {axis.name}: {line.where} says {values[axis.source]:g} {axis.unit}, '
                    'which is no position; look at the encoder and its scale'
                )
        if (said := (told, self._state and self._state.line)) != self._said:
            self._said, self._changed = said, time.monotonic()
        if came - sent > _LATE_NS:
            self._late = time.monotonic()
            return []
        self._round_trip.add(came - sent)
        self._last = max((sent + came) // 2, self._last + 1)
        return [Feedback(self._last, self._names, values[self._joints] * self._scales)]

    def _look(self, line: Line) -> None:
        """At the state of the controller."""
        self._looked = time.monotonic()
        self._state = state([line.get(word) for word in STATE_WORDS])

    def _check_axes(self, line: Line) -> None:
        """Hold the device file to what the controller says of its joints."""
        self._count = count = len(positions(line.get(_POSITIONS)))
        units = line.get('joint_units').split()
        for axis in self._file.axes:
            if axis.source >= count:
                raise ConnectionError(
                    f'axes: {axis.name}: index {axis.source}: LinuxCNC tells joints 0 to '
                    f'{count - 1} only; correct the device file'
                )
            word = units[axis.source] if axis.source < len(units) else 'nothing'
            unit = UNIT_WORDS.get(word)
            if unit is None:
                raise ConnectionError(
                    f'axes: {axis.name}: unit: LinuxCNC says {word}, expected one of '
                    f'{list(UNIT_WORDS)}; set LINEAR_UNITS or ANGULAR_UNITS of [TRAJ] to one of '
                    'these in the INI file of LinuxCNC'
                )
            if unit != axis.unit:
                raise ConnectionError(
                    f'axes: {axis.name}: unit: LinuxCNC says {unit}, the device file '
                    f'{axis.unit}; correct the device file'
                )

