"""The web server of the page: values as server-sent events, wishes as POST requests.

Nobody but this page may ask for anything (OWASP, Cross-Site Request Forgery Prevention Cheat
Sheet): a request must name this server as its host, which a rebound DNS name does not, come from
this page's own origin, and carry the key in a header that other sites cannot set. On localhost the
page holds the key; elsewhere the address with which it is opened must.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
import secrets
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from importlib.resources import files
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from aiohttp import web

from rtest_drivers.view.address import is_local, named_hosts, page_address
from rtest_drivers.view.state import TICK_S, CellState
from rtest_estimation.errors import UserError

KEY_HEADER = 'X-Rtest-Key'
MARK_LIMIT = 200
# What a person can ask of a session, as services `session/NAME`.
WISHES = ('start', 'repeat', 'skip', 'calibrate', 'abort')
_TYPES = {'.js': 'text/javascript', '.css': 'text/css'}
_HEADERS = {
    'Content-Security-Policy':
        "default-src 'self'; img-src data:; frame-ancestors 'none'; base-uri 'none'",
    'X-Content-Type-Options': 'nosniff',
    'Referrer-Policy': 'no-referrer',
    'Cache-Control': 'no-store',
}
# A wish is a few words.
_LARGEST = 4096

Ask = Callable[[str], Awaitable[tuple[bool, str]]]
Mark = Callable[[str], tuple[bool, str]]


class Server:
    """Serves one cell's page.

    ask : calls the session's service of a name; (granted, answer)
    mark : puts a text into the recording; (done, answer)
    """

    def __init__(self, state: CellState, ask: Ask, mark: Mark, host: str) -> None:
        self._state, self._ask, self._mark = state, ask, mark
        self.host = host
        self.key = secrets.token_urlsafe(16)
        self._live = 'null'
        self._ticked = asyncio.Condition()
        static = files('rtest_drivers.view') / 'static'
        self._html = (static / 'page.html').read_text(encoding='utf-8')
        # Read once: no request names a file that is opened.
        self._files = {
            one.name: one.read_text(encoding='utf-8') for one in static.iterdir()
            if PurePosixPath(one.name).suffix in _TYPES
        }

    @property
    def local(self) -> bool:
        """Whether only this host can reach the server."""
        return is_local(self.host)

    def application(self) -> web.Application:
        """The application, with the task that ticks."""
        application = web.Application(middlewares=[self._guard], client_max_size=_LARGEST)
        application.router.add_get('/', self._page)
        for name in self._files:
            application.router.add_get(f'/{name}', self._file)
        application.router.add_get('/events', self._events)
        application.router.add_post('/ask', self._on_ask)
        application.router.add_post('/mark', self._on_mark)
        application.cleanup_ctx.append(self._ticking)
        return application

    async def _ticking(self, _: web.Application) -> AsyncIterator[None]:
        async def tick() -> None:
            while True:
                self._live = json.dumps(self._state.tick(time.monotonic()))
                async with self._ticked:
                    self._ticked.notify_all()
                await asyncio.sleep(TICK_S)

        task = asyncio.create_task(tick())
        yield
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    # --- who may ---

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[Any]]
    ) -> web.StreamResponse:
        if not self._is_ours(request.host):
            return _refusal(421, f'{request.host}: not the name of this server')
        origin = request.headers.get('Origin')
        if origin is not None and _netloc(origin) != request.host:
            return _refusal(403, f'asked by {origin}, not by the page of this server')
        if request.method == 'POST':
            given = request.headers.get(KEY_HEADER, '')
            if not secrets.compare_digest(given.encode(), self.key.encode()):
                return _refusal(
                    403, 'controls are off: load the page anew, with the address that was printed'
                )
        response = await handler(request)
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    def _is_ours(self, host: str) -> bool:
        """Whether a Host header can be of a request meant for this server.

        Addresses in numbers are, on localhost those of the loopback: to rebind, a foreign page
        needs a name.
        """
        try:
            name = urlsplit(f'//{host}').hostname or ''
        except ValueError:
            return False
        names = {'localhost', self.host.lower()}
        if not self.local:
            own = socket.gethostname().lower()
            names |= {own, f'{own}.local', own.partition('.')[0]}
        try:
            number = ipaddress.ip_address(name)
        except ValueError:
            return name in names
        return not self.local or number.is_loopback

    # --- the page ---

    async def _page(self, _: web.Request) -> web.Response:
        key = self.key if self.local else ''
        text = self._html.replace('KEY', key)
        return web.Response(text=text, content_type='text/html')

    async def _file(self, request: web.Request) -> web.Response:
        name = request.path.lstrip('/')
        return web.Response(
            text=self._files[name], content_type=_TYPES[PurePosixPath(name).suffix]
        )

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """The history, then ten times a second what is, and each part when it has changed.

        A page that takes longer than a tick gets the next one after it has taken the last.
        """
        response = web.StreamResponse(headers={**_HEADERS, 'Content-Type': 'text/event-stream'})
        await response.prepare(request)
        sent: dict[str, int] = {}
        try:
            await response.write(_event('history', json.dumps(list(self._state.history))))
            while True:
                changed = {
                    name: revision for name, (revision, _) in self._state.parts.items()
                    if sent.get(name) != revision
                }
                for name, revision in changed.items():
                    shown = self._state.parts[name][1]
                    await response.write(
                        _event('part', json.dumps({'name': name, 'shown': shown}))
                    )
                    sent[name] = revision
                await response.write(_event('live', self._live))
                async with self._ticked:
                    await self._ticked.wait()
        except ConnectionResetError:
            return response

    # --- wishes ---

    async def _on_ask(self, request: web.Request) -> web.Response:
        wish = (await _body(request)).get('wish')
        if wish not in WISHES:
            return _refusal(400, f'{wish!r}: expected one of {", ".join(WISHES)}')
        granted, answer = await self._ask(wish)
        return web.json_response({'granted': granted, 'answer': answer})

    async def _on_mark(self, request: web.Request) -> web.Response:
        text = (await _body(request)).get('text')
        if not isinstance(text, str) or not (text := text.strip()):
            return _refusal(400, 'write what is to be marked')
        if len(text) > MARK_LIMIT or not text.isprintable():
            return _refusal(400, f'a mark has at most {MARK_LIMIT} characters, in one line')
        if problem := self._state.problem(time.monotonic()):
            return web.json_response({'granted': False, 'answer': problem})
        granted, answer = self._mark(text)
        return web.json_response({'granted': granted, 'answer': answer})


async def serve(server: Server, port: int, stop: asyncio.Event) -> None:
    """Serve until `stop`; says where. Raises UserError where the address cannot be had."""
    runner = web.AppRunner(server.application(), access_log=None, shutdown_timeout=0.5)
    await runner.setup()
    try:
        try:
            await web.TCPSite(runner, server.host, port).start()
        except OSError as error:
            raise UserError(
                f'{server.host}:{port}: cannot be served: {error.strerror}; choose another '
                '--port or --host'
            ) from None
        bound, key = runner.addresses[0][1], '' if server.local else server.key
        for host in named_hosts(server.host):
            print(f'page: {page_address(host, bound, key)}', flush=True)
        await stop.wait()
    finally:
        await runner.cleanup()


def _netloc(origin: str) -> str | None:
    """Host and port of an Origin header; None where it is no address."""
    try:
        return urlsplit(origin).netloc
    except ValueError:
        return None


async def _body(request: web.Request) -> dict[str, Any]:
    try:
        data = await request.json()
    except (ValueError, LookupError, RecursionError):
        # No JSON, in a character set that does not exist, or nested without end.
        data = None
    return data if isinstance(data, dict) else {}


def _event(name: str, data: str) -> bytes:
    return f'event: {name}\ndata: {data}\n\n'.encode()


def _refusal(status: int, answer: str) -> web.Response:
    body = {'granted': False, 'answer': answer}
    return web.json_response(body, status=status, headers=_HEADERS)
