"""Node `identifier`: finished cycles in; location errors, error maps and model gap out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial

import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rtest_msgs.msg import Cycle, ErrorMap, LocationErrors, ModelGap, NestCalibration
from std_msgs.msg import String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from rtest_estimation import messages
from rtest_estimation.attempts import counted
from rtest_estimation.errors import UserError
from rtest_estimation.nodes import diagnostics
from rtest_estimation.nodes.qos import LATCHED, LATCHED_100
from rtest_estimation.nodes.run import run, when_time_goes_back
from rtest_estimation.records import Cycle as CycleRecord
from rtest_estimation.records import Kind
from rtest_estimation.records import NestCalibration as NestRecord
from rtest_identification.gap.model_file import Model, load_model
from rtest_identification.gap.offline import SessionGap, gap_session
from rtest_identification.gap.output import lines, summary
from rtest_identification.gap.workflow import GapResult
from rtest_identification.machine import Machine, parse_machine
from rtest_identification.nodes import publish
from rtest_identification.nodes.background import Background
from rtest_identification.nodes.markers import position_markers
from rtest_identification.observations import turns
from rtest_identification.pipeline import Identification, identify

# Verdicts on the model gap that leave nothing to be looked for.
_GOOD = ('no gap', 'explained')
# The comparison with the model waits until no cycle has come for so long [s].
_REST_S = 1.0


@dataclass(frozen=True)
class Compared:
    """What came of a comparison, or why there is none. stamp : of the last cycle in it [ns]."""

    stamp: int
    found: SessionGap | UserError


def compare(
    machine: Machine,
    cycles: tuple[CycleRecord, ...],
    directions: dict[str, np.ndarray],
    model: Model | None,
) -> Compared:
    """Compare a model with what was measured; takes seconds."""
    stamp = max(cycle.stamp for cycle in cycles)
    try:
        return Compared(stamp, gap_session(machine, cycles, directions, model))
    except UserError as error:
        return Compared(stamp, error)


class IdentifierNode(Node):
    """Identifies anew after every static cycle, with all cycles of the session so far.

    Then compares them with the model, unless the next cycle is there already.
    """

    def __init__(self) -> None:
        super().__init__('identifier')
        self._machine: Machine | None = None
        # It takes seconds, in which the node goes on saying how it is.
        self._comparison = Background(self._on_compared)
        self._begin()
        self._back = when_time_goes_back(self, self._begin)
        self._problem = 'waiting for the machine'
        self._location = self.create_publisher(LocationErrors, 'rtest/location_errors', LATCHED)
        self._map = self.create_publisher(ErrorMap, 'rtest/error_map', LATCHED_100)
        self._markers = self.create_publisher(MarkerArray, 'rtest/markers', LATCHED)
        self._diagnostics = diagnostics.Diagnostics(self)
        self._gap = self.create_publisher(ModelGap, 'rtest/model_gap', LATCHED)
        model = self.declare_parameter('model', '').value
        self._model = load_model(model) if model else None
        self._nests: dict[str, NestRecord] = {}
        self.create_subscription(String, 'rtest/machine', self._on_machine, LATCHED)
        self.create_subscription(NestCalibration, 'rtest/nest', self._on_nest, LATCHED_100)
        self.create_subscription(Cycle, 'rtest/cycle', self._on_cycle, LATCHED_100)
        self.create_service(Trigger, '~/finish', self._on_finish)
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _begin(self) -> None:
        self._cycles: list[CycleRecord] = []
        self._result: Identification | None = None
        self._found: GapResult | None = None
        # Whether the comparison with the model was begun for the cycles so far, and what the last
        # one said; when the last static cycle came.
        self._asked, self._verdict, self._came = False, '', 0.0

    def _on_machine(self, message: String) -> None:
        try:
            self._machine = parse_machine(message.data, 'rtest/machine')
            self._problem = 'waiting for a static cycle'
            self._identify()
        except UserError as error:
            self._machine, self._problem = None, str(error)
            self.get_logger().error(str(error))

    def _on_cycle(self, message: Cycle) -> None:
        try:
            cycle = messages.cycle(message)
        except messages.MessageError as error:
            self.get_logger().error(f'rtest/cycle: {error}')
            return
        if any(c.plan.session != cycle.plan.session for c in self._cycles):
            self._begin()
        self._cycles = counted([*self._cycles, cycle])
        if cycle.plan.kind is Kind.STATIC:
            self._asked, self._came = False, time.monotonic()
            self._identify()

    def _on_nest(self, message: NestCalibration) -> None:
        nest = messages.nest_calibration(message)
        self._nests[nest.calibration] = nest
        if any(c.calibration == nest.calibration and turns(self._machine, c.plan)
               for c in self._cycles if self._machine is not None):
            self._asked = False

    def _identify(self) -> None:
        if self._machine is None or not any(turns(self._machine, c.plan) for c in self._cycles):
            return
        try:
            result = identify(self._machine, tuple(self._cycles), nests=self._used_nests())
        except UserError as error:
            self._problem = str(error)
            self.get_logger().warning(str(error))
            return
        self._result, self._problem = result, ''
        stamp = max(cycle.stamp for cycle in self._cycles)
        self._location.publish(publish.location_errors(result, stamp))
        for axis_map in result.maps:
            self._map.publish(publish.error_map(result, axis_map, stamp))
        if result.inner_map is not None:
            self._map.publish(publish.grid_map(result, result.inner_map, stamp))
        self._markers.publish(position_markers(result, stamp))

    def _on_finish(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._cycles and not any(c.plan.kind is Kind.STATIC for c in self._cycles):
            response.success = any(c.plan.kind is Kind.DYNAMIC for c in self._cycles)
            response.message = 'no static cycle to identify'
            return response
        self._identify()
        response.success = self._result is not None
        response.message = self._summary()
        if self._result is not None:
            self._comparison.wait()
            if not self._asked:
                self._compare()
                self._comparison.wait()
            response.message += f'; {self._verdict}'
            self._report()
        return response

    def _used_nests(self) -> list[NestRecord]:
        """Calibrations of the cycles, in the order in which they were made."""
        names = dict.fromkeys(cycle.calibration for cycle in self._cycles)
        return sorted(
            (self._nests[name] for name in names if name in self._nests), key=lambda n: n.stamp
        )

    def _compare(self) -> None:
        """Begin to compare model and measurement, with the cycles so far."""
        self._asked = True
        cycles = tuple(self._cycles)
        directions = {
            cycle.plan.setup: self._nests[cycle.calibration].sensitive
            for cycle in cycles
            if cycle.calibration in self._nests
        }
        self._comparison.start(
            partial(compare, self._machine, cycles, directions, self._model)
        )

    def _on_compared(self, compared: Compared) -> None:
        if isinstance(compared.found, UserError):
            self._verdict = f'no comparison with the model: {compared.found}'
        elif any(c.plan.session == compared.found.session for c in self._cycles):
            self._gap.publish(publish.model_gap(compared.found, compared.stamp))
            self._found = compared.found.result
            self._verdict = summary(self._found)

    def _summary(self) -> str:
        if self._result is None:
            return self._problem
        location = self._result.location
        return (
            f'{int(location.determined.sum())} location and squareness errors from '
            f'{len(self._result.observations)} poses, residual {self._result.fit.rms * 1e6:.2f} µm'
        )

    def _report(self) -> None:
        self._comparison.poll()
        waited = time.monotonic() - self._came > _REST_S
        if self._result is not None and not (self._asked or self._comparison.busy) and waited:
            self._compare()
        warnings = self._result.warnings if self._result else ()
        # Waiting is no fault, what cannot be identified is.
        static = any(c.plan.kind is Kind.STATIC for c in self._cycles)
        wrong = warnings or (self._problem and (static or self._machine is None))
        level = diagnostics.WARN if wrong else diagnostics.OK
        values = {f'warning {n + 1}': text for n, text in enumerate(warnings)}
        notes = self._result.notes if self._result else ()
        values |= {f'note {n + 1}': text for n, text in enumerate(notes)}
        self._diagnostics.publish(
            diagnostics.status('identifier: session', level, self._summary(), values)
        )
        if self._found is not None:
            # The verdict's message has no words: which sizes, what else it could be, and where an
            # unexplained rest sits.
            notes = {f'note {n + 1}': text for n, text in enumerate(lines(self._found))}
            level = diagnostics.OK if self._found.verdict in _GOOD else diagnostics.WARN
            self._diagnostics.publish(diagnostics.status(
                'identifier: model gap', level, summary(self._found), notes
            ))


def main(args: list[str] | None = None) -> int:
    """Entry point."""
    return run(IdentifierNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
