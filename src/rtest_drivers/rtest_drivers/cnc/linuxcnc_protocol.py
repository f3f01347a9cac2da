"""The language of linuxcncrsh: text in, values out (man page linuxcncrsh(1)).

A request is a line, a reply is a line. Replies to `get` end in CR LF, those to `set` in LF CR, and
a refused `get` ends in an empty line more.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

# No reply is as long; the server writes from a buffer of this size.
LONGEST = 4096
_NUMBER = re.compile(r'-?[0-9]+\.[0-9]+')
# What `get joint_units` says of a joint, as units of the device file. It can also be CM, GRAD, or
# CUSTOM for any other: then the device file could not be held to anything.
UNIT_WORDS = {'MM': 'mm', 'INCH': 'inch', 'DEG': 'deg', 'RAD': 'rad'}


class ReplyError(ConnectionError):
    """A reply that is no answer to what was asked."""


class Unanswered(ReplyError):
    """A whole reply, but not to what was asked."""


class Refused(Unanswered):
    """The server says NAK."""


def take_line(buffer: bytearray) -> str | None:
    """Take the first line out of what was received; None where no line has ended yet."""
    while buffer[:1] in (b'\r', b'\n'):
        del buffer[0]
    ends = [at for at in (buffer.find(b'\r'), buffer.find(b'\n')) if at >= 0]
    if not ends:
        if len(buffer) > LONGEST:
            raise ReplyError(f'{len(buffer)} bytes without an end of line; is it linuxcncrsh?')
        return None
    line = buffer[: min(ends)].decode('utf-8', 'replace')
    del buffer[: min(ends)]
    return line


def answer(request: str, reply: str) -> str:
    """What a reply to `get WORD` or `set WORD ...` says after the word.

    Raises Refused where it is NAK, Unanswered where it answers something else.
    """
    verb, word = request.upper().split()[:2]
    start = f'{verb} {word} ' if verb == 'SET' else f'{word} '
    if reply in (f'{verb} {word} NAK', f'{verb} NAK'):
        raise Refused(f'{request!r} was refused')
    if not reply.startswith(start):
        raise Unanswered(f'{request!r} was answered by {reply[:60]!r}')
    return reply[len(start) :]


def positions(said: str) -> np.ndarray:
    """(joints,) positions; raises ReplyError where one of them is no number."""
    words = said.split()
    if not words or not all(map(_NUMBER.fullmatch, words)):
        raise ReplyError(f'positions were told as {said[:60]!r}')
    return np.array(words, dtype=float)


@dataclass(frozen=True)
class State:
    """What the controller says of itself.

    homed : one a joint; program : IDLE, RUNNING or PAUSED; line : of the program
    """

    estop: bool
    machine_on: bool
    homed: tuple[bool, ...]
    program: str
    line: str


# Words to `get`, one after the other.
STATE_WORDS = ('estop', 'machine', 'joint_homed', 'program_status', 'program_line')


def state(said: list[str]) -> State:
    """What was said to `STATE_WORDS`."""
    estop, machine, homed, program, line = said
    return State(
        estop == 'ON', machine == 'ON', tuple(word == 'YES' for word in homed.split()), program,
        line,
    )
