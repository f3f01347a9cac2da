"""Keys pressed while a command runs, one at a time, where there is a terminal."""

from __future__ import annotations

import contextlib
import select
import sys
import termios
import tty
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """A function that gives what was pressed since it was last called, '' for nothing."""
    if not sys.stdin.isatty():
        yield str
        return
    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    # Keys come without Enter, and Ctrl-C still interrupts.
    tty.setcbreak(terminal)
    try:
        yield lambda: sys.stdin.read(1) if select.select([terminal], [], [], 0.0)[0] else ''
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
