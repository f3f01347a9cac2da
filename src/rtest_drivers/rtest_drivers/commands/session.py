"""Run a session: start the node graph, measure every cycle of the session file, record.

The session file says under `devices` where gauges and CNC are to be reached; --check tries them,
and measures and judges the whole chain where the file has a cycle of `kind: check`. A driver it
does not name is expected in the ROS graph of this machine. With --simulate a simulated machine
cell takes their place, on this host only.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtest_drivers.commands.view import check_address
from rtest_drivers.config import config_path
from rtest_drivers.domain import held_domain
from rtest_drivers.graph import (
    RATE,
    VIEW_HOST,
    VIEW_PORT,
    GraphSettings,
    frames_node,
    session_name,
    view_node,
)
from rtest_drivers.runner import NodeFailed, Stopped, run_session
from rtest_estimation.errors import UserError

if TYPE_CHECKING:
    from rtest_estimation.records import CyclePlan

HELP = 'run a measurement session and record it'
# What --check tries: the devices alone, or all that is between the sphere and the report.
DEVICES, CHAIN = 'devices', 'chain'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest session`."""
    parser.add_argument('--config', type=Path, metavar='YAML',
                        help='what to measure: machine, cycle, set-ups (default: the demo)')
    parser.add_argument('--session', metavar='NAME',
                        help='name of the session (default: name of the file, date, time)')
    parser.add_argument('--simulate', type=Path, metavar='TRUTH.yaml',
                        help='measure a simulated cell with the errors of this file')
    parser.add_argument('--check', nargs='?', choices=(DEVICES, CHAIN), const=CHAIN,
                        help='try every device of the session file and print what answers, rate, '
                        'jitter, skew, unit, range; then, where its cycle is of kind: check, '
                        'measure it and judge the whole chain as `rtest check` does. '
                        '`--check devices` measures nothing. Status 1 where something is wrong')
    parser.add_argument('--moves', action='store_true',
                        help='with --check: MOVES each axis of a LinuxCNC by 1 mm or 1 deg and '
                        'back, and says which sign, unit or name is wrong')
    parser.add_argument('--hold', action='store_true',
                        help='every cycle waits for `rtest ask start`, or for the page')
    parser.add_argument('--view', action='store_true',
                        help='show the session on a page, at --host and --port')
    parser.add_argument('--host', default=VIEW_HOST, metavar='ADDRESS',
                        help='of the page (default: 127.0.0.1, this computer only)')
    parser.add_argument('--port', type=int, default=VIEW_PORT, metavar='N',
                        help=f'of the page (default: {VIEW_PORT})')
    parser.add_argument('--frames', action='store_true',
                        help='publish tf of the machine, moved by its feedback, and record it')
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
                        help=f'simulated seconds per second (default: {RATE:g}, at which two '
                        'processor cores lose nothing; faster may lose readings)')
    parser.add_argument('--domain', type=int, metavar='N',
                        help='ROS domain (default: ROS_DOMAIN_ID; simulated: a free one, whatever '
                        'ROS_DOMAIN_ID is)')


def run(arguments: argparse.Namespace) -> int:
    """Run the session, then identify its recording, or judge the chain by it."""
    config = (arguments.config or config_path('demo.yaml')).absolute()
    if arguments.moves and not arguments.check:
        raise UserError('--moves: expected together with --check')
    if arguments.check:
        right, whole = _check(config, arguments)
        if not (right and whole):
            return 0 if right else 1
    settings = GraphSettings(
        config=config,
        session=arguments.session or session_name(config.stem),
        out=arguments.out.absolute(),
        simulate=arguments.simulate.absolute() if arguments.simulate else None,
        rate=arguments.rate,
        namespace=arguments.namespace,
        remaps=tuple(arguments.remap),
        hold=arguments.hold,
        view=(arguments.host, arguments.port) if arguments.view else None,
        frames=arguments.frames,
    )
    if settings.frames:
        frames_node({})
    if settings.view is not None:
        view_node(*settings.view)
        check_address(*settings.view)
    settings, complete = measure(settings, arguments.domain, bool(arguments.session))
    if settings.checks:
        return _judge(settings, complete)
    evaluate(settings, complete)
    return 0


def _check(path: Path, arguments: argparse.Namespace) -> tuple[bool, bool]:
    """Try the devices of a session file.

    A simulated cell has none, and a file that checks the whole chain need not name any.

    Returns whether all are right, and whether the whole chain is to be checked.
    """
    from rtest_drivers.device_check import check_session_devices
    from rtest_drivers.devices import check_devices
    from rtest_identification.session_file import load_session

    config = load_session(path)
    chain = arguments.check == CHAIN and config.checks
    example = shown(config_path('check_example.yaml'))
    if arguments.simulate is not None:
        if not chain:
            raise UserError(
                '--check: a simulated cell has no devices to try; leave --simulate out, or give a '
                f'session file with cycle: {{kind: check}}, as {example}, to check the whole chain'
            )
        return True, chain
    if not config.devices and not chain:
        raise UserError(f'{path}: devices: missing, --check tries what it names')
    check_devices(config, path)
    wrong = check_session_devices(config, arguments.moves)
    for line in wrong:
        print(f'rtest: {line}', file=sys.stderr)
    if not wrong and not chain and arguments.check == CHAIN:
        print('the whole chain, with nest, sphere and noise, is checked with a session file of '
              f'cycle: {{kind: check}}, as {example}')
    if config.devices:
        print(f'{shown(path)}: '
              + (f'{len(wrong)} found wrong' if wrong else 'every device answers'))
    return not wrong, chain


def _judge(settings: GraphSettings, complete: bool) -> int:
    """Judge the chain by what was recorded; returns the exit status."""
    from rtest_drivers.commands.check import judge
    from rtest_identification.session_file import load_session

    try:
        wrong = judge(settings.folder, load_session(settings.config).approach.direction)
    except UserError as error:
        raise NodeFailed(f'{error}\n  recorded: {shown(settings.recording)}') from None
    if not complete:
        raise _incomplete(settings, 'the verdicts are of what there is; to judge it again')
    return wrong


def measure(
    settings: GraphSettings, domain: int | None, named: bool = False
) -> tuple[GraphSettings, bool]:
    """Run the graph for one session; says where things are, also when it ends early.

    named : whether the user has chosen the session's name; another is changed where it is taken

    Returns the settings with the name the session got, and whether every cycle was measured.
    Raises UserError, NodeFailed, Stopped.
    """
    from rtest_drivers.devices import check_devices
    from rtest_identification.session_file import load_session

    # Mistakes in the files are told before anything is started.
    config = load_session(settings.config)
    settings = settings.of(config)
    simulated = settings.simulate is not None
    if simulated:
        _check_truth(settings.simulate, config.plans)
    else:
        check_devices(config, settings.config)
    try:
        with held_domain(simulated, domain, settings.namespace) as number:
            settings = _reserve(settings, named)
            print(
                f'recording to {shown(settings.recording)}, logs in {shown(settings.log)}',
                flush=True,
            )
            return settings, run_session(settings, number)
    except (NodeFailed, Stopped) as error:
        if settings.recording.exists():
            error.args = (
                f'{error}\n  recorded so far: {shown(settings.recording)}; to evaluate it: '
                f'{_again(settings)}',
            )
        raise


def evaluate(settings: GraphSettings, complete: bool) -> Path:
    """Identify what a session has recorded, also where it is incomplete.

    Returns the path of identification.json, or of thermal.json after a thermal session, or of
    dynamic.json where there is no static cycle. Raises NodeFailed where something is missing.
    """
    from rtest_drivers.commands import dynamic
    from rtest_drivers.commands.identify import identify
    from rtest_drivers.commands.thermal import evaluate as thermal
    from rtest_estimation.records import Kind
    from rtest_identification.session_file import load_session

    kinds = {plan.kind for plan in load_session(settings.config).plans}
    try:
        if Kind.DYNAMIC in kinds:
            result = dynamic.evaluate(settings.folder)
        if Kind.STATIC in kinds:
            result = (thermal if settings.thermal else identify)(settings.folder, quiet=True)
    except UserError as error:
        raise NodeFailed(f'{error}\n  recorded: {shown(settings.recording)}') from None
    if not complete:
        raise _incomplete(settings, 'the report holds what there is; to identify it again')
    return result


def _incomplete(settings: GraphSettings, what: str) -> NodeFailed:
    return NodeFailed(
        f'session {settings.session} is incomplete, see above; {what}: {_again(settings)}'
    )


def _again(settings: GraphSettings) -> str:
    from rtest_identification.session_cycle import DYNAMIC
    from rtest_identification.session_file import load_session

    command = 'thermal' if settings.thermal else 'check' if settings.checks else 'identify'
    if load_session(settings.config).kind == DYNAMIC:
        command = 'dynamic'
    return f'rtest {command} {shlex.quote(shown(settings.folder))}'


def _check_truth(truth: Path, plans: Sequence[CyclePlan]) -> None:
    """Refuse a wrong truth file; tell faults that never occur in these plans.

    In a process of its own: the truth is known to nothing that estimates.
    """
    cycles = [f'{plan.cycle}={len(plan.commands)}' for plan in plans]
    done = subprocess.run(
        [sys.executable, '-m', 'rtest_drivers.sim.truth', str(truth), *cycles],
        capture_output=True, text=True, check=False,
    )
    if done.returncode == 2:
        raise UserError(done.stderr)
    if done.returncode:
        raise NodeFailed(f'{truth}: could not be checked\n{done.stderr}')
    for line in done.stdout.splitlines():
        print(f'warning: {line}', flush=True)


def _reserve(settings: GraphSettings, named: bool) -> GraphSettings:
    """Make the folder of the logs; where the user has not chosen a name, one that nobody has."""
    name, number = settings.session, 1
    while True:
        taken = settings.folder.exists()
        if taken and named:
            raise UserError(
                f'{settings.folder}: exists already; choose another --session or --out'
            )
        try:
            if not taken:
                settings.log.mkdir(parents=True, exist_ok=named)
                return settings
        except FileExistsError:
            if named or not settings.log.is_dir():
                raise UserError(f'{settings.out}: cannot be written: File exists') from None
        except OSError as error:
            raise UserError(f'{settings.out}: cannot be written: {error.strerror}') from None
        # Another session was started in the same second.
        number += 1
        settings = replace(settings, session=f'{name}-{number}')


def shown(path: Path) -> str:
    """A path as a person would type it: relative where it is below the current folder."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)
