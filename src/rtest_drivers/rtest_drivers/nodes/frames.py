"""Node `frames`: tf of the machine, from its URDF and the encoder feedback.

A cell may have tf of its own: this node is started only where somebody asks for it. It listens
best effort, so that no driver waits for it, and lets at most 20 sets of transforms a second pass,
each with the stamp of its feedback. A joint without a position in the feedback has no transform
until it has one again; /diagnostics tell it.

Parameters
----------
prefix : put before the name of every frame, such as ``cell_1/``
"""

from __future__ import annotations

import sys
from collections.abc import Iterable

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
from geometry_msgs.msg import Transform as TransformMessage
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from tf2_msgs.msg import TFMessage

from rtest_estimation import messages
from rtest_estimation.errors import UserError
from rtest_estimation.nodes import diagnostics
from rtest_estimation.nodes.qos import LATCHED, STREAM
from rtest_estimation.nodes.run import run
from rtest_identification.frames import (
    DescriptionError,
    Joint,
    Transform,
    fixed,
    moving,
    read_joints,
)

# Between two sets of transforms [ns]; a little less than a 20th of a second, or the jitter of
# stamps that come just as slowly would leave every other one out.
PERIOD = 49_500_000
# Stamps that go back further were set back: a replay begins anew [ns].
_BACK = 500_000_000
# As listeners of tf expect it.
_DEPTH = 100
# A driver does not wait for what this node has not taken yet.
_LOSSY = QoSProfile(depth=STREAM.depth, reliability=ReliabilityPolicy.BEST_EFFORT)


class FramesNode(Node):
    """Wraps `rtest_identification.frames`. Raises UserError for a prefix that tf refuses."""

    def __init__(self) -> None:
        super().__init__('frames')
        once = ParameterDescriptor(read_only=True)
        self._prefix = self.declare_parameter('prefix', '', once).value
        if self._prefix.startswith('/'):
            raise UserError(
                f'parameter prefix: {self._prefix!r}, but no frame of tf begins with a slash; '
                "expected for example 'cell_1/'"
            )
        self._joints: tuple[Joint, ...] = ()
        self._stamp: int | None = None
        # Since the last report.
        self._missing: set[str] = set()
        self._damaged = ''
        # What is wrong with the description.
        self._problem = ''
        # Names of tf are absolute: frames of all namespaces are one tree.
        self._tf = self.create_publisher(TFMessage, '/tf', _DEPTH)
        self._tf_static = self.create_publisher(TFMessage, '/tf_static', LATCHED)
        self._diagnostics = diagnostics.Diagnostics(self)
        self.create_subscription(String, 'robot_description', self._on_description, LATCHED)
        self.create_subscription(JointState, 'rtest/cnc/feedback', self._on_feedback, _LOSSY)
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_description(self, message: String) -> None:
        try:
            self._joints, self._problem = read_joints(message.data), ''
        except DescriptionError as error:
            self._joints, self._problem = (), f'robot_description: {error}'
            return
        now = self.get_clock().now().to_msg()
        self._tf_static.publish(self._message(fixed(self._joints), now))

    def _on_feedback(self, message: JointState) -> None:
        stamp = messages.nanoseconds(message.header.stamp)
        if self._stamp is not None and -_BACK < stamp - self._stamp < PERIOD:
            return
        try:
            feedback = messages.feedback(message)
        except messages.MessageError as error:
            self._damaged = str(error)
            return
        self._stamp = stamp
        positions = dict(zip(feedback.axes, feedback.position.tolist(), strict=True))
        transforms, missing = moving(self._joints, positions)
        self._missing |= set(missing)
        if transforms:
            self._tf.publish(self._message(transforms, message.header.stamp))

    def _message(self, transforms: Iterable[Transform], stamp: Time) -> TFMessage:
        return TFMessage(
            transforms=[
                TransformStamped(
                    header=Header(stamp=stamp, frame_id=self._prefix + one.parent),
                    child_frame_id=self._prefix + one.child,
                    transform=TransformMessage(
                        translation=Vector3(**dict(zip('xyz', one.translation, strict=True))),
                        rotation=Quaternion(**dict(zip('xyzw', one.quaternion, strict=True))),
                    ),
                )
                for one in transforms
            ]
        )

    def _report(self) -> None:
        level, line = diagnostics.OK, f'{len(self._joints)} transforms'
        if self._problem:
            level, line = diagnostics.WARN, self._problem
        elif self._damaged:
            level, line = diagnostics.WARN, f'damaged message: {self._damaged}'
        elif not self._joints:
            line = 'waiting for robot_description'
        elif self._stamp is None:
            line = 'waiting for rtest/cnc/feedback'
        elif self._missing:
            names = sorted(self._missing)
            frames = ', '.join(joint.child for joint in self._joints if joint.name in names)
            level = diagnostics.WARN
            line = f'no position of {", ".join(names)}: no transform of {frames}'
        values = {'prefix': self._prefix}
        if self._stamp is not None:
            age = self.get_clock().now().nanoseconds - self._stamp
            values['feedback_age_s'] = f'{age / 1e9:.2f}'
        self._diagnostics.publish(diagnostics.status('frames: transforms', level, line, values))
        self._missing, self._damaged = set(), ''


def main(args: list[str] | None = None) -> int:
    """Entry point; a user's mistake is one line on stderr and status 2."""
    try:
        return run(FramesNode, args)
    except UserError as error:
        print(f'frames: {error}', file=sys.stderr)
        rclpy.try_shutdown()
        return 2


if __name__ == '__main__':
    sys.exit(main())
