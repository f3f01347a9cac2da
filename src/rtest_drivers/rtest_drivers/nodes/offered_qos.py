"""Quality of service that publishers offer: what to ask for, and how rosbag2 writes it down."""

from __future__ import annotations

from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from rtest_estimation.nodes.qos import STREAM


def compatible(offered: list[QoSProfile]) -> QoSProfile:
    """The most a subscription can ask for and still hear every publisher."""
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=STREAM.depth,
        reliability=(ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT),
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE),
    )


def asks_more(asked: QoSProfile, offered: QoSProfile) -> bool:
    """Whether a subscription does not hear a publisher because of what it asks for."""
    return (
        asked.reliability == ReliabilityPolicy.RELIABLE != offered.reliability
        or asked.durability == DurabilityPolicy.TRANSIENT_LOCAL != offered.durability
    )


def qos_yaml(qos: QoSProfile) -> str:
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
