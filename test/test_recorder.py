"""The recorder as a process over real DDS: complete, countable, and readable when killed."""

import os
import random
import re
import resource
import signal
import subprocess
import sys
import threading
import time

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.reader import make_reader
from rclpy.clock import Clock
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock as ClockMessage
from rtest_msgs.msg import CyclePlan, GaugeSamples
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from rtest_estimation.bagfile import read_bag
from rtest_estimation.nodes.qos import LATCHED, LATCHED_100, STREAM
from rtest_estimation.recording import read_recording

pytestmark = pytest.mark.graph

# One for every run of the tests, so that two runs on a computer do not hear each other.
DOMAIN = 1 + os.getpid() % 100
READINGS = 5
PERIOD = 0.001


class Graph:
    """The other side of the recorder: a node that publishes a session by hand."""

    def __init__(self, out):
        self.out = out
        self.context = Context()
        rclpy.init(context=self.context, domain_id=DOMAIN)
        self.node = Node('by_hand', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.processes = []
        self.open = True
        self.spinning = threading.Thread(target=self.spin, daemon=True)
        self.spinning.start()

    def spin(self):
        while self.open:
            self.executor.spin_once(timeout_sec=0.05)

    def start(
        self, *arguments, session='s1', program=('-m', 'rtest_drivers.nodes.recorder'), **options
    ):
        process = subprocess.Popen(
            [
                *(sys.executable, *map(str, program), '--ros-args'),
                *('-p', f'out:={self.out}', '-p', f'session:={session}', *arguments),
            ],
            env={
                **os.environ,
                'ROS_DOMAIN_ID': str(DOMAIN),
                'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **options,
        )
        self.processes.append(process)
        return process

    def publisher(self, message_type, topic, qos=STREAM, listeners=1):
        publisher = self.node.create_publisher(message_type, topic, qos)
        wait_for(lambda: publisher.get_subscription_count() >= listeners)
        return publisher

    def path(self, session='s1'):
        return self.out / session / f'{session}.mcap'

    def finish(self, name='/recorder/finish'):
        client = self.node.create_client(Trigger, name)
        assert client.wait_for_service(20)
        future = client.call_async(Trigger.Request())
        wait_for(future.done)
        return future.result()

    def close(self):
        for process in self.processes:
            if process.poll() is None:
                process.kill()
            process.communicate()
        self.open = False
        self.spinning.join()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


def wait_for(condition, timeout=30.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, 'waited in vain'
        time.sleep(0.01)


@pytest.fixture
def graph(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    graph = Graph(tmp_path)
    yield graph
    graph.close()


def stamp():
    return Clock().now().to_msg()


def gauges(sequence):
    message = GaugeSamples(sequence=sequence, period=PERIOD, channels=3)
    message.header.stamp = stamp()
    message.displacement = [sequence * 1e-6] * (3 * READINGS)
    message.status = [0] * (3 * READINGS)
    return message


def feedback(value):
    message = JointState(name=list('XYZBC'), position=[float(value)] * 5)
    message.header.stamp = stamp()
    return message


def plan(cycle='1a-static'):
    message = CyclePlan(session='s1', cycle=cycle, setup='1a', axes=list('XYZBC'), dwell=0.3)
    message.header.stamp = stamp()
    message.commands = [0.0] * 10
    return message


def told(process, number=signal.SIGINT):
    process.send_signal(number)
    output, errors = process.communicate(timeout=20)
    return process.returncode, output, errors


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_records_everything_and_closes_when_told(graph, number):
    # Latched before there is a recorder: it must be in the recording all the same.
    machine = graph.publisher(String, 'rtest/machine', LATCHED, listeners=0)
    machine.publish(String(data='name: by hand\nchain: []\naxes: {}\n'))
    process = graph.start()
    plans = graph.publisher(CyclePlan, 'rtest/plan', LATCHED_100)
    readings = graph.publisher(GaugeSamples, 'rtest/gauges')
    encoders = graph.publisher(JointState, 'rtest/cnc/feedback')
    # Unknown to the contract, and offering less than the recorder would like.
    unreliable = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    extra = graph.publisher(String, 'rtest/extra', unreliable)
    for index in range(5):
        plans.publish(plan(f'cycle {index}'))
    for index in range(1500):
        readings.publish(gauges(READINGS * index))
        encoders.publish(feedback(index))
        if index % 10 == 0:
            time.sleep(0.005)
    extra.publish(String(data='last words'))
    types = {
        name: graph.node.get_publishers_info_by_topic(name)[0].topic_type_hash
        for name in ('/rtest/gauges', '/rtest/plan', '/rtest/cnc/feedback')
    }
    time.sleep(0.2)
    status, output, errors = told(process, number)
    assert status == 0, errors
    assert re.search(rf'recorded \d+ messages, 0 lost, {graph.path()}', output)

    recording = read_recording(graph.path().parent)
    assert recording.warnings == ()
    assert recording.closed
    assert recording.machine_text.startswith('name: by hand')
    assert [entry.cycle for entry in recording.plans] == [f'cycle {index}' for index in range(5)]
    assert [block.sequence for block in recording.gauges] == list(range(0, 7500, READINGS))
    assert recording.gauges[7].displacement[0, 0] == pytest.approx(35e-6)
    assert [entry.position[0] for entry in recording.feedback] == list(range(1500))
    assert '/diagnostics' in recording.topics
    with AnyReader([graph.path().parent]) as reader:
        hashes = {connection.topic: connection.digest for connection in reader.connections}
        last = [
            reader.deserialize(data, connection.msgtype).data
            for connection, _, data in reader.messages()
            if connection.topic == '/rtest/extra'
        ]
        profiles = {
            connection.topic: connection.ext.offered_qos_profiles
            for connection in reader.connections
        }
    assert last == ['last words']
    for name, expected in types.items():
        assert hashes[name] == f'RIHS01_{bytes(expected.value).hex()}'
    assert profiles['/rtest/plan'][0].durability.name == 'TRANSIENT_LOCAL'
    assert profiles['/rtest/extra'][0].reliability.name == 'BEST_EFFORT'


def test_finish_waits_for_what_is_on_its_way_and_can_be_repeated(graph):
    process = graph.start()
    readings = graph.publisher(GaugeSamples, 'rtest/gauges')
    for index in range(400):
        readings.publish(gauges(READINGS * index))
    answer = graph.finish()
    assert answer.success
    match = re.fullmatch(r'recorded (\d+) messages, 0 lost, (.*)', answer.message)
    with open(match[2], 'rb') as file:
        reader = make_reader(file)
        assert reader.get_summary().statistics.message_count == int(match[1])
        assert len(list(reader.iter_messages(topics=['/rtest/gauges']))) == 400
    readings.publish(gauges(0))
    again = graph.finish()
    assert (again.success, again.message) == (True, answer.message)
    assert told(process)[0] == 0


def test_lost_readings_are_told(graph):
    process = graph.start()
    heard = []
    graph.node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, STREAM)
    readings = graph.publisher(GaugeSamples, 'rtest/gauges')
    for sequence in (10, 15, 40, 45, 0, 5):
        readings.publish(gauges(sequence))
    wait_for(lambda: any(b'30 readings' in entry for entry in states(heard)))
    answer = graph.finish()
    assert re.fullmatch(r'recorded \d+ messages, 30 lost, .*', answer.message)
    (values,) = ({pair.key: pair.value for pair in array.status[0].values} for array in heard[-1:])
    assert values['lost readings /rtest/gauges'] == '30'
    assert values['driver restarts /rtest/gauges'] == '1'
    assert told(process)[0] == 0


def states(heard):
    return [
        status.level + status.message.encode()
        for array in heard
        for status in array.status
        if status.name == '/recorder'
    ]


@pytest.mark.parametrize('seed', [1, 2, 3])
def test_killed_at_any_moment_leaves_a_recording_that_opens(graph, seed):
    life = random.Random(seed).uniform(1.0, 4.0)
    process = graph.start()
    plans = graph.publisher(CyclePlan, 'rtest/plan', LATCHED_100)
    encoders = graph.publisher(JointState, 'rtest/cnc/feedback')
    readings = graph.publisher(GaugeSamples, 'rtest/gauges')
    plans.publish(plan())
    begun = time.monotonic()
    published = []
    while time.monotonic() - begun < life:
        readings.publish(gauges(READINGS * len(published)))
        encoders.publish(feedback(len(published)))
        published.append(time.monotonic())
        time.sleep(0.003)
    killed = time.monotonic()
    process.kill()
    process.communicate()

    recording = read_recording(graph.path().parent)
    kept = [block.sequence for block in recording.gauges]
    assert kept == list(range(0, READINGS * len(kept), READINGS))
    lost = killed - published[len(kept) - 1]
    print(f'killed after {life:.2f} s: the last {lost:.2f} s are missing')
    assert lost < 1.5
    assert recording.lost == 0
    assert not recording.closed
    # Readers that know nothing of this project open it as well.
    for path in (graph.path(), graph.path().parent):
        with AnyReader([path]) as reader:
            topics = [connection.topic for connection, _, _ in reader.messages()]
        assert topics.count('/rtest/gauges') == len(kept)
    with graph.path().open('rb') as file:
        messages = list(make_reader(file, validate_crcs=True).iter_messages('/rtest/gauges'))
    assert len(messages) == len(kept)


def test_simulated_time_is_logged_and_never_zero(graph):
    process = graph.start('-p', 'use_sim_time:=true')
    plans = graph.publisher(CyclePlan, 'rtest/plan', LATCHED_100, listeners=0)
    plans.publish(plan())
    clock = graph.publisher(ClockMessage, '/clock')
    assert plans.get_subscription_count() == 0
    now = 1_600_000_000_000_000_000
    readings = graph.publisher(GaugeSamples, 'rtest/gauges', listeners=0)
    while not readings.get_subscription_count():
        clock.publish(ClockMessage(clock=Time(nanoseconds=now).to_msg()))
        time.sleep(0.01)
    for index in range(50):
        now += 1_000_000_000
        clock.publish(ClockMessage(clock=Time(nanoseconds=now).to_msg()))
        readings.publish(gauges(READINGS * index))
        time.sleep(0.005)
    assert readings.wait_for_all_acked(Duration(seconds=5))
    assert graph.finish().success
    assert told(process)[0] == 0
    with graph.path().open('rb') as file:
        messages = list(make_reader(file).iter_messages())
    topics = [channel.topic for _, channel, _ in messages]
    assert topics.count('/rtest/plan') == 1
    assert topics.count('/rtest/gauges') == 50
    for _, _, message in messages:
        assert 1_600_000_000_000_000_000 <= message.log_time <= now
        assert message.publish_time == message.log_time


def test_namespace_and_remapping(graph):
    process = graph.start('-r', '__ns:=/cell7', '-r', 'rtest/gauges:=/probes')
    graph.publisher(JointState, '/cell7/rtest/cnc/feedback').publish(feedback(1))
    graph.publisher(GaugeSamples, '/probes').publish(gauges(0))
    other = graph.publisher(JointState, '/rtest/cnc/feedback', listeners=0)
    other.publish(feedback(2))
    answer = graph.finish('/cell7/recorder/finish')
    assert answer.success
    assert told(process)[0] == 0
    with graph.path().open('rb') as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert topics - {'/diagnostics'} == {'/cell7/rtest/cnc/feedback', '/probes'}


def test_full_disk_is_told_and_the_node_lives(graph):
    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    heard = []
    graph.node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, STREAM)
    process = graph.start(preexec_fn=limit)
    noise = graph.publisher(String, 'rtest/noise')
    chance = random.Random(5)
    for _ in range(30):
        noise.publish(String(data=''.join(chance.choices('0123456789abcdef', k=20_000))))
        time.sleep(0.02)
    error = DiagnosticStatus.ERROR + f'cannot write {graph.path()}: File too large'.encode()
    wait_for(lambda: any(entry.startswith(error) for entry in states(heard)))
    answer = graph.finish()
    assert not answer.success
    assert 'File too large' in answer.message
    assert process.poll() is None
    status, _, errors = told(process)
    assert status == 1
    assert 'cannot write' in errors


# A recorder whose disk stops to answer when the first file appears in the folder, and goes on
# answering when the second does.
STALLING = """
import os, sys, time
from pathlib import Path
from rtest_drivers import mcap_file
stall, mend = map(Path, sys.argv[1:3])
real = os.fsync
def fsync(handle):
    while stall.exists() and not mend.exists():
        time.sleep(0.01)
    real(handle)
mcap_file.os.fsync = fsync
from rtest_drivers.nodes.recorder import main
sys.exit(main(sys.argv[:1] + sys.argv[3:]))
"""


def test_a_stalled_disk_is_told_counted_and_bounded(graph):
    stall, mend = graph.out / 'stall', graph.out / 'mend'
    heard = []
    graph.node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, STREAM)
    process = graph.start('-p', 'memory_mb:=4', program=('-c', STALLING, stall, mend))
    noise = graph.publisher(String, 'rtest/noise')
    noise.publish(String(data='before'))
    wait_for(lambda: states(heard))
    stall.touch()
    sent = 0
    while not any(b'not written: ' in entry for entry in states(heard)):
        noise.publish(String(data='x' * 50_000))
        sent += 1
        time.sleep(0.01)
        assert sent < 3000
    # What was told while the disk stood still.
    (told_last,) = heard[-1:]
    values = {pair.key: pair.value for pair in told_last.status[0].values}
    assert int(values['waiting_bytes']) <= 4e6
    wait_for(lambda: any(b'the disk has not answered for' in entry for entry in states(heard)))
    mend.touch()
    wait_for(lambda: any(b'was too slow or full' in entry for entry in states(heard)))
    answer = graph.finish()
    assert not answer.success
    lost = int(re.search(r'; not written: (\d+) of /rtest/noise', answer.message)[1])
    assert told(process)[0] == 0
    bag = read_bag(graph.path(), ())
    assert bag.closed
    assert bag.topics['/rtest/noise'][1] + lost == sent + 1
    counted = f'not written /rtest/noise: {lost} messages'
    assert any(counted in warning for warning in bag.warnings)


def test_a_clock_that_is_set_does_not_part_the_messages(graph):
    program = """
import sys, time
from types import SimpleNamespace
from rtest_drivers import clock
from rtest_drivers.nodes import recorder
begun = time.monotonic()
# A day back after two seconds.
clock.time = SimpleNamespace(
    monotonic_ns=time.monotonic_ns,
    time_ns=lambda: time.time_ns() - (86400 * 10**9 if time.monotonic() - begun > 2 else 0),
)
sys.exit(recorder.main())
"""
    heard = []
    graph.node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, STREAM)
    before = time.time_ns()
    process = graph.start(program=('-c', program))
    readings = graph.publisher(GaugeSamples, 'rtest/gauges')
    sent = 0
    while not any(b'clock was set by -8.64e+04 s' in entry for entry in states(heard)):
        readings.publish(gauges(READINGS * sent))
        sent += 1
        time.sleep(0.01)
        assert sent < 3000
    assert graph.finish().success
    assert told(process)[0] == 0
    with graph.path().open('rb') as file:
        messages = make_reader(file).iter_messages(topics='/rtest/gauges', log_time_order=False)
        times = [message.log_time for _, _, message in messages]
    assert len(times) == sent
    assert times == sorted(times)
    assert before < times[0] and times[-1] < time.time_ns()


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ({'session': 'old'}, 'old: there is a recording already'),
        ({'session': '../up'}, "parameter session: '../up', expected a name"),
        ({'session': '7'}, 'parameter session: expected a text, put it in quotes'),
    ],
)
def test_mistakes_are_one_line_and_status_2(graph, arguments, message):
    (graph.out / 'old').mkdir()
    process = graph.start(**arguments)
    output, errors = process.communicate(timeout=30)
    assert process.returncode == 2
    assert output == ''
    assert message in errors
    assert len(errors.splitlines()) == 1
    assert list((graph.out / 'old').iterdir()) == []
