"""Stop processes in order, and clean up what those that had to be killed leave behind."""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import signal
import socket
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

# How long a node may take to end after SIGINT, and then after SIGTERM [s].
PATIENCE_S = 5.0
SHARED_MEMORY = Path('/dev/shm')
# A segment exists for a moment before its process locks it [s].
_YOUNG_S = 10.0


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


def remove_leftovers() -> None:
    """Remove what nodes left that were killed in earlier sessions, with whoever watched them."""
    # What is younger may belong to a process that is just starting.
    remove_dead_shared_memory(0.0, until=time.time() - _YOUNG_S)
    remove_dead_sockets()


def remove_dead_shared_memory(
    since: float, folder: Path = SHARED_MEMORY, until: float = math.inf
) -> list[str]:
    """Remove Fast DDS segments and ports that lost their process, which cannot do it any more.

    A segment or port NAME has lock files ``NAME_el`` and, where several processes share it,
    ``NAME_sl``, which its processes hold locked as long as they live: where all can be locked, and
    no process maps it, none lives. Its mutex is ``sem.NAME_mutex``. Only files of this user from
    `since` to `until` (seconds since the epoch) are touched.

    Returns the names of the files that were removed.
    """
    removed: list[str] = []
    mapped = _mapped(folder)
    for base in sorted({_base(path.name) for path in folder.glob('*fastrtps_*')}):
        files = [folder / name for name in (base, f'{base}_el', f'{base}_sl', f'sem.{base}_mutex')]
        with contextlib.ExitStack() as held:
            if not all(_dead(path, since, until, mapped, held) for path in files):
                continue
            for path in files:
                with contextlib.suppress(OSError):
                    path.unlink()
                    removed.append(path.name)
    return removed


def remove_dead_sockets(folder: Path | None = None) -> list[str]:
    """Remove this user's sockets of simulated cells at which nobody listens; returns their names.

    folder : where sockets are; the system's folder for temporary files when it is not given
    """
    removed = []
    for path in sorted((folder or Path(tempfile.gettempdir())).glob('rtest-cell-*.sock')):
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as probe:
            if path.stat().st_uid != os.getuid() or not path.is_socket():
                continue
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:
                path.unlink()
                removed.append(path.name)
    return removed


def _base(name: str) -> str:
    """Segment or port that a file belongs to."""
    return name.removeprefix('sem.').removesuffix('_mutex').removesuffix('_el').removesuffix('_sl')


def _mapped(folder: Path) -> set[str]:
    """Paths below `folder` that a process maps, as far as this user may look."""
    found: set[str] = set()
    for maps in Path('/proc').glob('[0-9]*/maps'):
        # A process may end meanwhile, or be somebody else's.
        with contextlib.suppress(OSError):
            lines = maps.read_text(encoding='utf-8', errors='replace').splitlines()
            found.update(line[line.index('/') :] for line in lines if f' {folder}/' in line)
    return found


def _dead(
    path: Path, since: float, until: float, mapped: set[str], held: contextlib.ExitStack
) -> bool:
    """Whether nobody uses a file, or there is none; its lock is kept until `held` closes."""
    try:
        status = path.stat()
        if status.st_uid != os.getuid() or not since <= status.st_mtime <= until:
            return False
        if path.name.endswith(('_el', '_sl')):
            fcntl.flock(held.enter_context(path.open('rb')), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return str(path) not in mapped
