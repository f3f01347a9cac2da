"""Node `replay`: publishes a recording as its drivers did, with the time of the recording.

Stamps, data and latched topics are those of the recording; /clock is the time of reception. By
default only readings, feedback, temperatures, plans and the machine are published, so that the
nodes that listen compute everything else anew. Every node there is gets every message, at whatever
rate: see `takers`.

Parameters
----------
bag : directory or file of the recording
rate : seconds of the recording per second; 0: as fast as the estimators take it
start, stop : from and until when [s] after the first message; the end where `stop` is 0
loop : whether to begin anew at the end
paused : whether to wait for the service ~/pause before the first message
everything : also what the other nodes had published
force : go on where somebody else publishes on the same topics
topics : ROLE=NAME, comma-separated, where the recording has several topics of a type

Service ~/pause (std_srvs/SetBool): true pauses, false goes on.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock as ClockMessage
from std_srvs.srv import SetBool

from rtest_drivers.keys import pressed_keys
from rtest_drivers.nodes.takers import Takers
from rtest_drivers.playlist import Message, Playlist
from rtest_drivers.runner import NodeFailed
from rtest_drivers.topics import chosen_topics
from rtest_estimation.errors import UserError
from rtest_estimation.nodes.publish import time as stamp
from rtest_estimation.nodes.qos import LATCHED_100, STREAM

CLOCK = '/clock'
# All nodes of a busy graph are found after this time [s].
DISCOVERY_S = 3.0
# A subscription is seen in the graph a little before its publisher has matched it [s].
SETTLE_S = 0.5
FOLLOW = 'start it with -p use_sim_time:=true, so that it follows /clock'
_CLOCK_S = 0.02
_LOOK_S = 1.0
_PROGRESS_S = 5.0


class ReplayNode(Node):
    """Replays one recording; see the module. Raises UserError for a user's mistakes."""

    def __init__(self, key: Callable[[], str] = str) -> None:
        super().__init__('replay')
        # The clock of this node is the one it publishes.
        self.set_parameters([Parameter('use_sim_time', value=False)])
        self._path = Path(self._parameter('bag', ''))
        self._rate = self._parameter('rate', 1.0)
        self._loop = self._parameter('loop', False)
        self._paused = self._parameter('paused', False)
        self._force = self._parameter('force', False)
        if not 0.0 <= self._rate < math.inf:
            raise UserError(f'--rate {self._rate:g}: expected a number above 0, or max')
        chosen = [text for text in self._parameter('topics', '').split(',') if text]
        self._list = Playlist(
            self._path, chosen_topics(chosen), self._parameter('everything', False),
            self._parameter('start', 0.0), self._parameter('stop', 0.0),
        )
        self._key = key
        self._next = self._list.start
        self._anchor = (time.monotonic(), self._list.start)
        self._told_of: set[str] = set()
        self._clock = self.create_publisher(ClockMessage, CLOCK, 10)
        self._topics = {
            topic.name: self.create_publisher(
                _message_type(topic.type_name),
                topic.name,
                LATCHED_100 if topic.latched else STREAM,
            )
            for topic in self._list.topics.values()
        }
        self.create_service(SetBool, '~/pause', self._on_pause)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._spinner = SingleThreadedExecutor()
        self._spinner.add_node(self)

    def _parameter(self, name: str, default: Any) -> Any:
        value = self.declare_parameter(name, default, ignore_override=False).value
        return type(default)(value)

    def run(self) -> None:
        """Replay until the end; without one where it loops.

        Raises UserError where somebody else publishes the same, NodeFailed where a message was
        lost.
        """
        for line in self._list.warnings:
            print(f'  warning: {line}', flush=True)
        self._wait(lambda: False, DISCOVERY_S)
        self._look_for_others()
        roles = {
            publisher.topic_name: self._list.topics[name].role
            for name, publisher in self._topics.items()
        }
        takers = Takers(self, {name: role for name, role in roles.items() if role}, self._wait)
        if not takers.names and not self._rate:
            raise UserError(
                '--rate max: no estimator listens that could say when it is ready for more; start '
                'one, or give a number'
            )
        listeners = ', '.join(takers.names) or 'whoever listens, no estimator'
        print(f'  {len(self._topics)} topics to {listeners}', flush=True)
        self._wait(self._matched, DISCOVERY_S)
        self._wait(lambda: False, SETTLE_S)
        self.create_timer(_CLOCK_S, self._publish_clock, clock=self._steady)
        self.create_timer(_LOOK_S, self._look_for_others, clock=self._steady)
        for name in takers.begin(self._publish_clock):
            print(f'  warning: {name} goes on from what it had; {FOLLOW}', flush=True)
        self._go_to(self._list.start)
        while True:
            self._play(takers)
            for line in takers.finish():
                print(f'  {line}', flush=True)
            if not self._loop:
                return
            self._go_to(self._list.start)
            if names := takers.begin(self._publish_clock):
                raise NodeFailed(f'{names[0]} does not begin anew; {FOLLOW}')
            self._go_to(self._list.start)

    def _play(self, takers: Takers) -> None:
        """Publish every message once, at its time."""
        begun = told = time.monotonic()
        count = 0
        for batch in self._list.batches():
            for message in batch:
                self._await(message)
                self._topics[message.topic].publish(message.data)
                if role := self._list.topics[message.topic].role:
                    takers.sent(role)
            count += len(batch)
            self._publish_clock()
            takers.await_all()
            if time.monotonic() - told > _PROGRESS_S:
                told = time.monotonic()
                print(f'  {self._seconds(self._next):.1f} s of '
                      f'{self._seconds(self._list.end):.1f} s', flush=True)
        passed = time.monotonic() - begun
        print(f'{self._path}: {count} messages of {self._seconds(self._list.end):.1f} s replayed '
              f'in {passed:.1f} s', flush=True)

    def _seconds(self, moment: int) -> float:
        return (moment - self._list.start) * 1e-9

    # --- time ---

    def _go_to(self, moment: int) -> None:
        self._next, self._anchor = moment, (time.monotonic(), moment)

    def _due(self) -> float:
        """The time of the recording until which messages are due [ns]."""
        wall, moment = self._anchor
        if self._paused:
            return moment
        return moment + (time.monotonic() - wall) * self._rate * 1e9 if self._rate else math.inf

    def _await(self, message: Message) -> None:
        """Wait until a message is due; keys and services are answered meanwhile."""
        self._next = message.time
        while self._paused or self._due() < message.time:
            left = (message.time - self._due()) / (self._rate * 1e9) if self._rate else _CLOCK_S
            self._spin(max(0.0, min(left, _CLOCK_S)))

    def _publish_clock(self) -> None:
        """The clock does not run ahead of messages that are late."""
        self._clock.publish(ClockMessage(clock=stamp(int(min(self._due(), self._next)))))

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pause(request.data)
        response.success, response.message = True, f'at {self._seconds(self._next):.2f} s'
        return response

    def _pause(self, paused: bool) -> None:
        # Goes on from where it is, not from where it would have been.
        now = self._next if self._paused or not self._rate else min(int(self._due()), self._next)
        self._anchor, self._paused = (time.monotonic(), now), paused
        print(f'  {"paused" if paused else "going on"} at {self._seconds(now):.1f} s', flush=True)

    def _spin(self, timeout: float) -> None:
        self._spinner.spin_once(timeout_sec=timeout)
        if self._key() == ' ':
            self._pause(not self._paused)

    def _wait(self, done: Callable[[], bool], timeout: float) -> bool:
        end = time.monotonic() + timeout
        while not done():
            left = end - time.monotonic()
            if left <= 0.0:
                return False
            self._spin(min(left, _CLOCK_S))
        return True

    # --- others ---

    def _matched(self) -> bool:
        """Whether what is published now reaches everybody who is known to listen."""
        return all(
            publisher.get_subscription_count() >= self.count_subscribers(publisher.topic_name)
            for publisher in self._topics.values()
        )

    def _look_for_others(self) -> None:
        """Raise UserError where somebody else publishes the same; warn of it with --force."""
        for topic in (CLOCK, *(publisher.topic_name for publisher in self._topics.values())):
            # Diagnostics are everybody's.
            if topic in (*self._told_of, '/diagnostics') or self.count_publishers(topic) < 2:
                continue
            names = sorted(
                {info.node_name for info in self.get_publishers_info_by_topic(topic)}
                - {self.get_name()}
            )
            others = ', '.join(names) or 'another replay'
            if not self._force:
                raise UserError(
                    f'{others} publishes on {topic} in this ROS domain, and a replay would mix '
                    'with it; stop it, choose another --domain, or give --force'
                )
            self._told_of.add(topic)
            print(f'  warning: {others} publishes on {topic} too: its messages mix with the '
                  'replay', flush=True)


def _message_type(name: str) -> type:
    package, _, kind = name.partition('/msg/')
    return getattr(import_module(f'{package}.msg'), kind)


def replay(args: list[str] | None = None) -> None:
    """Run the node to its end; raises UserError, NodeFailed."""
    # Ctrl-C ends Python's own way, not with a context that is gone.
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with pressed_keys() as key:
            node = ReplayNode(key)
            try:
                node.run()
            finally:
                node.destroy_node()
    finally:
        rclpy.try_shutdown()


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit status, 2 for a user's mistake."""
    try:
        replay(args)
    except UserError as error:
        print(f'replay: {error}', file=sys.stderr)
        return 2
    except NodeFailed as error:
        print(f'replay: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == '__main__':
    sys.exit(main())
