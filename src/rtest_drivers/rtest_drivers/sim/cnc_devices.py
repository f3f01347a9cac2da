"""Controllers to talk to: linuxcncrsh, an OPC UA server, an MTConnect agent, with faults.

They listen on 127.0.0.1 only, at a port the system chooses unless one is given, which is how one
of them is started again. They speak for themselves: nothing here is shared with what reads them.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import socketserver
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

HOST = '127.0.0.1'


class LinuxCncServer:
    """Like linuxcncrsh of LinuxCNC 2.9; change its attributes to make it misbehave.

    position : of joints 0 to 5 [mm] or [deg]
    dead : the task process: positions stay as they are, sets hang
    late : time before every answer [s]; half : answers without their end
    mixed : how many requests are still refused, as where two came at the same moment
    """

    def __init__(
        self, password: str = 'EMC', enable_password: str = 'EMCTOO', port: int = 0
    ) -> None:
        self.password, self.enable_password = password, enable_password
        self.position: Sequence[float] = [0.0] * 6
        self.units = 'MM MM MM DEG DEG MM'
        self.estop, self.machine_on, self.homed = False, True, True
        self.program, self.line = 'IDLE', 0
        self.dead, self.half, self.late = False, False, 0.0
        self.mixed = 0
        self.in_control: socket.socket | None = None
        self.requests: deque[str] = deque(maxlen=1000)
        self._clients: set[socket.socket] = set()
        self._server = _TcpServer((HOST, port), self._handler())
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def hang_up(self) -> None:
        """End every connection."""
        for client in list(self._clients):
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End."""
        self.dead = False
        self.hang_up()
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def _handler(self) -> type[socketserver.BaseRequestHandler]:
        peer = self

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                with contextlib.suppress(OSError):
                    peer._serve(self.request)

        return Handler

    def _serve(self, client: socket.socket) -> None:
        self._clients.add(client)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        session = {'echo': True, 'linked': False, 'verbose': False}
        with client.makefile('rb') as lines:
            for raw in lines:
                request = raw.decode().strip()
                self.requests.append(request)
                answer = f'{request}\n' if session['echo'] and session['linked'] else ''
                if self.mixed > 0:
                    self.mixed -= 1
                    answer += f'{request.split()[0].upper()} NAK\r\n'
                else:
                    answer += self._answer(client, request.split(), session)
                if self.late:
                    time.sleep(self.late)
                client.sendall(answer[: len(answer) // 2 if self.half else None].encode())
        self._clients.discard(client)

    def _answer(self, client: socket.socket, words: list[str], session: dict[str, bool]) -> str:
        verb, name = words[0].lower(), words[1].lower() if len(words) > 1 else ''
        if verb == 'hello':
            session['linked'] = len(words) == 4 and words[1] == self.password
            said = 'ACK EMCNETSVR 1.1' if session['linked'] else 'NAK'
            return f'HELLO {said}\r\n'
        if verb == 'get':
            value = self._value(client, name)
            if name == 'echo':
                value = 'ON' if session['echo'] else 'OFF'
            if value is None:
                return f'GET {name.upper()} NAK\r\n\r\n'
            return f'{name.upper()} {value}\r\n'
        if verb != 'set':
            return ''
        good = session['linked'] and self._set(client, name, words[2:], session)
        if good and not session['verbose']:
            return ''
        return f'SET {name.upper()} {"ACK" if good else "NAK"}\n\r'

    def _value(self, client: socket.socket, name: str) -> str | None:
        onoff = {'estop': self.estop, 'machine': self.machine_on,
                 'enable': self.in_control is client}
        if name in onoff:
            return 'ON' if onoff[name] else 'OFF'
        return {
            'joint_pos': ' '.join(f'{value:f}' for value in self.position),
            'joint_units': self.units,
            'joint_homed': ' '.join(['YES' if self.homed else 'NO'] * 6),
            'program_status': self.program,
            'program_line': str(self.line),
            'debug': '0',
        }.get(name)

    def _set(
        self, client: socket.socket, name: str, words: list[str], session: dict[str, bool]
    ) -> bool:
        if name in ('echo', 'verbose'):
            session[name] = words[0] == 'on'
            return True
        if name == 'enable':
            if words[0] == self.enable_password:
                self.in_control = client
            return words[0] == self.enable_password
        if self.in_control is not client or (name == 'debug' and len(words) != 2):
            return False
        while self.dead:
            time.sleep(0.01)
        time.sleep(0.1)
        return True


class _TcpServer(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True


class OpcUaServer:
    """One variable a name, in a thread of its own."""

    def __init__(self, nodes: Mapping[str, str], port: int = 0) -> None:
        """`nodes`: name to the text of a node id in namespace 2."""
        self._nodes, self._variables = nodes, {}
        self.port = port or _free_port()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._run(self._start())

    @property
    def url(self) -> str:
        """Where it listens."""
        return f'opc.tcp://{HOST}:{self.port}'

    def write(
        self, values: Mapping[str, Any], stamp: float | None = None, bad: str = ''
    ) -> None:
        """Change values, with a source time stamp [s] (now) and the name of a bad status."""
        self._run(self._write(values, time.time() if stamp is None else stamp, bad))

    def end_subscriptions(self) -> None:
        """Delete every subscription without telling, as after a fault of the server."""
        service = self._server.iserver.subscription_service
        self._run(service.delete_subscriptions(list(service.subscriptions)))

    def stop_publishing(self) -> None:
        """Subscriptions stay, nothing of them is published any more."""

        async def cancel() -> None:
            for one in self._server.iserver.subscription_service.subscriptions.values():
                one._task.cancel()

        self._run(cancel())

    def state(self, value: int) -> None:
        """Change the server's state, 0 for running."""
        from asyncua import ua

        node = self._server.get_node(ua.NodeId(ua.ObjectIds.Server_ServerStatus_State))
        self._run(node.write_value(ua.DataValue(ua.Variant(value, ua.VariantType.Int32))))

    def freeze(self, until: threading.Event) -> None:
        """Do nothing until then, with every connection open; returns at once."""
        self._loop.call_soon_threadsafe(until.wait)

    def close(self) -> None:
        """End."""
        self._run(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(60.0)

    async def _start(self) -> None:
        from asyncua import Server, ua

        self._server = Server()
        await self._server.init()
        self._server.set_endpoint(self.url)
        self._server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        space = await self._server.register_namespace('urn:controller')
        for name, text in self._nodes.items():
            self._variables[name] = await self._server.nodes.objects.add_variable(
                ua.NodeId(text, space), name, 0.0
            )
        await self._server.start()

    async def _end(self) -> None:
        await self._server.stop()
        # It leaves some behind.
        rest = asyncio.all_tasks() - {asyncio.current_task()}
        for task in rest:
            task.cancel()
        await asyncio.gather(*rest, return_exceptions=True)

    async def _write(self, values: Mapping[str, Any], stamp: float, bad: str) -> None:
        from asyncua import ua

        when = datetime.fromtimestamp(stamp, timezone.utc)
        code = ua.StatusCode(getattr(ua.StatusCodes, bad or 'Good'))
        for name, value in values.items():
            data = ua.DataValue(ua.Variant(value), StatusCode=code, SourceTimestamp=when)
            await self._server.write_attribute_value(self._variables[name].nodeid, data)


class MtConnectAgent:
    """Serves /probe, /current and /sample of one device over HTTP.

    size : of its buffer; instance : another one after a restart
    """

    def __init__(self, items: Mapping[str, tuple[str, str]], size: int = 64) -> None:
        """`items`: id to (type, units)."""
        self.items, self.size, self.instance = items, size, 1_700_000_000
        self._lock = threading.Lock()
        self._server = ThreadingHTTPServer((HOST, 0), self._handler())
        self._server.daemon_threads = True
        self.url = f'http://{HOST}:{self._server.server_address[1]}'
        self.paths: deque[str] = deque(maxlen=1000)
        self.answer: bytes | None = None
        self.restart(self.instance)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def restart(self, instance: int) -> None:
        """Forget everything."""
        with self._lock:
            self.instance, self._next = instance, 1
            self._buffer: deque[tuple[int, str, str, str]] = deque(maxlen=self.size)
            self._current: dict[str, tuple[int, str, str, str]] = {}
        self.observe(dict.fromkeys(self.items, 'UNAVAILABLE'))

    def observe(self, values: Mapping[str, Any], stamp: float | None = None) -> None:
        """New values, with a time stamp [s] (now)."""
        when = datetime.fromtimestamp(time.time() if stamp is None else stamp, timezone.utc)
        text = when.strftime('%Y-%m-%dT%H:%M:%S.%fZ')
        with self._lock:
            for item, value in values.items():
                self._current[item] = one = (self._next, item, text, str(value))
                self._buffer.append(one)
                self._next += 1

    def close(self) -> None:
        """End."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        peer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = 'HTTP/1.1'
            disable_nagle_algorithm = True

            def do_GET(self) -> None:
                body = peer._document(self.path) if peer.answer is None else peer.answer
                self.send_response(200)
                self.send_header('Content-Type', 'text/xml')
                self.send_header('Content-Length', str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *words: object) -> None:
                pass

        return Handler

    def _document(self, path: str) -> bytes:
        self.paths.append(path)
        parts = urlsplit(path)
        request = parts.path.rpartition('/')[2]
        query = {key: values[0] for key, values in parse_qs(parts.query).items()}
        with self._lock:
            if request == 'probe':
                return self._probe()
            if request == 'current':
                return self._streams(sorted(self._current.values()), self._next)
            start, count = int(query['from']), int(query['count'])
            if not self._buffer[0][0] <= start <= self._next:
                return self._error(f"'from' must be greater than {self._buffer[0][0]}")
            wanted = [one for one in self._buffer if one[0] >= start][:count]
            return self._streams(wanted, wanted[-1][0] + 1 if wanted else self._next)

    def _header(self, following: int) -> str:
        return (
            f'<Header creationTime="2024-01-01T00:00:00Z" sender="sim" version="1.4" '
            f'instanceId="{self.instance}" bufferSize="{self.size}" '
            f'firstSequence="{self._buffer[0][0]}" lastSequence="{self._next - 1}" '
            f'nextSequence="{following}"/>'
        )

    def _streams(self, wanted: Sequence[tuple[int, str, str, str]], following: int) -> bytes:
        names = {'POSITION': 'Position', 'ANGLE': 'Angle', 'EMERGENCY_STOP': 'EmergencyStop',
                 'AVAILABILITY': 'Availability'}
        observed = ''.join(
            f'<{names[self.items[item][0]]} dataItemId="{item}" timestamp="{stamp}" '
            f'sequence="{number}">{value}</{names[self.items[item][0]]}>'
            for number, item, stamp, value in wanted
        )
        return _xml('MTConnectStreams', self._header(following) + (
            f'<Streams><DeviceStream name="sim" uuid="1"><ComponentStream component="Axes">'
            f'<Samples>{observed}</Samples></ComponentStream></DeviceStream></Streams>'
        ))

    def _probe(self) -> bytes:
        items = ''.join(
            f'<DataItem category="SAMPLE" id="{item}" name="n{item}" type="{kind}"'
            + (f' units="{units}"' if units else '') + '/>'
            for item, (kind, units) in self.items.items()
        )
        return _xml('MTConnectDevices', self._header(1) + (
            f'<Devices><Device id="d" name="sim" uuid="1"><DataItems>{items}</DataItems></Device>'
            '</Devices>'
        ))

    def _error(self, text: str) -> bytes:
        return _xml('MTConnectError', self._header(1) + (
            f'<Errors><Error errorCode="OUT_OF_RANGE">{text}</Error></Errors>'
        ))


def _xml(name: str, inside: str) -> bytes:
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>'
        f'<{name} xmlns="urn:mtconnect.org:{name}:1.4">{inside}</{name}>'
    ).encode()


def _free_port() -> int:
    with socket.socket() as one:
        one.bind((HOST, 0))
        return one.getsockname()[1]
