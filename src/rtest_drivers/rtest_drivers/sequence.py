"""Counting readings from the start of a driver, so that a jump shows a loss."""

from __future__ import annotations


class Sequence:
    """Makes a device's own count start at zero and go on after the device started again.

    losses : readings that were acquired but did not arrive; restarts : of the device
    """

    def __init__(self) -> None:
        self.next = 0
        self.losses = 0
        self.restarts = 0
        self._base: int | None = None

    def number(self, device: int, readings: int) -> int:
        """The driver's index of the first of `readings` that the device counts from `device`."""
        if self._base is None:
            self._base = device
        index = device - self._base
        if index < self.next:
            # The device counts from its start again. How many were lost is not known: the jump
            # by one keeps it visible that some may be.
            index = self.next + 1
            self._base = device - index
            self.restarts += 1
        self.losses += index - self.next
        self.next = index + readings
        return index
