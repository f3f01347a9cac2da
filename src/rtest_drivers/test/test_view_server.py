"""The web server of the page: who may ask, what is refused, what is sent."""

import asyncio
import ipaddress
import json
import re
import socket
import time
from importlib.resources import files
from urllib.parse import urlsplit

import pytest
from aiohttp.test_utils import TestClient, TestServer

from rtest_drivers.cli import main
from rtest_drivers.view.address import is_local, named_hosts, own_addresses, page_address
from rtest_drivers.view.devices import Report
from rtest_drivers.view.server import KEY_HEADER, Server, serve
from rtest_drivers.view.state import CellState


class Cell:
    """A server of a cell that grants everything but skip; what was asked and marked."""

    def __init__(self, host='127.0.0.1'):
        self.asked, self.marked = [], []
        self.state = CellState()
        self.state.add_report(Report('/recorder', 0, 'recording', {}, time.monotonic()))
        self.server = Server(self.state, self._ask, self._mark, host)

    async def _ask(self, wish):
        self.asked.append(wish)
        return wish != 'skip', f'{wish} heard'

    def _mark(self, text):
        self.marked.append(text)
        return True, text

    def run(self, test):
        """Run `test(client)` against the server."""

        async def whole():
            async with TestClient(TestServer(self.server.application())) as client:
                return await test(client)

        return asyncio.run(whole())

    def post(self, path, body, **headers):
        headers = {KEY_HEADER: self.server.key, **headers}

        async def test(client):
            answer = await client.post(path, json=body, headers=headers)
            return answer.status, await answer.json()

        return self.run(test)


def test_the_page_comes_with_its_key_and_from_nowhere_else() -> None:
    cell = Cell()

    async def test(client):
        page = await client.get('/')
        texts = [await page.text()]
        for name in ('page.js', 'page.css'):
            texts.append(await (await client.get(f'/{name}')).text())
        return page.headers, texts

    headers, texts = cell.run(test)
    assert cell.server.key in texts[0]
    assert "default-src 'self'" in headers['Content-Security-Policy']
    assert not any('http://' in text or 'https://' in text for text in texts)


def test_every_module_that_the_page_imports_is_served() -> None:
    async def test(client):
        found, seen = ['page.js'], {}
        while found:
            name = found.pop()
            answer = await client.get(f'/{name}')
            seen[name] = answer.status, answer.content_type, await answer.text()
            found += set(re.findall(r"from '\./(\w+\.js)'", seen[name][2])) - seen.keys()
        return seen, (await client.get('/page.html')).status

    seen, page = Cell().run(test)
    assert {(status, kind) for status, kind, _ in seen.values()} == {(200, 'text/javascript')}
    static = files('rtest_drivers.view') / 'static'
    assert set(seen) == {one.name for one in static.iterdir() if one.name.endswith('.js')}
    assert not any('http://' in text or 'https://' in text for _, _, text in seen.values())
    # Only the page itself, with its key.
    assert page == 404


def test_a_wish_goes_to_the_session_and_its_answer_back() -> None:
    cell = Cell()
    assert cell.post('/ask', {'wish': 'start'}) == (
        200, {'granted': True, 'answer': 'start heard'}
    )
    assert cell.post('/ask', {'wish': 'skip'})[1] == {'granted': False, 'answer': 'skip heard'}
    assert cell.asked == ['start', 'skip']


@pytest.mark.parametrize(
    ('headers', 'status'),
    [
        ({KEY_HEADER: ''}, 403),
        ({KEY_HEADER: 'guessed'}, 403),
        ({'Origin': 'http://evil.example'}, 403),
        ({'Origin': 'null'}, 403),
        # A name that was made to point to this computer.
        ({'Host': 'evil.example:8090'}, 421),
    ],
)
def test_nobody_else_can_ask(headers, status) -> None:
    cell = Cell()
    given, answer = cell.post('/ask', {'wish': 'start'}, **headers)
    assert given == status and not answer['granted'] and answer['answer']
    assert cell.asked == []


@pytest.mark.parametrize('bound', ['127.0.0.1', '0.0.0.0', '192.0.2.7'])
@pytest.mark.parametrize('named', ['evil.example', 'evil.example:8090', '[::1', 'a]b', '1.2.3'])
def test_a_foreign_name_cannot_even_look(bound, named) -> None:
    async def test(client):
        return (await client.get('/', headers={'Host': named})).status

    assert Cell(bound).run(test) == 421


@pytest.mark.parametrize(
    ('bound', 'named', 'status'),
    [
        ('0.0.0.0', '192.0.2.7:8090', 200),
        ('0.0.0.0', '[2001:db8::1]:8090', 200),
        ('0.0.0.0', socket.gethostname(), 200),
        ('cell.example', 'Cell.Example:8090', 200),
        ('127.0.0.1', 'localhost:8090', 200),
        ('127.0.0.1', '[::1]:8090', 200),
        ('127.0.0.1', '192.0.2.7', 421),
    ],
)
def test_names_and_addresses_of_this_server(bound, named, status) -> None:
    async def test(client):
        return (await client.get('/', headers={'Host': named})).status

    assert Cell(bound).run(test) == status


@pytest.mark.parametrize(
    ('data', 'headers', 'status'),
    [
        (b'{"wish": "start"}', {'Origin': 'http://['}, 403),
        (b'{"wish": "start"}', {'Content-Type': 'text/plain; charset=klingon'}, 400),
        (b'[' * 4000, {}, 400),
        (b'\xff', {}, 400),
    ],
)
def test_what_cannot_be_read_is_refused(data, headers, status) -> None:
    cell = Cell()

    async def test(client):
        given = {KEY_HEADER: cell.server.key, **headers}
        return (await client.post('/ask', data=data, headers=given)).status

    assert cell.run(test) == status
    assert cell.asked == []


def test_elsewhere_the_page_does_not_hold_the_key_but_the_address_does() -> None:
    cell = Cell('0.0.0.0')

    async def test(client):
        return await (await client.get('/', headers={'Host': '192.0.2.7:8090'})).text()

    assert cell.server.key not in cell.run(test)
    assert [is_local(host) for host in ('127.0.0.1', '::1', 'localhost', '0.0.0.0', 'box')] == [
        True, True, True, False, False
    ]


def test_bound_everywhere_the_page_is_named_and_numbered() -> None:
    assert page_address('cell', 8090, 'secret') == 'http://cell:8090/#secret'
    assert page_address('::1', 8090) == 'http://[::1]:8090/'
    assert named_hosts('127.0.0.1') == ['127.0.0.1']
    assert named_hosts('::') == [socket.gethostname()]
    name, *numbers = named_hosts('0.0.0.0')
    assert name == socket.gethostname() and numbers == own_addresses()
    for number in map(ipaddress.IPv4Address, numbers):
        assert not number.is_loopback
        # It is this computer's own: something can be bound to it.
        socket.create_server((str(number), 0)).close()


@pytest.mark.parametrize('host', ['127.0.0.1', '0.0.0.0'])
def test_every_address_is_printed_with_the_key_where_the_page_has_none(host, capsys) -> None:
    cell, stop = Cell(host), asyncio.Event()
    stop.set()
    asyncio.run(serve(cell.server, 0, stop))
    printed = capsys.readouterr().out.splitlines()
    assert [line.partition(': ')[0] for line in printed] == ['page'] * len(named_hosts(host))
    addresses = [urlsplit(line.partition(': ')[2]) for line in printed]
    assert [one.hostname for one in addresses] == [one.lower() for one in named_hosts(host)]
    assert {one.fragment for one in addresses} == {'' if host == '127.0.0.1' else cell.server.key}


@pytest.mark.parametrize(
    'body', [{}, {'wish': 'stop'}, {'wish': ['start']}, [], 'start']
)
def test_what_is_no_wish_is_refused(body) -> None:
    cell = Cell()
    assert cell.post('/ask', body)[0] == 400
    assert cell.asked == []


def test_marks_are_limited_in_length_and_to_one_line() -> None:
    cell = Cell()
    assert cell.post('/mark', {'text': ' door opened '})[1]['granted']
    for text in ('', '   ', 'x' * 201, 'two\nlines', 7):
        assert cell.post('/mark', {'text': text})[0] == 400
    assert cell.marked == ['door opened']
    cell.state.add_report(Report('/recorder', 0, 'finished', {}, time.monotonic()))
    answer = cell.post('/mark', {'text': 'late'})[1]
    assert not answer['granted'] and 'finished' in answer['answer']


def test_events_are_history_then_parts_that_changed_and_what_is() -> None:
    cell = Cell()
    cell.state.add_result('location', {'rows': []})

    async def test(client):
        events = []
        async with client.get('/events') as response:
            assert response.headers['Content-Type'].startswith('text/event-stream')
            while len(events) < 6:
                name = (await response.content.readline()).decode().removeprefix('event: ')
                data = (await response.content.readline()).decode().removeprefix('data: ')
                await response.content.readline()
                events.append((name.strip(), json.loads(data)))
                if len(events) == 4:
                    cell.state.add_mark('here')
        return events

    events = cell.run(test)
    assert events[0][0] == 'history'
    assert events[1] == ('part', {'name': 'location', 'shown': {'rows': []}})
    assert [name for name, _ in events].count('part') == 2
    assert [data['name'] for name, data in events if name == 'part'] == ['location', 'marks']


@pytest.mark.parametrize('command', [['view'], ['session', '--view']])
def test_an_address_that_cannot_be_served_is_one_line_before_anything_starts(
    command, capsys, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv('ROS_DOMAIN_ID', '0')
    with socket.create_server(('127.0.0.1', 0)) as taken:
        for port in (taken.getsockname()[1], 70000):
            assert main([*command, '--port', str(port)]) == 2
            said = capsys.readouterr().err
            assert said.startswith('rtest: ') and str(port) in said and said.count('\n') == 1
    assert not list(tmp_path.iterdir())
