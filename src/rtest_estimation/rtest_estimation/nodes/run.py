"""Running a node as a process."""

from __future__ import annotations

import signal
from collections.abc import Callable

import rclpy
from rclpy.clock import JumpHandle, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

# A clock that goes back further than this was set back: a replay begins anew [s].
_BACK_S = 0.5


def when_time_goes_back(node: Node, begin_anew: Callable[[], None]) -> JumpHandle:
    """Call `begin_anew` when the /clock that the node follows goes back; keep what is returned."""
    threshold = JumpThreshold(
        min_forward=None, min_backward=Duration(seconds=-_BACK_S), on_clock_change=False
    )
    return node.get_clock().create_jump_callback(
        threshold, post_callback=lambda _: begin_anew()
    )


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
