"""Tells whether LinuxCNC's task process lives.

When it dies, linuxcncrsh answers every `get` with the values it last had and hangs in every `set`.
So a `set` that changes nothing, `set debug` to what it is, is sent now and then. Only who has
control may set; it is taken once, at the start, and never taken back from another client, who
would not notice. linuxcncrsh cannot tell whether somebody else has control: this watchdog is for a
machine that no other client of linuxcncrsh controls. Nor should anybody command it from a screen
meanwhile: the task process has room for one command, and another within the same cycle of it is
lost. Where [TASK] CYCLE_TIME is 0.001 that is one in a thousand.

Where another client has set a time-out (`set timeout`) shorter than `_HANGS_S`, a dead process is
not noticed.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from rtest_drivers.clock import HostClock
from rtest_drivers.cnc.linuxcnc_line import Line
from rtest_drivers.cnc.linuxcnc_protocol import Refused, Unanswered, answer

_PERIOD_S = 0.25
# An answer takes 0.1 s, and a task cycle more.
_HANGS_S = 0.3


class Watchdog:
    """Asks on a connection of its own and does not wait, so that feedback goes on."""

    def __init__(self, connect: Callable[[], Line], password: str) -> None:
        """Connect, take control, ask once; raises ConnectionError saying what to do."""
        self._connect, self._password = connect, password
        self._alive = 0
        self._lost_control = False
        self._start()

    def _start(self) -> None:
        self._line = self._connect()
        try:
            self._line.set(f'set enable {self._password}')
            # Its first word is not looked at.
            self._request = f'set debug x {self._line.get("debug")}'
            self._line.send(self._request)
            reply = self._line.reply(_HANGS_S)
        except Refused:
            self.close()
            raise ConnectionError(
                f'{self._line.where} does not give control; set enable_password of the device '
                'file to what --enablepw of linuxcncrsh says, or leave it out'
            ) from None
        except BaseException:
            self.close()
            raise
        if reply is None:
            self.close()
            raise ConnectionError(
                "LinuxCNC's task process does not answer, its positions are frozen; start "
                'LinuxCNC again, home, and run the cycle again'
            )
        self._sent = time.monotonic()
        # Of the question that is not answered yet, None where there is none [ns].
        self._asked: int | None = None

    def close(self) -> None:
        """Hang up."""
        self._line.close()

    def told(self) -> str:
        """Whether it watches."""
        return 'off: another client took control' if self._lost_control else 'on'

    def alive_until(self, clock: HostClock) -> int:
        """Until when values are known to be fresh, in the time of `clock` [ns].

        Raises ConnectionError when the process is dead. Where another client has control nothing
        is known, and everything is taken for fresh.
        """
        if self._lost_control:
            return clock.now()
        waited = time.monotonic() - self._sent
        if self._asked is None:
            if waited >= _PERIOD_S:
                self._asked, self._sent = clock.now(), time.monotonic()
                self._line.send(self._request)
        elif (reply := self._line.reply(0.0)) is not None:
            try:
                answer(self._request, reply)
            except Unanswered:
                # Another client has control, or the words were mixed with those of one.
                self._lost_control = self._line.get('enable') != 'ON'
            self._alive, self._asked = self._asked, None
        elif waited > _HANGS_S:
            # A command from a screen at the same moment takes the answer away: ask once more.
            self.close()
            self._start()
        return self._alive
