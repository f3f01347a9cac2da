"""Waiting in the node `session`."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

# What has to be so, and for how long it is waited for [s]; returns whether it is so.
Wait = Callable[[Callable[[], bool], float], bool]


class SessionError(RuntimeError):
    """The session cannot go on; says what did not happen."""


class Waiting:
    """Spins the node while something is waited for; nothing is heard otherwise.

    each_second : called meanwhile
    """

    def __init__(self, node: Node, each_second: Callable[[], None]) -> None:
        self._spinner = SingleThreadedExecutor()
        self._spinner.add_node(node)
        self._each_second, self._called = each_second, time.monotonic()

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Spin until `done()` or `timeout` seconds of wall time; returns whether it is done."""
        deadline = time.monotonic() + timeout
        while not done():
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            self._spinner.spin_once(timeout_sec=min(left, 0.1))
            if time.monotonic() - self._called >= 1.0:
                self._called = time.monotonic()
                self._each_second()
        return True
