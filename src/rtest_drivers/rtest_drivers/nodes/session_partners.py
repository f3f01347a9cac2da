"""The nodes that `session` works with: are they there, the drivers' states, the end of all."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.node import Node
from std_srvs.srv import Trigger

from rtest_drivers.nodes.session_heard import HEARD_S, Heard
from rtest_drivers.nodes.session_voice import Voice
from rtest_drivers.nodes.session_waiting import SessionError, Wait
from rtest_estimation.errors import UserError

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


class Partners:
    """Drivers, and the nodes that are closed after them.

    finishers : in the order in which they are closed
    ready_timeout : how long nodes and their subscriptions may take to appear [s]
    """

    def __init__(
        self,
        node: Node,
        drivers: Sequence[str],
        finishers: Sequence[str],
        ready_timeout: float,
        wait: Wait,
        voice: Voice,
        heard: Heard,
    ) -> None:
        self._node, self._drivers, self._finishers = node, drivers, finishers
        self._ready_timeout, self._wait = ready_timeout, wait
        self._voice, self._heard = voice, heard
        self._change = {
            name: node.create_client(ChangeState, f'{name}/change_state') for name in drivers
        }
        self._state = {
            name: node.create_client(GetState, f'{name}/get_state') for name in drivers
        }
        self._finish = {
            name: node.create_client(Trigger, f'{name}/finish') for name in finishers
        }

    def wait_for_nodes(self, simulated: bool) -> None:
        """Until all are in the graph.

        Raises SessionError naming those that are not, UserError where another session is there.
        """
        clients = {f'{name}/change_state': client for name, client in self._change.items()}
        clients |= {f'{name}/finish': client for name, client in self._finish.items()}

        def missing() -> list[str]:
            return [name for name, client in clients.items() if not client.service_is_ready()]

        if not self._wait(lambda: not missing(), self._ready_timeout):
            names = dict.fromkeys(service.split('/')[0] for service in missing())
            raise SessionError(
                f'after {self._ready_timeout:.0f} s these nodes are not in the graph: '
                f'{", ".join(names)} (their services {", ".join(missing())} are missing); start '
                'them in the same ROS domain and namespace'
            )
        # Who is found last may be another session. A simulated one has its domain for itself.
        self._wait(lambda: False, SETTLE_S if simulated else OTHERS_S)
        here = self._node.get_namespace()
        others = [
            space for name, space in self._node.get_node_names_and_namespaces()
            # A simulated clock is that of the whole domain.
            if name == self._node.get_name() and (simulated or space == here)
        ]
        if len(others) > 1:
            raise UserError('another session runs in this ROS domain; choose another domain')

    def wait_for(self, what: str, done: Callable[[], bool]) -> None:
        """Until something is so. Raises SessionError saying that there is no `what`."""
        if not self._wait(done, self._ready_timeout):
            raise SessionError(f'after {self._ready_timeout:.0f} s there is no {what}')

    def wait_for_listeners(self) -> None:
        """Until nobody misses the first reading. Raises SessionError naming who would."""
        self._voice.status = 'waiting for subscriptions'

        def missing() -> list[str]:
            gaps = []
            for topic in STREAMS:
                resolved = self._node.resolve_topic_name(topic)
                infos = self._node.get_subscriptions_info_by_topic(resolved)
                present = {info.node_name for info in infos}
                gaps += [f'{name} to {resolved}' for name in LISTENERS if name not in present]
            return gaps

        if not self._wait(lambda: not missing(), self._ready_timeout):
            raise SessionError(
                f'after {self._ready_timeout:.0f} s these subscriptions are missing: '
                f'{", ".join(missing())}; check remappings'
            )
        self._wait(lambda: False, SETTLE_S)

    def bring_to(self, goal: int) -> None:
        """Take the drivers, one after the other, from whatever state to inactive or active.

        Raises SessionError with what the driver says.
        """
        for driver in self._drivers:
            self._bring_to(driver, goal)

    def _bring_to(self, driver: str, goal: int) -> None:
        steps = {
            State.PRIMARY_STATE_UNCONFIGURED: (Transition.TRANSITION_CONFIGURE, 'configured'),
            State.PRIMARY_STATE_INACTIVE: (Transition.TRANSITION_ACTIVATE, 'activated'),
        }
        self._voice.status = f'preparing {driver}'
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
                self._wait(lambda: bool(self._heard.said.get(driver)), HEARD_S)
                why = self._heard.said.get(driver, '') or 'its log says why'
                raise SessionError(f'driver {driver} could not be {word}: {why}')

    def _ask_state(self, driver: str) -> GetState.Response:
        """The state of a driver; asked again where the answer was lost.

        A service is seen a little before its answers find their way back.
        """
        client, deadline = self._state[driver], time.monotonic() + SERVICE_TIMEOUT_S
        while time.monotonic() < deadline:
            future = client.call_async(GetState.Request())
            if self._wait(future.done, ANSWER_S):
                return future.result()
            client.remove_pending_request(future)
        raise SessionError(f'{driver}/get_state did not answer within {SERVICE_TIMEOUT_S:.0f} s')

    def _transition(self, driver: str, transition: int) -> bool:
        """Change the state of a driver; where the answer is lost its state tells."""
        request = ChangeState.Request(transition=Transition(id=transition))
        future = self._change[driver].call_async(request)
        deadline = time.monotonic() + SERVICE_TIMEOUT_S
        while not self._wait(future.done, ANSWER_S):
            if self._ask_state(driver).current_state.id == _REACHED[transition]:
                return True
            if time.monotonic() > deadline:
                raise SessionError(
                    f'{driver}/change_state did not answer within {SERVICE_TIMEOUT_S:.0f} s'
                )
        return future.result().success

    def close(self, before_each: Callable[[], None]) -> None:
        """Stop the drivers and finish the other nodes; what cannot be is a problem.

        before_each : called before each of the others is finished, when the last messages of the
            one before have arrived

        Raises SessionError where a node does not answer.
        """
        # All at once, so that feedback and readings end together as well as they can.
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        asked = {name: self._change[name].call_async(request) for name in reversed(self._drivers)}
        for name, future in asked.items():
            if not self._wait(future.done, SERVICE_TIMEOUT_S) or not future.result().success:
                self._voice.problem(f'driver {name} could not be deactivated')
        for name in self._finishers:
            # Let the last messages of the one before arrive.
            self._wait(lambda: False, SETTLE_S)
            before_each()
            answer = self._end(name)
            if answer.success:
                self._voice.say(f'{name}: {answer.message}')
            else:
                self._voice.problem(f'{name}: {answer.message}')

    def _end(self, name: str) -> Trigger.Response:
        future = self._finish[name].call_async(Trigger.Request())
        if not self._wait(future.done, SERVICE_TIMEOUT_S):
            raise SessionError(f'{name}/finish did not answer within {SERVICE_TIMEOUT_S:.0f} s')
        return future.result()
