"""Simulated gauge controllers on pseudo-terminals, with the faults of real lines.

Each answers as its manual says; the formats are written here once more, independent of the
drivers that read them.
"""

from __future__ import annotations

import math
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

Displacements = Callable[[], Sequence[float]]
# What `GaugeDevice.fault` can be, besides '' for none.
FAULTS = {
    'silent': 'no answer',
    'late': 'the answer comes late, after `late` seconds',
    'half': 'the first half of the answer',
    'garbage': 'random bytes, as with a wrong baud rate',
    'flip': 'one bit of the answer is wrong',
    'wrong': 'the answer to another question',
    'error': 'the device refuses the question',
}
_LOOK_S = 0.05


class Emulator:
    """What a controller answers.

    read : gives the displacement of each gauge [m]; NaN is no measurement, infinite is over range
    """

    terminator = b'\r'

    def __init__(self, read: Displacements) -> None:
        self.read = read

    def answer(self, question: bytes) -> bytes:
        """To a whole question, without its terminator."""
        raise NotImplementedError

    def wrong(self, question: bytes) -> bytes:
        """A legal answer to another question."""
        raise NotImplementedError

    def error(self, question: bytes) -> bytes:
        """What it says when it refuses the question."""
        raise NotImplementedError

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Whole questions in what has come, and the rest."""
        *questions, rest = data.split(self.terminator)
        return questions, rest


class Lkg(Emulator):
    """Keyence LK-G: M0 (both outputs), M1, M2, Q0, R0, SW,CA,n; mm with four decimals."""

    def __init__(self, read: Displacements) -> None:
        super().__init__(read)
        self.measuring = True
        self.sampling = 0

    def answer(self, question: bytes) -> bytes:
        """To one command."""
        if question in (b'Q0', b'R0'):
            mode = question == b'R0'
            known, self.measuring = self.measuring is mode, mode
            return b'ER,' + question + b',01\r' if known else question + b'\r'
        if question.startswith(b'SW,CA,'):
            if self.measuring:
                return b'ER,SW,01\r'
            self.sampling = int(question[6:])
            return b'SW,CA\r'
        outputs = {b'M0': (0, 1), b'M1': (0,), b'M2': (1,)}.get(question)
        if outputs is None:
            return b'ER,' + question[:2] + b',00\r'
        if not self.measuring:
            return b'ER,' + question + b',01\r'
        values = [*self.read(), math.nan][:2]
        return question + b''.join(b',' + _lkg_value(values[one]) for one in outputs) + b'\r'

    def wrong(self, question: bytes) -> bytes:
        """Of the second output."""
        return b'M2,+00.0123\r'

    def error(self, question: bytes) -> bytes:
        """Status error."""
        return b'ER,' + question[:2] + b',01\r'


class Lkg5000(Emulator):
    """Keyence LK-G5000: MM and a mask of twelve outputs, MS and the number of one."""

    def answer(self, question: bytes) -> bytes:
        """To one command."""
        values = list(self.read())
        if question.startswith(b'MM,') and len(question) == 15:
            chosen = [index for index, bit in enumerate(question[3:]) if bit == ord('1')]
        elif question.startswith(b'MS,'):
            chosen = [int(question[3:]) - 1]
        else:
            return b'ER,' + question[:2] + b',50\r'
        values += [math.nan] * 12
        return question + b''.join(b',' + _lkg_value(values[one]) for one in chosen) + b'\r'

    def wrong(self, question: bytes) -> bytes:
        """Of one output."""
        return b'MS,02,+00.0123\r'

    def error(self, question: bytes) -> bytes:
        """Status error."""
        return b'ER,' + question[:2] + b',51\r'


class Nd287(Emulator):
    """Heidenhain ND 287: Ctrl-B and ESC A0200 CR; mm with four decimals."""

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        """Ctrl-B is a question without terminator."""
        return super().split(data.replace(b'\x02', b'\x02\r'))

    def answer(self, question: bytes) -> bytes:
        """To Ctrl-B or one command."""
        value = self.read()[0] * 1e3
        if question == b'\x02':
            if not math.isfinite(value):
                return b'+    0.0000 ?  \r\n'
            return (b'-' if value < 0.0 else b'+') + b'%10.4f    \r\n' % abs(value)
        if question == b'\x1bA0200':
            # The manual gives no answer for a gauge without signal.
            return b'\x02%+010d\r\n' % round(value * 1e4) if math.isfinite(value) else b'\x15'
        return b'\x15'

    def wrong(self, question: bytes) -> bytes:
        """To the other of the two."""
        return b'\x02+000000123\r\n' if question == b'\x02' else b'+    0.0123    \r\n'

    def error(self, question: bytes) -> bytes:
        """NAK."""
        return b'\x15'


class Mux10(Emulator):
    """Mitutoyo multiplexer: the number of an input and CR; mm with four decimals."""

    def answer(self, question: bytes) -> bytes:
        """Of one input."""
        values = self.read()
        if not question.isdigit() or not 1 <= int(question) <= len(values):
            return b'9' + question[:1] + b'2\r'
        value = values[int(question) - 1] * 1e3
        if not math.isfinite(value):
            return b'9' + question + b'1\r'
        sign = b'-' if value < 0.0 else b'+'
        return b'0' + question + b'A' + sign + b'%08.4f\r' % abs(value)

    def wrong(self, question: bytes) -> bytes:
        """Of the ninth input."""
        return b'09A+000.0123\r'

    def error(self, question: bytes) -> bytes:
        """A status."""
        return b'9' + question + b'1\r'


class Digimatic(Emulator):
    """13 nibbles in hexadecimal digits, whatever is asked; mm with three decimals."""

    def answer(self, question: bytes) -> bytes:
        """The reading."""
        if not math.isfinite(self.read()[0]):
            return self.error(question)
        value = round(self.read()[0] * 1e6)
        return b'FFFF%d%06d30\r\n' % (8 if value < 0 else 0, abs(value))

    def wrong(self, question: bytes) -> bytes:
        """Nothing tells one answer from another."""
        return self.answer(question)

    def error(self, question: bytes) -> bytes:
        """Sign nibble that does not exist."""
        return b'FFFF5000000 30\r\n'


class GaugeDevice:
    """A controller at the end of a line that can be unplugged.

    port : path that stands for the line while it is plugged in, a link to the pseudo-terminal
    fault : key of FAULTS, or ''; delay : from question to answer [s]; late : of the fault [s]
    """

    def __init__(self, emulator: Emulator, port: Path | str, seed: int = 0) -> None:
        self.emulator, self.port = emulator, str(port)
        self.fault, self.delay, self.late = '', 0.0, 0.6
        self._rng = np.random.default_rng(seed)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.plug()

    def plug(self) -> None:
        """Plug the line in; does nothing where it is."""
        if self._thread is not None:
            return
        master, slave = os.openpty()
        tty.setraw(slave)
        os.symlink(os.ttyname(slave), self.port)
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, args=(master, slave), daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Pull the plug; does nothing where it is out."""
        if self._thread is None:
            return
        self._stop.set()
        self._thread.join()
        self._thread = None

    close = unplug

    def _serve(self, master: int, slave: int) -> None:
        rest = b''
        while not self._stop.is_set():
            if not select.select([master], [], [], _LOOK_S)[0]:
                continue
            questions, rest = self.emulator.split(rest + os.read(master, 1024))
            for question in questions:
                os.write(master, self._reply(question))
        os.unlink(self.port)
        os.close(master)
        os.close(slave)

    def _reply(self, question: bytes) -> bytes:
        fault = self.fault
        if fault == 'silent':
            return b''
        if fault == 'garbage':
            return self._rng.integers(0, 256, 20, dtype=np.uint8).tobytes() + b'\r\n'
        if fault in ('wrong', 'error'):
            return getattr(self.emulator, fault)(question)
        answer = bytearray(self.emulator.answer(question))
        time.sleep(self.delay + (self.late if fault == 'late' else 0.0))
        if fault == 'flip':
            answer[self._rng.integers(len(answer))] ^= 1 << self._rng.integers(8)
        return bytes(answer[: len(answer) // 2] if fault == 'half' else answer)


def _lkg_value(value: float) -> bytes:
    """Eight characters of a displacement [m]."""
    if math.isnan(value):
        return b'XXXXXXXX'
    if abs(value) >= 0.1:
        return b'+FFFFFFF' if value > 0.0 else b'-FFFFFFF'
    return b'%+08.4f' % (value * 1e3)
