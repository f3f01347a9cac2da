"""What a recorder subscribes to, and what it knows to have missed there.

The topics of the graph are subscribed to before anybody publishes; others that are wanted are
found by their names. Messages are handed over serialised, as they came.
"""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rtest_msgs.msg import (
    Cycle,
    CyclePlan,
    ErrorMap,
    GaugeSamples,
    LocationErrors,
    ModelGap,
    NestCalibration,
)
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from rtest_drivers.message_types import MessageTypeError, MessageTypes
from rtest_drivers.nodes.offered_qos import asks_more, compatible, qos_yaml
from rtest_drivers.session_writer import SessionWriter
from rtest_estimation.messages import nanoseconds
from rtest_estimation.nodes.qos import LATCHED_100, STREAM
from rtest_estimation.sequence import SequenceCheck

# The topics of the graph: recorded from their first message, so subscribed to before it.
# Latched ones with depth 100: the publisher's depth decides what a late subscriber gets.
# A name stands for a type that a ROS may lack: it is imported where the topic is wanted.
CONTRACT: dict[str, tuple[type | str, QoSProfile]] = {
    'rtest/machine': (String, LATCHED_100),
    'rtest/plan': (CyclePlan, LATCHED_100),
    'rtest/gauges': (GaugeSamples, STREAM),
    'rtest/cnc/feedback': (JointState, STREAM),
    'rtest/temperature': (Temperature, STREAM),
    'rtest/nest': (NestCalibration, LATCHED_100),
    'rtest/sphere_centre': (PointStamped, STREAM),
    'rtest/cycle': (Cycle, LATCHED_100),
    'rtest/location_errors': (LocationErrors, LATCHED_100),
    'rtest/error_map': (ErrorMap, LATCHED_100),
    'rtest/model_gap': (ModelGap, LATCHED_100),
    'rtest/markers': (MarkerArray, LATCHED_100),
    'rtest/mark': (String, LATCHED_100),
    '/diagnostics': (DiagnosticArray, STREAM),
    'robot_description': (String, LATCHED_100),
    '/tf': ('tf2_msgs/msg/TFMessage', STREAM),
    '/tf_static': ('tf2_msgs/msg/TFMessage', LATCHED_100),
}
# Messages of one topic taken in a row.
BATCH = 100


class RecordedTopics:
    """Subscriptions of a recorder.

    node : the recorder; writer : where messages go
    patterns : full names to record
    now : the time to log [ns], never 0
    simulated : whether that is simulated time
    Attributes: `checks` of the running index of readings and `not_received` messages by the
    middleware's word, both by topic; `problems`, why a topic is not recorded; `last_message`, when
    the last one came that was not a diagnostic (monotonic) [s].
    """

    def __init__(
        self,
        node: Node,
        writer: SessionWriter,
        patterns: list[re.Pattern[str]],
        now: Callable[[], int],
        simulated: bool,
    ) -> None:
        self._node = node
        self._writer = writer
        self._patterns = patterns
        self._now = now
        self._simulated = simulated
        self._types = MessageTypes()
        self._subscriptions_by_name: dict[str, Subscription] = {}
        self._declared: set[str] = set()
        self.checks: dict[str, SequenceCheck] = {}
        self.not_received: Counter[str] = Counter()
        self.problems: dict[str, str] = {}
        self.last_message = 0.0

    def start(self) -> None:
        """Subscribe to the topics of the graph."""
        namespace = self._node.get_namespace().rstrip('/')
        for name, (message_type, qos) in CONTRACT.items():
            usual = name if name.startswith('/') else f'{namespace}/{name}'
            resolved = self._node.resolve_topic_name(name)
            if not (self._wanted(usual) or self._wanted(resolved)):
                continue
            if isinstance(message_type, str):
                self._subscribe_by_name(resolved, [message_type], qos)
            else:
                self._subscribe(resolved, message_type, qos)

    def stop(self) -> None:
        """Take nothing any more."""
        for subscription in self._subscriptions_by_name.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions_by_name.clear()
        self._patterns = []

    @property
    def lost(self) -> int:
        """Readings and messages that are known not to have come."""
        return sum(check.lost for check in self.checks.values()) + sum(
            # Lost readings are in the running index already.
            count for name, count in self.not_received.items() if name not in self.checks
        )

    def _wanted(self, name: str) -> bool:
        hidden = any(part.startswith('_') for part in name.split('/'))
        return not hidden and any(pattern.fullmatch(name) for pattern in self._patterns)

    def _subscribe(self, name: str, message_type: type, qos: QoSProfile) -> None:
        package, _, _ = message_type.__module__.partition('.')
        try:
            definition = self._types.definition(f'{package}/msg/{message_type.__name__}')
        except MessageTypeError as error:
            self.problems[name] = f'{name} is not recorded: {error}'
            return
        check = None
        if message_type is GaugeSamples:
            check = self.checks.setdefault(name, SequenceCheck())

        def take(data: bytes, info: dict[str, int]) -> None:
            now = self._now()
            if name not in self._declared:
                self._declared.add(name)
                self._writer.add_topic(name, definition, self._offered_qos(name))
            # Simulated and wall time must not meet in one message.
            sent = 0 if self._simulated else info.get('source_timestamp', 0)
            number = info.get('publication_sequence_number') or 0
            self._writer.put(name, now, sent, number, data)
            if check is not None:
                self._check_sequence(name, check, data)
            if message_type is not DiagnosticArray:
                self.last_message = time.monotonic()

        def on_message(data: bytes, info: dict[str, int]) -> None:
            take(data, info)
            # The executor takes one message of a topic and looks at everything again, which
            # costs more than the message. What has come meanwhile is taken here, by the call
            # that the executor uses itself; a bounded number, for the sake of the other topics.
            for _ in range(BATCH):
                more = subscription.handle.take_message(message_type, True)
                if more is None:
                    break
                take(*more)

        def on_lost(event: Any) -> None:
            self.not_received[name] += event.total_count_change

        subscription = self._node.create_subscription(
            message_type,
            name,
            on_message,
            qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=on_lost,
                # Mended by look_around.
                use_default_callbacks=False,
            ),
        )
        self._subscriptions_by_name[name] = subscription

    def _check_sequence(self, name: str, check: SequenceCheck, data: bytes) -> None:
        message = deserialize_message(data, GaugeSamples)
        readings = len(message.displacement) // max(message.channels, 1)
        loss = check.add(nanoseconds(message.header.stamp), message.sequence, readings)
        if loss is not None:
            self._node.get_logger().warning(
                f'{name}: {loss.count} readings lost before reading {message.sequence}'
            )

    def _offered_qos(self, name: str) -> str:
        """The publishers' profiles as rosbag2 writes them (YAML)."""
        return ''.join(
            qos_yaml(info.qos_profile) for info in self._node.get_publishers_info_by_topic(name)
        )

    def look_around(self) -> None:
        """Subscribe to new topics, and again where a publisher offers less than was asked."""
        for name, types in self._node.get_topic_names_and_types():
            subscription = self._subscriptions_by_name.get(name)
            if subscription is None and not self._wanted(name):
                continue
            offered = [info.qos_profile for info in self._node.get_publishers_info_by_topic(name)]
            if not offered:
                continue
            qos = compatible(offered)
            if subscription is not None:
                if asks_more(subscription.qos_profile, qos):
                    self._node.get_logger().warning(
                        f'{name}: a publisher offers less, following it'
                    )
                    message_type = subscription.msg_type
                    self._node.destroy_subscription(subscription)
                    self._subscribe(name, message_type, qos)
            elif name not in self.problems:
                self._subscribe_by_name(name, types, qos)

    def _subscribe_by_name(self, name: str, types: list[str], qos: QoSProfile) -> None:
        package, _, type_name = types[0].partition('/msg/')
        try:
            message_type = getattr(import_module(f'{package}.msg'), type_name)
        except (ImportError, AttributeError):
            self.problems[name] = f'{name} is not recorded: {types[0]} is not installed here'
            return
        if len(types) > 1:
            self.problems[name] = f'{name} has types {", ".join(types)}, recorded: {types[0]}'
        self._subscribe(name, message_type, qos)
