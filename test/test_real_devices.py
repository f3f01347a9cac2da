"""A whole session on real devices: LinuxCNC runs the programs of a plan, gauges on serial lines.

Controller and machine differ: LinuxCNC sees joints that are off from where they are, and the
machine that the joints move has geometric errors. What was put in comes out of the identification.
"""

import json
import math
import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from linuxcnc_cell import missing, running
from measured_sphere import MeasuredSphere
from scipy.stats import norm

from rtest_drivers.cli import main
from rtest_drivers.config import config_path
from rtest_drivers.domain import free_domain
from rtest_drivers.sim.errors import GeometricErrors
from rtest_estimation.recording import read_recording
from rtest_identification.session_file import load_session

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(bool(missing()), reason=missing()),
    pytest.mark.skipif(
        not (find_spec('rclpy') and find_spec('rtest_msgs')), reason='needs ROS 2 and rtest_msgs'
    ),
]

SESSION = """
machine: {machine}
cycle: {{b_deg: [-60, -30, 0, 30, 60], c_deg: [0, 60, 120, 180, 240, 300], dwell_s: 0.2}}
nest_calibration: {{step_mm: 1.0, dwell_s: 0.2}}
setups:
  a: {{sphere_mm: [0, -70.0, 40.0]}}
  b: {{sphere_mm: [0, 0, 120.0]}}
moves: {{linear_mm_min: 12000, rotary_deg_min: 7000, approach_mm_min: 6000}}
devices:
  gauges: {{backend: serial, file: {nest}}}
  cnc: {{backend: linuxcnc, file: {cnc}, run_programs: unattended}}
"""
# In the machine that the joints move [m], [rad].
ERRORS = {
    'E_X(0Y)B': -7.8e-6, 'E_Y(0Y)B': 12.1e-6, 'E_Z(0Y)B': -38.0e-6, 'E_X(0B)C': 4.6e-6,
    'E_A(0Y)B': 18.0e-6, 'E_B(0Y)B': 41.0e-6, 'E_C(0Y)B': 8.0e-6, 'E_A(0B)C': -12.0e-6,
    'E_A(0Y)Z': -1.0e-6, 'E_B(0X)Z': -8.0e-6, 'E_C(0Y)X': 14.0e-6,
}
# Between the joints and what the controller believes [mm], [deg].
HIDDEN = {'X': 0.03, 'B': -0.004}
# Of all errors at once by what one is with k = 3.
COVERAGE = norm.isf((1.0 - (1.0 - 2.0 * norm.sf(3.0)) ** (1.0 / len(ERRORS))) / 2.0)
LIMIT_S = 240.0


def run(command: list[str]) -> subprocess.CompletedProcess:
    """Run a session; it ends within its time or fails with what it said."""
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'},
    )
    try:
        out, _ = process.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=30.0)
        pytest.fail(f'not finished after {LIMIT_S} s:\n{out}')
    return subprocess.CompletedProcess(command, process.returncode, out)


def test_errors_behind_the_controllers_back_are_identified(tmp_path: Path) -> None:
    with running(HIDDEN) as cell, cell.true_positions() as true:
        config = cell.folder / 'small.yaml'
        config.write_text(SESSION.format(
            machine=config_path('nmv1500dcg.yaml'), cnc=cell.device, nest=tmp_path / 'nest.yaml'
        ))
        loaded = load_session(config)
        spheres = {plan.setup: plan.sphere for plan in loaded.plans}
        sphere = MeasuredSphere(
            loaded.machine, GeometricErrors(ERRORS, {}), list(spheres.values()),
            lambda: true.latest and true.latest[1],
        )
        with sphere.gauges(tmp_path):
            plan = cell.folder / 'plan'
            assert main(['plan', '--config', str(config), '--out', str(plan),
                         '--tolerance-um', '500']) == 0
            done = run(
                [sys.executable, '-m', 'rtest_drivers.cli', 'session', '--config',
                 str(plan / 'session.yaml'), '--session', 'real', '--out', str(tmp_path / 'out'),
                 '--domain', str(free_domain())],
            )
        assert true.overruns == 0
    assert done.returncode == 0, done.stdout
    folder = tmp_path / 'out' / 'real'
    recording = read_recording(folder)
    assert recording.closed and '/clock' not in recording.topics
    found = json.loads((folder / 'identification' / 'identification.json').read_text())
    assert found['missing'] == []
    values = {**found['location_errors'], **found['squareness']}
    # X of the sphere is further out: as if B were as much less. B stands where it is turned less.
    put_in = ERRORS | {
        'E_X(0Y)B': ERRORS['E_X(0Y)B'] - HIDDEN['X'] * 1e-3,
        'E_B(0Y)B': ERRORS['E_B(0Y)B'] + math.radians(HIDDEN['B']),
    }
    assert set(values) == set(put_in)
    off = {
        symbol: (values[symbol]['value'] - value) / values[symbol]['stddev']
        for symbol, value in put_in.items()
    }
    assert max(map(abs, off.values())) < COVERAGE, off
