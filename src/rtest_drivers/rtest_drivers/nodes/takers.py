"""Estimators that take a replay: nothing is sent to one that is still busy with what it got.

Reliable delivery is not enough: a queue of the middleware that is full forgets its oldest message.
An estimator counts what it has taken and says so in its service ``received``.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping

from rclpy.client import Client
from rclpy.node import Node
from std_srvs.srv import Trigger

from rtest_drivers.runner import NodeFailed

# An estimator that takes nothing for so long has lost a message or hangs [s].
PATIENCE_S = 10.0
# Closing a cycle of hours, or identifying from it, may take this long [s].
FINISH_S = 120.0
# The clock reaches a node within this time [s].
RESTART_S = 2.0
_RECEIVED = '/received'

Wait = Callable[[Callable[[], bool], float], bool]


class Takers:
    """The estimators that were there when it was made, with their identifiers.

    topics : resolved topic name to its role
    wait : spins until a condition holds, or a time [s] has passed; returns whether it holds
    """

    def __init__(self, node: Node, topics: Mapping[str, str], wait: Wait) -> None:
        self._node, self._wait = node, wait
        self._services: dict[str, Client] = {}
        self._roles: dict[str, set[str]] = {}
        self._before: dict[str, Counter[str]] = {}
        self._sent: Counter[str] = Counter()
        subscribers = {
            topic: {
                f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                for info in node.get_subscriptions_info_by_topic(topic)
            }
            for topic in topics
        }
        for service, types in node.get_service_names_and_types():
            name = service.removesuffix(_RECEIVED)
            if name == service or types != ['std_srvs/srv/Trigger']:
                continue
            roles = {topics[topic] for topic, nodes in subscribers.items() if name in nodes}
            if roles:
                self._roles[name] = roles

    @property
    def names(self) -> list[str]:
        """Of the estimators."""
        return sorted(self._roles)

    def sent(self, role: str) -> None:
        """One message went out on the topic of a role."""
        self._sent[role] += 1

    def await_all(self) -> None:
        """Wait until every estimator has taken what was sent; raises NodeFailed."""
        for name, roles in self._roles.items():
            last, moved = Counter(), time.monotonic()
            while True:
                taken = self._received(name) - self._before[name]
                short = [role for role in sorted(roles) if taken[role] < self._sent[role]]
                if not short:
                    break
                if taken != last:
                    last, moved = taken, time.monotonic()
                elif time.monotonic() - moved > PATIENCE_S:
                    counts = ', '.join(
                        f'{taken[role]} of {self._sent[role]} messages of {role}' for role in short
                    )
                    raise NodeFailed(
                        f'{name} has got {counts}: the rest was lost or it hangs; replay again, '
                        'more slowly'
                    )
                self._wait(lambda: False, 0.002)

    def finish(self) -> list[str]:
        """End the session as the session node does; what estimators and identifiers say."""
        lines = []
        for name in self.names:
            lines.append(f'{name}: {self._call(f"{name}/finish", FINISH_S).message}')
            identifier = f'{name.rpartition("/")[0]}/identifier'
            if (identifier, f'{identifier}/finish') in self._identifiers():
                said = self._call(f'{identifier}/finish', FINISH_S).message
                lines.append(f'{identifier}: {said}')
        return lines

    def begin(self, tell: Callable[[], None]) -> list[str]:
        """Wait until every estimator has begun anew because the clock went back.

        tell : publishes the clock

        Returns those that go on from what they had before.
        """
        self._sent.clear()
        end = time.monotonic() + RESTART_S
        while True:
            tell()
            self._before = {name: self._received(name) for name in self.names}
            old = [name for name, counts in self._before.items() if counts]
            if not old or time.monotonic() > end:
                return old
            self._wait(lambda: False, 0.05)

    def _identifiers(self) -> set[tuple[str, str]]:
        services = dict(self._node.get_service_names_and_types())
        return {(s.removesuffix('/finish'), s) for s in services if s.endswith('/finish')}

    def _received(self, name: str) -> Counter[str]:
        words = self._call(f'{name}{_RECEIVED}', PATIENCE_S).message.split()
        return Counter({role: int(n) for role, n in zip(words[::2], words[1::2], strict=True)})

    def _call(self, service: str, timeout: float) -> Trigger.Response:
        if service not in self._services:
            self._services[service] = self._node.create_client(Trigger, service)
        client = self._services[service]
        if self._wait(client.service_is_ready, PATIENCE_S):
            future = client.call_async(Trigger.Request())
            if self._wait(future.done, timeout):
                return future.result()
        raise NodeFailed(f'{service} did not answer within {timeout:.0f} s')
