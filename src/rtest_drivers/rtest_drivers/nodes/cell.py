"""The simulated machine cell as a process: the hardware behind the drivers, and the clock."""

from __future__ import annotations

import sys
import time
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rosgraph_msgs.msg import Clock as ClockMessage
from rtest_msgs.msg import CyclePlan

from rtest_drivers.cell_link import CNC, DEFAULT_ADDRESS, GAUGES, THERMOMETERS, CellServer
from rtest_drivers.nodes.driver import run
from rtest_drivers.sim.cell import Cell
from rtest_drivers.sim.truth import load_truth, unmet
from rtest_estimation.errors import UserError
from rtest_estimation.messages import MessageError, cycle_plan
from rtest_estimation.nodes import diagnostics
from rtest_estimation.nodes.publish import time as stamp
from rtest_estimation.nodes.qos import LATCHED_100

_TICK_S = 0.01
# After a pause (a slow driver, a busy computer) simulated time goes on, it does not catch up.
_LONGEST_TICK_S = 0.05
_STEP_NS = 200_000_000
# In a tick while the machine only warms up.
_WAITING_STEP_NS = 10_000_000_000


class CellNode(Node):
    """Node 'cell': simulated time, plans in, what the devices read out over the link.

    Simulated time stands still while a connected driver has not dealt with what it was sent. It
    runs at `rate`, faster while the cell waits long for a plan that is known already and its truth
    file has `waiting_read_every_s`.
    """

    def __init__(self) -> None:
        super().__init__('cell')
        truth = self._parameter('truth', '', 'path of the truth file (YAML)')
        address = self._parameter('address', DEFAULT_ADDRESS, 'path of the socket for the drivers')
        self._rate = self._parameter(
            'rate', 1.0, 'simulated seconds per second; 0: as fast as the drivers take it'
        )
        epoch = self._parameter('epoch', 0, 'start of simulated time [ns]; 0: now')
        if not truth:
            raise UserError('parameter truth: missing, give the path of a truth file')
        if not self._rate >= 0.0:
            raise UserError(f'parameter rate: expected 0 or more, got {self._rate}')
        self._cell = Cell(load_truth(truth), epoch or time.time_ns())
        self._server = CellServer(address)
        gauges = self._cell.truth.gauges
        one = f'{gauges.lower * 1e3:g} {gauges.upper * 1e3:g}'
        self._ranges = '; '.join([one] * len(gauges.tilt))
        self._address, self._refused = address, ''
        self._known: set[tuple[str, str, int]] = set()
        # Cycles that faults wait for, and what is to be told once.
        self._unplanned = {f.cycle for f in self._cell.truth.faults if f.cycle is not None}
        self._warnings: list[str] = []
        self._clock_publisher = self.create_publisher(ClockMessage, '/clock', 10)
        self._diagnostics = diagnostics.Diagnostics(self)
        self._plans = self.create_subscription(CyclePlan, 'rtest/plan', self._plan, LATCHED_100)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._woken = time.monotonic()
        self._ticker = self.create_timer(_TICK_S, self._tick, clock=steady)
        self._held, self._ticks = 0, 0
        self._reporter = self.create_timer(1.0, self._report, clock=steady)
        self._reported = (time.monotonic(), self._cell.now)

    def close(self) -> None:
        """Hang up on the drivers and remove the socket."""
        if self._unplanned:
            cycles = ', '.join(sorted(self._unplanned))
            self.get_logger().warning(f'faults never met: there was no cycle {cycles}')
        self._server.close()

    def _parameter(self, name: str, default: Any, description: str) -> Any:
        # An integer is a fine rate, and 0 a fine epoch: `-p rate:=20` must not be a type error.
        descriptor = ParameterDescriptor(description=description, dynamic_typing=True)
        return type(default)(self.declare_parameter(name, default, descriptor).value)

    def _plan(self, message: CyclePlan) -> None:
        try:
            plan = cycle_plan(message)
            key = (plan.session, plan.cycle, plan.stamp)
            if key in self._known:
                return
            self._cell.queue(plan)
        except (MessageError, UserError) as error:
            self._refused = f'plan refused: {error}'
            self.get_logger().error(self._refused)
            return
        self._refused = ''
        self._known.add(key)
        self._unplanned.discard(plan.cycle)
        faults = [f for f in self._cell.truth.faults if f.cycle == plan.cycle]
        for line in unmet(faults, {plan.cycle: len(plan.commands)}):
            self.get_logger().warning(line)
            self._warnings.append(line)
        self.get_logger().info(f'plan {plan.cycle}: {len(plan.commands)} poses')

    def _tick(self) -> None:
        woken = time.monotonic()
        passed, self._woken = min(woken - self._woken, _LONGEST_TICK_S), woken
        self._ticks += 1
        if self._rate:
            if self._server.taken:
                self._advance(round(self._rate * passed * 1e9))
                if (until := self._cell.waits_until) is not None:
                    self._advance(min(_WAITING_STEP_NS, until - self._cell.now))
            else:
                self._held += 1
        elif {GAUGES, CNC} <= set(self._server.connected):
            # As fast as possible starts when these drivers look on, not before.
            while time.monotonic() - woken < 0.8 * _TICK_S:
                if self._server.taken:
                    self._advance(_STEP_NS)
                else:
                    time.sleep(2e-4)
        self._clock_publisher.publish(ClockMessage(clock=stamp(self._cell.now)))

    def _advance(self, step: int) -> None:
        output = self._cell.advance(self._cell.now + step)
        self._server.send(GAUGES, output.blocks)
        self._server.send(CNC, output.feedback)
        self._server.send(THERMOMETERS, output.temperatures)

    def _report(self) -> None:
        now, cell = time.monotonic(), self._cell
        before, simulated = self._reported
        self._reported = (now, cell.now)
        text = 'waiting for a plan'
        if cell.busy and cell.run is not None:
            text = f'measuring {cell.run.plan.cycle}'
        elif cell.waiting:
            text = 'waiting for the start of a plan'
        held, ticks = self._held, max(self._ticks, 1)
        self._held = self._ticks = 0
        values = {
            'rate': f'{(cell.now - simulated) * 1e-9 / (now - before):.2f}',
            'waited_for_drivers': f'{100.0 * held / ticks:.0f} %',
            'connected': ', '.join(self._server.connected) or 'nobody',
            'plans_waiting': cell.waiting,
            'gauge_range_mm': self._ranges,
        }
        if self._unplanned:
            values['faults_wait_for'] = ', '.join(sorted(self._unplanned))
        level = diagnostics.OK
        if self._refused:
            level, text = diagnostics.ERROR, self._refused
        elif self._warnings:
            level, text = diagnostics.WARN, self._warnings.pop(0)
        status = diagnostics.status('cell: simulation', level, text, values)
        status.hardware_id = self._address
        self._diagnostics.publish(status)


def main(args: list[str] | None = None) -> int:
    """Entry point of the node."""
    return run(CellNode, args)


if __name__ == '__main__':
    sys.exit(main())
