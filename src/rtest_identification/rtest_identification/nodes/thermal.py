"""Node `thermal`: in a thermal session, each finished cycle extends the picture of the drift.

Publishes the errors that each cycle gives by itself, and writes thermal.json and the report, as
`rtest thermal` does from the recording, into the folder of the parameter `out`. It takes the place
of the identifier, which would fit all cycles as one machine.
"""

from __future__ import annotations

from pathlib import Path
from threading import Thread

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rtest_msgs.msg import Cycle, ErrorMap, LocationErrors
from sensor_msgs.msg import Temperature
from std_msgs.msg import String
from std_srvs.srv import Trigger

from rtest_estimation import messages
from rtest_estimation.errors import UserError
from rtest_estimation.nodes import diagnostics
from rtest_estimation.nodes.qos import LATCHED, LATCHED_100, STREAM
from rtest_estimation.nodes.run import run
from rtest_estimation.records import Cycle as CycleRecord
from rtest_estimation.records import Kind
from rtest_identification.machine import Machine, parse_machine
from rtest_identification.nodes import publish
from rtest_identification.thermal import output, words
from rtest_identification.thermal.live import LiveSession
from rtest_identification.thermal.pipeline import Thermal
from rtest_identification.thermal.report import write_report


class ThermalNode(Node):
    """Identifies every static cycle by itself, and all of them together as they come."""

    def __init__(self) -> None:
        super().__init__('thermal')
        self._out = self.declare_parameter('out', '').value
        self._machine: Machine | None = None
        self._live = LiveSession()
        self._result: Thermal | None = None
        self._due = False
        self._drawing = Thread()
        self._problem = 'waiting for the machine'
        # Of every cycle, for who comes later.
        self._location = self.create_publisher(
            LocationErrors, 'rtest/location_errors', LATCHED_100
        )
        self._map = self.create_publisher(ErrorMap, 'rtest/error_map', LATCHED_100)
        self._diagnostics = diagnostics.Diagnostics(self)
        self.create_subscription(String, 'rtest/machine', self._on_machine, LATCHED)
        self.create_subscription(Cycle, 'rtest/cycle', self._on_cycle, LATCHED_100)
        self.create_subscription(Temperature, 'rtest/temperature', self._on_temperature, STREAM)
        self.create_service(Trigger, '~/finish', self._on_finish)
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _on_machine(self, message: String) -> None:
        try:
            self._machine = parse_machine(message.data, 'rtest/machine')
        except UserError as error:
            self._machine, self._problem = None, str(error)
            self.get_logger().error(str(error))
        else:
            self._problem, self._due = 'waiting for a static cycle', self._live.static > 0

    def _on_temperature(self, message: Temperature) -> None:
        try:
            self._live.add_temperature(messages.temperature(message))
        except messages.MessageError as error:
            self.get_logger().error(f'rtest/temperature: {error}', throttle_duration_sec=10.0)

    def _on_cycle(self, message: Cycle) -> None:
        try:
            cycle = messages.cycle(message)
        except messages.MessageError as error:
            self.get_logger().error(f'rtest/cycle: {error}')
            return
        if cycle.plan.session != self._live.session and self._live.session:
            self._live.clear()
            self._result = None
        self._live.add_cycle(cycle)
        if cycle.plan.kind is Kind.STATIC:
            self._due = True
            self._publish(cycle)

    def _publish(self, cycle: CycleRecord) -> None:
        """The errors by this cycle alone."""
        if self._machine is None:
            return
        try:
            result = self._live.alone(self._machine, cycle)
        except UserError as error:
            self.get_logger().warning(f'{cycle.plan.cycle}: {error}')
            return
        self._location.publish(publish.location_errors(result, cycle.stamp))
        for axis_map in result.maps:
            self._map.publish(publish.error_map(result, axis_map, cycle.stamp))

    def _evaluate(self) -> None:
        """All cycles so far, to thermal.json."""
        self._due = False
        if self._machine is None:
            return
        try:
            self._result, self._problem = self._live.result(self._machine), ''
            if self._out:
                output.write(self._result, Path(self._out))
        except UserError as error:
            self._problem = str(error)
            self.get_logger().warning(str(error))
        except OSError as error:
            self._refused(error)

    def _draw(self, result: Thermal) -> None:
        """The report of this result."""
        try:
            write_report(result, Path(self._out))
        except OSError as error:
            self._refused(error)

    def _refused(self, error: OSError) -> None:
        self._problem = f'{self._out}: cannot be written: {error.strerror or error}'
        self.get_logger().error(self._problem)

    def _on_finish(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._drawing.is_alive():
            self._drawing.join()
        # With the temperatures since the last cycle.
        self._evaluate()
        if self._out and self._result is not None:
            self._draw(self._result)
        response.success = self._result is not None and not self._problem
        response.message = self._summary()
        return response

    def _summary(self) -> str:
        if self._problem or self._result is None:
            return self._problem
        return words.summary(self._result)

    def _report(self) -> None:
        # Drawing takes seconds, and what comes meanwhile must not wait; it is drawn afterwards.
        if self._due and not self._drawing.is_alive():
            self._evaluate()
            # Of one cycle there is nothing to show yet.
            if self._out and self._result is not None and len(self._result.cycles) > 1:
                self._drawing = Thread(target=self._draw, args=(self._result,), daemon=True)
                self._drawing.start()
        warnings = self._result.warnings if self._result else ()
        level = diagnostics.WARN if warnings or self._problem else diagnostics.OK
        values = {f'warning {n + 1}': text for n, text in enumerate(warnings)}
        self._diagnostics.publish(
            diagnostics.status('thermal: session', level, self._summary(), values)
        )


def main(args: list[str] | None = None) -> int:
    """Entry point."""
    return run(ThermalNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
