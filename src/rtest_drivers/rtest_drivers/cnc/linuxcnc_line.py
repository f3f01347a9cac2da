"""A connection to linuxcncrsh: one request, one reply.

linuxcncrsh takes the requests of all connections apart with one `strtok`: two that come in the
same microseconds mix their words, and either is refused or answered by what the other asked. On
LinuxCNC 2.9.0 with three connections that ask as fast as they can it was 0.2 % of the requests,
at 200 a second it is one in hours. So what is not answered is asked again before it is believed.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time

from rtest_drivers.cnc.linuxcnc_protocol import ReplyError, Unanswered, answer, take_line

_REPLY_S = 0.5
# The server looks every 0.1 s only whether the task process has got the command.
_SET_S = 2.0
_CONNECT_S = 2.0
_TRIES = 4
_SILENCE_S = 0.02
# For a server that talks without end.
_DISCARD_S = 0.5


class Line:
    """The connection. Several requests in one packet would stall the server: never done here.

    A reply that is late is never taken for that to the next request: after a time-out the line
    must be closed.
    """

    def __init__(self, host: str, port: int, password: str) -> None:
        """Connect and say hello; raises ConnectionError saying what to do."""
        self.where = f'linuxcncrsh at {host}:{port}'
        self._buffer = bytearray()
        try:
            self._socket = socket.create_connection((host, port), _CONNECT_S)
        except OSError as error:
            raise ConnectionError(
                f'no {self.where} ({error.strerror or error}); start LinuxCNC with '
                '[DISPLAY] DISPLAY = linuxcncrsh, or set host and port of the device file'
            ) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            self._hello(password)
            self.set('set verbose on')
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def ask(self, request: str, timeout: float = _REPLY_S) -> str:
        """The reply to a request; raises ConnectionError where there is none in `timeout` [s]."""
        self.send(request)
        reply = self.reply(timeout)
        if reply is None:
            raise ReplyError(
                f'{self.where} did not answer {request!r} in {timeout:g} s; look whether LinuxCNC '
                'still runs'
            )
        return reply

    def get(self, word: str) -> str:
        """What `get` says; raises ConnectionError."""
        return self._answer(f'get {word}', _REPLY_S)

    def set(self, request: str) -> None:
        """A request that is acknowledged; raises Refused or another ConnectionError."""
        if (said := self._answer(request, _SET_S)) != 'ACK':
            raise ReplyError(f'{self.where}: {request!r} was answered by {said[:60]!r}')

    def _answer(self, request: str, timeout: float) -> str:
        for tries in range(1, _TRIES + 1):
            try:
                return answer(request, self.ask(request, timeout))
            except Unanswered:
                if tries == _TRIES:
                    raise
                self._discard()
        raise AssertionError

    def _hello(self, password: str) -> None:
        for _ in range(_TRIES):
            reply = self.ask(f'hello {password} rtest 1.1')
            if not reply.endswith('NAK'):
                break
        if reply.split()[:1] != ['HELLO']:
            raise ReplyError(
                f'{self.where} is none, it says {reply[:60]!r}; set host and port of the device '
                'file to those of linuxcncrsh'
            )
        if reply.split()[:2] != ['HELLO', 'ACK']:
            raise ReplyError(
                f'{self.where} does not let us in ({reply[:60]!r}); set password of the '
                'device file to what --connectpw of linuxcncrsh says'
            )
        for _ in range(_TRIES):
            self.ask('set echo off')  # Its echo is its reply.
            if (reply := self.ask('get echo')) == 'ECHO OFF':
                return
            self._discard()
        raise ReplyError(f"{self.where}: 'get echo' was answered by {reply[:60]!r}")

    def _discard(self) -> None:
        """What comes after an answer to something else, so that no later one is mistaken."""
        limit = time.monotonic() + _DISCARD_S
        while self.reply(_SILENCE_S) is not None:
            if time.monotonic() > limit:
                raise ReplyError(f'{self.where} talks without being asked; is it linuxcncrsh?')

    def send(self, request: str) -> None:
        """Send a request, without its reply."""
        try:
            self._socket.settimeout(_REPLY_S)
            self._socket.sendall(request.encode() + b'\n')
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from None

    def reply(self, timeout: float) -> str | None:
        """The next line, None where none came in `timeout` [s]."""
        limit, left = time.monotonic() + timeout, timeout
        while (line := take_line(self._buffer)) is None:
            if left < 0.0:
                return None  # Something comes, but no line.
            left = limit - time.monotonic()
            try:
                ready, _, _ = select.select([self._socket], [], [], max(0.0, left))
                data = self._socket.recv(4096) if ready else None
            except OSError as error:
                raise self._lost(error.strerror or str(error)) from None
            if data is None:
                return None
            if not data:
                raise self._lost('it hung up')
            self._buffer += data
        return line

    def _lost(self, why: str) -> ConnectionError:
        with contextlib.suppress(OSError):
            self._socket.close()
        return ConnectionError(f'lost {self.where} ({why}); start LinuxCNC again')
