"""Cell, gauge driver and CNC driver as processes over DDS."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')
pytest.importorskip('rtest_msgs.msg')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from geometry_msgs.msg import Point  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState, GetState  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from rtest_msgs.msg import CyclePlan, GaugeSamples  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from rtest_estimation import messages  # noqa: E402
from rtest_estimation.nodes.qos import LATCHED_100, STREAM  # noqa: E402

pytestmark = pytest.mark.graph

CONFIG = Path(__file__).parents[1] / 'src' / 'rtest_drivers' / 'config'
DOMAIN = '82'
EPOCH = 1_700_000_000_000_000_000


class Graph:
    """Processes of the nodes, and a node of this process that listens to them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.address = str(folder / 'cell.sock')
        self.environment = {
            **os.environ,
            'ROS_DOMAIN_ID': DOMAIN,
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        }
        os.environ.update(self.environment)
        self.processes: dict[str, subprocess.Popen] = {}
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('listener', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.blocks, self.feedback, self.clock, self.diagnostics = [], [], [], {}
        self.node.create_subscription(GaugeSamples, 'rtest/gauges', self.blocks.append, STREAM)
        self.node.create_subscription(
            JointState, 'rtest/cnc/feedback', self.feedback.append, STREAM
        )
        self.node.create_subscription(Clock, '/clock', self.clock.append, 10)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._diagnose, 100)
        self.plans = self.node.create_publisher(CyclePlan, 'rtest/plan', LATCHED_100)

    def _diagnose(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.diagnostics[status.name.split(':')[0]] = status

    def start(self, name: str, **parameters: object) -> None:
        arguments = ['--ros-args']
        for key, value in parameters.items():
            arguments += ['-p', f'{key}:={value}']
        with (self.folder / f'{name}.log').open('ab') as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, '-m', f'rtest_drivers.nodes.{name}', *arguments],
                env=self.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def stop(self, name: str, signum: int = signal.SIGINT) -> int:
        process = self.processes.pop(name)
        process.send_signal(signum)
        return process.wait(timeout=10.0)

    def close(self) -> None:
        for name in list(self.processes):
            self.stop(name, signal.SIGKILL)
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def log(self, name: str) -> str:
        return (self.folder / f'{name}.log').read_text()

    def until(self, condition, timeout: float = 20.0) -> None:
        limit = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < limit, {
                name: self.log(name)[-2000:] for name in self.processes
            }
            self.executor.spin_once(timeout_sec=0.02)

    def call(self, service: type, name: str, request: object) -> object:
        client = self.node.create_client(service, name)
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        self.node.destroy_client(client)
        return future.result()

    def change(self, driver: str, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return self.call(ChangeState, f'{driver}/change_state', request).success

    def state(self, driver: str) -> str:
        return self.call(GetState, f'{driver}/get_state', GetState.Request()).current_state.label

    def both(self, transition: int) -> None:
        for driver in ('gauges', 'cnc'):
            assert self.change(driver, transition)

    def status(self, name: str, level: bytes, text: str) -> None:
        """Wait for a diagnostic status."""

        def seen() -> bool:
            status = self.diagnostics.get(name)
            return status is not None and status.level == level and text in status.message

        self.until(seen)


@pytest.fixture
def graph(tmp_path: Path):
    graph = Graph(tmp_path)
    yield graph
    graph.close()


def start_all(graph: Graph, rate: float = 20.0, truth: Path = CONFIG / 'cell_demo.yaml') -> None:
    graph.start('cell', truth=truth, rate=rate, epoch=EPOCH, address=graph.address)
    for driver in ('gauges', 'cnc'):
        graph.start(driver, backend='cell', address=graph.address, use_sim_time='true')
    graph.until(lambda: graph.clock and Path(graph.address).exists())


def plan() -> CyclePlan:
    commands = np.array([[0, -0.09, 0.0406, 0, 0], [1e-3, -0.09, 0.0406, 0, 0]])
    message = CyclePlan(
        session='s', cycle='1a-nest', kind=CyclePlan.NEST_CALIBRATION, setup='1a',
        sphere=Point(x=0.0, y=-0.09, z=0.0406), axes=list('XYZBC'), dwell=0.3,
        commands=commands.ravel().tolist(),
    )
    message.header.frame_id = 'machine'
    message.header.stamp.sec = EPOCH // 10**9
    return message


def test_life_of_the_drivers(graph: Graph) -> None:
    start_all(graph)
    assert graph.state('gauges') == graph.state('cnc') == 'unconfigured'
    graph.both(Transition.TRANSITION_CONFIGURE)
    assert graph.state('gauges') == 'inactive'
    # Inactive drivers take what comes and publish nothing, and the cell goes on.
    before = len(graph.clock)
    graph.until(lambda: len(graph.clock) > before + 50)
    assert not graph.blocks and not graph.feedback
    graph.plans.publish(plan())
    graph.both(Transition.TRANSITION_ACTIVATE)
    graph.until(lambda: len(graph.blocks) > 100 and len(graph.feedback) > 1000)
    graph.status('gauges', DiagnosticStatus.OK, 'active')
    graph.status('cnc', DiagnosticStatus.OK, 'active')
    graph.status('cell', DiagnosticStatus.OK, 'waiting for a plan')
    values = {item.key: item.value for item in graph.diagnostics['gauges'].values}
    assert values['rate_hz'] == '50.0' and values['losses'] == '0'
    graph.both(Transition.TRANSITION_DEACTIVATE)
    first = len(graph.blocks)
    blocks = [messages.gauge_block(message) for message in graph.blocks]
    assert [block.sequence for block in blocks] == list(range(0, 10 * first, 10))
    stamps = np.concatenate([block.stamps for block in blocks])
    assert set(np.diff(stamps)) == {20_000_000}
    assert graph.blocks[0].header.frame_id == 'nest'
    # The step of 1 mm along X was carried out: 0.6 mm at the first gauge.
    assert np.ptp(np.concatenate([block.displacement for block in blocks])[-200:, 0]) < 1e-5
    feedback = [messages.feedback(message) for message in graph.feedback]
    assert feedback[0].axes == ('X', 'Y', 'Z', 'B', 'C', 'S')
    assert set(np.diff([item.stamp for item in feedback])) == {20_000_000}
    assert feedback[-1].position[:3] == pytest.approx([1e-3, -0.09, 0.0406], abs=1e-6)
    # Active again: the count starts again.
    graph.blocks.clear()
    graph.both(Transition.TRANSITION_ACTIVATE)
    graph.until(lambda: len(graph.blocks) > 5)
    assert graph.blocks[0].sequence == 0
    graph.both(Transition.TRANSITION_DEACTIVATE)
    graph.both(Transition.TRANSITION_CLEANUP)
    assert graph.state('cnc') == 'unconfigured'
    for name in ('gauges', 'cnc'):
        assert graph.stop(name) == 0
    assert graph.stop('cell', signal.SIGTERM) == 0
    assert not Path(graph.address).exists()
    for name in ('gauges', 'cnc', 'cell'):
        assert 'Traceback' not in graph.log(name)


def test_a_lost_cell_is_reported_and_found_again(graph: Graph) -> None:
    for driver in ('gauges', 'cnc'):
        graph.start(driver, backend='cell', address=graph.address)
    # Nobody there yet: configuring fails, says why, and can be tried again.
    assert not graph.change('gauges', Transition.TRANSITION_CONFIGURE)
    assert graph.state('gauges') == 'unconfigured'
    graph.status('gauges', DiagnosticStatus.ERROR, 'start the node cell')
    graph.start('cell', truth=CONFIG / 'cell_demo.yaml', rate=5.0, address=graph.address)
    graph.until(lambda: graph.clock and Path(graph.address).exists())
    graph.both(Transition.TRANSITION_CONFIGURE)
    graph.both(Transition.TRANSITION_ACTIVATE)
    graph.until(lambda: len(graph.blocks) > 5)
    graph.stop('cell', signal.SIGKILL)
    for driver in ('gauges', 'cnc'):
        graph.status(driver, DiagnosticStatus.ERROR, 'simulated cell at')
    assert graph.processes['gauges'].poll() is None and graph.processes['cnc'].poll() is None
    assert graph.state('gauges') == 'active'
    graph.start('cell', truth=CONFIG / 'cell_demo.yaml', rate=5.0, address=graph.address)
    count = len(graph.blocks)
    graph.until(lambda: len(graph.blocks) > count + 5)
    # What a new cell may have counted meanwhile nobody knows.
    graph.status('gauges', DiagnosticStatus.WARN, 'readings lost since the start')
    # The restart shows as one jump: by 1 more than a block, or by more when the new cell has
    # already counted further than the old one.
    sequences = np.array([message.sequence for message in graph.blocks])
    jumps = np.diff(sequences)
    assert jumps.min() == 10 and (jumps > 10).sum() == 1


def test_back_pressure_loses_nothing_at_full_speed(graph: Graph) -> None:
    start_all(graph, rate=0.0)
    # As fast as possible waits for both drivers.
    graph.until(lambda: len(graph.clock) > 20)
    assert len({(m.clock.sec, m.clock.nanosec) for m in graph.clock}) == 1
    graph.both(Transition.TRANSITION_CONFIGURE)
    graph.both(Transition.TRANSITION_ACTIVATE)
    # A driver that stands still holds simulated time.
    graph.until(lambda: len(graph.blocks) > 5)
    gauges = graph.processes['gauges']
    gauges.send_signal(signal.SIGSTOP)
    try:
        time.sleep(0.3)
        graph.clock.clear()
        graph.until(lambda: len(graph.clock) > 30)
        assert len({(m.clock.sec, m.clock.nanosec) for m in graph.clock[10:]}) == 1
    finally:
        gauges.send_signal(signal.SIGCONT)
    count = len(graph.blocks)
    graph.until(lambda: len(graph.blocks) > count + 100)
    # No plan, so no nest on the table, which is no fault.
    graph.status('gauges', DiagnosticStatus.OK, 'active')
    graph.change('gauges', Transition.TRANSITION_DEACTIVATE)
    values = {item.key: item.value for item in graph.diagnostics['gauges'].values}
    assert values['losses'] == '0'


def test_faults_reach_the_diagnostics(graph: Graph, tmp_path: Path) -> None:
    text = (CONFIG / 'cell_demo.yaml').read_text()
    text = text.replace('machine: nmv', f'machine: {CONFIG}/nmv')
    text += """
faults:
  - {kind: gauge_error, at_s: 0.0, for_s: 30.0, gauge: 1}
  - {kind: gauge_silent, at_s: 30.0, for_s: 10000.0}
  - {kind: feedback_stale, at_s: 0.0, for_s: 10000.0}
"""
    truth = tmp_path / 'truth.yaml'
    truth.write_text(text)
    start_all(graph, rate=5.0, truth=truth)
    graph.both(Transition.TRANSITION_CONFIGURE)
    graph.both(Transition.TRANSITION_ACTIVATE)
    bad = plan()
    bad.commands[0] = 0.5
    graph.plans.publish(bad)
    graph.status('cell', DiagnosticStatus.ERROR, "plan refused: plan '1a-nest': pose 0: X = 0.5")
    graph.status('cnc', DiagnosticStatus.WARN, 'stale')
    graph.status('gauges', DiagnosticStatus.WARN, 'gauge 2 with a device error')
    graph.status('gauges', DiagnosticStatus.ERROR, 'no data for')


@pytest.mark.parametrize(
    ('parameters', 'expected'),
    [
        ({}, 'parameter truth: missing'),
        ({'truth': '/none.yaml'}, '/none.yaml: cannot read'),
        ({'truth': CONFIG / 'cell_demo.yaml', 'address': '/none/x.sock'}, 'cannot listen'),
        ({'truth': CONFIG / 'cell_demo.yaml', 'rate': -1}, 'expected 0 or more'),
    ],
)
def test_mistakes_end_with_one_line(graph: Graph, parameters: dict, expected: str) -> None:
    graph.start('cell', **parameters)
    assert graph.processes.pop('cell').wait(timeout=20.0) == 2
    lines = graph.log('cell').splitlines()
    assert len(lines) == 1 and expected in lines[0]
