"""Node `view`: serves a page that shows the running cell, and passes on what it asks for.

It only listens: to the streams best effort, so that no publisher waits for it, and it looks 25
times a second at what has come, however much that is. Marks go out on `rtest/mark`.

Parameters
----------
host : address to serve at; everything but localhost lets others on the network look
port : 0 is any free one
"""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rtest_msgs.msg import Cycle, CyclePlan, ErrorMap, GaugeSamples, LocationErrors, ModelGap
from sensor_msgs.msg import JointState, Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from rtest_drivers.graph import VIEW_HOST, VIEW_PORT
from rtest_drivers.view import results
from rtest_drivers.view.devices import Report
from rtest_drivers.view.server import WISHES, Server, serve
from rtest_drivers.view.state import CellState
from rtest_estimation import messages
from rtest_estimation.errors import UserError
from rtest_estimation.nodes.qos import LATCHED_100

# How often messages are taken [s], and how many of a topic at once are looked at.
_LOOK_S, _LOOKED_AT = 0.04, 8
# At most so many callbacks a look: those of every topic and some answers.
_CALLBACKS = 40
_ANSWER_S = 5.0
# Best effort: a publisher does not wait for what this node has not taken.
_LOSSY = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=200,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
# Few, and some are said once: why a pose is missing. Their publishers keep the last ones only, and
# wait for nobody either.
_SAID = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=200)


class ViewNode(Node):
    """Fills a `CellState` from the topics; asks the session and sets marks for the page."""

    def __init__(self) -> None:
        super().__init__('view')
        self.host = self.declare_parameter('host', VIEW_HOST).value
        self.port = self.declare_parameter('port', VIEW_PORT).value
        self.state = CellState()
        # Callbacks so far, by which `look` sees that nothing is left.
        self.handled = 0
        self._mark = self.create_publisher(String, 'rtest/mark', LATCHED_100)
        self._listen(GaugeSamples, 'rtest/gauges', self._on_gauges)
        self._listen(JointState, 'rtest/cnc/feedback', self._on_feedback)
        self._listen(PointStamped, 'rtest/sphere_centre', self._on_centre)
        self._listen(Temperature, 'rtest/temperature', self._on_temperatures)
        self._listen(DiagnosticArray, '/diagnostics', self._on_diagnostics, _SAID)
        self._state_of(String, 'rtest/machine', lambda m: self.state.add_machine(m.data))
        self._state_of(
            CyclePlan, 'rtest/plan', lambda m: self.state.add_plan(messages.cycle_plan(m))
        )
        self._state_of(Cycle, 'rtest/cycle', lambda m: self.state.add_cycle(messages.cycle(m)))
        self._state_of(LocationErrors, 'rtest/location_errors', self._on_location)
        self._state_of(ErrorMap, 'rtest/error_map', self._on_map)
        self._state_of(ModelGap, 'rtest/model_gap', self._on_gap)
        self._state_of(MarkerArray, 'rtest/markers', self._on_markers)
        self._state_of(String, 'rtest/mark', lambda m: self.state.add_mark(m.data))
        self._wishes = {
            wish: self.create_client(Trigger, f'session/{wish}') for wish in WISHES
        }

    # --- what comes in ---

    def _listen(
        self, kind: type, topic: str, take: Callable[[list[Any], float], None],
        qos: QoSProfile = _LOSSY,
    ) -> None:
        """A stream: all that has come is taken in one callback, as the recorder does."""

        def on_message(message: Any) -> None:
            batch = [message]
            while len(batch) < qos.depth:
                more = subscription.handle.take_message(kind, False)
                if more is None:
                    break
                batch.append(more[0])
            self.handled += 1
            take(batch, time.monotonic())

        subscription = self.create_subscription(kind, topic, on_message, qos)

    def _state_of(self, kind: type, topic: str, take: Callable[[Any], None]) -> None:
        """A latched topic; a message that cannot be read is told and left out."""

        def on_message(message: Any) -> None:
            self.handled += 1
            try:
                take(message)
            except messages.MessageError as error:
                self.get_logger().error(f'{topic}: {error}')

        self.create_subscription(kind, topic, on_message, LATCHED_100)

    def _on_gauges(self, batch: list[GaugeSamples], now: float) -> None:
        for message in batch[-_LOOKED_AT:]:
            try:
                self.state.add_gauges(messages.gauge_block(message), now)
            except messages.MessageError as error:
                self.get_logger().error(str(error), throttle_duration_sec=1.0)

    def _on_feedback(self, batch: list[JointState], now: float) -> None:
        try:
            self.state.add_feedback(messages.feedback(batch[-1]), len(batch), now)
        except messages.MessageError as error:
            self.get_logger().error(str(error), throttle_duration_sec=1.0)

    def _on_centre(self, batch: list[PointStamped], now: float) -> None:
        point = batch[-1].point
        self.state.add_centre(np.array([point.x, point.y, point.z]), now)

    def _on_temperatures(self, batch: list[Temperature], now: float) -> None:
        for message in batch:
            try:
                self.state.add_temperature(messages.temperature(message), now)
            except messages.MessageError as error:
                self.get_logger().error(str(error), throttle_duration_sec=1.0)

    def _on_diagnostics(self, batch: list[DiagnosticArray], now: float) -> None:
        for message in batch:
            for one in message.status:
                values = {pair.key: pair.value for pair in one.values}
                # Others in the domain may send what the message does not define.
                level = min(int.from_bytes(one.level, 'little'), 3)
                self.state.add_report(Report(one.name, level, one.message, values, now))

    def _on_location(self, m: LocationErrors) -> None:
        self.state.add_result(
            'location', results.location_table(m.symbols, m.values, m.covariance, m.residual)
        )

    def _on_map(self, m: ErrorMap) -> None:
        self.state.add_result(
            f'map:{m.axis}', results.error_map(m.axis, m.symbols, m.b, m.c, m.values, m.stddev)
        )

    def _on_gap(self, m: ModelGap) -> None:
        self.state.add_result('gap', results.model_gap(
            m.verdict, m.effects, m.confidence, m.rivals, m.noise, m.before, m.after,
            messages.nanoseconds(m.header.stamp),
        ))

    def _on_markers(self, message: MarkerArray) -> None:
        self.state.add_result('picture', [
            {
                'group': marker.ns,
                'type': marker.type,
                'colour': [round(c, 3) for c in (marker.color.r, marker.color.g, marker.color.b)],
                'text': marker.text,
                'points': [
                    [round(p.x * 1e3, 3), round(p.y * 1e3, 3), round(p.z * 1e3, 3)]
                    for p in marker.points
                ],
            }
            for marker in message.markers if marker.action == marker.ADD
        ])

    # --- what goes out ---

    async def ask(self, wish: str) -> tuple[bool, str]:
        """Call the session's service; (granted, answer)."""
        client = self._wishes[wish]
        if not client.service_is_ready():
            return False, 'no session in the graph'
        future = client.call_async(Trigger.Request())
        deadline = time.monotonic() + _ANSWER_S
        while not future.done():
            if time.monotonic() > deadline:
                client.remove_pending_request(future)
                return False, f'the session did not answer within {_ANSWER_S:.0f} s'
            await asyncio.sleep(_LOOK_S)
        answer = future.result()
        return answer.success, answer.message

    def mark(self, text: str) -> tuple[bool, str]:
        """Put a text into the recording, at this moment."""
        self._mark.publish(String(data=text))
        return True, f'marked: {text}'

    async def look(self, executor: SingleThreadedExecutor) -> None:
        """Take what has come, 25 times a second; between the looks the server works."""
        while True:
            for _ in range(_CALLBACKS):
                before = self.handled
                executor.spin_once(timeout_sec=0.0)
                if self.handled == before:
                    break
            await asyncio.sleep(_LOOK_S)


async def _run(node: ViewNode) -> None:
    """Serve until SIGINT or SIGTERM."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    looking = asyncio.create_task(node.look(executor))
    # An error in looking ends the node, it is not swallowed with the task.
    looking.add_done_callback(lambda _: stop.set())
    try:
        server = Server(node.state, node.ask, node.mark, node.host)
        await serve(server, node.port, stop)
        if looking.done():
            looking.result()
    finally:
        looking.cancel()
        executor.shutdown()


def main(args: list[str] | None = None) -> int:
    """Entry point; the exit status is 0, or 2 for a user's mistake."""
    rclpy.init(args=args, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = ViewNode()
    try:
        asyncio.run(_run(node))
    except UserError as error:
        print(f'view: {error}', file=sys.stderr)
        return 2
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
