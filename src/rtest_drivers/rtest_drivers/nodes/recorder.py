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
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from std_srvs.srv import Trigger

from rtest_drivers.clock import HostClock
from rtest_drivers.graph import RECORDED
from rtest_drivers.nodes.recorded_topics import RecordedTopics
from rtest_drivers.session_writer import MEMORY, NOT_WRITTEN, SessionWriter
from rtest_estimation.errors import UserError
from rtest_estimation.nodes.qos import STREAM

# A recording is complete when nothing came for this long after the others finished [s].
QUIET = 0.3
PATIENCE = 3.0
SPIN = 0.1
# How long a disk may take for what waits in memory when the session is over [s].
CLOSE_PATIENCE = 60.0
MAX_MEMORY_MB = 100_000


class Recorder(Node):
    """Records a session; see the module.

    Parameters: `out` directory of the recordings, `session` name (the bag is out/session),
    `topics` patterns of the names to record, relative to the node's namespace or absolute,
    `memory_mb` what may wait for the disk.

    None of them can be set later: who can call services of this node cannot name a path.

    Raises UserError for parameters that cannot be used and where the recording exists.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__('recorder', **options)
        out = self._parameter('out', '')
        self.session = self._parameter('session', '')
        memory = self._parameter('memory_mb', MEMORY // 1_000_000)
        patterns = [self._pattern(text) for text in self._parameter('topics', RECORDED)]
        self._simulated = self.get_parameter('use_sim_time').value
        # A clock that is set meanwhile must not part the messages before from those after.
        self._host = HostClock()
        self._time = 0
        self.writer = _open_writer(out, self.session, memory)
        self._topics = RecordedTopics(self, self.writer, patterns, self._now, self._simulated)
        self._ending = 0.0
        self._finished: tuple[bool, str] | None = None
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
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
            return self.declare_parameter(
                name, default, ParameterDescriptor(read_only=True)
            ).value
        except InvalidParameterTypeException as error:
            kinds = {str: 'a text, put it in quotes', int: 'a whole number'}
            kind = kinds.get(type(default), 'a list of texts, put them in quotes')
            raise UserError(f'parameter {name}: expected {kind}') from error

    def _pattern(self, text: str) -> re.Pattern[str]:
        namespace = self.get_namespace().rstrip('/')
        try:
            return re.compile(text if text.startswith('/') else f'{re.escape(namespace)}/{text}')
        except re.error as error:
            raise UserError(f'parameter topics: {text!r} is not a pattern: {error}') from error

    def _start(self) -> None:
        """Subscribe as soon as there is a time to log."""
        if self._now() <= 0:
            return
        self.destroy_timer(self._start_timer)
        self._topics.start()
        self.create_timer(0.5, self._topics.look_around, clock=self._steady)

    # --- what is told ---

    @property
    def lost(self) -> int:
        """Readings and messages that are known to be missing from the recording."""
        return self._topics.lost + self.writer.dropped.total()

    def _note_losses(self) -> None:
        """Have it noted in the recording what did not come to it."""
        self.writer.note_losses(
            {f'not received {name}': count for name, count in self._topics.not_received.items()}
        )

    def _report(self) -> None:
        """Publish the state, once a second of wall time."""
        self.writer.check()
        self._note_losses()
        now = self.get_clock().now()
        if now.nanoseconds <= 0:
            return
        status = DiagnosticStatus(name=self.get_fully_qualified_name(), hardware_id=self.session)
        status.level, status.message = self._state()
        values = {
            'file': str(self.writer.path),
            'messages': self.writer.taken,
            'bytes': self.writer.size,
            'waiting_bytes': self.writer.waiting,
            'lost': self.lost,
            'disk_free': shutil.disk_usage(self.writer.path.parent).free,
        }
        for name, check in self._topics.checks.items():
            values[f'lost readings {name}'] = check.lost
            values[f'driver restarts {name}'] = check.restarts
        for name, count in self._topics.not_received.items():
            values[f'lost messages {name}'] = count
        for name, count in self.writer.dropped.items():
            values[f'{NOT_WRITTEN} {name}'] = count
        for name, problem in self._topics.problems.items():
            values[f'problem {name}'] = problem
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = now.to_msg()
        self._diagnostics.publish(message)

    def _state(self) -> tuple[bytes, str]:
        if self.writer.error is not None:
            return DiagnosticStatus.ERROR, f'{self.writer.error}{self._not_written()}'
        if self.writer.dropped:
            return DiagnosticStatus.ERROR, f'the disk was too slow or full{self._not_written()}'
        if self.lost:
            return DiagnosticStatus.WARN, f'{self.lost} readings or messages lost'
        if self._topics.problems:
            return DiagnosticStatus.WARN, next(iter(self._topics.problems.values()))
        if not self._simulated and (problem := self._host.problem()):
            return DiagnosticStatus.WARN, problem
        return DiagnosticStatus.OK, 'finished' if self.closed else 'recording'

    def _not_written(self) -> str:
        """What was refused for want of memory, for example ``; not written: 3 of /a``."""
        counts = self.writer.dropped
        listed = ', '.join(f'{count} of {name}' for name, count in sorted(counts.items()))
        return f'; {NOT_WRITTEN}: {listed}' if listed else ''

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
        last = max(self._topics.last_message, self._ending)
        return now - last > QUIET or now - self._ending > PATIENCE

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""
        return self._finished is not None

    def finish(self) -> tuple[bool, str]:
        """Stop recording and close the file; (complete, one line). Can be repeated.

        Complete is a recording that is closed and that the disk has refused nothing of.
        """
        if self._finished is None:
            self._topics.stop()
            self._note_losses()
            try:
                self.writer.close(CLOSE_PATIENCE)
            except OSError:
                return False, f'{self.writer.error}{self._not_written()}'
            self._finished = (
                not self.writer.dropped,
                f'recorded {self.writer.written} messages, {self.lost} lost'
                f'{self._not_written()}, {self.writer.path}',
            )
        return self._finished

    def _now(self) -> int:
        """The time to log [ns]; never back to 0, as simulated time may."""
        now = self.get_clock().now().nanoseconds if self._simulated else self._host.now()
        if now > 0:
            self._time = now
        return self._time


def _open_writer(out: str, session: str, memory_mb: int) -> SessionWriter:
    """Create out/session/session.mcap."""
    if not out:
        raise UserError('parameter out: empty, expected the directory for the recordings')
    if not re.fullmatch(r'\w[\w.+ -]*', session):
        raise UserError(
            f'parameter session: {session!r}, expected a name of letters, digits, - and _'
        )
    if not 1 <= memory_mb <= MAX_MEMORY_MB:
        raise UserError(
            f'parameter memory_mb: {memory_mb}, expected a number from 1 to {MAX_MEMORY_MB}'
        )
    folder = Path(out) / session
    try:
        return SessionWriter(folder, memory_mb * 1_000_000)
    except FileExistsError as error:
        raise UserError(
            f'{folder}: there is a recording already; choose another session name'
        ) from error
    except OSError as error:
        raise UserError(f'{folder}: cannot be written: {error.strerror}') from error


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
            complete, line = recorder.finish()
            print(f'recorder: {line}', file=sys.stdout if complete else sys.stderr, flush=True)
        return 0 if recorder.closed else 1
    finally:
        rclpy.try_shutdown()


if __name__ == '__main__':
    sys.exit(main())
