"""Node `recorder`: everything of a session in one MCAP file.

Subscribes to the topics of the graph before anybody publishes, finds others by their names, and
writes serialised messages as they came. What is lost is counted: readings by their running index,
other messages by the middleware's word, and what the disk refused.
"""

from __future__ import annotations

import re
import shutil
import signal
import sys
import time
from collections import Counter
from importlib import import_module
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PointStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
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
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from rtest_drivers.message_types import MessageTypeError, MessageTypes
from rtest_drivers.session_writer import SessionWriter
from rtest_estimation.errors import UserError
from rtest_estimation.messages import nanoseconds
from rtest_estimation.nodes.qos import LATCHED_100, STREAM
from rtest_estimation.sequence import SequenceCheck

# The topics of the graph: recorded from their first message, so subscribed to before it.
# Latched ones with depth 100: the publisher's depth decides what a late subscriber gets.
CONTRACT: dict[str, tuple[type, QoSProfile]] = {
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
}
DEFAULT_TOPICS = ['rtest/.*', '/diagnostics']
# A recording is complete when nothing came for this long after the others finished [s].
QUIET = 0.3
PATIENCE = 3.0
SPIN = 0.1
# Messages of one topic taken in a row.
BATCH = 100


class Recorder(Node):
    """Records a session; see the module.

    Parameters: `out` directory of the recordings, `session` name (the bag is out/session),
    `topics` patterns of the names to record, relative to the node's namespace or absolute.

    Raises UserError for parameters that cannot be used and where the recording exists.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('recorder', **options)
        out = self._parameter('out', '')
        self.session = self._parameter('session', '')
        patterns = self._parameter('topics', DEFAULT_TOPICS)
        self._patterns = [self._pattern(text) for text in patterns]
        self.writer = _open_writer(out, self.session)
        self._types = MessageTypes()
        self._subscriptions_by_name: dict[str, Subscription] = {}
        self._declared: set[str] = set()
        self._checks: dict[str, SequenceCheck] = {}
        self._middleware_lost: Counter[str] = Counter()
        self._problems: dict[str, str] = {}
        self._last_message = 0.0
        self._ending = 0.0
        self._time = 0
        self._finished: str | None = None
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._simulated = self.get_parameter('use_sim_time').value
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', STREAM)
        # In a group of its own: it waits while the subscriptions go on.
        self.create_service(
            Trigger, '~/finish', self._on_finish, callback_group=ReentrantCallbackGroup()
        )
        self.create_timer(1.0, self._report, clock=self._steady)
        # Simulated time is 0 until the first /clock, and a log time of 0 spoils a recording:
        # until then nothing is subscribed to. Latched topics are none the worse for it.
        self._start_timer = self.create_timer(0.02, self._start, clock=self._steady)
        self._start()

    def _parameter(self, name: str, default: Any) -> Any:
        try:
            return self.declare_parameter(name, default).value
        except InvalidParameterTypeException as error:
            kind = 'a text' if isinstance(default, str) else 'a list of texts'
            raise UserError(f'parameter {name}: expected {kind}, put it in quotes') from error

    def _pattern(self, text: str) -> re.Pattern[str]:
        namespace = self.get_namespace().rstrip('/')
        try:
            return re.compile(text if text.startswith('/') else f'{re.escape(namespace)}/{text}')
        except re.error as error:
            raise UserError(f'parameter topics: {text!r} is not a pattern: {error}') from error

    # --- subscriptions ---

    def _start(self) -> None:
        """Subscribe as soon as there is a time to log."""
        if self._now() <= 0:
            return
        self.destroy_timer(self._start_timer)
        for name, (message_type, qos) in CONTRACT.items():
            usual = name if name.startswith('/') else f'{self.get_namespace().rstrip("/")}/{name}'
            resolved = self.resolve_topic_name(name)
            if self._wanted(usual) or self._wanted(resolved):
                self._subscribe(resolved, message_type, qos)
        self.create_timer(0.5, self._look_around, clock=self._steady)

    def _wanted(self, name: str) -> bool:
        hidden = any(part.startswith('_') for part in name.split('/'))
        return not hidden and any(pattern.fullmatch(name) for pattern in self._patterns)

    def _subscribe(self, name: str, message_type: type, qos: QoSProfile) -> None:
        package, _, _ = message_type.__module__.partition('.')
        try:
            definition = self._types.definition(f'{package}/msg/{message_type.__name__}')
        except MessageTypeError as error:
            self._problems[name] = f'{name} is not recorded: {error}'
            return
        check = None
        if message_type is GaugeSamples:
            check = self._checks.setdefault(name, SequenceCheck())

        def take(data: bytes, info: dict[str, int]) -> None:
            now = self._now() or self._time
            self._time = now
            if name not in self._declared:
                self._declared.add(name)
                self.writer.add_topic(name, definition, self._offered_qos(name))
            # Simulated and wall time must not meet in one message.
            sent = 0 if self._simulated else info.get('source_timestamp', 0)
            number = info.get('publication_sequence_number') or 0
            self.writer.put(name, now, sent, number, data)
            if check is not None:
                self._check_sequence(name, check, data)
            if message_type is not DiagnosticArray:
                self._last_message = time.monotonic()

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
            self._middleware_lost[name] += event.total_count_change

        subscription = self.create_subscription(
            message_type,
            name,
            on_message,
            qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=on_lost,
                # Mended by _look_around.
                use_default_callbacks=False,
            ),
        )
        self._subscriptions_by_name[name] = subscription

    def _check_sequence(self, name: str, check: SequenceCheck, data: bytes) -> None:
        message = deserialize_message(data, GaugeSamples)
        readings = len(message.displacement) // max(message.channels, 1)
        loss = check.add(nanoseconds(message.header.stamp), message.sequence, readings)
        if loss is not None:
            self.get_logger().warning(
                f'{name}: {loss.count} readings lost before reading {message.sequence}'
            )

    def _offered_qos(self, name: str) -> str:
        """The publishers' profiles as rosbag2 writes them (YAML)."""
        return ''.join(
            _qos_yaml(info.qos_profile) for info in self.get_publishers_info_by_topic(name)
        )

    def _look_around(self) -> None:
        """Subscribe to new topics, and again where a publisher offers less than was asked."""
        for name, types in self.get_topic_names_and_types():
            subscription = self._subscriptions_by_name.get(name)
            if subscription is None and not self._wanted(name):
                continue
            offered = [info.qos_profile for info in self.get_publishers_info_by_topic(name)]
            if not offered:
                continue
            qos = _compatible(offered)
            if subscription is not None:
                if _asks_more(subscription.qos_profile, qos):
                    self.get_logger().warning(f'{name}: a publisher offers less, following it')
                    message_type = subscription.msg_type
                    self.destroy_subscription(subscription)
                    self._subscribe(name, message_type, qos)
            elif name not in self._problems:
                self._subscribe_to_found(name, types, qos)

    def _subscribe_to_found(self, name: str, types: list[str], qos: QoSProfile) -> None:
        package, _, type_name = types[0].partition('/msg/')
        try:
            message_type = getattr(import_module(f'{package}.msg'), type_name)
        except (ImportError, AttributeError):
            self._problems[name] = f'{name} is not recorded: {types[0]} is not installed here'
            return
        if len(types) > 1:
            self._problems[name] = f'{name} has types {", ".join(types)}, recorded: {types[0]}'
        self._subscribe(name, message_type, qos)

    # --- what is told ---

    @property
    def lost(self) -> int:
        """Readings and messages that are known to be missing from the recording."""
        return (
            sum(check.lost for check in self._checks.values())
            + sum(
                count
                for name, count in self._middleware_lost.items()
                # Lost readings are in the running index already.
                if name not in self._checks
            )
            + self.writer.dropped.total()
        )

    def _report(self) -> None:
        """Publish the state, once a second of wall time."""
        self.writer.check()
        now = self.get_clock().now()
        if now.nanoseconds <= 0:
            return
        status = DiagnosticStatus(name=self.get_fully_qualified_name(), hardware_id=self.session)
        status.level, status.message = self._state()
        values = {
            'file': str(self.writer.path),
            'messages': self.writer.taken,
            'bytes': self.writer.size,
            'queued': self.writer.queued,
            'lost': self.lost,
            'disk_free': shutil.disk_usage(self.writer.path.parent).free,
        }
        for name, check in self._checks.items():
            values[f'lost readings {name}'] = check.lost
            values[f'driver restarts {name}'] = check.restarts
        for name, count in self._middleware_lost.items():
            values[f'lost messages {name}'] = count
        for name, count in self.writer.dropped.items():
            values[f'not written {name}'] = count
        for name, problem in self._problems.items():
            values[f'problem {name}'] = problem
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = now.to_msg()
        self._diagnostics.publish(message)

    def _state(self) -> tuple[bytes, str]:
        if self.writer.error is not None:
            return DiagnosticStatus.ERROR, self.writer.error
        if self.writer.dropped:
            count = self.writer.dropped.total()
            return DiagnosticStatus.ERROR, f'{count} messages not written, the disk is too slow'
        if self.lost:
            return DiagnosticStatus.WARN, f'{self.lost} readings or messages lost'
        if self._problems:
            return DiagnosticStatus.WARN, next(iter(self._problems.values()))
        return DiagnosticStatus.OK, 'finished' if self._finished else 'recording'

    # --- the end ---

    async def _on_finish(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Close the recording when what was published before has arrived."""
        self.await_rest()
        quiet = Future(executor=self.executor)

        def look() -> None:
            if self.is_quiet() and not quiet.done():
                quiet.set_result(None)

        timer = self.create_timer(SPIN, look, clock=self._steady)
        await quiet
        self.destroy_timer(timer)
        response.success, response.message = self.finish()
        return response

    def await_rest(self) -> None:
        """Begin to wait for what is still on its way."""
        self._ending = time.monotonic()

    def is_quiet(self) -> bool:
        """Whether nothing but diagnostics came for a while, or it is time to give up waiting."""
        now = time.monotonic()
        return now - max(self._last_message, self._ending) > QUIET or now - self._ending > PATIENCE

    def finish(self) -> tuple[bool, str]:
        """Stop recording and close the file; (closed, one line). Can be repeated."""
        if self._finished is None:
            for subscription in self._subscriptions_by_name.values():
                self.destroy_subscription(subscription)
            self._subscriptions_by_name.clear()
            self._patterns = []
            try:
                self.writer.close()
            except OSError:
                return False, str(self.writer.error)
            self._finished = (
                f'recorded {self.writer.written} messages, {self.lost} lost, {self.writer.path}'
            )
        return True, self._finished

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds


def _open_writer(out: str, session: str) -> SessionWriter:
    """Create out/session/session.mcap."""
    if not out:
        raise UserError('parameter out: empty, expected the directory for the recordings')
    if not re.fullmatch(r'\w[\w.+ -]*', session):
        raise UserError(
            f'parameter session: {session!r}, expected a name of letters, digits, - and _'
        )
    folder = Path(out) / session
    try:
        return SessionWriter(folder)
    except FileExistsError as error:
        raise UserError(
            f'{folder}: there is a recording already; choose another session name'
        ) from error
    except OSError as error:
        raise UserError(f'{folder}: cannot be written: {error.strerror}') from error


def _compatible(offered: list[QoSProfile]) -> QoSProfile:
    """The most a subscription can ask for and still hear every publisher."""
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=STREAM.depth,
        reliability=(ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT),
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE),
    )


def _asks_more(asked: QoSProfile, offered: QoSProfile) -> bool:
    return (
        asked.reliability == ReliabilityPolicy.RELIABLE != offered.reliability
        or asked.durability == DurabilityPolicy.TRANSIENT_LOCAL != offered.durability
    )


def _qos_yaml(qos: QoSProfile) -> str:
    """One entry of rosbag2's list of offered profiles (metadata version 9)."""

    def duration(value: Any) -> str:
        seconds, nanoseconds = divmod(value.nanoseconds, 1_000_000_000)
        return f'{{sec: {seconds}, nsec: {nanoseconds}}}'

    return (
        f'- history: {qos.history.name.lower()}\n'
        f'  depth: {qos.depth}\n'
        f'  reliability: {qos.reliability.name.lower()}\n'
        f'  durability: {qos.durability.name.lower()}\n'
        f'  deadline: {duration(qos.deadline)}\n'
        f'  lifespan: {duration(qos.lifespan)}\n'
        f'  liveliness: {qos.liveliness.name.lower()}\n'
        f'  liveliness_lease_duration: {duration(qos.liveliness_lease_duration)}\n'
        f'  avoid_ros_namespace_conventions: {str(qos.avoid_ros_namespace_conventions).lower()}\n'
    )


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; exit status 0, 2 for a user's mistake."""
    told: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda received, _frame: told.append(received))
    # rclpy's own handlers end the context at once, with messages still to be taken.
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        try:
            recorder = Recorder()
        except UserError as error:
            print(f'recorder: {error}', file=sys.stderr)
            return 2
        executor = SingleThreadedExecutor()
        executor.add_node(recorder)
        try:
            while not told:
                executor.spin_once(timeout_sec=SPIN)
            recorder.await_rest()
            while not recorder.is_quiet():
                executor.spin_once(timeout_sec=SPIN)
        finally:
            closed, line = recorder.finish()
            print(f'recorder: {line}', file=sys.stdout if closed else sys.stderr, flush=True)
        return 0 if closed else 1
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    sys.exit(main())
