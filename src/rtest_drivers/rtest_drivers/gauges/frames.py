"""What every protocol of a gauge is made of: frames, readings, questions and answers.

Nothing here or in a protocol touches a port: bytes go in, readings come out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rtest_estimation.records import Status

# [m] of the units a controller can show.
UNITS = {'mm': 1e-3, 'um': 1e-6, 'inch': 25.4e-3}


class IllegalFrame(ValueError):
    """Bytes that the manual does not know as an answer; says what is wrong with them."""


class OtherAnswer(ValueError):
    """A legal answer, but to another question."""


@dataclass(frozen=True)
class Reading:
    """One gauge's part of an answer.

    value : in the unit of the controller; NaN unless the status is VALID
    reason : why it is not valid, in a few words
    """

    value: float
    status: Status = Status.VALID
    reason: str = ''


@dataclass(frozen=True)
class Query:
    """A question, how many readings answer it, and how to read a frame that came back.

    read : gives `outputs` readings, raises IllegalFrame or OtherAnswer
    """

    send: bytes
    outputs: int
    read: Callable[[bytes], tuple[Reading, ...]]


@dataclass(frozen=True)
class Command:
    """Something to send and the frame that ends its execution."""

    send: bytes
    done: re.Pattern[bytes]


@dataclass(frozen=True)
class Line:
    """Settings of a serial line: parity is 'none', 'even' or 'odd'."""

    baud: int
    bytesize: int = 8
    parity: str = 'none'
    stopbits: int = 1


@dataclass(frozen=True)
class Protocol:
    """How to talk to a controller.

    queries : asked one after the other, together one reading of every gauge
    line, rate : factory settings of the line, questions a second that suit the device [1/s]
    alone : bytes that are an answer without terminator
    setup : sent when the line was opened
    fence : a harmless question with an answer of its own kind. Controllers answer in order, so
        that after it no earlier answer can be under way. Without one only silence tells that.
    latch : the device takes its reading this long after the question at most [s]; None: at any
        time before the answer begins
    """

    queries: tuple[Query, ...]
    terminator: bytes
    line: Line
    rate: float
    alone: bytes = b''
    setup: tuple[Command, ...] = ()
    fence: Command | None = None
    latch: float | None = None
    longest: int = 160


class Framer:
    """Cuts a stream of bytes into frames, which it gives without their terminator.

    A line longer than the protocol's longest is dropped as a whole, so that the buffer is bounded
    and no tail of it passes for a frame.

    dropped : bytes of such lines
    """

    def __init__(self, protocol: Protocol) -> None:
        self._end, self._alone = protocol.terminator, protocol.alone
        self._longest = protocol.longest
        self.dropped = 0
        self.clear()

    def clear(self) -> None:
        """Forget the beginning of a frame."""
        self._rest, self._skip = b'', False

    def feed(self, data: bytes) -> list[bytes]:
        """The frames that `data` completes."""
        for code in self._alone:
            byte = bytes([code])
            data = data.replace(byte, byte + self._end)
        *lines, rest = (self._rest + data).split(self._end)
        frames = []
        for line in lines:
            if self._skip or len(line) > self._longest:
                self.dropped += len(line)
            else:
                frames.append(line)
            self._skip = False
        if len(rest) >= self._longest + len(self._end):
            # The first byte of a terminator may be the last one so far.
            keep = rest[len(rest) - len(self._end) + 1 :]
            self.dropped += len(rest) - len(keep)
            rest, self._skip = keep, True
        self._rest = rest
        return frames


def bad(status: Status, reason: str, count: int = 1) -> tuple[Reading, ...]:
    """`count` readings without a value."""
    return (Reading(math.nan, status, reason),) * count


def by_table(
    field: bytes, table: Sequence[tuple[re.Pattern[bytes], Status, str]]
) -> tuple[Reading, ...]:
    """The reading of one field: the first pattern of the table that is all of it decides.

    Raises IllegalFrame where there is none.
    """
    for pattern, status, reason in table:
        if pattern.fullmatch(field):
            if status is Status.VALID:
                return (Reading(float(field)),)
            return bad(status, reason)
    raise IllegalFrame(f'{field!r} is no measured value')
