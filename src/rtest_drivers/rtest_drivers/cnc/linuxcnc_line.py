"""A connection to linuxcncrsh: one request, one reply."""

from __future__ import annotations

import contextlib
import select
import socket
import time

from rtest_drivers.cnc.linuxcnc_protocol import ReplyError, answer, take_line

_REPLY_S = 0.5
# The server looks every 0.1 s only whether the task process has got the command.
_SET_S = 2.0
_CONNECT_S = 2.0


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
            reply = self.ask(f'hello {password} rtest 1.1')
            if reply.split()[:2] != ['HELLO', 'ACK']:
                raise ReplyError(
                    f'{self.where} does not let us in ({reply[:60]!r}); set password of the '
                    'device file to what --connectpw of linuxcncrsh says'
                )
            self.ask('set echo off')  # The echo of this request is its reply.
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
        """What `get` says."""
        return answer(f'get {word}', self.ask(f'get {word}'))

    def set(self, request: str) -> None:
        """A request that is acknowledged; raises Refused or another ConnectionError."""
        if (said := answer(request, self.ask(request, _SET_S))) != 'ACK':
            raise ReplyError(f'{self.where}: {request!r} was answered by {said[:60]!r}')

    def send(self, request: str) -> None:
        """Send a request, without its reply."""
        try:
            self._socket.settimeout(_REPLY_S)
            self._socket.sendall(request.encode() + b'\n')
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from None

    def reply(self, timeout: float) -> str | None:
        """The next line, None where none came in `timeout` [s]."""
        limit = time.monotonic() + timeout
        while (line := take_line(self._buffer)) is None:
            try:
                ready, _, _ = select.select(
                    [self._socket], [], [], max(0.0, limit - time.monotonic())
                )
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
