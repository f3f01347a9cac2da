"""Complaints of other nodes: which of them a session tells the person who waits."""

from __future__ import annotations

import re

# Warnings of these nodes are told at the end, or are the session's own.
QUIET = ('identifier', 'thermal', 'session')

_NUMBERS = re.compile(r'[\d., ]+')


class Complaints:
    """Remembers what was told, so that it is not told every second."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], tuple[int, str]] = {}

    def is_new(self, source: str, text: str, cycle: int) -> bool:
        """Whether a complaint is to be told: once per cycle, and not again while it is the same.

        It may carry numbers that change every second.

        source : name of the node; cycle : number of the cycle that is being measured
        """
        if source in QUIET:
            return False
        kind = _NUMBERS.sub('', text)
        told_in, last = self._told.get((source, kind), (-1, ''))
        if cycle == told_in or text == last:
            return False
        self._told[source, kind] = (cycle, text)
        return True
