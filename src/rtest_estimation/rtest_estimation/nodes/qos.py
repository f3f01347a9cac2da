"""Quality of service of the graph's topics."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _profile(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


# State that a node started later must still get.
LATCHED = _profile(1, DurabilityPolicy.TRANSIENT_LOCAL)
# Plans, calibrations and cycles: every one of a session, not only the last.
LATCHED_100 = _profile(100, DurabilityPolicy.TRANSIENT_LOCAL)
# Readings and feedback: none may be lost while a subscriber is briefly busy.
STREAM = _profile(1000, DurabilityPolicy.VOLATILE)
