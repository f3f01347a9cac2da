"""Computing beside a node that goes on answering."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, TypeVar

Result = TypeVar('Result')
# Of the thread: reading and recording come first.
_NICE = 10


class Background(Generic[Result]):
    """One computation at a time, in a thread that nobody waits for when the process ends.

    An executor of `concurrent.futures` would wait for it.

    take : called with each result, in the thread that calls `poll` or `wait`
    """

    def __init__(self, take: Callable[[Result], None]) -> None:
        self._take = take
        self._future: Future[Result] | None = None

    @property
    def busy(self) -> bool:
        """Whether there is a computation whose result was not taken."""
        return self._future is not None

    def start(self, compute: Callable[[], Result]) -> None:
        """Begin; the one before must have been taken."""
        if self._future is not None:
            raise RuntimeError('the computation before was not taken')
        future = self._future = Future()

        def work() -> None:
            # On Linux this is the thread's own.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
            try:
                future.set_result(compute())
            except BaseException as error:  # handed on to who takes the result
                future.set_exception(error)

        threading.Thread(target=work, daemon=True).start()

    def poll(self) -> None:
        """Take the result if it is there; raises what the computation has raised."""
        if self._future is not None and self._future.done():
            self.wait()

    def wait(self) -> None:
        """Take the result when it is there; returns at once where nothing was begun."""
        if self._future is not None:
            future, self._future = self._future, None
            self._take(future.result())
