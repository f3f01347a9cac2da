"""A connection to an MTConnect agent: documents over HTTP."""

from __future__ import annotations

import http.client
import math
import socket
import time
from typing import Any

from rtest_drivers.addresses import split_url
from rtest_drivers.cnc.mtconnect_xml import LARGEST, DocumentError
from rtest_estimation.errors import UserError

_REPLY_S = 0.8


class _Socket(socket.socket):
    """One that receives nothing after a moment: the time-out of a socket is for every byte anew.

    until : on time.monotonic
    """

    until = math.inf

    def recv_into(self, *args: Any) -> int:
        left = self.until - time.monotonic()
        if left <= 0.0:
            raise TimeoutError('the answer was not complete in time')
        self.settimeout(left)
        return super().recv_into(*args)


class _Connection(http.client.HTTPConnection):
    def connect(self) -> None:
        super().connect()
        self.sock = _Socket(fileno=self.sock.detach())


class Agent:
    """Asks an agent for documents; the connection is kept."""

    def __init__(self, url: str) -> None:
        """Raises UserError where `url` is not one of an agent."""
        self.url = url
        parts = split_url(url)
        if parts is None or parts.scheme != 'http' or parts.query:
            raise UserError(f'url: expected http://HOST:PORT of an MTConnect agent, got {url!r}')
        self._base = parts.path.rstrip('/')
        self._connection = _Connection(parts.hostname, parts.port or 80, timeout=_REPLY_S)

    def get(self, path: str, limit: float = _REPLY_S) -> bytes:
        """The document at `path`, also one that says an error, whole within `limit` [s].

        Raises ConnectionError.
        """
        try:
            if self._connection.sock is None:
                self._connection.connect()
            self._connection.sock.settimeout(_REPLY_S)
            self._connection.sock.until = time.monotonic() + limit
            self._connection.request('GET', f'{self._base}/{path}', headers={'Accept': 'text/xml'})
            answer = self._connection.getresponse()
            body = answer.read(LARGEST + 1)
            if len(body) > LARGEST:
                self.close()
        except (OSError, http.client.HTTPException) as error:
            self.close()
            raise ConnectionError(
                f'no MTConnect agent at {self.url} ({str(error) or type(error).__name__}); start '
                'it, or set url of the device file'
            ) from None
        if answer.status != http.client.OK and b'MTConnectError' not in body:
            raise DocumentError(
                f'{self.url}/{path} answers HTTP {answer.status}; set url and device of the '
                'device file'
            )
        return body

    def close(self) -> None:
        """Hang up; it connects again by itself."""
        self._connection.close()
