"""What the drivers have in common: life cycle, reading thread, diagnostics."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, Node, TransitionCallbackReturn

from rtest_drivers.backends import make
from rtest_drivers.cell_link import DEFAULT_ADDRESS
from rtest_estimation.errors import UserError
from rtest_estimation.nodes import diagnostics
from rtest_estimation.nodes.qos import STREAM
from rtest_estimation.nodes.run import run as spin

# The reading thread looks this often whether it is to end.
_READ_S = 0.2
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.2, 5.0
# What goes wrong is to be known within a second.
_REPORT_S = 0.5
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class Driver(Node):
    """A lifecycle node around one backend.

    configure opens the backend, activate starts publishing; in between everything read is thrown
    away. A thread reads and publishes, so that neither waits for the executor and nothing queues
    up: what the backend holds back meanwhile is its own affair. A lost device is reported in
    /diagnostics and tried again; the process goes on.
    """

    def __init__(
        self,
        name: str,
        topic: str,
        message: type,
        backends: dict[str, Callable[[str], Any]],
        silence: float = 2.0,
    ) -> None:
        super().__init__(name)
        self._backends = backends
        self._parameter('backend', 'cell', f'where the data come from, one of {sorted(backends)}')
        self._parameter('address', DEFAULT_ADDRESS, 'device file; of the backend cell, a socket')
        self._parameter('silence_s', silence, 'time without data that is reported as an error [s]')
        self._publisher = self.create_lifecycle_publisher(message, topic, STREAM)
        self._diagnostics = diagnostics.Diagnostics(self)
        # Not in ROS time: the clock may come from the very device that is lost.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(_REPORT_S, self._report, clock=steady)
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._backend: Any = None
        self._state = 'unconfigured'
        self._problem = ''
        self._reconnects = 0
        self._received = time.monotonic()

    # --- what the drivers differ in ---

    @abstractmethod
    def start(self) -> None:
        """Publishing begins: set every count to zero."""

    @abstractmethod
    def messages(self, records: Sequence[Any]) -> list[Any]:
        """Messages for what was read; counts it."""

    @abstractmethod
    def health(self) -> tuple[str, dict[str, Any]]:
        """A warning, or '' where all is well, and the counts to show, since the last call."""

    @abstractmethod
    def told(self, backend: Any) -> tuple[str, dict[str, Any]]:
        """What the backend says of its device: a problem, or '', and what to show."""

    # --- life cycle ---

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the backend; stays unconfigured where that fails."""
        name = self.get_parameter('backend').value
        try:
            self._backend = make(self._backends, name, self.get_parameter('address').value)
            self._backend.open()
        except (UserError, ConnectionError) as error:
            self._trouble(str(error))
            self._backend = None
            return _FAILURE
        self._problem, self._state = '', 'inactive'
        self._stop.clear()
        self._thread = threading.Thread(target=self._read, name='reading', daemon=True)
        self._thread.start()
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start publishing; readings count from zero."""
        result = super().on_activate(state)
        with self._lock:
            self.start()
            self._state, self._received = 'active', time.monotonic()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop publishing; the backend stays open."""
        with self._lock:
            self._state = 'inactive'
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the backend."""
        self.close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the backend."""
        self.close('finalized')
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """A transition failed in an unexpected way: close the backend, back to unconfigured."""
        self.close()
        return super().on_error(state)

    def close(self, state: str = 'unconfigured') -> None:
        """End the reading thread and close the backend."""
        with self._lock:
            self._state = state
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._backend is not None:
            self._backend.close()
            self._backend = None
        self._problem = ''

    # --- reading ---

    def _read(self) -> None:
        wait = 0.0
        while not self._stop.wait(wait):
            try:
                if wait:
                    self._backend.open()
                    self._reconnects += 1
                    self.get_logger().info('connected again')
                    self._problem, wait = '', 0.0
                self._publish(self._backend.read(_READ_S))
            except ConnectionError as error:
                self._trouble(str(error))
            except Exception:
                if not self.context.ok():
                    return  # The process is ending, and the publisher ended before this thread.
                self._trouble(f'reading failed, which is a bug:\n{traceback.format_exc()}')
            else:
                continue
            self._backend.close()
            wait = min(2.0 * wait or _FIRST_WAIT_S, _LONGEST_WAIT_S)

    def _publish(self, records: Sequence[Any]) -> None:
        if not records:
            return
        with self._lock:
            if self._state != 'active':
                return
            self._received = time.monotonic()
            for message in self.messages(records):
                self._publisher.publish(message)

    # --- diagnostics ---

    def _trouble(self, text: str) -> None:
        if text != self._problem:
            self.get_logger().error(text)
        self._problem = text
        self._report()

    def _report(self) -> None:
        with self._lock:
            state, age = self._state, time.monotonic() - self._received
            warning, values = self.health()
            backend = self._backend
            problem, told = self.told(backend) if backend is not None else ('', {})
        level, text = diagnostics.OK, state
        if self._problem:
            level, text = diagnostics.ERROR, self._problem
        elif state == 'active' and age > self.get_parameter('silence_s').value:
            level = diagnostics.ERROR
            text = problem or (
                f'no data for {age:.1f} s; check that the device runs and its cable'
            )
        elif problem or (state == 'active' and warning):
            level = diagnostics.WARN
            text = '; '.join(filter(None, (problem, warning)))
        values = {
            'state': state, 'age_s': f'{age:.2f}', 'reconnects': self._reconnects,
            **values, **told,
        }
        status = diagnostics.status(f'{self.get_name()}: driver', level, text, values)
        status.hardware_id = self.get_parameter('address').value
        self._diagnostics.publish(status)

    def _parameter(self, name: str, default: Any, description: str) -> None:
        # Read-only: who can call services of this node cannot name another device.
        descriptor = ParameterDescriptor(description=description, read_only=True)
        self.declare_parameter(name, default, descriptor)


def run(make_node: Callable[[], Any], args: list[str] | None = None) -> int:
    """Spin a node until SIGINT or SIGTERM; returns the exit status.

    A user's mistake is one line on stderr and status 2.
    """
    try:
        return spin(make_node, args)
    except UserError as error:
        print(error, file=sys.stderr)
        rclpy.try_shutdown()
        return 2
