"""Heidenhain ND 287 (and ND 281 B) display units for one length gauge.

User's manual of the ND 287, chapters II-5 and II-6. STX (Ctrl-B) asks for the measured value at
that time: sign, ten characters with decimal point and blanks for leading zeros, blank, unit
(blank is mm, " inch, ? a fault), sorting state, state of a measuring series, CR LF; 17 characters
in all, which is the 187 bits of the manual's transfer time. Propagation (ND 281 B, page 42, the
same interface): stored 1 ms after Ctrl-B at most, sent within 50 ms.

ESC A0200 CR asks for the position: STX, sign, nine digits without decimal point, CR LF. What the
display does not understand it answers with NAK. Factory setting of the line is 9600 baud, seven
bits, even parity, two stop bits; blank lines after a value must be set to none.
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
)
from rtest_estimation.errors import UserError
from rtest_estimation.records import Status
from rtest_identification.session_reader import Reader

OPTIONS = {'command', 'decimals'}
_NAK = b'\x15'
# The length is fixed: with a character missing the columns would be taken for one another.
_VALUE = re.compile(rb'(?=.{15}\Z)([+-]) *(\d+(?:\.\d+)?) (.)([ <=>?])(.)', re.DOTALL)
_FAULT = re.compile(rb'[+-][ -~]{11}\?[ -~]{2}')
_POSITION = re.compile(rb'\x02([+-]\d{9})')
_UNITS = {b' ': 'mm', b'"': 'inch'}
# The current value, or that of the first axis; the others are extremes, sums and differences.
_CURRENT = b' A1'
_CTRL_B, _A0200 = b'\x02', b'\x1bA0200\r'
# Storage delay and one character at 9600 baud [s].
_LATCH_S = 2e-3


def nd287(outputs: int, unit: str, options: Reader) -> Protocol:
    """Protocol of a display with one gauge.

    The option `command` is 'ctrl-b' or 'A0200'; the latter needs `decimals`, the digits after the
    point that the display shows. Raises UserError.
    """
    where = options.where
    if outputs != 1:
        raise UserError(f'{where}: channels: expected one for each display, got {outputs}')
    command = options.data.get('command', 'ctrl-b')
    if command not in ('ctrl-b', 'A0200'):
        raise UserError(f'{where}: command: expected ctrl-b or A0200, got {command!r}')
    if (command == 'A0200') != ('decimals' in options.data):
        raise UserError(f'{where}: decimals: belongs to the command A0200 and to no other')
    if command == 'A0200':
        decimals = options.integer('decimals', 0, (0, 8))
        query = Query(_A0200, 1, lambda frame: _position(frame, decimals))
        fence = Command(_CTRL_B, re.compile(rb'[+-].{14}', re.DOTALL))
    else:
        query = Query(_CTRL_B, 1, lambda frame: _value(frame, unit))
        fence = Command(_A0200, re.compile(rb'\x02.*|\x15', re.DOTALL))
    return Protocol(
        queries=(query,),
        terminator=b'\r\n',
        line=Line(9600, 7, 'even', 2),
        rate=10.0,
        alone=_NAK,
        fence=fence,
        latch=_LATCH_S,
        longest=40,
    )


def _value(frame: bytes, unit: str) -> tuple[Reading, ...]:
    """Answer to Ctrl-B."""
    if frame == _NAK:
        return bad(Status.DEVICE_ERROR, 'the display refused the question (NAK)')
    if frame.startswith(b'\x02'):
        raise OtherAnswer(f'{frame!r} answers a command')
    if _FAULT.fullmatch(frame):
        return bad(Status.DEVICE_ERROR, 'the display reports a fault of the gauge')
    match = _VALUE.fullmatch(frame)
    if match is None:
        raise IllegalFrame(f'{frame!r} is no measured value')
    sign, number, shown, _, series = match.groups()
    if _UNITS.get(shown) != unit:
        got = _UNITS.get(shown, ascii(shown.decode('latin-1')))
        return bad(Status.DEVICE_ERROR, f'the display shows {got}, expected {unit}')
    if series not in _CURRENT:
        return bad(Status.DEVICE_ERROR, f'the display does not show the current value: {series!r}')
    return (Reading(float(sign + number)),)


def _position(frame: bytes, decimals: int) -> tuple[Reading, ...]:
    """Answer to A0200."""
    if frame == _NAK:
        return bad(Status.DEVICE_ERROR, 'the display refused the command (NAK)')
    match = _POSITION.fullmatch(frame)
    if match is not None:
        return (Reading(int(match[1]) / 10**decimals),)
    if _VALUE.fullmatch(frame):
        raise OtherAnswer(f'{frame!r} answers Ctrl-B')
    raise IllegalFrame(f'{frame!r} is no position')
