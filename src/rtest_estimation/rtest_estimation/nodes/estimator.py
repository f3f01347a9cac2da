"""Node `estimator`: gauge readings and encoder feedback in, sphere centres and cycles out."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rtest_msgs.msg import Cycle, CyclePlan, GaugeSamples, NestCalibration
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from rtest_estimation import messages
from rtest_estimation import nest as nests
from rtest_estimation.dwell import DwellRules
from rtest_estimation.errors import UserError
from rtest_estimation.laser import CentreSolver, CentreStatus
from rtest_estimation.nodes import diagnostics, publish
from rtest_estimation.nodes.qos import LATCHED, LATCHED_100, STREAM
from rtest_estimation.nodes.run import run, when_time_goes_back
from rtest_estimation.pipeline import EstimationRules, Estimator, Finished
from rtest_estimation.records import CyclePlan as PlanRecord
from rtest_estimation.records import GaugeBlock, NestKind, Status
from rtest_estimation.records import NestCalibration as NestRecord
from rtest_estimation.sequence import SequenceCheck
from rtest_estimation.thinning import Thinning

# A look at the progress is followed by this many times as long without one.
LOOK_SHARE = 4.0
_KINDS = {'contact': NestKind.CONTACT, 'laser': NestKind.LASER}


class EstimatorNode(Node):
    """Wraps `pipeline.Estimator`; everything it knows it got from topics."""

    def __init__(self) -> None:
        super().__init__('estimator')
        radius = self.declare_parameter('sphere_radius_mm', 12.7).value
        settle = self.declare_parameter('settle_s', DwellRules().settle).value
        # The stream is for eyes and plots; finished cycles use every reading.
        self._centre_period = 1e9 / self.declare_parameter('sphere_centre_hz', 100.0).value
        kind = self.declare_parameter('nest', 'contact').value
        if kind not in _KINDS:
            raise UserError(f'parameter nest: expected {" or ".join(_KINDS)}, got {kind!r}')
        self._rules = EstimationRules(
            DwellRules(settle=float(settle)), float(radius) * 1e-3, _KINDS[kind]
        )
        self._begin()
        self._back = when_time_goes_back(self, self._begin)

        self._nest = self.create_publisher(NestCalibration, 'rtest/nest', LATCHED)
        self._centre = self.create_publisher(PointStamped, 'rtest/sphere_centre', STREAM)
        self._cycle = self.create_publisher(Cycle, 'rtest/cycle', LATCHED_100)
        self._diagnostics = diagnostics.Diagnostics(self)
        self.create_subscription(CyclePlan, 'rtest/plan', self._on_plan, LATCHED_100)
        self.create_subscription(GaugeSamples, 'rtest/gauges', self._on_gauges, STREAM)
        self.create_subscription(JointState, 'rtest/cnc/feedback', self._on_feedback, STREAM)
        self.create_service(Trigger, '~/finish', self._on_finish)
        self.create_service(Trigger, '~/received', self._on_received)
        # On the wall clock: diagnostics keep coming when the simulated clock stands.
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _begin(self) -> None:
        self._estimator = Estimator(self._rules)
        self._last: Finished | None = None
        self._progress: tuple[PlanRecord, int] | None = None
        self._look_at = 0.0
        self._received: Counter[str] = Counter()
        self._shown = Thinning(self._centre_period)
        self._solver: CentreSolver | None = None
        self._damaged: list[str] = []
        self._sequence = SequenceCheck()
        # Readings that were lost before the current cycle.
        self._lost_before = 0

    def _on_plan(self, message: CyclePlan) -> None:
        self._received['plan'] += 1
        self._accept(messages.cycle_plan, message, self._estimator.add_plan)

    def _on_feedback(self, message: JointState) -> None:
        self._received['feedback'] += 1
        self._accept(messages.feedback, message, self._estimator.add_feedback)

    def _on_gauges(self, message: GaugeSamples) -> None:
        self._received['gauges'] += 1
        self._accept(messages.gauge_block, message, self._add_gauges)

    def _accept(
        self, convert: Callable[[Any], Any], message: Any, add: Callable[[Any], None]
    ) -> None:
        try:
            record = convert(message)
        except messages.MessageError as error:
            self._damaged.append(str(error))
            self.get_logger().error(str(error), throttle_duration_sec=1.0)
            return
        add(record)
        self._drain()

    def _add_gauges(self, block: GaugeBlock) -> None:
        self._estimator.add_gauges(block)
        self._sequence.add(block.stamp, block.sequence, len(block.displacement))
        nest = self._estimator.nest
        if nest is None or block.displacement.shape[1] != len(nest.direction):
            return
        good = (block.status == Status.VALID).all(axis=1)
        good &= np.isfinite(block.displacement).all(axis=1)
        rows = self._shown.rows(block.stamps, good)
        centres = self._centres(nest, block.displacement[rows])
        for stamp, centre in zip(block.stamps[rows].tolist(), centres, strict=True):
            if np.isfinite(centre).all():
                header = publish.header(stamp, 'table')
                self._centre.publish(PointStamped(header=header, point=publish.point(centre)))

    def _centres(self, nest: NestRecord, readings: np.ndarray) -> np.ndarray:
        """(n, 3) sphere centres [m]; NaN where a laser nest is not calibrated."""
        if nest.kind is not NestKind.LASER:
            return nests.centres(nest, readings)
        if self._solver is None or self._solver.nest is not nest:
            self._solver = CentreSolver(nest)
        found, status = self._solver(readings)
        found[status != CentreStatus.VALID] = np.nan
        return found

    def _drain(self) -> None:
        while (ready := self._estimator.finished()) is not None:
            self._publish(ready)

    def _publish(self, ready: Finished) -> None:
        self._last = ready
        self._lost_before = self._sequence.lost
        if ready.nest is not None:
            self._nest.publish(publish.nest_calibration(ready.nest))
        self._cycle.publish(publish.cycle(ready.cycle))
        plan = ready.cycle.plan
        line = f'{plan.cycle}: {len(ready.cycle.points)} of {len(plan.commands)} poses'
        level = diagnostics.OK
        if ready.problem or ready.cycle.missing:
            level = diagnostics.WARN
            line += f'; {ready.problem}' if ready.problem else ''
            self.get_logger().warning(line)
        reasons = {f'pose {m.index}': m.reason for m in ready.cycle.missing}
        self._diagnostics.publish(
            diagnostics.status('estimator: finished cycle', level, line, reasons)
        )

    def _on_finish(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        for ready in self._estimator.finish():
            self._publish(ready)
        response.success = True
        response.message = f'{len(self._estimator.nests)} nest calibrations'
        return response

    def _on_received(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """How many messages were taken, for whoever must not send faster than that."""
        response.success = True
        response.message = ' '.join(f'{name} {n}' for name, n in self._received.items())
        return response

    def _report(self) -> None:
        progress = self._look_at_progress()
        values = {
            'discarded_feedback': self._estimator.discarded,
            'damaged': len(self._damaged),
            'lost_readings': self._sequence.lost,
        }
        if self._estimator.feedback_stamp:
            age = self.get_clock().now().nanoseconds - self._estimator.feedback_stamp
            values['feedback_age_s'] = f'{age / 1e9:.2f}'
        line = 'waiting for a plan'
        if progress is not None:
            plan, done = progress
            values |= {
                'cycle': plan.cycle, 'started': plan.stamp, 'poses_done': done,
                'poses': len(plan.commands),
            }
            line = f'{plan.cycle}: {done} of {len(plan.commands)} poses'
        level = diagnostics.OK
        if lost := self._sequence.lost - self._lost_before:
            level, line = diagnostics.WARN, f'{lost} gauge readings did not arrive'
        if self._damaged:
            level, line = diagnostics.WARN, f'damaged message: {self._damaged[-1]}'
        self._diagnostics.publish(diagnostics.status('estimator: cycle', level, line, values))

    def _look_at_progress(self) -> tuple[PlanRecord, int] | None:
        """Poses reached so far; after a look that took long not so soon again.

        Readings must not wait for it, on a busy computer and in a cycle of a thousand poses.
        """
        plan = self._estimator.current
        begun = time.monotonic()
        if begun >= self._look_at or self._progress is None or self._progress[0] is not plan:
            self._progress = self._estimator.progress()
            self._look_at = begun + LOOK_SHARE * (time.monotonic() - begun)
        return self._progress

    def close(self) -> None:
        """Publish what is still open when the process is told to stop."""
        for ready in self._estimator.finish():
            self._publish(ready)


def main(args: list[str] | None = None) -> int:
    """Entry point; a user's mistake is one line on stderr and status 2."""
    try:
        return run(EstimatorNode, args)
    except UserError as error:
        print(error, file=sys.stderr)
        rclpy.try_shutdown()
        return 2


if __name__ == '__main__':
    raise SystemExit(main())
