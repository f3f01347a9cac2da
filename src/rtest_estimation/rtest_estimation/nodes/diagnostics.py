"""Status of a node on /diagnostics."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node

from rtest_estimation.version import code_version

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)


def status(
    name: str, level: bytes, message: str, values: Mapping[str, object] | None = None
) -> DiagnosticStatus:
    """One status; `name` starts with the node's name, as in 'estimator: cycle'."""
    pairs = [KeyValue(key=str(k), value=str(v)) for k, v in (values or {}).items()]
    return DiagnosticStatus(name=name, level=level, message=message, values=pairs)


class Diagnostics:
    """Publishes on /diagnostics."""

    def __init__(self, node: Node) -> None:
        self._node = node
        # A module that is run has another name, its file is where it always is.
        package = Path(inspect.getfile(type(node))).parents[1].name
        self._version = code_version(package) if package.startswith('rtest_') else 'unknown'
        self._publisher = node.create_publisher(DiagnosticArray, '/diagnostics', 10)

    def publish(self, *statuses: DiagnosticStatus) -> None:
        """Send statuses, stamped now, with the version of the node's code."""
        for status in statuses:
            status.values.append(KeyValue(key='version', value=self._version))
        message = DiagnosticArray(status=list(statuses))
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
