"""Node `session`: wakes the drivers, starts one cycle after the other, closes the recording.

On a real machine somebody starts the NC program of each cycle, or the node does where the session
file says `run_programs`. A cycle whose program ends before its last pose, as after an E-stop, is
measured anew. The services `session/repeat` and `session/skip` (std_srvs/Trigger) measure it anew
at any time, or go on with the next one. `session/calibrate` measures the nest of the set-up anew
and then the cycle; `session/abort` ends the session with what there is. None of them stops the
machine.

The cycles of a thermal session begin at their times; one whose predecessor takes longer begins
after it and is told to be late.

Parameters
----------
config : session file (YAML)
session : name of the session
simulated : whether the time comes from a simulated cell
ready_timeout : how long the other nodes may take to appear [s]
cycle_timeout : how long a cycle may take [s]; 0 is an estimate from its path
hold : whether every cycle waits for the service `session/start`
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Iterator
from functools import partial
from itertools import count
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rtest_msgs.msg import Cycle, NestCalibration
from rtest_msgs.msg import CyclePlan as CyclePlanMessage
from std_msgs.msg import String
from std_srvs.srv import Trigger

from rtest_drivers.clock import HostClock
from rtest_drivers.graph import INCOMPLETE
from rtest_drivers.nodes.session_cycles import Cycles, Key
from rtest_drivers.nodes.session_heard import Heard
from rtest_drivers.nodes.session_measure import InSimulatedCell, OnMachine
from rtest_drivers.nodes.session_partners import Partners
from rtest_drivers.nodes.session_voice import Voice
from rtest_drivers.nodes.session_waiting import SessionError, Waiting
from rtest_drivers.provenance import TOPIC, provenance
from rtest_drivers.wishes import ABORT, CALIBRATE, GRANTED, START, Wishes
from rtest_estimation.errors import UserError
from rtest_estimation.nodes.qos import LATCHED, LATCHED_100
from rtest_estimation.records import CyclePlan, Kind
from rtest_identification.session_file import SessionConfig, load_session
from rtest_identification.urdf import describe

DRIVERS = ('gauges', 'cnc')
THERMOMETERS = 'thermometers'


class SessionNode(Node):
    """Runs a session from waiting for the other nodes to the closed recording.

    All waiting is done by spinning, so that the steps of a session read from top to bottom;
    time-outs are wall time, except those of the machine's motion. The other modules `session_*`
    hold what the steps need: `Partners` the other nodes, `Cycles` the plans and what came of them,
    `Heard` what is said on /diagnostics, `InSimulatedCell` or `OnMachine` how one cycle is carried
    out, `Voice` what is told.
    """

    def __init__(self) -> None:
        super().__init__('session')
        # Read once: who can call services of this node cannot name another file.
        fixed = ParameterDescriptor(read_only=True)
        self.session = self.declare_parameter('session', 'session', fixed).value
        self.simulated = self.declare_parameter('simulated', False, fixed).value
        ready_timeout = self.declare_parameter('ready_timeout', 30.0, fixed).value
        cycle_timeout = self.declare_parameter('cycle_timeout', 0.0, fixed).value
        self.hold = self.declare_parameter('hold', False, fixed).value
        config = self.declare_parameter('config', '', fixed).value
        self.config: SessionConfig = load_session(config)
        self._file = Path(config)
        more = (THERMOMETERS,) if self.config.reads_temperatures(self.simulated) else ()
        drivers = (*DRIVERS, *more)
        # Closed in this order: what the earlier one publishes last, the later one still needs.
        identifier = 'thermal' if self.config.every else 'identifier'
        finishers = ('estimator', *(() if self.config.checks else (identifier,)), 'recorder')
        # As the drivers' stamps, so that a clock that is set does not part plan and readings.
        self._host = HostClock()

        self._machine = self.create_publisher(String, 'rtest/machine', LATCHED)
        self._description = self.create_publisher(String, 'robot_description', LATCHED)
        self._provenance = self.create_publisher(String, TOPIC, LATCHED)
        plans = self.create_publisher(CyclePlanMessage, 'rtest/plan', LATCHED_100)
        self._wishes = Wishes()
        names = [plan.cycle for plan in self.config.plans]
        self._voice = Voice(self, self.session, names, self._wishes)
        self._wait = Waiting(self, self._voice.diagnose).wait
        heard = Heard(drivers, self._voice)
        self._cycles = Cycles(self.session, plans, self._now, self._wait, self._voice, heard)
        self.create_subscription(Cycle, 'rtest/cycle', self._cycles.on_cycle, LATCHED_100)
        self.create_subscription(NestCalibration, 'rtest/nest', self._cycles.on_nest, LATCHED)
        self.create_subscription(DiagnosticArray, '/diagnostics', heard.on_diagnostics, 100)
        self._partners = Partners(
            self, drivers, finishers, ready_timeout, self._wait, self._voice, heard
        )
        for wish in GRANTED:
            self.create_service(Trigger, f'~/{wish}', partial(self._on_wish, wish))
        needs = (
            self._now, self._wait, self._voice, heard, self._cycles, self._wishes, cycle_timeout
        )
        self._measuring = InSimulatedCell(*needs) if self.simulated else OnMachine(
            *needs, self._file.parent, self.config.devices.get('cnc')
        )

    def run(self) -> list[str]:
        """Run the session; returns what went wrong on the way, nothing when all went through.

        Raises SessionError where it cannot go on.
        """
        self._prepare()
        poses = sum(len(plan.commands) for plan in self.config.plans)
        self._voice.say(
            f'{self.config.machine.name}: {len(self.config.plans)} cycles, {poses} poses'
        )
        started = self._measure_all()
        if self._wishes.wish == ABORT:
            names = [p.cycle for p in self.config.plans if not started.get(p.cycle)]
            started = {cycle: keys for cycle, keys in started.items() if keys}
            self._voice.problem('ended as was asked for' + (
                f'; not measured: {", ".join(names)}' if names else ''
            ))
        self._voice.status = 'finishing'
        self._partners.close(self._cycles.tell_finished)
        if lost := self._cycles.lost(started):
            self._voice.problem(f'incomplete: nothing was measured in {", ".join(lost)}')
        self._voice.status = 'finished'
        self._voice.diagnose()
        return self._voice.problems

    def _prepare(self) -> None:
        """Wait for the other nodes, tell them of the machine, and wake the drivers."""
        self._partners.wait_for_nodes(self.simulated)
        if self.simulated:
            # The drivers are opened next, and need it.
            self._partners.wait_for('/clock of the simulated cell', lambda: self._now() > 0)
        self._machine.publish(String(data=self.config.machine.text))
        self._description.publish(String(data=describe(self.config)))
        self._provenance.publish(String(data=self._made_by()))
        self._partners.bring_to(State.PRIMARY_STATE_INACTIVE)
        self._partners.wait_for_listeners()
        self._partners.bring_to(State.PRIMARY_STATE_ACTIVE)

    def _measure_all(self) -> dict[str, list[Key]]:
        """One cycle after the other; by name, the keys of all attempts."""
        started = {}
        # Of the repeated cycles: when each is to begin.
        turns = self._turns()
        left = deque(enumerate(self.config.plans, 1))
        while left and self._wishes.wish != ABORT:
            number, plan = left.popleft()
            self._voice.cycle_number = number
            timed = self.config.every and plan.kind is Kind.STATIC and plan.cycle not in started
            keys = started.setdefault(plan.cycle, [])
            if self._may_start(plan):
                keys += self._measuring.measure(plan, next(turns) if timed else 0)
            if self._wishes.wish == CALIBRATE:
                left.extendleft(self._calibration(number, plan))
        return started

    def _turns(self) -> Iterator[int]:
        """Times at which repeated cycles begin [ns], from the first question on."""
        start = self._now()
        for number in count():
            yield start + round(number * self.config.every * 1e9)

    def _may_start(self, plan: CyclePlan) -> bool:
        """Wait until the cycle is asked for, where the session holds; whether it is."""
        wishes = self._wishes
        wishes.wish = ''
        if self.hold:
            wishes.held, self._voice.status = plan.cycle, f'{plan.cycle} waits to be started'
            self._voice.say_cycle(plan, '`rtest ask start` starts it')
            self._wait(lambda: bool(wishes.wish), math.inf)
            wishes.held = ''
            if wishes.wish != START:
                return False
            wishes.wish = ''
        return True

    def _calibration(self, number: int, plan: CyclePlan) -> list[tuple[int, CyclePlan]]:
        """The nest calibration of the cycle's set-up after the cycle itself: the last is next."""
        again = [
            (n, one) for n, one in enumerate(self.config.plans, 1)
            if one.kind is Kind.NEST_CALIBRATION and one.setup == plan.setup
        ]
        return again if plan.kind is Kind.NEST_CALIBRATION else [(number, plan), *again]

    def _made_by(self) -> str:
        devices = {} if self.simulated else self.config.devices
        files = {name: device.file for name, device in devices.items()}
        cycles = {plan.cycle: len(plan.commands) for plan in self.config.plans}
        return provenance(self.session, self._file, files, cycles)

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds if self.simulated else self._host.now()

    def _on_wish(
        self, wish: str, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        refused = self._wishes.refuses(wish, self.simulated and self._cycles.any_open)
        response.success = not refused
        if refused:
            response.message = f'{self._voice.status}; {refused}'
        else:
            cycle = self.config.plans[self._voice.cycle_number - 1].cycle
            self._wishes.wish, response.message = wish, f'{cycle} {GRANTED[wish]}'
        return response


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit status.

    0 when all went through, `INCOMPLETE` when the recording was closed but something is missing in
    it, 1 when the session could not go on, 2 for a user's mistake.
    """
    rclpy.init(args=args)
    try:
        problems = SessionNode().run()
    except UserError as error:
        print(f'session: {error}', file=sys.stderr)
        return 2
    except SessionError as error:
        print(f'session: {error}', file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        print('session: stopped before its end', file=sys.stderr)
        return 1
    finally:
        rclpy.try_shutdown()
    return INCOMPLETE if problems else 0


if __name__ == '__main__':
    sys.exit(main())
