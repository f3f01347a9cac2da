"""A session on a controller that speaks OPC UA or MTConnect, whose programs a person starts.

Servers are those of `rtest_drivers.sim`, over sockets of this host; gauges on pseudo-terminals.
What was put into the machine comes out of the identification.
"""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path

import pytest
from measured_sphere import MeasuredSphere
from played_machine import PlayedMachine
from scipy.stats import norm

from rtest_drivers.config import config_path
from rtest_drivers.domain import free_domain
from rtest_drivers.sim.cnc_devices import MtConnectAgent, OpcUaServer
from rtest_drivers.sim.errors import GeometricErrors
from rtest_identification.session_file import SessionConfig, load_session

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(
        not (find_spec('rclpy') and find_spec('rtest_msgs')),
        reason='needs ROS 2 and rtest_msgs; make test installs both',
    ),
]

AXES = 'XYZBC'
SESSION = """
machine: {machine}
cycle: {{b_deg: [-60, 0, 60], c_deg: [0, 90, 180, 270], dwell_s: 0.3}}
nest_calibration: {{step_mm: 1.0, dwell_s: 0.3}}
setups:
  a: {{sphere_mm: [0, -70.0, 40.0]}}
devices:
  gauges: {{backend: serial, file: {nest}}}
  cnc: {{backend: {backend}, file: {cnc}}}
"""
# In the machine [m], [rad]; the controller is off by HIDDEN [mm], [deg] too.
ERRORS = {'E_X(0Y)B': -8e-6, 'E_Z(0Y)B': -38e-6, 'E_X(0B)C': 5e-6, 'E_A(0B)C': -60e-6}
HIDDEN = {'X': 0.03, 'B': -0.004}
LIMIT_S = 120.0

Tell = Callable[[Mapping[str, float]], None]


@contextlib.contextmanager
def opcua(folder: Path) -> Iterator[tuple[Path, Tell]]:
    """A server in the style of a SINUMERIK; gives the device file and how to tell positions."""
    server = OpcUaServer(
        {axis: f'/Channel/MachineAxis/measPos1[u1,{n}]' for n, axis in enumerate(AXES, 1)}
    )
    file = folder / 'cnc.yaml'
    file.write_text(f'url: {server.url}\nperiod_ms: 20\naxes:\n' + ''.join(
        f"  {axis}: {{node: 'ns=2;s=/Channel/MachineAxis/measPos1[u1,{n}]', "
        f'unit: {"deg" if axis in "BC" else "mm"}}}\n' for n, axis in enumerate(AXES, 1)
    ))
    try:
        yield file, server.write
    finally:
        server.close()


@contextlib.contextmanager
def mtconnect(folder: Path) -> Iterator[tuple[Path, Tell]]:
    """An agent; gives the device file and how to tell positions."""
    agent = MtConnectAgent({
        f'{axis}act': ('ANGLE', 'DEGREE') if axis in 'BC' else ('POSITION', 'MILLIMETER')
        for axis in AXES
    }, size=1024)
    file = folder / 'cnc.yaml'
    file.write_text(f'url: {agent.url}\nperiod_ms: 20\naxes:\n' + ''.join(
        f'  {axis}: {{item: {axis}act, unit: {"deg" if axis in "BC" else "mm"}}}\n'
        for axis in AXES
    ))
    try:
        yield file, lambda values: agent.observe(
            {f'{axis}act': repr(value) for axis, value in values.items()}
        )
    finally:
        agent.close()


def attend(config: Path, loaded: SessionConfig, machine: PlayedMachine, out: Path) -> str:
    """Run a session as a person does who starts the programs it asks for; what it said."""
    plans, said = {plan.cycle: plan for plan in loaded.plans}, []
    with subprocess.Popen(
        [sys.executable, '-m', 'rtest_drivers.cli', 'session', '--config', str(config),
         '--session', 'asked', '--out', str(out), '--domain', str(free_domain())],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'PYTHONUNBUFFERED': '1'},
    ) as process:
        # However long it takes on a loaded computer, it must end.
        watch = threading.Timer(LIMIT_S, process.send_signal, [signal.SIGINT])
        watch.start()
        for line in process.stdout:
            said.append(line)
            if 'start the NC program of ' in line:
                cycle = line.partition('start the NC program of ')[2].partition(':')[0]
                machine.start(plans[cycle])
        watch.cancel()
    assert process.returncode == 0, ''.join(said)
    return ''.join(said)


@pytest.mark.parametrize(('backend', 'controller'), [('opcua', opcua), ('mtconnect', mtconnect)])
def test_errors_are_identified(backend: str, controller: Callable, tmp_path: Path) -> None:
    with controller(tmp_path) as (file, tell):
        config = tmp_path / 'session.yaml'
        config.write_text(SESSION.format(
            machine=config_path('nmv1500dcg.yaml'), nest=tmp_path / 'nest.yaml', backend=backend,
            cnc=file,
        ))
        # Read before the nest's file is there: only what it plans is needed.
        loaded = load_session(config)
        machine = PlayedMachine(loaded.machine, tell, HIDDEN)
        sphere = MeasuredSphere(
            loaded.machine, GeometricErrors(ERRORS, {}), [loaded.plans[0].sphere], machine.true
        )
        with machine.telling(), sphere.gauges(tmp_path):
            said = attend(config, loaded, machine, tmp_path)
    found = json.loads(
        (tmp_path / 'asked' / 'identification' / 'identification.json').read_text()
    )
    assert found['missing'] == [], said
    values = {**found['location_errors'], **found['squareness']}
    # X of the sphere is further out: as if B were as much less. B stands where it is turned less.
    put_in = {symbol: ERRORS.get(symbol, 0.0) for symbol in values} | {
        'E_X(0Y)B': ERRORS['E_X(0Y)B'] - HIDDEN['X'] * 1e-3, 'E_B(0Y)B': math.radians(HIDDEN['B']),
    }
    assert {'E_X(0Y)B', 'E_Z(0Y)B', 'E_X(0B)C', 'E_A(0B)C'} <= set(values)
    off = {
        symbol: (one['value'] - put_in[symbol]) / one['stddev']
        for symbol, one in values.items() if one['value'] is not None
    }
    # All of them by what one is with k = 3.
    limit = norm.isf((1.0 - (1.0 - 2.0 * norm.sf(3.0)) ** (1.0 / len(off))) / 2.0)
    assert max(map(abs, off.values())) < limit, (off, said)
