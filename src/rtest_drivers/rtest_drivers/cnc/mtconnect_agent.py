"""A connection to an MTConnect agent: documents over HTTP."""

from __future__ import annotations

import http.client
from urllib.parse import urlsplit

from rtest_drivers.cnc.mtconnect_xml import LARGEST, DocumentError
from rtest_estimation.errors import UserError

_REPLY_S = 0.8


class Agent:
    """Asks an agent for documents; the connection is kept."""

    def __init__(self, url: str) -> None:
        """Raises UserError where `url` is not one of an agent."""
        self.url = url
        parts = urlsplit(url)
        try:
            good = parts.scheme == 'http' and parts.hostname and not parts.query
            port = parts.port or 80
        except ValueError:
            good = False
        if not good:
            raise UserError(f'url: expected http://HOST:PORT of an MTConnect agent, got {url!r}')
        self._base = parts.path.rstrip('/')
        self._connection = http.client.HTTPConnection(parts.hostname, port, timeout=_REPLY_S)

    def get(self, path: str) -> bytes:
        """The document at `path`, also one that says an error; raises ConnectionError."""
        try:
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
