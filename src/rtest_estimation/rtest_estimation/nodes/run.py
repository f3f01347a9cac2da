"""Running a node as a process."""

from __future__ import annotations

import signal
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node


def run(make: Callable[[], Node], args: list[str] | None = None) -> int:
    """Spin the node that `make` gives until SIGINT or SIGTERM; returns the exit status 0.

    A node that has a method ``close`` gets it called while it can still publish.
    """
    # rclpy's own handlers shut the context down at once; ours lets the node close first.
    rclpy.init(args=args, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = make()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    stopping = False

    def stop(*_: object) -> None:
        nonlocal stopping
        stopping = True

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    try:
        while not stopping and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
        close = getattr(node, 'close', None)
        if close:
            close()
    except ExternalShutdownException:
        pass
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 0
