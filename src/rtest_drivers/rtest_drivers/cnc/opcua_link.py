"""A subscription at an OPC UA server, in a thread of its own: asyncua is asynchronous."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

# Time for an answer; a server that is silent for longer is lost.
_REQUEST_S = 0.7
# A subscription of which nothing comes for its keep-alive interval and this is dead.
_SILENT_S = 0.6
# Longest time from one question after the server's state to the next.
_ASK_S = 0.1
_CONNECT_S = 5.0
# Batches that wait for the driver; more are thrown away.
_WAITING = 1000
# Values of one node that the server keeps until it publishes.
_KEPT = 100
# Server_ServerStatus_State (OPC 10000-6, annex A) and its value while a server does its work
# (ServerState, OPC 10000-5).
_STATE, _RUNNING = 'i=2259', 0


class LinkError(ConnectionError):
    """What is wrong is known, and said."""


@dataclass(frozen=True)
class Batch:
    """What one message of the server brought, or a sign of life.

    stamp : arrival in this host's time; of a sign of life, until when everything is known [ns]
    values : (name of the node, asyncua's DataValue); empty for a sign of life
    round_trip : of the question after a sign of life [ns]
    """

    stamp: int
    values: tuple[tuple[str, Any], ...] = ()
    round_trip: int = 0


@dataclass(frozen=True)
class LinkSettings:
    """Where to connect and what to subscribe.

    security : of asyncua: 'Policy,Mode,certificate,key'; '' for none
    nodes : name to node id; period : of sampling and publishing asked for [s]
    """

    url: str
    user: str
    password: str
    security: str
    nodes: Mapping[str, str]
    period: float


class Link:
    """The connection, until it is stopped or lost; not to be started again.

    The server tells changes only, and that there are none by empty messages, keep-alives, which
    are asked for after every publishing interval. Its state is read in the same period: what it
    had sampled one publishing interval before the question has been told before the answer,
    provided that the subscription lives. That is known as soon as anything of the subscription
    comes after the answer; only then is the answer a sign of life.
    """

    def __init__(self, settings: LinkSettings, now: Callable[[], int]) -> None:
        """`now` is this host's time [ns]."""
        # Its log repeats with tracebacks what is raised here in one line.
        logging.getLogger('asyncua').setLevel(logging.CRITICAL)
        self._settings, self._now = settings, now
        self._batches: queue.Queue[Batch | None] = queue.Queue(_WAITING)
        self._ready = threading.Event()
        self._failure: BaseException | None = None
        self._loop: asyncio.AbstractEventLoop
        self._stop: asyncio.Event
        self._thread = threading.Thread(target=self._main, name='opcua', daemon=True)
        self._names: dict[Any, str] = {}
        self._values: list[tuple[str, Any]] = []
        self._arrival = 0
        self.lost = 0

    def start(self) -> None:
        """Connect and subscribe; raises ConnectionError saying what to do."""
        self._thread.start()
        self._ready.wait()
        self._raise()

    def stop(self) -> None:
        """Disconnect."""
        with contextlib.suppress(RuntimeError):  # The loop has ended.
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    def take(self, timeout: float) -> list[Batch]:
        """What came, waiting up to `timeout` [s]; raises ConnectionError when the link is lost."""
        batches: list[Batch | None] = []
        with contextlib.suppress(queue.Empty):
            batches.append(self._batches.get(timeout=timeout))
            while True:
                batches.append(self._batches.get_nowait())
        self._raise()
        return [batch for batch in batches if batch is not None]

    def _raise(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _main(self) -> None:
        try:
            asyncio.run(self._run())
        except BaseException as error:
            self._failure = error
        self._wake()

    def _wake(self) -> None:
        """Who waits, for the connection or for values."""
        self._ready.set()
        self._put(None)

    async def _run(self) -> None:
        from asyncua import Client
        from asyncua.ua import UaError

        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        settings = self._settings
        where = f'OPC UA server {settings.url}'
        wrong = (OSError, asyncio.TimeoutError, UaError, ValueError)
        try:
            client = Client(settings.url, timeout=_REQUEST_S)
            if settings.user:
                client.set_user(settings.user)
                client.set_password(settings.password)
            if settings.security:
                await client.set_security_string(settings.security)
            await asyncio.wait_for(client.connect(), _CONNECT_S)
        except wrong as error:
            raise ConnectionError(
                f'no {where} ({_text(error)}); start it, or set url, user, password and security '
                'of the device file'
            ) from None
        try:
            await self._follow(client)
        except wrong as error:
            # Told before saying goodbye, for which a frozen server takes its time.
            self._failure = error if isinstance(error, LinkError) else ConnectionError(
                f'lost {where} ({_text(error)}); look whether the controller and the network run'
            )
            self._wake()
        finally:
            with contextlib.suppress(*wrong):  # It may have gone already.
                await asyncio.wait_for(client.disconnect(), _CONNECT_S)

    async def _follow(self, client: Any) -> None:
        from asyncua import ua
        from asyncua.common.subscription import Subscription

        settings, state = self._settings, client.get_node(_STATE)
        # Not by the client, which asks for keep-alives every 45 minutes.
        parameters = ua.CreateSubscriptionParameters(
            RequestedPublishingInterval=settings.period * 1e3,
            RequestedLifetimeCount=10_000,
            RequestedMaxKeepAliveCount=1,
            MaxNotificationsPerPublish=10_000,
            PublishingEnabled=True,
        )
        subscription = Subscription(state.session, parameters, self)
        revised = await subscription.init()
        for name, node in settings.nodes.items():
            await self._subscribe(client, subscription, name, node)
        behind = round(revised.RevisedPublishingInterval * 1e6)
        silence = _SILENT_S + (
            revised.RevisedPublishingInterval * 1e-3 * revised.RevisedMaxKeepAliveCount
        )
        begun = time.monotonic()
        answers: list[tuple[float, Batch]] = []
        self._ready.set()
        while not self._stop.is_set():
            asked = self._now()
            if (said := await state.read_value()) != _RUNNING:
                raise LinkError(
                    f'OPC UA server {settings.url} is not running, its state is {said}; look at '
                    'the controller'
                )
            now = time.monotonic()
            answers.append((now, Batch(asked - behind, round_trip=self._now() - asked)))
            published = subscription.last_publish_at or begun
            if now - published > silence:
                raise LinkError(
                    f'OPC UA server {settings.url} answers, but of the subscription nothing has '
                    f'come for {now - published:.1f} s; it is made anew, start the server again '
                    'if that does not help'
                )
            for _, batch in (one for one in answers if one[0] < published):
                self._put(batch)
            answers = [one for one in answers if one[0] >= published]
            try:
                await asyncio.wait_for(self._stop.wait(), min(settings.period, _ASK_S))
            except asyncio.TimeoutError:
                continue

    async def _subscribe(self, client: Any, subscription: Any, name: str, node: str) -> None:
        from asyncua.ua import UaError

        try:
            target = client.get_node(node)
            self._names[target.nodeid] = name
            await subscription.subscribe_data_change(
                target, queuesize=_KEPT, sampling_interval=self._settings.period * 1e3
            )
        except (UaError, ValueError) as error:
            raise LinkError(
                f'{name}: node {node!r}: {_text(error)}; correct the device file, node ids are '
                'those that a browser of the server shows, capitals and all'
            ) from None

    # asyncua calls these two. The values of one message come one by one, but in one go.

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        """One value."""
        if not self._values:
            self._arrival = self._now()
            # Behind the others of the message, which are in the loop's queue already.
            self._loop.call_soon(self._flush)
        self._values.append((self._names[node.nodeid], data.monitored_item.Value))

    def status_change_notification(self, notification: Any) -> None:
        """The server has something to say of the subscription itself: that it is over."""
        self._failure = LinkError(
            f'OPC UA server {self._settings.url} ended the subscription '
            f'({notification.Status.name}); look whether it was stopped'
        )
        self._wake()
        self._stop.set()

    def _flush(self) -> None:
        self._put(Batch(self._arrival, tuple(self._values)))
        self._values = []

    def _put(self, batch: Batch | None) -> None:
        try:
            self._batches.put_nowait(batch)
        except queue.Full:
            self.lost += 1


def _text(error: BaseException) -> str:
    return str(error) or type(error).__name__
