"""Stop processes in order, and clean up what those that had to be killed leave behind."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

# How long a node may take to end after SIGINT, and then after SIGTERM [s].
PATIENCE_S = 5.0
SHARED_MEMORY = Path('/dev/shm')


class Process(Protocol):
    """What `stop` needs of a process that leads a process group of its own."""

    pid: int

    def poll(self) -> int | None:
        """Exit status, or None while it runs."""


def stop(processes: Iterable[Process], patience: float = PATIENCE_S) -> list[Process]:
    """End processes: SIGINT, SIGTERM after `patience` seconds, SIGKILL after as many more.

    Returns those that had to be killed.
    """
    running = list(processes)
    for signum in (signal.SIGINT, signal.SIGTERM):
        running = [process for process in running if process.poll() is None]
        for process in running:
            _send(process, signum)
        deadline = time.monotonic() + patience
        while running and time.monotonic() < deadline:
            time.sleep(0.02)
            running = [process for process in running if process.poll() is None]
        if not running:
            return []
    for process in running:
        _send(process, signal.SIGKILL)
    while any(process.poll() is None for process in running):
        time.sleep(0.02)
    return running


def stop_in_order(groups: Sequence[Iterable[Process]], patience: float = PATIENCE_S) -> list:
    """`stop` one group after the other; returns all that had to be killed."""
    return [process for group in groups for process in stop(group, patience)]


def _send(process: Process, signum: signal.Signals) -> None:
    # The whole group, so that nothing a node has started itself stays behind.
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signum)


def remove_dead_shared_memory(since: float, folder: Path = SHARED_MEMORY) -> list[str]:
    """Remove Fast DDS segments that lost their process; a killed node cannot do it itself.

    A segment NAME has lock files ``NAME_el`` and, where several processes share it, ``NAME_sl``,
    which its processes hold locked as long as they live: where all can be locked, none lives. Only
    files of this user that are not older than `since` (seconds since the epoch) are touched.

    Returns the names of the files that were removed.
    """
    removed: list[str] = []
    for base in sorted({path.name[:-3] for path in folder.glob('fastrtps_*_[es]l')}):
        locks = [folder / f'{base}{suffix}' for suffix in ('_el', '_sl')]
        with contextlib.ExitStack() as held:
            if not all(_lock_dead(path, since, held) for path in locks if path.exists()):
                continue
            for path in (folder / base, *locks, folder / f'sem.{base}_mutex'):
                with contextlib.suppress(OSError):
                    path.unlink()
                    removed.append(path.name)
    return removed


def _lock_dead(path: Path, since: float, held: contextlib.ExitStack) -> bool:
    """Lock a lock file of this run until `held` closes; False where a process has it."""
    try:
        status = path.stat()
        if status.st_uid != os.getuid() or status.st_mtime < since:
            return False
        fcntl.flock(held.enter_context(path.open('rb')), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
