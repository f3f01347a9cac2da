"""A serial line: a port of this computer, ``socket://host:port`` or ``rfc2217://host:port``."""

from __future__ import annotations

import contextlib
import errno
import os
import time
from collections.abc import Iterator

import serial

from rtest_drivers.gauges.frames import Line

try:
    import termios

    _ERRORS: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:  # Windows
    termios = None
    _ERRORS = (OSError,)

_PARITY = {'none': 'N', 'even': 'E', 'odd': 'O'}
# The port is asked this long at a time whether anything came [s].
_SLICE_S = 0.02
_WRITE_S = 0.5
# More than this waiting is thrown away in the next round [bytes].
_MOST_WAITING = 4096
_WHY = {
    errno.ENOENT: 'check the cable; ls -l /dev/serial/by-id shows what is there',
    errno.ENODEV: 'check the cable; ls -l /dev/serial/by-id shows what is there',
    errno.EACCES: 'add the user to the group dialout and log in again',
    errno.EAGAIN: 'another program uses it; close that one',
    errno.EBUSY: 'another program uses it; close that one',
}


class Port:
    """An open line; every call raises ConnectionError when the line is lost."""

    def __init__(self, url: str, line: Line) -> None:
        """Open it; the message of the ConnectionError says what failed and what to do."""
        self.url = url
        try:
            self._port = serial.serial_for_url(
                url,
                baudrate=line.baud,
                bytesize=line.bytesize,
                parity=_PARITY[line.parity],
                stopbits=line.stopbits,
                timeout=_SLICE_S,
                # pyserial's RFC 2217 client has no such limit.
                write_timeout=None if url.startswith('rfc2217:') else _WRITE_S,
                exclusive=True,
            )
        except (*_ERRORS, ValueError) as error:
            number = getattr(error, 'errno', None)
            advice = _WHY.get(number, 'check the port and what is at its other end')
            text = f'{url}: cannot be opened ({_reason(error)}); {advice}'
            raise ConnectionError(text) from None
        self._tune(line)

    def _tune(self, line: Line) -> None:
        """Settings that not every port has."""
        with contextlib.suppress(AttributeError, *_ERRORS, ValueError):
            # USB converters hold bytes back for 16 ms otherwise.
            self._port.set_low_latency_mode(True)
        if termios is not None and line.parity != 'none':
            with contextlib.suppress(AttributeError, *_ERRORS, ValueError):
                # pyserial leaves the check off. With it a byte of wrong parity is read as zero,
                # which no protocol knows.
                settings = termios.tcgetattr(self._port.fd)
                settings[0] |= termios.INPCK
                termios.tcsetattr(self._port.fd, termios.TCSANOW, settings)

    def write(self, data: bytes) -> None:
        """Send bytes."""
        with self._lost():
            self._port.write(data)

    def read(self, seconds: float) -> bytes:
        """What has come, waiting up to `seconds` for the first byte; empty where none came."""
        limit = time.monotonic() + seconds
        with self._lost():
            while True:
                data = self._port.read(max(1, self._port.in_waiting))
                if data or time.monotonic() >= limit:
                    return data

    def drop(self) -> int:
        """Throw away what has come; returns how many bytes."""
        count = 0
        with self._lost():
            while count < _MOST_WAITING and (waiting := self._port.in_waiting):
                count += len(self._port.read(waiting))
        return count

    def close(self) -> None:
        """Close it."""
        with contextlib.suppress(*_ERRORS):
            self._port.close()

    @contextlib.contextmanager
    def _lost(self) -> Iterator[None]:
        try:
            yield
        except _ERRORS as error:
            raise ConnectionError(
                f'{self.url}: the line is lost ({_reason(error)}); plug it in again, '
                'it is tried again by itself'
            ) from None


def _reason(error: Exception) -> str:
    """One line of an exception of pyserial or the system."""
    number = getattr(error, 'errno', None)
    text = os.strerror(number) if number else ' '.join(str(error).split())
    return text or type(error).__name__
