"""Stamps of this host's clock that go on steadily whatever is done to it."""

from __future__ import annotations

import time

# The kernel steers the clock by less than 0.1 %; a larger difference was set.
_STEP_S = 0.05


class HostClock:
    """The wall clock of this host as it was when this was made, going on steadily.

    Where somebody sets the clock meanwhile, stamps go on as before, so that they neither go back
    nor jump away from those of another driver; `problem` says so. One for the life of a driver,
    not for each connection: a device that is opened again goes on in the time of the others.
    """

    def __init__(self) -> None:
        self._offset = _wall_ahead()

    def now(self) -> int:
        """The time [ns]."""
        return time.monotonic_ns() + self._offset

    def problem(self) -> str:
        """Whether the clock was set since, in one line; '' where it was not."""
        step = (_wall_ahead() - self._offset) * 1e-9
        if abs(step) < _STEP_S:
            return ''
        return (
            f"this host's clock was set by {step:+.3g} s; stamps go on in the time before; start "
            'the drivers again before the next session'
        )


def _wall_ahead() -> int:
    """Wall clock minus steady clock [ns]."""
    before = time.monotonic_ns()
    wall = time.time_ns()
    return wall - (before + time.monotonic_ns()) // 2
