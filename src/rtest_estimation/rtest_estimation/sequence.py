"""Finds lost readings by the running index that every `GaugeBlock` carries."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Loss:
    """Readings that were taken and did not arrive.

    stamp : acquisition time of the first reading after the gap [ns]
    first : index of the first lost reading
    count : how many
    """

    stamp: int
    first: int
    count: int


class SequenceCheck:
    """Follows the index of one topic's readings, in order of arrival.

    The index starts at 0 with every start of the driver: a jump forward is a loss, a first index
    other than 0 means that the first readings are missing, a step back is a restart (counted in
    `restarts`) and is judged like a start.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.restarts = 0
        self._next = 0

    def add(self, stamp: int, sequence: int, readings: int) -> Loss | None:
        """Take note of one block; returns what was lost before it, if anything.

        stamp [ns] and sequence of its first reading, readings : how many it holds.
        """
        expected = self._next
        if sequence < expected:
            self.restarts += 1
            expected = 0
        self._next = sequence + readings
        if sequence == expected:
            return None
        self.lost += sequence - expected
        return Loss(stamp, expected, sequence - expected)
