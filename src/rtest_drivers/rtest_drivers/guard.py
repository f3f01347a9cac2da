"""The process that ends a session's nodes when the runner is killed and cannot do it itself.

It reads ``pid rank`` lines from a pipe whose other end only the runner holds: when the runner
dies, however it dies, the pipe ends. A last line ``done`` means that nothing is left to do.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import time
from pathlib import Path

from rtest_drivers.processes import remove_dead_shared_memory, stop_in_order


class _Orphan:
    """Somebody else's child; the descriptor keeps its number from meaning another process."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._descriptor = os.pidfd_open(pid)

    def poll(self) -> int | None:
        ready, _, _ = select.select([self._descriptor], [], [], 0)
        return 0 if ready else None


def main() -> None:
    """Wait for the end of the pipe; then stop rank 0, then rank 1."""
    started = time.time() - 1.0
    for signum in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(signum, signal.SIG_IGN)
    ranks: tuple[list[_Orphan], list[_Orphan]] = ([], [])
    for line in sys.stdin:
        if line.strip() == 'done':
            return
        pid, rank = map(int, line.split())
        with contextlib.suppress(ProcessLookupError):
            ranks[rank].append(_Orphan(pid))
    stop_in_order(ranks)
    remove_dead_shared_memory(started)
    for path in sys.argv[1:]:
        Path(path).unlink(missing_ok=True)


if __name__ == '__main__':
    main()
