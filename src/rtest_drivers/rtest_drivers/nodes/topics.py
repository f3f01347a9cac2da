"""A listener that lists topics, measures their rates and prints their messages."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from typing import Any

import rclpy
import yaml
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from rtest_estimation.errors import UserError

# A graph is found when nothing new has appeared for so long, or it is time to look [s]. A busy
# computer finds the publishers of a node some seconds after those of another.
_QUIET_S, _LONGEST_S = 4.0, 20.0
# Nothing at all is believed after this time [s].
_EMPTY_S = 8.0
# Of a long array so many elements are printed.
_SHOWN = 24


@dataclass(frozen=True)
class Topic:
    """A topic, the listener itself not counted."""

    name: str
    type: str
    publishers: int
    subscriptions: int


@dataclass(frozen=True)
class TopicRate:
    """What came on a topic. rate : [1/s]; longest_gap : between two messages [s]."""

    messages: int
    rate: float
    bytes_a_second: float
    longest_gap: float


@contextlib.contextmanager
def looker(domain: int) -> Iterator[Looker]:
    """A listener in a ROS domain."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node('look', context=context, use_global_arguments=False)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield Looker(node, executor)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)


class Looker:
    """Looks at the topics of a graph; offers nothing itself."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor) -> None:
        self._node, self._executor = node, executor
        self._find()

    def topics(self) -> list[Topic]:
        """Every topic of the graph that somebody else publishes or listens to."""
        found = []
        for name, types in sorted(self._node.get_topic_names_and_types()):
            publishers = self._others(self._node.get_publishers_info_by_topic(name))
            listeners = self._others(self._node.get_subscriptions_info_by_topic(name))
            if publishers + listeners:
                found.append(Topic(name, ', '.join(types), publishers, listeners))
        return found

    def rates(self, topic: str | None, seconds: float) -> dict[str, TopicRate]:
        """Measure one topic, or all that are published, for so long."""
        names = [self._name(topic)] if topic else [
            one.name for one in self.topics() if one.publishers
        ]
        came: dict[str, list[tuple[float, int]]] = {name: [] for name in names}
        for name in names:
            def note(data: bytes, came: list = came[name]) -> None:
                came.append((time.monotonic(), len(data)))

            self._subscribe(name, note, raw=True)
        self._spin(seconds)
        return {name: _rate(came[name], seconds) for name in names}

    def messages(self, topic: str, count: int) -> Iterator[str]:
        """Messages of a topic as YAML, so many, or without end for 0."""
        texts: list[str] = []
        self._subscribe(self._name(topic), lambda m: texts.append(as_yaml(m)), raw=False)
        printed = 0
        while not count or printed < count:
            self._executor.spin_once(timeout_sec=0.1)
            while texts and (not count or printed < count):
                printed += 1
                yield texts.pop(0)

    def _find(self) -> None:
        """Wait until the graph has been found."""
        start = changed = time.monotonic()
        seen: list[Topic] = []
        while (now := time.monotonic()) - start < _LONGEST_S and (
            now - changed < (_QUIET_S if seen else _EMPTY_S)
        ):
            self._spin(0.1)
            if (found := self.topics()) != seen:
                seen, changed = found, now

    def _spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=min(left, 0.1))

    def _others(self, infos: list[Any]) -> int:
        return sum(info.node_name != self._node.get_name() for info in infos)

    def _name(self, topic: str) -> str:
        """A topic's full name; it may be given without the leading slash."""
        end = time.monotonic() + _LONGEST_S
        while True:
            names = [one.name for one in self.topics() if one.publishers]
            for name in (topic, f'/{topic}'):
                if name in names:
                    return name
            if time.monotonic() > end:
                break
            self._spin(0.1)
        raise UserError(f'{topic}: nobody publishes that; there are {", ".join(names) or "none"}')

    def _subscribe(self, name: str, take: Any, raw: bool) -> None:
        offered = [i.qos_profile for i in self._node.get_publishers_info_by_topic(name)]
        kind = dict(self._node.get_topic_names_and_types())[name][0]
        package, _, type_name = kind.partition('/msg/')
        try:
            message_type = getattr(import_module(f'{package}.msg'), type_name)
        except (ImportError, AttributeError):
            self._node.get_logger().warning(f'{name}: {kind} is not installed here')
            return
        latched = all(q.durability == DurabilityPolicy.TRANSIENT_LOCAL for q in offered)
        # Best effort but where the last message is wanted: nobody waits for this listener.
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=1000,
            reliability=(
                ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT
            ),
            durability=(
                DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
            ),
        )
        self._node.create_subscription(message_type, name, take, qos, raw=raw)


def _rate(came: list[tuple[float, int]], seconds: float) -> TopicRate:
    times = [when for when, _ in came]
    gaps = [b - a for a, b in pairwise(times)]
    return TopicRate(
        len(came), len(came) / seconds, sum(size for _, size in came) / seconds,
        max(gaps, default=0.0),
    )


def as_yaml(message: Any) -> str:
    """A message as YAML; of long arrays the beginning and how long they are."""
    return yaml.safe_dump(_plain(message), sort_keys=False, allow_unicode=True).rstrip()


def _plain(value: Any) -> Any:
    if hasattr(value, 'get_fields_and_field_types'):
        return {name: _plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return int.from_bytes(value, 'little')
    if isinstance(value, str | bool | int | float):
        return value
    items = [_plain(item) for item in list(value[:_SHOWN])]
    more = len(value) - len(items)
    return [*items, f'... {more} more'] if more > 0 else items
