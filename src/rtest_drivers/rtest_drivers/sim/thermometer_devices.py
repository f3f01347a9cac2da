"""A simulated thermocouple module, for a `GaugeDevice` on a pseudo-terminal.

It answers as Advantech's ADAM-4018 does (user's manual of the ADAM-4000 series, commands #AAN and
#AA): ``#010`` is channel 0 of the module at address 01, ``#01`` all of its channels; a value is a
sign and five digits with a point.
"""

from __future__ import annotations

import math

from rtest_drivers.sim.gauge_devices import Emulator


class ThermocoupleModule(Emulator):
    """Module at address 01; `read` gives its temperatures [deg C], NaN for a broken wire."""

    def answer(self, question: bytes) -> bytes:
        """To one question."""
        values = list(self.read())
        channel = question[3:]
        if question[:3] != b'#01' or (channel and not channel.isdigit()):
            return b'?01\r'
        chosen = [values[int(channel)]] if channel else values
        return b'>' + b''.join(_value(celsius) for celsius in chosen) + b'\r'

    def wrong(self, question: bytes) -> bytes:
        """Of another number of channels."""
        return b'>+022.00+022.00+022.00\r'

    def error(self, question: bytes) -> bytes:
        """It does not know the command."""
        return b'?01\r'


def _value(celsius: float) -> bytes:
    return b'+9999.9' if math.isnan(celsius) else b'%+07.2f' % celsius
