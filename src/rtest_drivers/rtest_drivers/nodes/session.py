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
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.client import Client
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rtest_msgs.msg import Cycle, NestCalibration
from rtest_msgs.msg import CyclePlan as CyclePlanMessage
from std_msgs.msg import String
from std_srvs.srv import Trigger

from rtest_drivers.clock import HostClock
from rtest_drivers.cnc.programs import program_of, start_program
from rtest_drivers.graph import INCOMPLETE
from rtest_drivers.provenance import TOPIC, provenance
from rtest_drivers.schedule import NANOSECONDS, STOPPED_S, Progress, pose_count, turn
from rtest_estimation.errors import UserError
from rtest_estimation.missing import grouped
from rtest_estimation.nodes import diagnostics, publish
from rtest_estimation.nodes.qos import LATCHED, LATCHED_100
from rtest_estimation.records import CyclePlan, Kind, Missing, NestKind
from rtest_identification.session_file import (
    BY_HAND,
    UNATTENDED,
    SessionConfig,
    load_session,
)
from rtest_identification.urdf import describe

DRIVERS = ('gauges', 'cnc')
THERMOMETERS = 'thermometers'
# Who must not miss the first reading.
LISTENERS = ('recorder', 'estimator')
STREAMS = ('rtest/gauges', 'rtest/cnc/feedback')
# Wall time a service may take [s]: an identification of a long session is the longest.
SERVICE_TIMEOUT_S = 120.0
# After this time an answer is taken for lost [s].
ANSWER_S = 5.0
_REACHED = {
    Transition.TRANSITION_CONFIGURE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_ACTIVATE: State.PRIMARY_STATE_ACTIVE,
    Transition.TRANSITION_DEACTIVATE: State.PRIMARY_STATE_INACTIVE,
}
# A subscription is seen in the graph a little before its publisher has matched it [s].
SETTLE_S = 0.5
# All nodes of a busy graph are found after this time [s].
OTHERS_S = 3.0
# How often progress is told: of a simulated cycle, of a real one [s].
PROGRESS_S, SLOW_PROGRESS_S = 2.0, 10.0
# Warnings of these nodes are told at the end, or are our own.
QUIET = ('identifier', 'thermal', 'session')
# A simulated clock that stands still this long has lost its cell [s].
CLOCK_TIMEOUT_S = 30.0
# An NC program that has ended for so long has left its cycle: the estimator would have finished
# it by now [s].
ENDED_S = 5.0
# The CNC driver tells its state as often, twice over [s].
HEARD_S = 1.0
REPEAT, SKIP = 'repeat', 'skip'
START, CALIBRATE, ABORT = 'start', 'calibrate', 'abort'
# What then happens to the cycle.
GRANTED = {
    START: 'starts',
    REPEAT: 'is measured anew',
    SKIP: 'is left',
    CALIBRATE: 'is measured anew after a calibration of the nest',
    ABORT: 'ends, and the session with it',
}
# What the CNC driver says where no NC program runs.
IDLE = 'IDLE'


_NUMBERS = re.compile(r'[\d., ]+')


class SessionError(RuntimeError):
    """The session cannot go on; says what did not happen."""


class SessionNode(Node):
    """Runs a session from waiting for the other nodes to the closed recording.

    All waiting is done by spinning in `wait`, so that the steps of a session read from top to
    bottom; time-outs are wall time, except those of the machine's motion.
    """

    def __init__(self) -> None:
        super().__init__('session')
        # Read once: who can call services of this node cannot name another file.
        fixed = ParameterDescriptor(read_only=True)
        self.session = self.declare_parameter('session', 'session', fixed).value
        self.simulated = self.declare_parameter('simulated', False, fixed).value
        self.ready_timeout = self.declare_parameter('ready_timeout', 30.0, fixed).value
        self.cycle_timeout = self.declare_parameter('cycle_timeout', 0.0, fixed).value
        self.hold = self.declare_parameter('hold', False, fixed).value
        config = self.declare_parameter('config', '', fixed).value
        self.config: SessionConfig = load_session(config)
        self._file, self._folder = Path(config), Path(config).parent
        more = (THERMOMETERS,) if self.config.reads_temperatures(self.simulated) else ()
        self._drivers = (*DRIVERS, *more)
        # Closed in this order: what the earlier one publishes last, the later one still needs.
        identifier = 'thermal' if self.config.every else 'identifier'
        self._finishers = ('estimator', identifier, 'recorder')
        # As the drivers' stamps, so that a clock that is set does not part plan and readings.
        self._host = HostClock()

        self._machine = self.create_publisher(String, 'rtest/machine', LATCHED)
        self._description = self.create_publisher(String, 'robot_description', LATCHED)
        self._provenance = self.create_publisher(String, TOPIC, LATCHED)
        self._plans = self.create_publisher(CyclePlanMessage, 'rtest/plan', LATCHED_100)
        self._diagnostics = diagnostics.Diagnostics(self)
        self.create_subscription(Cycle, 'rtest/cycle', self._on_cycle, LATCHED_100)
        self.create_subscription(NestCalibration, 'rtest/nest', self._on_nest, LATCHED)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)
        self._change = {
            name: self.create_client(ChangeState, f'{name}/change_state')
            for name in self._drivers
        }
        self._state = {
            name: self.create_client(GetState, f'{name}/get_state') for name in self._drivers
        }
        self._finish = {
            name: self.create_client(Trigger, f'{name}/finish') for name in self._finishers
        }
        for wish in GRANTED:
            self.create_service(Trigger, f'~/{wish}', partial(self._on_wish, wish))

        self._spinner = SingleThreadedExecutor()
        self._spinner.add_node(self)
        self._started = self._reported = time.monotonic()
        self._cycles: dict[tuple[str, int], Cycle] = {}
        self._nests: dict[str, NestCalibration] = {}
        self._open: dict[tuple[str, int], CyclePlan] = {}
        self._poses_done: tuple[str, int, int, int] | None = None
        self._feedback_age: float | None = None
        self._finished: dict[str, dict[str, str]] = {}
        self._complaints: dict[tuple[str, str], tuple[int, str]] = {}
        self._problems: list[str] = []
        self._status = 'waiting for the other nodes'
        self._cycle_number = 0
        self._wish, self._held, self._following = '', '', False
        # What each driver last said, and the state of the NC program: since when it has not run.
        self._said: dict[str, str] = {}
        self._heard = 0
        self._program: str | None = None
        self._tells_program, self._ran, self._ended = False, False, math.nan

    # ---- the session, step by step ----

    def run(self) -> list[str]:
        """Run the session; returns what went wrong on the way, nothing when all went through.

        Raises SessionError where it cannot go on.
        """
        self._wait_for_nodes()
        if self.simulated:
            # The drivers are opened next, and need it.
            self._wait_for('/clock of the simulated cell', lambda: self._now() > 0)
        self._machine.publish(String(data=self.config.machine.text))
        self._description.publish(String(data=describe(self.config)))
        self._provenance.publish(String(data=self._made_by()))
        for name in self._drivers:
            self._bring_to(name, State.PRIMARY_STATE_INACTIVE)
        self._wait_for_listeners()
        for name in self._drivers:
            self._bring_to(name, State.PRIMARY_STATE_ACTIVE)
        poses = sum(len(plan.commands) for plan in self.config.plans)
        self.say(f'{self.config.machine.name}: {len(self.config.plans)} cycles, {poses} poses')
        started = {}
        # Of the repeated cycles: when each is to begin.
        turns = self._turns()
        left = deque(enumerate(self.config.plans, 1))
        while left and self._wish != ABORT:
            self._cycle_number, plan = left.popleft()
            timed = self.config.every and plan.kind is Kind.STATIC and plan.cycle not in started
            keys = started.setdefault(plan.cycle, [])
            if self._may_start(plan):
                measure = self._measure if self.simulated else self._measure_on_machine
                keys += measure(plan, next(turns) if timed else 0)
            if self._wish == CALIBRATE:
                left.extendleft(self._calibration(self._cycle_number, plan))
        if self._wish == ABORT:
            names = [p.cycle for p in self.config.plans if not started.get(p.cycle)]
            started = {cycle: keys for cycle, keys in started.items() if keys}
            self._problem('ended as was asked for' + (
                f'; not measured: {", ".join(names)}' if names else ''
            ))
        self._status = 'finishing'
        self._close()
        self._judge(started)
        self._status = 'finished'
        self._diagnose()
        return self._problems

    def _turns(self) -> Iterator[int]:
        """Times at which repeated cycles begin [ns], from the first question on."""
        start = self._now()
        for number in count():
            yield start + round(number * self.config.every * 1e9)

    def _made_by(self) -> str:
        devices = {} if self.simulated else self.config.devices
        files = {name: device.file for name, device in devices.items()}
        cycles = {plan.cycle: len(plan.commands) for plan in self.config.plans}
        return provenance(self.session, self._file, files, cycles)

    def _wait_for_nodes(self) -> None:
        clients = {f'{name}/change_state': client for name, client in self._change.items()}
        clients |= {f'{name}/finish': client for name, client in self._finish.items()}

        def missing() -> list[str]:
            return [name for name, client in clients.items() if not client.service_is_ready()]

        if not self.wait(lambda: not missing(), self.ready_timeout):
            names = dict.fromkeys(service.split('/')[0] for service in missing())
            raise SessionError(
                f'after {self.ready_timeout:.0f} s these nodes are not in the graph: '
                f'{", ".join(names)} (their services {", ".join(missing())} are missing); start '
                'them in the same ROS domain and namespace'
            )
        # Who is found last may be another session. A simulated one has its domain for itself.
        self.wait(lambda: False, SETTLE_S if self.simulated else OTHERS_S)
        here = self.get_namespace()
        others = [
            space for name, space in self.get_node_names_and_namespaces()
            # A simulated clock is that of the whole domain.
            if name == self.get_name() and (self.simulated or space == here)
        ]
        if len(others) > 1:
            raise UserError('another session runs in this ROS domain; choose another domain')

    def _wait_for_listeners(self) -> None:
        self._status = 'waiting for subscriptions'

        def missing() -> list[str]:
            gaps = []
            for topic in STREAMS:
                resolved = self.resolve_topic_name(topic)
                present = {i.node_name for i in self.get_subscriptions_info_by_topic(resolved)}
                gaps += [f'{name} to {resolved}' for name in LISTENERS if name not in present]
            return gaps

        if not self.wait(lambda: not missing(), self.ready_timeout):
            raise SessionError(
                f'after {self.ready_timeout:.0f} s these subscriptions are missing: '
                f'{", ".join(missing())}; check remappings'
            )
        self.wait(lambda: False, SETTLE_S)

    def _bring_to(self, driver: str, goal: int) -> None:
        """Take a driver from whatever state it is in to inactive or active."""
        steps = {
            State.PRIMARY_STATE_UNCONFIGURED: (Transition.TRANSITION_CONFIGURE, 'configured'),
            State.PRIMARY_STATE_INACTIVE: (Transition.TRANSITION_ACTIVATE, 'activated'),
        }
        self._status = f'preparing {driver}'
        while True:
            answer = self._ask_state(driver)
            state = answer.current_state.id
            # Somebody else may have activated the driver already; that is as good.
            if state == goal or state == State.PRIMARY_STATE_ACTIVE:
                return
            if state not in steps:
                raise SessionError(f'driver {driver} is {answer.current_state.label}; restart it')
            transition, word = steps[state]
            if not self._transition(driver, transition):
                self.wait(lambda: bool(self._said.get(driver)), HEARD_S)
                why = self._said.get(driver, '') or 'its log says why'
                raise SessionError(f'driver {driver} could not be {word}: {why}')

    def _ask_state(self, driver: str) -> GetState.Response:
        """The state of a driver; asked again where the answer was lost.

        A service is seen a little before its answers find their way back.
        """
        client, deadline = self._state[driver], time.monotonic() + SERVICE_TIMEOUT_S
        while time.monotonic() < deadline:
            future = client.call_async(GetState.Request())
            if self.wait(future.done, ANSWER_S):
                return future.result()
            client.remove_pending_request(future)
        raise SessionError(f'{driver}/get_state did not answer within {SERVICE_TIMEOUT_S:.0f} s')

    def _transition(self, driver: str, transition: int) -> bool:
        """Change the state of a driver; where the answer is lost its state tells."""
        request = ChangeState.Request(transition=Transition(id=transition))
        future = self._change[driver].call_async(request)
        deadline = time.monotonic() + SERVICE_TIMEOUT_S
        while not self.wait(future.done, ANSWER_S):
            if self._ask_state(driver).current_state.id == _REACHED[transition]:
                return True
            if time.monotonic() > deadline:
                raise SessionError(
                    f'{driver}/change_state did not answer within {SERVICE_TIMEOUT_S:.0f} s'
                )
        return future.result().success

    def _may_start(self, plan: CyclePlan) -> bool:
        """Wait until the cycle is asked for, where the session holds; whether it is."""
        self._wish = ''
        if self.hold:
            self._held, self._status = plan.cycle, f'{plan.cycle} waits to be started'
            self._say_cycle(plan, '`rtest ask start` starts it')
            self.wait(lambda: bool(self._wish), math.inf)
            self._held = ''
            if self._wish != START:
                return False
            self._wish = ''
        return True

    def _calibration(self, number: int, plan: CyclePlan) -> list[tuple[int, CyclePlan]]:
        """The nest calibration of the cycle's set-up after the cycle itself: the last is next."""
        again = [
            (n, one) for n, one in enumerate(self.config.plans, 1)
            if one.kind is Kind.NEST_CALIBRATION and one.setup == plan.setup
        ]
        return again if plan.kind is Kind.NEST_CALIBRATION else [(number, plan), *again]

    def _tell_turn(self, plan: CyclePlan, due: int) -> None:
        """Say when a repeated cycle is to begin, or that it is late. due : [ns], 0 for at once."""
        text, late = turn(due, self._now()) if due else ('', False)
        if late:
            self.get_logger().warning(f'{plan.cycle}: {text}')
        if text:
            self._status = f'waiting for {plan.cycle}'
            self._say_cycle(plan, text)

    def _measure(self, plan: CyclePlan, due: int) -> list[tuple[str, int]]:
        """Publish one plan and wait for its finished cycle; returns its key.

        Goes on where the cycle has stopped; it is then finished by the next plan or at the end.

        due : when it is to begin [ns]. The plan is published at once: a simulated cell that knows
            for how long it has nothing to do lets that time pass quickly
        """
        self._tell_turn(plan, due)
        key = self._start(plan, due)
        shown, told = time.monotonic(), 0
        progress = Progress(plan, key[1], shown, self.cycle_timeout)
        while key not in self._cycles:
            self.wait(lambda: key in self._cycles, 0.2)
            self._tell_finished()
            now, wall = self._now(), time.monotonic()
            if progress.clock_stands(now, wall) > CLOCK_TIMEOUT_S:
                raise SessionError(f'{plan.cycle}: the clock has stood still for '
                                   f'{CLOCK_TIMEOUT_S:.0f} s; is the simulated cell running?')
            if key in self._cycles or self._wish == ABORT:
                break
            done, poses = self._progress(key)
            if done:
                self._status = f'measuring {plan.cycle}'
            if why := progress.stopped(now, wall, done, self._feedback_age):
                self.get_logger().warning(f'{plan.cycle}: {why}')
                self._say_cycle(plan, f'{why}; going on')
                break
            if wall - shown > PROGRESS_S and told < done < poses:
                shown, told = wall, done
                self._say_cycle(plan, f'{done} of {poses} poses')
        return [key]

    def _measure_on_machine(self, plan: CyclePlan, due: int) -> list[tuple[str, int]]:
        """Measure a cycle whose NC program runs on a real machine; the keys of all attempts.

        Waits as long as it takes until somebody starts the program. due : when it is to begin [ns]
        """
        self._tell_turn(plan, due)
        self._wish = ''
        self._following = True
        while (left := (due - self._now()) / NANOSECONDS) > 0.0:
            if self.wait(lambda: self._wish in (SKIP, CALIBRATE, ABORT), left):
                self._following = False
                self._say_cycle(plan, f'{self._wish}, as was asked for')
                return []
        self._following = False
        device = self.config.devices.get('cnc')
        by_hand = device is None or device.programs == BY_HAND
        keys = []
        while True:
            self._wait_for_end_of_program(plan)
            self._wish = ''
            keys.append(self._start(plan))
            if not by_hand:
                # Once: after an E-stop only a person starts a machine again.
                by_hand = not self._start_program(plan)
            if by_hand:
                self._say_cycle(plan, f'start {self._program_name(plan)}')
            by_hand = True
            self._following = True
            again = self._follow(plan, keys[-1])
            self._following = False
            if not again:
                return keys

    def _follow(self, plan: CyclePlan, key: tuple[str, int]) -> bool:
        """Wait for a cycle on a real machine; whether it is to be measured anew."""
        shown, told, complained = time.monotonic(), 0, False
        progress = Progress(plan, key[1], shown, self.cycle_timeout, attended=True)
        while key not in self._cycles and not self._wish:
            self.wait(lambda: key in self._cycles or bool(self._wish), 0.2)
            self._tell_finished()
            wall = time.monotonic()
            done, poses = self._progress(key)
            ran = self._ran if self._tells_program else done > 0
            if ran and wall - self._ended > ENDED_S and key not in self._cycles:
                self._say_cycle(
                    plan, f'{done} of {len(plan.commands)} poses, and the program has ended'
                    f'{self._why()}; the cycle is measured anew, or `rtest ask skip`'
                )
                return True
            why = progress.stopped(self._now(), wall, done, self._feedback_age)
            if why and not complained:
                self.get_logger().warning(f'{plan.cycle}: {why}')
                self._say_cycle(
                    plan, f'{why}{self._why()}; go on with the program, or `rtest ask repeat` to '
                    'measure the cycle anew, `rtest ask skip` to leave it'
                )
            complained = bool(why)
            if wall - shown > SLOW_PROGRESS_S and told < done < poses:
                shown, told = wall, done
                self._say_cycle(plan, f'{done} of {poses} poses')
        if self._wish and key not in self._cycles:
            self._say_cycle(plan, f'{self._wish}, as was asked for')
        return self._wish == REPEAT

    def _start(self, plan: CyclePlan, due: int = 0) -> tuple[str, int]:
        """Publish a plan; returns the key of its cycle. The one before ends with it.

        due : when the cycle begins [ns]; at once where that is past
        """
        stamp = max(self._now(), due)
        key = (plan.cycle, stamp)
        self._status = f'{"waiting for" if due > self._now() else "measuring"} {plan.cycle}'
        self._poses_done = self._feedback_age = None
        self._ran = False
        self._open[key] = plan
        self._plans.publish(
            publish.cycle_plan(replace(plan, session=self.session, stamp=stamp))
        )
        return key

    def _progress(self, key: tuple[str, int]) -> tuple[int, int]:
        """Poses of the cycle that were reached so far, and all of them."""
        cycle, stamp, done, poses = self._poses_done or ('', 0, 0, 0)
        return (done, poses) if (cycle, stamp) == key else (0, poses)

    def _wait_for_end_of_program(self, plan: CyclePlan) -> None:
        """The program of the cycle before still moves the sphere out of the nest."""
        heard = self._heard
        self.wait(lambda: self._heard > heard + 1, 2.0 * HEARD_S)
        if self._program in (None, IDLE):
            return
        self._status = 'waiting for the end of the NC program'
        if not self.wait(lambda: self._program in (None, IDLE), STOPPED_S):
            self._say_cycle(plan, 'the program before still runs; end it')
            self.wait(lambda: self._program in (None, IDLE), math.inf)

    def _start_program(self, plan: CyclePlan) -> bool:
        """Start the program of a cycle; False where it has to be started by hand."""
        device, program = self.config.devices['cnc'], program_of(plan.cycle, self._folder)
        unattended = device.programs == UNATTENDED
        try:
            start_program(str(device.file), program.absolute(), unattended)
        except (UserError, ConnectionError) as error:
            self._say_cycle(plan, str(error))
            return False
        waits = '' if unattended else '; when the sphere is clear of the nest let it go on'
        self._say_cycle(plan, f'{program.name} started: {len(plan.commands)} poses{waits}')
        return True

    def _program_name(self, plan: CyclePlan) -> str:
        """For example `program 1a-static.ngc: 86 poses`."""
        program = program_of(plan.cycle, self._folder)
        name = f'program {program.name}' if program else f'the NC program of {plan.cycle}'
        return f'{name}: {len(plan.commands)} poses'

    def _why(self) -> str:
        said = self._said.get('cnc', '')
        return f' ({said})' if said else ''

    def _tell_finished(self) -> None:
        """Tell the outcome of every cycle that has come, also of one that had stopped before."""
        for key, plan in list(self._open.items()):
            if key in self._cycles:
                del self._open[key]
                self._say_cycle(plan, self._outcome(plan, self._cycles[key]))
                self._finished.pop(plan.cycle, None)

    def _outcome(self, plan: CyclePlan, cycle: Cycle) -> str:
        text = pose_count(len(plan.commands), len(cycle.points), len(cycle.missing))
        if cycle.missing:
            # The reasons are on another topic and may come a moment later.
            self.wait(lambda: plan.cycle in self._finished, 1.0)
            reasons = self._finished.get(plan.cycle, {})
            missing = [
                Missing(int(pose.removeprefix('pose ')), reason)
                for pose, reason in reasons.items()
                if pose.startswith('pose ')
            ]
            # Every reason is told with the result of the session.
            first, *more = grouped(missing) or ['']
            text += f' ({first}{"; ..." if more else ""})' if first else ''
        if plan.kind is Kind.DYNAMIC and not cycle.missing:
            return 'recorded'
        if plan.kind is Kind.NEST_CALIBRATION:
            # The calibration is on another topic and may come a moment later.
            self.wait(lambda: cycle.calibration in self._nests, 1.0 if cycle.calibration else 0.0)
            nest = self._nests.get(cycle.calibration)
            text += f', residual {nest.residual * 1e6:.2f} µm' if nest else ', no calibration'
            if nest and nest.kind == NestKind.LASER:
                text += ' before the correction'
        return text

    def _judge(self, started: dict[str, list[tuple[str, int]]]) -> None:
        """A cycle that says nothing is a problem; single missing poses are not."""
        lost = [
            name for name, keys in started.items()
            if not any(key in self._cycles and _says(self._cycles[key]) for key in keys)
        ]
        if lost:
            self._problem(f'incomplete: nothing was measured in {", ".join(lost)}')

    def _close(self) -> None:
        # All at once: a dwell that has no end is taken to be at the end of the feedback, and needs
        # readings there; and feedback that ends before the readings is stale.
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        asked = {name: self._change[name].call_async(request) for name in reversed(self._drivers)}
        for name, future in asked.items():
            if not self.wait(future.done, SERVICE_TIMEOUT_S) or not future.result().success:
                self._problem(f'driver {name} could not be deactivated')
        for name in self._finishers:
            # Let the last messages of the one before arrive.
            self.wait(lambda: False, SETTLE_S)
            self._tell_finished()
            answer = self._call(self._finish[name], Trigger.Request(), f'{name}/finish')
            if answer.success:
                self.say(f'{name}: {answer.message}')
            else:
                self._problem(f'{name}: {answer.message}')

    # ---- waiting, saying ----

    def wait(self, done: Callable[[], bool], timeout: float) -> bool:
        """Spin until `done()` or `timeout` seconds of wall time; returns whether it is done."""
        deadline = time.monotonic() + timeout
        while not done():
            left = deadline - time.monotonic()
            if left <= 0.0:
                return False
            self._spinner.spin_once(timeout_sec=min(left, 0.1))
            if time.monotonic() - self._reported >= 1.0:
                self._reported = time.monotonic()
                self._diagnose()
        return True

    def _wait_for(self, what: str, done: Callable[[], bool]) -> None:
        if not self.wait(done, self.ready_timeout):
            raise SessionError(f'after {self.ready_timeout:.0f} s there is no {what}')

    def _call(self, client: Client, request: Any, what: str) -> Any:
        future = client.call_async(request)
        if not self.wait(future.done, SERVICE_TIMEOUT_S):
            raise SessionError(f'{what} did not answer within {SERVICE_TIMEOUT_S:.0f} s')
        return future.result()

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds if self.simulated else self._host.now()

    def say(self, text: str) -> None:
        """One line of progress for the person who waits."""
        print(f'[{time.monotonic() - self._started:3.0f} s] {text}', flush=True)

    def _say_cycle(self, plan: CyclePlan, text: str) -> None:
        names = [one.cycle for one in self.config.plans]
        self.say(f'{names.index(plan.cycle) + 1}/{len(names)} {plan.cycle}: {text}')

    def _problem(self, text: str) -> None:
        self._problems.append(text)
        self.get_logger().warning(text)
        self.say(text)
        self._diagnose()

    # ---- messages ----

    def _on_cycle(self, message: Cycle) -> None:
        if message.plan.session == self.session:
            stamp = message.plan.header.stamp
            key = (message.plan.cycle, stamp.sec * NANOSECONDS + stamp.nanosec)
            known = self._cycles.get(key)
            # Somebody else's estimator may take our plans too, and have nothing to say of them.
            if known is None or len(message.points) > len(known.points):
                self._cycles[key] = message

    def _on_nest(self, message: NestCalibration) -> None:
        self._nests[message.calibration] = message

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name == 'estimator: cycle':
                if {'cycle', 'started', 'poses_done', 'poses'} <= values.keys():
                    numbers = (int(values[key]) for key in ('started', 'poses_done', 'poses'))
                    self._poses_done = (values['cycle'], *numbers)
                age = values.get('feedback_age_s')
                self._feedback_age = math.inf if age is None else float(age)
            elif status.name == 'estimator: finished cycle':
                self._finished[status.message.partition(':')[0]] = values
                continue
            self._note_driver(status, values)
            source = status.name.strip('/').split(':')[0]
            worse = status.level in (diagnostics.WARN, diagnostics.ERROR)
            if worse and source not in QUIET and self._is_new(source, status.message):
                self.say(f'{source}: {status.message}')

    def _is_new(self, source: str, text: str) -> bool:
        """Whether a complaint is to be told: once per cycle, and not again while it is the same.

        It may carry numbers that change every second.
        """
        kind = _NUMBERS.sub('', text)
        cycle, last = self._complaints.get((source, kind), (-1, ''))
        if cycle == self._cycle_number or text == last:
            return False
        self._complaints[source, kind] = (self._cycle_number, text)
        return True

    def _note_driver(self, status: DiagnosticStatus, values: dict[str, str]) -> None:
        """What a driver says, and whether an NC program runs."""
        name = status.name.rpartition('/')[2].partition(':')[0]
        if name not in self._drivers:
            return
        self._said[name] = '' if status.level == diagnostics.OK else status.message
        if name != 'cnc':
            return
        self._heard += 1
        program = values.get('program') or None
        self._tells_program |= program is not None
        if program is None and values.get('estop') == 'on':
            program = IDLE
        if program is not None and program != IDLE:
            self._ran, self._ended = True, math.nan
        elif self._program != program:
            self._ended = time.monotonic() if program == IDLE else math.nan
        self._program = program

    def _on_wish(
        self, wish: str, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        refused = self._refuses(wish)
        response.success = not refused
        if refused:
            response.message = f'{self._status}; {refused}'
        else:
            cycle = self.config.plans[self._cycle_number - 1].cycle
            self._wish, response.message = wish, f'{cycle} {GRANTED[wish]}'
        return response

    def _refuses(self, wish: str) -> str:
        """Why a wish cannot be granted; '' where it can."""
        if wish == START:
            return '' if self._held else 'no cycle waits to be started'
        if self._held:
            return 'there is nothing to repeat' if wish == REPEAT else ''
        # A simulated cycle needs nobody, and goes on to its end before a calibration. Otherwise a
        # wish would be remembered, and meet a cycle that nobody meant.
        interrupts = wish in (REPEAT, SKIP)
        if self._following or (self.simulated and self._open and not interrupts):
            return ''
        return f'there is nothing to {"repeat or skip" if interrupts else wish}'

    def _diagnose(self) -> None:
        level = diagnostics.WARN if self._problems else diagnostics.OK
        text = self._problems[-1] if self._problems else self._status
        values = {
            'session': self.session,
            'state': self._status,
            'cycle': self._cycle_number,
            'cycles': len(self.config.plans),
            'problems': len(self._problems),
            'waits_for_start': self._held,
        }
        self._diagnostics.publish(diagnostics.status('session: progress', level, text, values))


def _says(cycle: Cycle) -> bool:
    """Whether a finished cycle says anything.

    Displacements of poses count from the first point: alone it is zero. A dynamic cycle has
    readings only, of which those between its poses count.
    """
    if cycle.plan.kind == Kind.DYNAMIC:
        return len(cycle.plan.commands) // len(cycle.plan.axes) - len(cycle.missing) > 1
    return len(cycle.points) > 1


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
