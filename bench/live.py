"""Losses, and the age of the sphere centre, while a fast session is recorded.

    python bench/live.py [--seconds 60]

Three gauges at 10 kHz in messages of 100 readings and encoder feedback at 500 Hz are published in
real time to an estimator and a recorder, each a process of its own as in a session: a nest
calibration, then a static cycle. The age of a sphere centre is the time from the stamp of its
reading to its arrival in a third process; a reading waits up to 10 ms for its message to be full.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rtest_msgs.msg import CyclePlan, GaugeSamples, NestCalibration
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from rtest_drivers.domain import free_domain
from rtest_estimation.nodes import publish
from rtest_estimation.nodes.qos import LATCHED, LATCHED_100, STREAM
from rtest_estimation.recording import read_recording
from rtest_estimation.records import CyclePlan as CyclePlanRecord
from rtest_estimation.records import Kind
from rtest_identification.machine import load_machine
from rtest_identification.plans import nest_calibration, static

ROOT = Path(__file__).resolve().parents[1]
MACHINE = ROOT / 'src/rtest_drivers/config/nmv1500dcg.yaml'
BATCH, PERIOD_NS, FEEDBACK_NS = 100, 100_000, 2_000_000
TICK_NS = 10_000_000
MOVE_S, DWELL_S, REST_S = 0.1, 0.3, 1.0
NEST = np.array([[0.7, 0.0, 0.714], [-0.35, 0.61, 0.711], [-0.35, -0.61, 0.711]])


class Cell(Node):
    """Publishes the readings of a machine that moves through a nest calibration and stops."""

    def __init__(self) -> None:
        super().__init__('cell')
        self.machine = self.create_publisher(String, 'rtest/machine', LATCHED)
        self.plans = self.create_publisher(CyclePlan, 'rtest/plan', LATCHED_100)
        self.gauges = self.create_publisher(GaugeSamples, 'rtest/gauges', STREAM)
        self.feedback = self.create_publisher(JointState, 'rtest/cnc/feedback', STREAM)
        self.sequence = self.samples = 0
        self.rng = np.random.default_rng(1)

    def run(self, plan: CyclePlanRecord, start: int) -> int:
        """Publish a cycle in real time from `start` [ns] on; returns when it was over [ns]."""
        message = publish.cycle_plan(plan)
        message.header = publish.header(start, 'machine')
        self.plans.publish(message)
        knots = np.arange(2 * len(plan.commands)) // 2 * (MOVE_S + plan.dwell)
        knots[1::2] += plan.dwell
        rows = np.repeat(plan.commands, 2, axis=0)
        seconds = knots[-1] + REST_S
        nest = plan.kind is Kind.NEST_CALIBRATION
        for tick in range(int(seconds * 1e9) // TICK_NS):
            begin = start + tick * TICK_NS
            times = begin + np.arange(BATCH) * PERIOD_NS
            at = _positions((times - start) * 1e-9, knots, rows)
            values = (at[:, :3] - plan.commands[0, :3]) @ NEST.T * nest
            values += 1e-7 * self.rng.normal(size=values.shape)
            message = GaugeSamples(
                header=publish.header(begin, 'nest'), sequence=self.sequence,
                period=PERIOD_NS * 1e-9, channels=3, displacement=values.ravel(),
                status=bytes(3 * BATCH),
            )
            data = serialize_message(message)
            self.sequence += BATCH
            for stamp in range(begin, begin + TICK_NS, FEEDBACK_NS):
                _sleep_until(stamp)
                at = _positions(np.array([(stamp - start) * 1e-9]), knots, rows)[0]
                self.feedback.publish(JointState(
                    header=publish.header(stamp, ''), name=list(plan.axes), position=at.tolist()
                ))
                self.samples += 1
            _sleep_until(begin + TICK_NS)
            self.gauges.publish(data)
        return begin + TICK_NS


def _positions(seconds: np.ndarray, knots: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Axis positions at times after the start of a cycle."""
    return np.stack([np.interp(seconds, knots, column) for column in rows.T], axis=1)


class Listener(Node):
    """Notes how old every sphere centre is when it arrives."""

    def __init__(self) -> None:
        super().__init__('listener')
        self.ages: list[float] = []
        self.nests = 0
        self.create_subscription(PointStamped, 'rtest/sphere_centre', self.on_centre, STREAM)
        self.create_subscription(NestCalibration, 'rtest/nest', self.on_nest, LATCHED)

    def on_centre(self, message: PointStamped) -> None:
        """One centre."""
        now, stamp = time.time_ns(), message.header.stamp
        self.ages.append((now - stamp.sec * 10**9 - stamp.nanosec) * 1e-6)

    def on_nest(self, message: NestCalibration) -> None:
        """The nest is calibrated."""
        self.nests += 1


def _sleep_until(stamp: int) -> None:
    left = (stamp - time.time_ns()) * 1e-9
    if left > 0.0:
        time.sleep(left)


def _listen(seconds: float) -> None:
    """The third process: print the ages."""
    rclpy.init()
    node = Listener()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    ages = np.array(node.ages)
    print(f'nest calibrations {node.nests}, sphere centres {len(ages)}')
    if len(ages):
        shares = (50, 90, 99, 99.9, 100)
        shown = ', '.join(f'{q:g} %: {np.percentile(ages, q):.1f}' for q in shares)
        print(f'age of the sphere centre [ms]: {shown}')


def main() -> None:
    """Run the graph and print what came of it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--listen', type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.listen:
        _listen(arguments.listen)
        return
    os.environ['ROS_DOMAIN_ID'] = str(free_domain())
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    machine = load_machine(MACHINE)
    sphere = np.array([0.0, -0.09, 0.0406])
    nest = nest_calibration(machine, '1a', sphere, 1e-3, DWELL_S)
    levels, stations = np.radians(np.arange(-75, 76, 25)), np.radians(np.arange(12) * 30.0)
    poses = 2 + len(levels) * len(stations)
    static_dwell = arguments.seconds / poses - MOVE_S
    cycle = static(machine, '1a', sphere, levels, stations, static_dwell)
    seconds = len(nest.commands) * (MOVE_S + DWELL_S) + arguments.seconds + 2 * REST_S
    with tempfile.TemporaryDirectory() as folder:
        commands = [
            ['-m', 'rtest_drivers.nodes.recorder', '--ros-args', '-p', f'out:={folder}', '-p',
             'session:=live'],
            ['-m', 'rtest_estimation.nodes.estimator'],
            [__file__, '--listen', str(seconds + 8.0)],
        ]
        processes = [subprocess.Popen([sys.executable, *command]) for command in commands]
        try:
            rclpy.init()
            cell = Cell()
            spinner = SingleThreadedExecutor()
            spinner.add_node(cell)
            threading.Thread(target=spinner.spin, daemon=True).start()
            while min(p.get_subscription_count() for p in (cell.gauges, cell.feedback)) < 2:
                time.sleep(0.1)
            time.sleep(1.0)
            cell.machine.publish(String(data=machine.text))
            over = cell.run(nest, time.time_ns() + 200_000_000)
            cell.run(cycle, over)
            time.sleep(1.0)
            processes[0].send_signal(signal.SIGINT)
            processes[0].wait(30)
            processes[2].wait(60)
        finally:
            for process in processes:
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
                process.wait(30)
            spinner.shutdown()
            rclpy.try_shutdown()
        recording = read_recording(Path(folder) / 'live')
        print(f'readings: {cell.sequence} sent, '
              f'{sum(len(block.displacement) for block in recording.gauges)} recorded, '
              f'{recording.lost} lost; feedback: {len(recording.feedback)} of '
              f'{cell.samples} recorded')
        if recording.cycles:
            points = [len(message.points) for message in recording.cycles]
            print(f'poses measured: {points} of {[len(nest.commands), poses]}')
        print(f'load of the computer: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores')


if __name__ == '__main__':
    main()
