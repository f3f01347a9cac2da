"""Run a session: start the node graph, measure every cycle of the session file, record.

Without --simulate the nodes `gauges` and `cnc` are expected in the ROS graph of this
machine; with it a simulated machine cell takes their place, on this host only.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from rtest_drivers.config import config_path
from rtest_drivers.graph import GraphSettings, session_name
from rtest_drivers.runner import NodeFailed, Stopped, run_session
from rtest_estimation.errors import UserError

# Simulated seconds per second at which nodes on two processor cores lose nothing.
RATE = 10.0
HELP = 'run a measurement session and record it'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest session`."""
    parser.add_argument('--config', type=Path, metavar='YAML',
                        help='what to measure: machine, cycle, set-ups (default: the demo)')
    parser.add_argument('--session', metavar='NAME',
                        help='name of the session (default: name of the file, date, time)')
    parser.add_argument('--simulate', type=Path, metavar='TRUTH.yaml',
                        help='measure a simulated cell with the errors of this file')
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO',
                        help='remap a topic or service in all nodes; may be given several times')
    parser.add_argument('--namespace', default='', metavar='NS',
                        help='ROS namespace of all nodes and topics')
    add_run_arguments(parser)


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments that `rtest session` and `rtest demo` share."""
    parser.add_argument('--out', type=Path, default=Path('out'), metavar='DIR',
                        help='write to DIR/NAME (default: out)')
    parser.add_argument('--rate', type=float, default=RATE, metavar='N',
                        help=f'simulated seconds per second (default: {RATE:g}; 0 is as fast as '
                        'the cell can, which loses readings)')
    parser.add_argument('--domain', type=int, metavar='N',
                        help='ROS domain (default: ROS_DOMAIN_ID; simulated: a free one)')


def run(arguments: argparse.Namespace) -> int:
    """Run the session, then identify its recording."""
    from rtest_drivers.commands.identify import identify

    config = (arguments.config or config_path('demo.yaml')).absolute()
    settings = GraphSettings(
        config=config,
        session=arguments.session or session_name(config.stem),
        out=arguments.out.absolute(),
        simulate=arguments.simulate.absolute() if arguments.simulate else None,
        rate=arguments.rate,
        namespace=arguments.namespace,
        remaps=tuple(arguments.remap),
    )
    measure(settings, arguments.domain)
    identify(settings.folder)
    return 0


def measure(settings: GraphSettings, domain: int | None) -> None:
    """Run the graph for one session; says where things are, also when it ends early.

    Raises UserError, NodeFailed, Stopped.
    """
    from rtest_identification.plans import load_session

    # Mistakes in the files are told before anything is started; only the cell reads the truth.
    settings = replace(settings, sphere_radius=load_session(settings.config).sphere_radius)
    if settings.simulate is not None and not settings.simulate.is_file():
        raise UserError(f'{settings.simulate}: no such file; expected a truth file (YAML)')
    if domain is not None and not 0 <= domain <= 232:
        raise UserError(f'--domain {domain}: expected 0 to 232')
    if settings.folder.exists():
        raise UserError(f'{settings.folder}: exists already; choose another --session or --out')
    try:
        settings.log.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f'{settings.out}: cannot be written: {error.strerror}') from None
    print(f'recording to {shown(settings.recording)}, logs in {shown(settings.log)}', flush=True)
    try:
        run_session(settings, domain)
    except (NodeFailed, Stopped) as error:
        if settings.recording.exists():
            error.args = (f'{error}\n  recorded so far: {shown(settings.recording)}',)
        raise


def shown(path: Path) -> str:
    """A path as a person would type it: relative where it is below the current folder."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
