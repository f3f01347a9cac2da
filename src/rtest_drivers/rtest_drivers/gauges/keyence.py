"""Keyence LK-G laser displacement sensors, ASCII commands that end with CR.

LK-G series (LK-G3001): user's manual LK-G-M-NO5-E, chapter 5. Commands and answers are delimited
by CR; an answer begins with its command, an error is ``ER,command,code`` (page 5-5); a measured
value has eight characters (page 5-6). M0 reads both outputs, M1 and M2 one; Q0 and R0 go to the
set-up and to the measuring mode, in which alone M is answered; SW,CA,n sets the sampling cycle.

LK-G5000 series (LK-G5001): MM and a mask of the twelve outputs reads several of them in one
answer, which repeats the mask; other error codes. Known to the authors from published drivers
only, not from the manual.
"""

from __future__ import annotations

import re

from rtest_drivers.gauges.frames import (
    Command,
    IllegalFrame,
    Line,
    OtherAnswer,
    Protocol,
    Query,
    Reading,
    bad,
    by_table,
)
from rtest_estimation.errors import UserError
from rtest_estimation.records import Status
from rtest_identification.session_reader import Reader

# Sign and seven characters: leading zeros, at most one decimal point, where the settings put it.
# The display shows FFFFFF, the manual's table of the output seven of them.
_FIELD = (
    (re.compile(rb'[+-](?=[\d.]{7}\Z)\d+(\.\d+)?'), Status.VALID, ''),
    (re.compile(rb'[+-]F{6,7}'), Status.OUT_OF_RANGE, 'over range'),
    (re.compile(rb'X{8}'), Status.NO_SIGNAL, 'no measured value'),
)
_ANSWER = re.compile(rb'(?:ER,)?[A-Z][A-Z\d](?:,[ -~]*)?')
_OTHERS = {b'88': 'time-out', b'99': 'other error'}
_LKG_ERRORS = {
    b'00': 'command error',
    b'01': 'status error: not in the measuring mode',
    b'20': 'command length error',
    b'21': 'parameter count error',
    b'22': 'invalid parameter',
    **_OTHERS,
}
_LKG5000_ERRORS = {
    b'50': 'command error',
    b'51': 'status error: not in the general mode',
    b'60': 'command length error',
    b'61': 'parameter count error',
    b'62': 'parameter out of range',
    **_OTHERS,
}
# Parameter of SW,CA for a sampling cycle [us].
_SAMPLING = {20: 0, 50: 1, 100: 2, 200: 3, 500: 4, 1000: 5}
LKG_OPTIONS = {'sampling_us'}


def lkg(outputs: int, unit: str, options: Reader) -> Protocol:
    """Protocol of an LK-G controller with one output (M1) or two (M0).

    Raises UserError for more outputs and for a sampling cycle that it does not have.
    """
    if outputs > 2:
        raise UserError(
            f'{options.where}: channels: an LK-G has two outputs, got {outputs}; use a second '
            'controller, or the protocol keyence-lkg5000'
        )
    command, other = (b'M1', b'M2') if outputs == 1 else (b'M0', b'M1')
    setup = [Command(b'R0\r', re.compile(rb'R0|ER,R0,\d\d'))]
    if 'sampling_us' in options.data:
        sampling = options.data['sampling_us']
        if type(sampling) is not int or sampling not in _SAMPLING:
            raise UserError(
                f'{options.where}: sampling_us: expected one of {sorted(_SAMPLING)}, '
                f'got {sampling!r}'
            )
        change = b'SW,CA,%d' % _SAMPLING[sampling]
        setup = [
            Command(b'Q0\r', re.compile(rb'Q0|ER,Q0,\d\d')),
            Command(change + b'\r', re.compile(rb'SW,CA')),
            *setup,
        ]
    return _protocol(command, command, outputs, _LKG_ERRORS, other, tuple(setup))


def lkg5000(outputs: int, unit: str, options: Reader) -> Protocol:
    """Protocol of an LK-G5000 controller, its first `outputs` outputs.

    Raises UserError for more than twelve.
    """
    if outputs > 12:
        raise UserError(f'{options.where}: channels: an LK-G5000 has twelve outputs')
    mask = b'1' * outputs + b'0' * (12 - outputs)
    return _protocol(b'MM', b'MM,' + mask, outputs, _LKG5000_ERRORS, b'MS,01')


def _protocol(
    command: bytes,
    query: bytes,
    outputs: int,
    errors: dict[bytes, str],
    other: bytes,
    setup: tuple[Command, ...] = (),
) -> Protocol:
    """`query` is repeated by the answer; `other` is a question that is answered differently."""
    head, failed = query + b',', b'ER,' + command + b','

    def read(frame: bytes) -> tuple[Reading, ...]:
        if frame.startswith(head):
            fields = frame[len(head) :].split(b',')
            if len(fields) != outputs:
                raise IllegalFrame(f'{len(fields)} values instead of {outputs}')
            return tuple(reading for field in fields for reading in by_table(field, _FIELD))
        if re.fullmatch(re.escape(failed) + rb'\d\d', frame):
            code = frame[-2:]
            text = errors.get(code, 'not in the manual')
            return bad(Status.DEVICE_ERROR, f'error {code.decode()}, {text}', outputs)
        if _ANSWER.fullmatch(frame) and not frame.startswith((command, failed)):
            raise OtherAnswer(f'{frame!r} does not answer {query!r}')
        raise IllegalFrame(f'{frame!r} is no answer to {query!r}')

    echo = re.escape(other.partition(b',')[0])
    return Protocol(
        queries=(Query(query + b'\r', outputs, read),),
        terminator=b'\r',
        line=Line(115200),
        rate=100.0,
        setup=setup,
        fence=Command(other + b'\r', re.compile(rb'(?:ER,)?' + echo + rb'(?:,[ -~]*)?')),
    )
