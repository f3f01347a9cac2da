"""Run a session's nodes as one process each where there is no `ros2 launch`.

The runner needs no ROS itself. It stops all nodes when one fails, on Ctrl-C and on SIGTERM; the
recorder last, so that the end is in the recording. A guard process does the same when the runner
is killed.
"""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from rtest_drivers.domain import session_environment
from rtest_drivers.graph import (
    INCOMPLETE,
    LAST,
    LEADER,
    GraphSettings,
    ros_arguments,
    session_nodes,
)
from rtest_drivers.processes import (
    PATIENCE_S,
    remove_dead_shared_memory,
    remove_leftovers,
    stop_in_order,
)
from rtest_estimation.errors import UserError

LOG_TAIL = 12
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class NodeFailed(RuntimeError):
    """A node ended before the session did, or the session itself failed."""


class Stopped(RuntimeError):
    """The user or the system asked to stop; everything was stopped in order."""

    def __init__(self, signum: int) -> None:
        super().__init__(f'stopped by {signal.Signals(signum).name}')
        self.signum = signum


@dataclass(frozen=True)
class Command:
    """One process to run.

    log : where its output goes
    shown : its standard output goes to the user instead (standard error still to the log)
    optional : whether the others go on when it ends
    """

    name: str
    arguments: tuple[str, ...]
    log: Path
    shown: bool = False
    optional: bool = False


def run_session(settings: GraphSettings, domain: int) -> bool:
    """Run a session to its end in a ROS domain; returns whether every cycle was measured.

    Raises UserError for a user's mistake, NodeFailed, Stopped.
    """
    need_ros()
    remove_leftovers()
    environment = session_environment(settings.simulate is not None, domain)
    commands = [
        Command(
            node.name,
            (
                sys.executable, '-m', node.module, '--ros-args', '--disable-external-lib-logs',
                *ros_arguments(node, settings.namespace, settings.remaps),
            ),
            settings.log / f'{node.name}.log',
            shown=node.name == LEADER or node.optional,
            optional=node.optional,
        )
        for node in session_nodes(settings)
    ]
    return run(commands, environment=environment, leftovers=(settings.address,))


def need_ros() -> None:
    """Raise UserError where there is no ROS or no interface package."""
    for module, remedy in (
        ('rclpy', 'source a ROS 2 set-up or run `make demo` once'),
        ('rtest_msgs', 'build src/rtest_msgs with `colcon build` or run `make demo` once'),
    ):
        if find_spec(module) is None:
            raise UserError(f'cannot import {module}, which nodes need; {remedy}')


def run(
    commands: Sequence[Command],
    leader: str = LEADER,
    last: str = LAST,
    environment: dict[str, str] | None = None,
    leftovers: Sequence[str] = (),
    patience: float = PATIENCE_S,
) -> bool:
    """Run commands until `leader` ends, then stop the rest, `last` after all others.

    patience : see `stop` [s]
    leftovers : files that killed processes may leave; removed at the end

    Returns False where the leader ended with status `INCOMPLETE`.

    Raises NodeFailed when one fails, UserError when one reports a user's mistake (status 2),
    Stopped on a signal.
    """
    started = time.time()
    children: dict[str, subprocess.Popen] = {}
    with _signals() as received, _guard(leftovers) as guard:
        try:
            for command in commands:
                child = children[command.name] = _start(command, environment)
                guard.write(f'{child.pid} {int(command.name == last)}\n')
                guard.flush()
            needed = {c.name: children[c.name] for c in commands if not c.optional}
            optional = {c.name: (children[c.name], c.log) for c in commands if c.optional}
            failed = _watch(needed, leader, received, optional)
            # What failed by itself is known; what ends from here on was told to.
            codes = {name: child.poll() for name, child in children.items()}
        finally:
            others = [child for name, child in children.items() if name != last]
            rest = [children[last]] if last in children else []
            killed = stop_in_order([others, rest], patience)
            remove_dead_shared_memory(started - 1.0)
            for path in leftovers:
                Path(path).unlink(missing_ok=True)
    if received:
        raise Stopped(received[0])
    logs = {command.name: command.log for command in commands}
    if failed is not None:
        raise _failure(failed, codes[failed], logs[failed])
    if children[last].returncode not in (0, -signal.SIGINT, 128 + signal.SIGINT):
        raise _failure(last, children[last].returncode, logs[last])
    for child in killed:
        name = next(name for name, other in children.items() if other is child)
        raise NodeFailed(f'node {name} did not end and had to be killed; its log: {logs[name]}')
    return codes[leader] == 0


def _watch(
    children: dict[str, subprocess.Popen],
    leader: str,
    received: list[int],
    optional: dict[str, tuple[subprocess.Popen, Path]],
) -> str | None:
    """Wait for the first to end or for a signal; returns who failed, None for a normal end.

    optional : the others and their logs; that one of them has ended is told
    """
    while not received:
        for name in [name for name, (child, _) in optional.items() if child.poll() is not None]:
            _, log = optional.pop(name)
            print(f'node {name} has ended, the session goes on; its log: {log}', flush=True)
        # The leader last: when a node and the leader end together, the node is the cause.
        for name in sorted(children, key=lambda name: name == leader):
            code = children[name].poll()
            if code is not None:
                return None if name == leader and code in (0, INCOMPLETE) else name
        time.sleep(0.05)
    return None


def _start(command: Command, environment: dict[str, str] | None) -> subprocess.Popen:
    command.log.parent.mkdir(parents=True, exist_ok=True)
    with command.log.open('ab') as log:
        # A session of its own: the terminal's Ctrl-C reaches the runner only, which keeps order.
        return subprocess.Popen(
            command.arguments,
            stdin=subprocess.DEVNULL,
            stdout=None if command.shown else log,
            stderr=log,
            env=environment,
            start_new_session=True,
        )


def _failure(name: str, code: int | None, log: Path) -> Exception:
    """Why a node ended: a user's mistake (status 2) is its last line, the rest is a failure."""
    lines = [
        line for line in log.read_text(encoding='utf-8', errors='replace').splitlines() if line
    ]
    if code == 2 and lines:
        return UserError(lines[-1].removeprefix('rtest: ').removeprefix(f'{name}: '))
    ended = f'was killed by {signal.Signals(-code).name}' if code and code < 0 else (
        f'ended with status {code}'
    )
    tail = ''.join(f'\n  {line}' for line in lines[-LOG_TAIL:])
    return NodeFailed(f'node {name} {ended}; its log: {log}{tail}')


@contextlib.contextmanager
def _signals() -> Iterator[list[int]]:
    """Collect signals that ask to stop, instead of being interrupted by them."""
    received: list[int] = []
    before = {
        signum: signal.signal(signum, lambda number, _frame: received.append(number))
        for signum in _SIGNALS
        # Under nohup the session is to survive its terminal.
        if signum != signal.SIGHUP or signal.getsignal(signum) is not signal.SIG_IGN
    }
    try:
        yield received
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)


@contextlib.contextmanager
def _guard(leftovers: Sequence[str]) -> Iterator:
    """The guard process's pipe; told that all is done when everything was stopped here."""
    process = subprocess.Popen(
        (sys.executable, '-m', 'rtest_drivers.guard', *leftovers),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    try:
        yield process.stdin
        process.stdin.write('done\n')
    finally:
        # After an error in stopping the guard sees the end of the pipe and tries again.
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        process.wait()
