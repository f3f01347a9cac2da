"""The launch file starts what `rtest session` starts; `launch` itself is played."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from rtest_drivers import graph
from rtest_drivers.config import config_path
from rtest_drivers.graph import GraphSettings, session_nodes
from rtest_estimation.errors import UserError

LAUNCH_FILE = Path(__file__).parents[1] / 'launch' / 'session.launch.py'


class _Configuration:
    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


def _recorded(kind: str):
    return lambda *args, **kwargs: SimpleNamespace(kind=kind, args=args, **kwargs)


@pytest.fixture
def launch_file(monkeypatch):
    """What the launch file defines, run with stand-ins for launch and launch_ros."""
    for module, names in {
        'launch': {'LaunchContext': dict, 'LaunchDescription': list},
        'launch.actions': {
            name: _recorded(name)
            for name in (
                'DeclareLaunchArgument', 'OpaqueFunction', 'SetEnvironmentVariable', 'Shutdown',
            )
        },
        'launch.substitutions': {'LaunchConfiguration': _Configuration},
        'launch_ros': {},
        'launch_ros.actions': {name: _recorded(name) for name in ('LifecycleNode', 'Node')},
    }.items():
        stand_in = ModuleType(module)
        vars(stand_in).update(names)
        monkeypatch.setitem(sys.modules, module, stand_in)
    return runpy.run_path(str(LAUNCH_FILE))


def start(launch_file, **chosen: str) -> list[SimpleNamespace]:
    """Nodes that are launched with these arguments."""
    *before, opaque = launch_file['generate_launch_description']()
    context = {a.args[0]: a.default_value for a in before if a.kind == 'DeclareLaunchArgument'}
    assert set(chosen) <= set(context)
    return opaque.function(context | chosen)


def test_same_nodes_and_parameters_as_the_runner(launch_file, tmp_path):
    nodes = start(
        launch_file, session='monday', out=str(tmp_path), namespace='cell_1', rate='2.0',
        simulate=str(config_path('cell_demo.yaml')),
    )
    address = next(n for n in nodes if n.name == 'cell').parameters[0]['address']
    settings = GraphSettings(
        config_path('demo.yaml'), 'monday', tmp_path, config_path('cell_demo.yaml'), rate=2.0,
        address=address,
    )
    expected = session_nodes(settings)
    assert [n.name for n in nodes] == [n.name for n in expected]
    for node, other in zip(nodes, expected, strict=True):
        assert (node.package, node.executable) == (other.package, other.name)
        assert node.parameters == [other.parameters]
        assert node.kind == ('LifecycleNode' if other.lifecycle else 'Node')
        assert node.namespace == 'cell_1' and node.on_exit.kind == 'Shutdown'


def test_the_estimator_is_told_of_which_kind_the_nest_is(launch_file, tmp_path):
    for name, kind, radius in (('demo.yaml', 'contact', 12.7), ('laser.yaml', 'laser', 25.0)):
        nodes = start(
            launch_file, config=str(config_path(name)), out=str(tmp_path),
            simulate=str(config_path('cell_demo.yaml')),
        )
        (parameters,) = next(n for n in nodes if n.name == 'estimator').parameters
        assert parameters['nest'] == kind
        assert parameters['sphere_radius_mm'] == pytest.approx(radius)


def test_real_drivers_are_not_started(launch_file):
    assert not {'cell', 'gauges', 'cnc'} & {node.name for node in start(launch_file)}


def test_frames_are_recorded_and_their_end_does_not_end_the_session(launch_file, monkeypatch):
    monkeypatch.setattr(graph, 'find_spec', lambda name: name)
    nodes = {node.name: node for node in start(launch_file)}
    assert 'frames' not in nodes
    assert not {'/tf', '/tf_static'} & set(nodes['recorder'].parameters[0]['topics'])
    for truth in ('', str(config_path('cell_demo.yaml'))):
        nodes = {node.name: node for node in start(launch_file, frames='true', simulate=truth)}
        assert nodes['frames'].parameters == [{'use_sim_time': bool(truth)}]
        assert nodes['frames'].on_exit is None and nodes['session'].on_exit.kind == 'Shutdown'
        assert nodes['recorder'].parameters[0]['topics'] == [
            'rtest/.*', '/diagnostics', 'robot_description', '/tf', '/tf_static',
        ]


def test_without_the_messages_of_tf_frames_are_refused(launch_file, monkeypatch):
    monkeypatch.setattr(graph, 'find_spec', lambda name: None)
    with pytest.raises(UserError, match='install ros-jazzy-tf2-msgs'):
        start(launch_file, frames='true')


def test_every_executable_is_installed(launch_file, monkeypatch):
    monkeypatch.setattr(graph, 'find_spec', lambda name: name)
    sources = LAUNCH_FILE.parents[2]
    truth = str(config_path('cell_demo.yaml'))
    for node in start(launch_file, simulate=truth, frames='true', view='true'):
        assert f"'{node.executable} = {node.package}.nodes.{node.executable}:main'" in (
            sources / node.package / 'setup.py'
        ).read_text()
