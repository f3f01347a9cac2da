"""tf of the machine: the node by hand, and on the recording of a session."""

import math
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from test_interoperable import TF_HASH

from rtest_drivers.config import config_path
from rtest_drivers.domain import free_domain
from rtest_estimation.nodes.publish import time as stamp_of
from rtest_estimation.nodes.qos import LATCHED, STREAM
from rtest_identification.kinematics import predict
from rtest_identification.machine import load_machine
from rtest_identification.urdf import robot_description

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(
        find_spec('tf2_msgs') is None, reason='needs tf2_msgs (ros-jazzy-tf2-msgs)'
    ),
]

NMV = config_path('nmv1500dcg.yaml')
NEST = np.array([0.0, -0.09, 0.0406])
CONFIG = f"""
machine: {NMV}
cycle: {{b_deg: [-60, 0, 60], c_deg: [0, 90, 180, 270], dwell_s: 0.3}}
nest_calibration: {{step_mm: 1.0, dwell_s: 0.3}}
setups:
  1a: {{sphere_mm: [0, -90.0, 40.6]}}
"""
START, STEP = 1_700_000_000_000_000_000, 10_000_000


def nanoseconds(stamp):
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def matrix(transform):
    """4 x 4 of a geometry_msgs/Transform."""
    t, q = transform.translation, transform.rotation
    found = np.eye(4)
    found[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    found[:3, 3] = t.x, t.y, t.z
    return found


def place(transforms, frame):
    """Matrix of a frame in that from which it hangs at last."""
    found = np.eye(4)
    while frame in transforms:
        frame, step = transforms[frame]
        found = step @ found
    return found


def by_child(message):
    return {
        one.child_frame_id: (one.header.frame_id, matrix(one.transform))
        for one in message.transforms
    }


# --- the node by hand ---


class ByHand:
    """The node as a process, and a node that is session, CNC and viewer for it."""

    def __init__(self, *arguments):
        from tf2_msgs.msg import TFMessage

        domain = free_domain()
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'rtest_drivers.nodes.frames', '--ros-args', *arguments],
            env={**os.environ, 'ROS_DOMAIN_ID': str(domain)},
        )
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.node = rclpy.create_node('by_hand', context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.moving, self.fixed, self.told = [], [], []
        self.node.create_subscription(TFMessage, '/tf', self.moving.append, 100)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self.hear, 10)
        self.description = self.node.create_publisher(String, 'robot_description', LATCHED)
        self.feedback = self.node.create_publisher(JointState, 'rtest/cnc/feedback', STREAM)
        self.wait(
            lambda: self.node.count_publishers('/tf') and self.feedback.get_subscription_count()
        )
        self.number = 0

    def hear(self, message):
        self.told += [(s.level, s.message) for s in message.status if s.name.startswith('frames')]

    def wait(self, done):
        end = time.monotonic() + 30.0
        while not done():
            assert time.monotonic() < end and self.process.poll() is None
            self.executor.spin_once(timeout_sec=0.02)

    def describe(self):
        """Publish a description, then listen as somebody who comes later."""
        from tf2_msgs.msg import TFMessage

        self.description.publish(String(data=robot_description(load_machine(NMV), {'1a': NEST})))
        self.node.create_subscription(TFMessage, '/tf_static', self.fixed.append, LATCHED)
        self.wait(lambda: self.fixed)

    def move(self, **positions):
        """Publish one feedback, 10 ms after the one before."""
        self.number += 1
        message = JointState(name=list(positions), position=list(positions.values()))
        message.header.stamp = stamp_of(START + self.number * STEP)
        self.feedback.publish(message)
        self.executor.spin_once(timeout_sec=0.01)

    def close(self):
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(30) == 0
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def by_hand(request, monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    graph = ByHand(*request.param)
    yield graph
    graph.close()


@pytest.mark.parametrize('by_hand', [('-p', 'prefix:=cell_1/')], indirect=True)
def test_a_prefix_is_before_every_frame_and_no_more_than_20_sets_come_a_second(by_hand):
    by_hand.wait(lambda: any(text == 'waiting for robot_description' for _, text in by_hand.told))
    by_hand.describe()
    (static,) = by_hand.fixed
    assert {(t.header.frame_id, t.child_frame_id) for t in static.transforms} == {
        ('cell_1/spindle', 'cell_1/sphere'), ('cell_1/table', 'cell_1/nest_1a'),
    }
    assert by_child(static)['cell_1/nest_1a'][1][:3, 3] == pytest.approx(NEST)
    for number in range(100):
        by_hand.move(X=0.001 * number, Y=0.0, Z=0.0, B=0.0, C=math.pi / 2.0)
    by_hand.wait(lambda: len(by_hand.moving) >= 10)
    stamps = [nanoseconds(m.transforms[0].header.stamp) for m in by_hand.moving]
    assert min(np.diff(stamps)) >= 5 * STEP and set(stamps) <= set(
        range(START, START + 101 * STEP, STEP)
    )
    for message, stamp in zip(by_hand.moving, stamps, strict=True):
        assert {nanoseconds(t.header.stamp) for t in message.transforms} == {stamp}
        found = by_child(message)
        assert set(found) == {
            f'cell_1/{name}'
            for name in ('carried_by_B', 'table', 'carried_by_Y', 'carried_by_X', 'spindle')
        }
        assert found['cell_1/carried_by_X'][1][0, 3] == pytest.approx(
            0.001 * ((stamp - START) / STEP - 1.0)
        )
        turned = found['cell_1/table'][1][:3, :3] @ [1.0, 0.0, 0.0]
        assert turned == pytest.approx([0.0, 1.0, 0.0])


@pytest.mark.parametrize('by_hand', [()], indirect=True)
def test_axes_without_a_position_have_no_transform_and_are_told(by_hand):
    by_hand.describe()
    by_hand.wait(lambda: by_hand.told[-1:] == [(b'\0', 'waiting for rtest/cnc/feedback')])

    def told():
        by_hand.move(X=0.1, Y=0.0, B=math.nan, C=0.0)
        return [text for level, text in by_hand.told if level == b'\1']

    by_hand.wait(told)
    assert told()[0] == 'no position of B, Z: no transform of carried_by_B, spindle'
    by_hand.wait(lambda: by_hand.moving)
    assert all(
        set(by_child(m)) == {'carried_by_Y', 'carried_by_X', 'table'} for m in by_hand.moving
    )
    by_hand.description.publish(String(data='machine: 5'))
    by_hand.wait(lambda: 'robot_description: no URDF' in by_hand.told[-1][1])


def test_a_prefix_that_tf_refuses_is_one_line():
    done = subprocess.run(
        [
            sys.executable, '-m', 'rtest_drivers.nodes.frames', '--ros-args', '-p',
            'prefix:=/cell_1',
        ],
        capture_output=True, text=True, timeout=60, check=False,
    )
    assert done.returncode == 2 and done.stderr.count('\n') == 1
    assert "parameter prefix: '/cell_1'" in done.stderr


# --- on the recording of a session ---


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    """Folder of the recording of a simulated session with --frames."""
    folder = tmp_path_factory.mktemp('frames')
    (folder / 'short.yaml').write_text(CONFIG)
    done = subprocess.run(
        [
            sys.executable, '-m', 'rtest_drivers.cli', 'session', '--frames',
            '--config', str(folder / 'short.yaml'),
            '--simulate', str(config_path('cell_demo.yaml')),
            '--session', 'short', '--out', str(folder / 'out'),
        ],
        capture_output=True, text=True, timeout=180, check=False, cwd=folder,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'frames:' not in done.stdout, 'nothing is wrong with a frame'
    return folder / 'out' / 'short'


@pytest.fixture(scope='module')
def feedback(recording):
    """Stamp [ns] to the positions of X Y Z B C, read by rosbags."""
    with AnyReader([recording]) as reader:
        messages = [
            reader.deserialize(raw, connection.msgtype)
            for connection, _, raw in reader.messages(
                [c for c in reader.connections if c.topic == '/rtest/cnc/feedback']
            )
        ]
    return {
        nanoseconds(m.header.stamp): dict(zip(m.name, m.position, strict=True)) for m in messages
    }


@pytest.fixture(scope='module')
def transforms(recording):
    """Messages of /tf and of /tf_static, read by mcap and mcap_ros2."""
    found = {'/tf': [], '/tf_static': []}
    with (recording / 'short.mcap').open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=list(found)):
            found[channel.topic].append(message)
    return found


def test_the_recorded_frames_are_where_the_kinematics_have_the_sphere(transforms, feedback):
    machine = load_machine(NMV)
    (static,) = transforms['/tf_static']
    stamps, spheres = [], []
    for message in transforms['/tf']:
        (stamp,) = {nanoseconds(one.header.stamp) for one in message.transforms}
        frames = by_child(static) | by_child(message)
        assert set(frames) == {
            'carried_by_B', 'table', 'carried_by_Y', 'carried_by_X', 'spindle', 'sphere',
            'nest_1a',
        }
        table = np.linalg.inv(place(frames, 'table'))
        row = [feedback[stamp][letter] for letter in machine.letters]
        sphere = (table @ place(frames, 'sphere'))[:3, 3]
        assert sphere == pytest.approx(predict(machine, row).centre[0], abs=1e-9)
        assert (table @ place(frames, 'nest_1a'))[:3, 3] == pytest.approx(NEST, abs=1e-12)
        stamps.append(stamp)
        spheres.append(place(frames, 'sphere')[:3, 3])
    assert min(np.diff(stamps)) >= 49_500_000
    # The machine has moved meanwhile, and was followed: 50 readings of the feedback a second.
    assert len(stamps) > 10e-9 * (max(feedback) - min(feedback))
    assert np.ptp(spheres, axis=0).max() > 0.05


def test_others_can_play_the_recorded_frames_again(recording):
    text = (recording / 'metadata.yaml').read_text()
    topics = {
        entry['topic_metadata']['name']: entry['topic_metadata']
        for entry in yaml.safe_load(text)['rosbag2_bagfile_information'][
            'topics_with_message_count'
        ]
    }
    for name, durability in (('/tf', 'volatile'), ('/tf_static', 'transient_local')):
        assert topics[name]['type'] == 'tf2_msgs/msg/TFMessage'
        assert topics[name]['type_description_hash'] == TF_HASH
        (profile,) = topics[name]['offered_qos_profiles']
        assert profile['reliability'] == 'reliable' and profile['durability'] == durability
    assert topics['/robot_description']['type'] == 'std_msgs/msg/String'
