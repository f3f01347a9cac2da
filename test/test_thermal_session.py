"""A thermal session over DDS with a simulated cell, and the thermometer driver on a line."""

import json
import math
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

rclpy = pytest.importorskip('rclpy')
pytest.importorskip('rtest_msgs.msg')

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from sensor_msgs.msg import Temperature  # noqa: E402
from test_drivers import Graph  # noqa: E402

from rtest_drivers.config import config_path  # noqa: E402
from rtest_drivers.sim.gauge_devices import GaugeDevice  # noqa: E402
from rtest_drivers.sim.thermometer_devices import ThermocoupleModule  # noqa: E402
from rtest_estimation.nodes.qos import STREAM  # noqa: E402
from rtest_estimation.recording import read_recording  # noqa: E402
from rtest_identification.thermal.offline import thermal_recording  # noqa: E402
from rtest_identification.thermal.output import as_dict  # noqa: E402

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(not find_spec('rclpy'), reason='needs ROS 2'),
]

SESSION = """
machine: {machine}
cycle: {{kind: thermal, every_min: 0.5, hours: 0.01, b_deg: [-60, 0, 60],
        c_deg: [0, 90, 180, 270], dwell_s: 0.3}}
nest_calibration: {{step_mm: 1.0, dwell_s: 0.3}}
setups:
  low: {{sphere_mm: [0, -90.0, 40.6]}}
"""
FAULT = '{kind: pose_skipped, cycle: low-thermal-02, pose: 8}'
FILE = r"""
controllers:
  - {port: PORT, unit: degC, stddev_k: 0.1, rate_hz: 10, timeout_s: 0.2, terminator: "\r",
     over_range: '+9999.9',
     questions: [{query: "#010\r", pattern: '>([+-][0-9.]{6})', sensors: [B_cover]}]}
"""


def test_a_thermal_session_from_the_cell_to_the_report(tmp_path: Path) -> None:
    config = tmp_path / 'warm.yaml'
    config.write_text(SESSION.format(machine=config_path('nmv1500dcg.yaml')))
    truth = tmp_path / 'truth.yaml'
    text = config_path('cell_thermal.yaml').read_text()
    truth.write_text(text.replace(
        'machine: nmv1500dcg.yaml', f'machine: {config_path("nmv1500dcg.yaml")}'
    ) + f'faults: [{FAULT}]\n')
    done = subprocess.run(
        [sys.executable, '-m', 'rtest_drivers.cli', 'session', '--config', str(config),
         '--simulate', str(truth), '--session', 'warm', '--out', str(tmp_path)],
        capture_output=True, text=True, check=False, cwd=tmp_path,
        env={**os.environ, 'ROS_DOMAIN_ID': 'none', 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'},
    )
    out = done.stdout
    assert done.returncode == 0, out + done.stderr
    assert re.search(r'3/3 low-thermal-02: in 0\.\d min', out)
    assert '3/3 low-thermal-02: 13 of 14 poses, 1 missing' in out
    assert re.search(r'thermal: 2 cycles in \d+ s', out)
    assert out.splitlines()[-1].startswith('warm: 2 cycles in ')
    recording = read_recording(tmp_path / 'warm')
    assert recording.closed and recording.lost == 0
    starts = [plan.stamp for plan in recording.plans[1:]]
    assert starts[1] - starts[0] == 30 * 10**9
    result = thermal_recording(tmp_path / 'warm')
    assert [one.sensor for one in result.thermometers] == [
        'B_cover', 'ambient', 'bridge', 'nest', 'table',
    ]
    assert [len(cycle.points) for cycle in result.cycles] == [14, 13]
    folder = tmp_path / 'warm' / 'thermal'
    assert json.loads((folder / 'thermal.json').read_text()) == json.loads(
        json.dumps(as_dict(result))
    )
    assert (folder / 'thermal_report.html').is_file()
    assert {one['reason'] for one in as_dict(result)['missing']} == {'never reached'}
    for name in ('thermal', 'thermometers', 'session', 'cell'):
        assert 'Traceback' not in (tmp_path / 'log' / 'warm' / f'{name}.log').read_text()


def test_thermometers_on_a_line_are_published_and_their_faults_told(tmp_path: Path) -> None:
    celsius = [23.25]
    device = GaugeDevice(ThermocoupleModule(lambda: celsius), tmp_path / 'port')
    path = tmp_path / 'thermometers.yaml'
    path.write_text(FILE.replace('PORT', device.port))
    graph = Graph(tmp_path)
    found: list[Temperature] = []
    graph.node.create_subscription(Temperature, 'rtest/temperature', found.append, STREAM)
    try:
        graph.start('thermometers', backend='serial', address=path)
        assert graph.change('thermometers', Transition.TRANSITION_CONFIGURE)
        assert graph.change('thermometers', Transition.TRANSITION_ACTIVATE)
        graph.until(lambda: len(found) > 3)
        message = found[-1]
        assert (message.header.frame_id, message.temperature) == ('B_cover', 23.25)
        assert math.isclose(message.variance, 0.01)
        graph.status('thermometers', DiagnosticStatus.OK, 'active')
        # A broken wire is told, and nothing is published for it.
        celsius[0] = math.nan
        graph.status('thermometers', DiagnosticStatus.WARN, 'B_cover: out of range')
        assert {message.temperature for message in found} == {23.25}
        device.unplug()
        graph.status('thermometers', DiagnosticStatus.ERROR, 'port')
        celsius[0] = 24.5
        device.plug()
        graph.until(lambda: found[-1].temperature == 24.5)
        graph.status('thermometers', DiagnosticStatus.OK, 'active')
        assert graph.stop('thermometers') == 0
    finally:
        graph.close()
        device.close()
    assert 'Traceback' not in graph.log('thermometers')
