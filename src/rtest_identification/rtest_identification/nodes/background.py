"""Computing beside a node that goes on answering."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Result = TypeVar('Result')
# Of the thread: reading and recording come first.
_NICE = 10


class Background(Generic[Result]):
    """One computation at a time, in a thread that nobody waits for when the process ends.

    take : called with each result, in the thread that calls `poll` or `wait`
    """

    def __init__(self, take: Callable[[Result], None]) -> None:
        self._take = take
        self._thread: threading.Thread | None = None
        self._outcome: list[Result | BaseException] = []

    @property
    def busy(self) -> bool:
        """Whether there is a computation whose result was not taken."""
        return self._thread is not None

    def start(self, compute: Callable[[], Result]) -> None:
        """Begin; the one before must have been taken."""
        if self._thread is not None:
            raise RuntimeError('the computation before was not taken')

        def work() -> None:
            # On Linux this is the thread's own.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
            try:
                self._outcome.append(compute())
            except BaseException as error:  # handed on to who takes the result
                self._outcome.append(error)

        self._thread = threading.Thread(target=work, daemon=True)
        self._thread.start()

    def poll(self) -> None:
        """Take the result if it is there; raises what the computation has raised."""
        if self._thread is not None and not self._thread.is_alive():
            self.wait()

    def wait(self) -> None:
        """Take the result when it is there; returns at once where nothing was begun."""
        if self._thread is None:
            return
        self._thread.join()
        self._thread, outcome = None, self._outcome.pop()
        if isinstance(outcome, BaseException):
            raise outcome
        self._take(outcome)
