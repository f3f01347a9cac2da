"""`rtest replay` over real DDS: live nodes find what `rtest identify` finds, at any rate."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from rtest_msgs.msg import Cycle, ErrorMap, GaugeSamples, LocationErrors
from std_srvs.srv import SetBool

from rtest_drivers.domain import free_domain
from rtest_estimation.nodes import publish as estimation
from rtest_estimation.nodes.qos import LATCHED_100, STREAM
from rtest_estimation.recording import read_recording
from rtest_identification.nodes import publish as identification
from rtest_identification.offline import estimate_recording, identify_recording

pytestmark = pytest.mark.graph
SHORT = Path(__file__).resolve().parents[1] / 'bags' / 'short'
RESULTS = {'cycle': Cycle, 'location_errors': LocationErrors, 'error_map': ErrorMap}


class Live:
    """Estimator and identifier as processes, and what they publish."""

    def __init__(self):
        self.environment = {**os.environ, 'ROS_DOMAIN_ID': str(free_domain())}
        self.heard = {name: [] for name in (*RESULTS, 'clock', 'gauges')}
        self.processes = [
            self.start('-m', module, '--ros-args', '-p', 'use_sim_time:=true')
            for module in (
                'rtest_estimation.nodes.estimator', 'rtest_identification.nodes.identifier',
            )
        ]
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(self.environment['ROS_DOMAIN_ID']))
        self.node = Node('listener', context=self.context)
        for name, kind in RESULTS.items():
            self.node.create_subscription(
                kind, f'rtest/{name}', self.heard[name].append, LATCHED_100
            )
        self.node.create_subscription(Clock, '/clock', self.heard['clock'].append, 10)
        self.node.create_subscription(
            GaugeSamples, 'rtest/gauges', self.heard['gauges'].append, STREAM
        )
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.open = True
        self.spinning = threading.Thread(target=self.spin, daemon=True)
        self.spinning.start()
        wait_for(lambda: {'estimator', 'identifier'} <= set(self.node.get_node_names()))

    def spin(self):
        while self.open:
            self.executor.spin_once(timeout_sec=0.05)

    def start(self, *arguments):
        return subprocess.Popen(
            [sys.executable, *arguments], env=self.environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL,
        )

    def replay(self, *arguments):
        for messages in self.heard.values():
            messages.clear()
        process = self.start('-m', 'rtest_drivers.cli', 'replay', *map(str, arguments))
        self.processes.append(process)
        return process

    def close(self):
        for process in self.processes:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            process.communicate(timeout=30)
        self.open = False
        self.spinning.join()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def wait_for(condition, timeout=60.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.01)


@pytest.fixture(scope='module')
def live():
    nodes = Live()
    yield nodes
    nodes.close()


def done(process):
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    return output


def same_as_offline(live, path):
    """The last messages of the nodes against the offline command, number by number."""
    finished = [f.cycle for f in estimate_recording(read_recording(path))]
    result = identify_recording(path)
    wait_for(lambda: len(live.heard['cycle']) >= len(finished))
    wait_for(lambda: live.heard['location_errors'] and live.heard['error_map'])
    assert live.heard['cycle'] == [estimation.cycle(cycle) for cycle in finished]
    assert sum(len(cycle.points) for cycle in live.heard['cycle']) > 50
    errors = live.heard['location_errors'][-1]
    stamp = errors.header.stamp.sec * 10**9 + errors.header.stamp.nanosec
    assert errors == identification.location_errors(result, stamp)
    maps = {message.axis: message for message in live.heard['error_map']}
    for expected in (
        *(identification.error_map(result, one, stamp) for one in result.maps),
        *([identification.grid_map(result, result.inner_map, stamp)] if result.inner_map else []),
    ):
        # Equal also where a station is not determined, which is NaN.
        assert repr(maps.pop(expected.axis)) == repr(expected)
    assert not maps


def test_as_fast_as_possible_gives_bit_for_bit_what_identify_gives(live):
    output = done(live.replay(SHORT, '--rate', 'max'))
    assert 'replayed' in output and '/estimator' in output
    same_as_offline(live, SHORT)
    # Who finds the replay late misses the beginning, and nothing after it.
    heard = live.heard['gauges']
    recorded = read_recording(SHORT).gauges[-len(heard) :]
    assert [(message.sequence, message.header.stamp) for message in heard] == [
        (block.sequence, estimation.time(block.stamp)) for block in recorded
    ]


def test_again_at_a_fixed_rate_from_a_cut_bare_file(live, tmp_path):
    cut = tmp_path / 'cut.mcap'
    whole = (SHORT / 'short.mcap').read_bytes()
    cut.write_bytes(whole[: int(0.93 * len(whole))])
    output = done(live.replay(cut, '--rate', 60))
    assert 'cut or damaged' in output
    same_as_offline(live, cut)
    clock = [message.clock.sec + message.clock.nanosec * 1e-9 for message in live.heard['clock']]
    assert clock == sorted(clock)


def test_it_loops(live):
    process = live.replay(SHORT, '--rate', 'max', '--loop', '--stop', 40)
    recording = read_recording(SHORT)
    end = recording.start + 40 * 10**9
    cycles = sum(plan.stamp < end for plan in recording.plans)
    assert cycles > 1
    wait_for(lambda: len(live.heard['cycle']) >= 2 * cycles)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    assert process.returncode == 130
    heard = live.heard['cycle']
    assert heard[:cycles] == heard[cycles : 2 * cycles]


def test_it_pauses_and_keeps_to_start_and_stop(live):
    process = live.replay(SHORT, '--pause', '--start', 40, '--stop', 42, '--rate', 10)
    wait_for(lambda: len(live.heard['clock']) > 10)
    client = live.node.create_client(SetBool, '/replay/pause')
    assert client.wait_for_service(20)
    recording = read_recording(SHORT)
    assert {message.clock.sec for message in live.heard['clock']} == {
        (recording.start + 40 * 10**9) // 10**9
    }
    assert not live.heard['gauges']
    future = client.call_async(SetBool.Request(data=False))
    wait_for(future.done)
    done(process)
    stamps = [message.header.stamp for message in live.heard['gauges']]
    first, last = (stamp.sec + stamp.nanosec * 1e-9 for stamp in (stamps[0], stamps[-1]))
    start = recording.start * 1e-9
    # A batch is on its way for as long as it takes to fill it.
    assert 39.0 < first - start < 41.0 < last - start < 42.0


def test_a_live_publisher_on_the_same_topic_is_refused(live):
    publisher = live.node.create_publisher(GaugeSamples, 'rtest/gauges', STREAM)
    try:
        # On a busy computer it is found after the beginning.
        process = live.replay(SHORT)
        _, errors = process.communicate(timeout=60)
        assert 'rtest: listener publishes on /rtest/gauges' in errors
        assert process.returncode == 2
        output = done(live.replay(SHORT, '--rate', '2', '--stop', 10, '--force'))
        assert 'warning: listener publishes on /rtest/gauges too' in output
    finally:
        live.node.destroy_publisher(publisher)
