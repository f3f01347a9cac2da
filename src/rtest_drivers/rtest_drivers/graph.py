"""The nodes of a session and their parameters: one table for `rtest` and for `ros2 launch`."""

from __future__ import annotations

import json
import re
import tempfile
import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from rtest_estimation.errors import UserError

if TYPE_CHECKING:
    from rtest_identification.session_file import Device, SessionConfig

ParameterValue = str | int | float | bool | list[str]

# What ends the session when it ends, and what must see everybody else's last message.
LEADER = 'session'
LAST = 'recorder'
LOGS = 'log'
# Exit status of the leader when the recording was closed but something is missing in it.
INCOMPLETE = 3
# What a recorder records: names or patterns, below its namespace where no slash begins them.
RECORDED = ['rtest/.*', '/diagnostics']
# What a viewer needs besides to show the machine as it moves.
RECORDED_FRAMES = ['robot_description', '/tf', '/tf_static']
# Simulated seconds per second at which nodes on two processor cores lose nothing.
RATE = 10.0
# Where the page is served: on this computer only.
VIEW_HOST, VIEW_PORT = '127.0.0.1', 8090
# The problems are small: more threads than one are slower, and not bit for bit repeatable.
ONE_THREAD = {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'}

_NAME = re.compile(r'[A-Za-z0-9][A-Za-z0-9._-]*')
_NAMESPACE = re.compile(r'/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*')
_REMAP = re.compile(r'[^\s:=]+:=[^\s:=]+')


@dataclass(frozen=True)
class GraphNode:
    """One node of the graph; its executable has the name of the node.

    lifecycle : whether the session node configures and activates it
    optional : whether the session goes on when it ends
    """

    name: str
    package: str
    parameters: dict[str, ParameterValue] = field(default_factory=dict)
    lifecycle: bool = False
    optional: bool = False

    @property
    def module(self) -> str:
        """Module whose `main` is the node."""
        return f'{self.package}.nodes.{self.name}'


@dataclass(frozen=True)
class GraphSettings:
    """What a user chooses when starting a session.

    config : session file (YAML)
    session : name of the session, of its folder and of its recording
    sphere_radius : of the session file [m]; nest : 'contact' or 'laser', as there
    out : the recording is written to out/session/session.mcap
    simulate : truth file of the simulated cell; None for real devices
    devices : of the session file, for the drivers that are to be started; not used with `simulate`
    thermal : whether the session repeats a cycle while the machine warms up
    checks : whether it checks the measuring chain, and identifies nothing
    rate : simulated seconds per second of wall time
    namespace : of every node and topic, empty for none
    remaps : rules ``from:=to`` for every node
    address : where the simulated cell is to be reached by its drivers (AF_UNIX)
    hold : whether every cycle waits until it is asked for
    view : address and port of the page that shows the session; None for no page
    frames : whether the machine's frames are published as tf, and recorded
    """

    config: Path
    session: str
    out: Path
    simulate: Path | None = None
    devices: dict[str, Device] = field(default_factory=dict)
    sphere_radius: float = 0.0127
    nest: str = 'contact'
    thermal: bool = False
    checks: bool = False
    rate: float = 1.0
    namespace: str = ''
    remaps: tuple[str, ...] = ()
    address: str = field(default_factory=lambda: cell_address())
    hold: bool = False
    view: tuple[str, int] | None = None
    frames: bool = False

    def __post_init__(self) -> None:
        """Refuse names that would become a wrong path or a wrong ROS argument (UserError)."""
        if not _NAME.fullmatch(self.session) or self.session == LOGS:
            raise UserError(
                f'session name {self.session!r}: expected letters, digits, dot, dash, underscore'
                f'; {LOGS!r} is taken'
            )
        if self.namespace and not _NAMESPACE.fullmatch(self.namespace):
            raise UserError(
                f'namespace {self.namespace!r}: expected a ROS name such as cell_1 or /hall/cell_1'
            )
        check_remaps(self.remaps)
        if not 0.0 < self.rate < float('inf'):
            raise UserError(
                f'rate {self.rate:g}: expected a number above 0; at {RATE:g} two processor cores '
                'lose nothing'
            )

    def of(self, session: SessionConfig) -> GraphSettings:
        """With what the session file says."""
        return replace(
            self, sphere_radius=session.sphere_radius, nest=session.nest.name.lower(),
            devices=session.devices, thermal=session.every > 0.0, checks=session.checks,
        )

    @property
    def folder(self) -> Path:
        """The recording's folder, which the recorder makes, and where results are written."""
        return self.out / self.session

    @property
    def log(self) -> Path:
        """What the nodes say; not in the folder of the recording, which is to be a bag only."""
        return self.out / LOGS / self.session

    @property
    def recording(self) -> Path:
        """The recording, one MCAP file."""
        return self.folder / f'{self.session}.mcap'


def check_remaps(rules: Iterable[str]) -> None:
    """Refuse what is no rule ``from:=to`` (UserError)."""
    for rule in rules:
        if not _REMAP.fullmatch(rule):
            raise UserError(f'remap {rule!r}: expected FROM:=TO')


def session_name(stem: str) -> str:
    """A name for a new session: stem, as far as a name may have its letters, date, time."""
    stem = re.sub(r'[^A-Za-z0-9._-]+', '-', stem).strip('._-') or 'session'
    return f'{stem}-{time.strftime("%Y%m%d-%H%M%S")}'


def cell_address() -> str:
    """A socket path of its own for one simulated cell; short, as AF_UNIX wants it."""
    return str(Path(tempfile.gettempdir()) / f'rtest-cell-{uuid.uuid4().hex[:12]}.sock')


def session_nodes(settings: GraphSettings) -> tuple[GraphNode, ...]:
    """The nodes of a session, in the order in which they are started.

    Without a simulated cell the drivers read from the devices of the session file. One that has
    none there is expected in the graph already: the session node waits for it and says so.
    """
    simulated = settings.simulate is not None
    clock: dict[str, ParameterValue] = {'use_sim_time': simulated}
    driver: dict[str, ParameterValue] = {'backend': 'cell', 'address': settings.address, **clock}
    recorded = RECORDED + (RECORDED_FRAMES if settings.frames else [])
    nodes = [
        GraphNode(
            LAST,
            'rtest_drivers',
            {
                'out': str(settings.out), 'session': settings.session, 'topics': recorded,
                **clock,
            },
        ),
        GraphNode(
            'estimator',
            'rtest_estimation',
            {
                'sphere_radius_mm': settings.sphere_radius * 1e3, 'nest': settings.nest, **clock,
            },
        ),
        *_identifier(settings, clock),
    ]
    if simulated:
        nodes += [
            GraphNode(
                'cell',
                'rtest_drivers',
                {
                    'truth': str(settings.simulate),
                    'address': settings.address,
                    'rate': float(settings.rate),
                    'epoch': 0,
                },
            ),
            GraphNode('gauges', 'rtest_drivers', driver, lifecycle=True),
            GraphNode('cnc', 'rtest_drivers', driver, lifecycle=True),
        ]
        if settings.thermal:
            nodes.append(GraphNode('thermometers', 'rtest_drivers', driver, lifecycle=True))
    else:
        nodes += [
            GraphNode(
                name,
                'rtest_drivers',
                {'backend': device.backend, 'address': str(device.file), **clock},
                lifecycle=True,
            )
            for name, device in settings.devices.items()
        ]
    nodes.append(
        GraphNode(
            LEADER,
            'rtest_drivers',
            {
                'config': str(settings.config),
                'session': settings.session,
                'simulated': simulated,
                'hold': settings.hold,
                **clock,
            },
        )
    )
    if settings.view is not None:
        nodes.append(view_node(*settings.view))
    if settings.frames:
        nodes.append(frames_node(clock))
    return tuple(nodes)


def view_node(host: str, port: int) -> GraphNode:
    """The node that serves the page. Raises UserError for what is no port."""
    if not 0 <= port <= 65535:
        raise UserError(f'--port {port}: expected a number from 0 to 65535')
    return GraphNode('view', 'rtest_drivers', {'host': host, 'port': port}, optional=True)


def frames_node(clock: Mapping[str, ParameterValue]) -> GraphNode:
    """The node that publishes tf. Raises UserError where its messages are not installed."""
    if find_spec('tf2_msgs') is None:
        raise UserError(
            'frames: cannot import tf2_msgs, the messages of tf; install ros-jazzy-tf2-msgs, or '
            'run `make setup` where ROS comes as wheels'
        )
    return GraphNode('frames', 'rtest_drivers', dict(clock), optional=True)


def _identifier(
    settings: GraphSettings, clock: dict[str, ParameterValue]
) -> tuple[GraphNode, ...]:
    """Who makes errors of finished cycles; nobody where only the chain is checked."""
    if settings.checks:
        return ()
    if settings.thermal:
        out = {'out': str(settings.folder / 'thermal')}
        return (GraphNode('thermal', 'rtest_identification', {**out, **clock}),)
    return (GraphNode('identifier', 'rtest_identification', clock),)


def ros_arguments(node: GraphNode, namespace: str = '', remaps: tuple[str, ...] = ()) -> list[str]:
    """Command-line arguments after `--ros-args` that `ros2 launch` would pass to the node."""
    arguments = ['-r', f'__node:={node.name}']
    if namespace:
        arguments += ['-r', '__ns:=/' + namespace.lstrip('/')]
    for rule in remaps:
        arguments += ['-r', rule]
    for name, value in node.parameters.items():
        # The value is read as YAML, of which JSON is a part: a session named 12 stays a string.
        arguments += ['-p', f'{name}:={json.dumps(value)}']
    return arguments
