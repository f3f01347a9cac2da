"""Lasers at 10 kHz through estimator and recorder, live: lost readings, age of sphere centres.

    python bench/laser_live.py [--seconds 60] [--domain N]

Estimator and recorder run as in a session, a process each. This process is the drivers: it sends
what the simulated cell of config/cell_laser.yaml reads (three lasers at 10 kHz in batches of 100,
encoders at 50 Hz), each batch when its last reading is due by the clock, and listens to the sphere
centres. The age of a sphere centre is that of its reading when the centre is received.
"""

from __future__ import annotations

import argparse
import heapq
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from rtest_msgs.msg import Cycle, CyclePlan, GaugeSamples
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from rtest_drivers.config import config_path
from rtest_drivers.graph import ONE_THREAD
from rtest_drivers.sim.cell import Cell
from rtest_drivers.sim.truth import load_truth
from rtest_estimation import messages
from rtest_estimation.nodes import publish
from rtest_estimation.nodes.qos import LATCHED_100, STREAM
from rtest_estimation.recording import read_recording
from rtest_estimation.records import CyclePlan as Plan
from rtest_estimation.records import Feedback, GaugeBlock
from rtest_identification.plans import laser_calibration, static
from rtest_identification.session_file import load_session

_EPOCH = 1_700_000_000_000_000_000
_READY_S, _END_S = 3.0, 3.0
_BATCH_NS = 200_000_000


def simulate(seconds: float) -> tuple[list[Plan], list[tuple[int, object]]]:
    """Plans, and records with the simulated time at which each is complete, of a short session."""
    config, truth = load_session(config_path('laser.yaml')), load_truth(
        config_path('cell_laser.yaml')
    )
    machine, first = config.machine, config.plans[0]
    dwell = max(0.3, seconds / 44 - 0.4)
    levels, stations = np.radians([-60, -20, 0, 20, 60]), np.radians(np.arange(0, 360, 45))
    plans = [
        laser_calibration(machine, first.setup, first.sphere),
        static(machine, first.setup, first.sphere, levels, stations, dwell),
    ]
    cell, records, started = Cell(truth, _EPOCH), [], []
    for plan in plans:
        started.append(replace(plan, session='bench', stamp=cell.now))
        cell.queue(started[-1])
        while cell.busy:
            output = cell.advance(cell.now + _BATCH_NS)
            records += [(int(block.stamps[-1]), block) for block in output.blocks]
            records += [(sample.stamp, sample) for sample in output.feedback]
        # Long enough for the estimator to see the end of the cycle.
        output = cell.advance(cell.now + 5 * _BATCH_NS)
        records += [(int(block.stamps[-1]), block) for block in output.blocks]
        records += [(sample.stamp, sample) for sample in output.feedback]
    records.sort(key=lambda record: record[0])
    return started, records


class Feeder(Node):
    """Sends the records at their time, and listens."""

    def __init__(self) -> None:
        super().__init__('feeder')
        self._plan = self.create_publisher(CyclePlan, 'rtest/plan', LATCHED_100)
        self._gauges = self.create_publisher(GaugeSamples, 'rtest/gauges', STREAM)
        self._feedback = self.create_publisher(JointState, 'rtest/cnc/feedback', STREAM)
        self.create_subscription(PointStamped, 'rtest/sphere_centre', self._on_centre, STREAM)
        self.create_subscription(Cycle, 'rtest/cycle', self._on_cycle, LATCHED_100)
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 100)
        self.ages: list[float] = []
        self.cycles: list[Cycle] = []
        self.lost_in_estimator = 0
        self.late = 0.0

    def _on_centre(self, message: PointStamped) -> None:
        self.ages.append((time.time_ns() - messages.nanoseconds(message.header.stamp)) * 1e-9)

    def _on_cycle(self, message: Cycle) -> None:
        self.cycles.append(message)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'estimator: cycle':
                values = {pair.key: pair.value for pair in status.values}
                self.lost_in_estimator = int(values['lost_readings'])

    def ready(self) -> bool:
        """Whether estimator and recorder listen to the gauges."""
        return self._gauges.get_subscription_count() >= 2

    def spin(self, seconds: float) -> None:
        """Listen for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self, timeout_sec=left)

    def send(self, plans: list[Plan], records: list[tuple[int, object]]) -> None:
        """Send everything, each record when it is complete."""
        shift = time.time_ns() + 500_000_000 - _EPOCH
        plan_items = [(plan.stamp, plan) for plan in plans]
        for due, record in heapq.merge(plan_items, records, key=lambda item: item[0]):
            while (left := (due + shift - time.time_ns()) * 1e-9) > 0.0:
                rclpy.spin_once(self, timeout_sec=left)
            self.late = max(self.late, -left)
            if isinstance(record, GaugeBlock):
                self._gauges.publish(_samples(record, shift))
            elif isinstance(record, Feedback):
                self._feedback.publish(
                    JointState(
                        header=publish.header(record.stamp + shift, 'machine'),
                        name=list(record.axes), position=record.position.tolist(),
                    )
                )
            else:
                self._plan.publish(
                    publish.cycle_plan(replace(record, stamp=record.stamp + shift))
                )

    def finish(self, name: str) -> str:
        """Call a node's service `finish`."""
        client = self.create_client(Trigger, f'{name}/finish')
        client.wait_for_service(_READY_S)
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self, future, timeout_sec=60.0)
        return future.result().message


def _samples(block: GaugeBlock, shift: int) -> GaugeSamples:
    message = GaugeSamples(
        header=publish.header(block.stamp + shift, 'nest'), sequence=block.sequence,
        period=block.period, channels=block.displacement.shape[1],
    )
    message.displacement = block.displacement.ravel().tolist()
    message.status = block.status.ravel().tolist()
    return message


def _nodes(out: Path) -> Iterator[tuple[str, subprocess.Popen]]:
    for name, module, parameters in (
        ('recorder', 'rtest_drivers.nodes.recorder', [f'out:="{out}"', 'session:="bench"']),
        ('estimator', 'rtest_estimation.nodes.estimator',
         ['nest:="laser"', 'sphere_radius_mm:=25.0']),
    ):
        arguments = [part for text in parameters for part in ('-p', text)]
        yield name, subprocess.Popen(
            [sys.executable, '-m', module, '--ros-args', *arguments],
            env={**os.environ, **ONE_THREAD},
        )


def _processor_time(process: subprocess.Popen) -> float:
    """User and system time so far [s]."""
    fields = Path(f'/proc/{process.pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def main(arguments: list[str] | None = None) -> int:
    """Run; 1 where a reading is lost."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--seconds', type=float, default=60.0, help='of the static cycle')
    parser.add_argument('--domain', default=os.environ.get('ROS_DOMAIN_ID', '0'))
    chosen = parser.parse_args(arguments)
    os.environ['ROS_DOMAIN_ID'] = chosen.domain
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    plans, records = simulate(chosen.seconds)
    span = (records[-1][0] - records[0][0]) * 1e-9
    sent = sum(len(r.displacement) for _, r in records if isinstance(r, GaugeBlock))
    rclpy.init()
    feeder = Feeder()
    with tempfile.TemporaryDirectory() as folder:
        nodes = dict(_nodes(Path(folder)))
        try:
            while not feeder.ready():
                feeder.spin(0.1)
            feeder.spin(_READY_S)
            before = {name: _processor_time(node) for name, node in nodes.items()}
            feeder.send(plans, records)
            feeder.spin(_END_S)
            used = {name: _processor_time(node) - before[name] for name, node in nodes.items()}
            print(feeder.finish('estimator'), '|', feeder.finish('recorder'))
        finally:
            for node in nodes.values():
                node.terminate()
            for node in nodes.values():
                node.wait(20.0)
            feeder.destroy_node()
            rclpy.shutdown()
        recording = read_recording(Path(folder) / 'bench')
    return _tell(feeder, recording, sent, span, used)


def _tell(feeder: Feeder, recording: Any, sent: int, span: float, used: dict[str, float]) -> int:
    recorded = sum(len(block.displacement) for block in recording.gauges)
    print(f'{sent} readings of three lasers in {span:.0f} s, {os.cpu_count()} cores; sent '
          f'{feeder.late * 1e3:.0f} ms late at most')
    print(f'lost: {feeder.lost_in_estimator} in the estimator, {sent - recorded} in the recording')
    for name, seconds in used.items():
        print(f'{name}: {100.0 * seconds / span:.0f} % of a core')
    for cycle in feeder.cycles:
        poses = len(cycle.points) + len(cycle.missing)
        print(f'{cycle.plan.cycle}: {len(cycle.points)} of {poses} poses')
    ages = np.array(feeder.ages) * 1e3
    if len(ages):
        print(f'age of {len(ages)} sphere centres: median {np.median(ages):.1f} ms, 99th '
              f'percentile {np.percentile(ages, 99):.1f} ms, largest {ages.max():.0f} ms')
    complete = feeder.lost_in_estimator == 0 and recorded == sent and len(ages) > 0
    print(f'nothing lost: {"yes" if complete else "NO"}')
    return 0 if complete else 1


if __name__ == '__main__':
    sys.exit(main())
