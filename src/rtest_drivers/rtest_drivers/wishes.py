"""What a person may ask of a running session, and when it is granted."""

from __future__ import annotations

REPEAT, SKIP = 'repeat', 'skip'
START, CALIBRATE, ABORT = 'start', 'calibrate', 'abort'
# What then happens to the cycle.
GRANTED = {
    START: 'starts',
    REPEAT: 'is measured anew',
    SKIP: 'is left',
    CALIBRATE: 'is measured anew after a calibration of the nest',
    ABORT: 'ends, and the session with it',
}


class Wishes:
    """The wish that was granted last, and what decides on the next one.

    wish : '' where nothing was asked for since the cycle began
    held : the cycle that waits to be started, '' where none does
    following : whether a cycle on a real machine is waited for
    """

    def __init__(self) -> None:
        self.wish = self.held = ''
        self.following = False

    def refuses(self, wish: str, simulated: bool) -> str:
        """Why a wish cannot be granted; '' where it can.

        simulated : whether a simulated cycle is being measured
        """
        if wish == START:
            return '' if self.held else 'no cycle waits to be started'
        if self.held:
            return 'there is nothing to repeat' if wish == REPEAT else ''
        # A simulated cycle needs nobody, and goes on to its end before a calibration. Otherwise a
        # wish would be remembered, and meet a cycle that nobody meant.
        interrupts = wish in (REPEAT, SKIP)
        if self.following or (simulated and not interrupts):
            return ''
        return f'there is nothing to {"repeat or skip" if interrupts else wish}'
