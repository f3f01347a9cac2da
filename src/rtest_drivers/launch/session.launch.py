"""The graph of a session under `ros2 launch`; `rtest session` starts the same nodes without it."""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node

from launch import LaunchContext, LaunchDescription
from rtest_drivers.config import config_path
from rtest_drivers.graph import (
    ONE_THREAD,
    VIEW_HOST,
    VIEW_PORT,
    GraphSettings,
    session_name,
    session_nodes,
)
from rtest_identification.session_file import load_session

ARGUMENTS = {
    'config': (str(config_path('demo.yaml')), 'session file: machine, cycle, set-ups (YAML)'),
    'out': ('out', 'the recording is written to out/session/session.mcap'),
    'session': ('', 'name of the session; empty: name of the file, date and time'),
    'simulate': ('', 'truth file of a simulated cell; empty: the devices of the session file'),
    'rate': ('1.0', 'simulated seconds per second'),
    'namespace': ('', 'of every node and topic'),
    'hold': ('false', 'whether every cycle waits for the service session/start'),
    'view': ('false', 'whether a page shows the session at http://127.0.0.1:8090/'),
    'frames': ('false', 'whether tf of the machine is published and recorded'),
}


def graph(context: LaunchContext) -> list[Node]:
    """Launch actions of the nodes; any node that ends, ends the launch."""
    chosen = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    config = Path(chosen['config']).absolute()
    settings = GraphSettings(
        config=config,
        session=chosen['session'] or session_name(config.stem),
        out=Path(chosen['out']).absolute(),
        simulate=Path(chosen['simulate']).absolute() if chosen['simulate'] else None,
        rate=float(chosen['rate']),
        namespace=chosen['namespace'],
        hold=chosen['hold'] == 'true',
        view=(VIEW_HOST, VIEW_PORT) if chosen['view'] == 'true' else None,
        frames=chosen['frames'] == 'true',
    )
    settings = settings.of(load_session(config))
    return [
        (LifecycleNode if node.lifecycle else Node)(
            package=node.package,
            executable=node.name,
            name=node.name,
            namespace=settings.namespace,
            parameters=[node.parameters],
            output='screen',
            on_exit=None if node.optional else Shutdown(),
        )
        for node in session_nodes(settings)
    ]


def generate_launch_description() -> LaunchDescription:
    """Entry point of `ros2 launch rtest_drivers session.launch.py`."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    threads = [SetEnvironmentVariable(name, value) for name, value in ONE_THREAD.items()]
    return LaunchDescription([*arguments, *threads, OpaqueFunction(function=graph)])
