"""Mitutoyo Digimatic gauges behind a converter to a serial line.

MUX-10 format of multiplexers and of the USB Input Tool as virtual serial port: the question is
the number of the input and CR, the answer ``0``, number of the input, ``A``, sign, eight
characters with floating decimal point, CR (QM-Height manual 99MAF600B, section 6.3; GageMux
manual, page 7). What begins with ``9`` is a status of the converter instead of a value. The unit
is not in it.

Digimatic format: 13 nibbles, here as the hexadecimal digits that a simple converter passes on:
four times F, sign (0 or 8), six digits, number of decimals (0 to 5), unit (0 mm, 1 inch)
(99MBA043A page 6-12, LSM-6200 manual 99MBC095A page 6-28).
"""

from __future__ import annotations

import re

from rtest_drivers.gauges.frames import (
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

DIGIMATIC_OPTIONS = {'query'}
_MUX = re.compile(rb'0([1-9])A([+-](?=[\d.]{8}\Z)\d+(?:\.\d+)?)')
_STATUS = re.compile(rb'9([1-9])\d')
_NIBBLES = re.compile(rb'[Ff]{4}([08])(\d{6})([0-5])([01])')
_UNITS = {b'0': 'mm', b'1': 'inch'}
_LINE, _RATE = Line(9600), 5.0


def mux10(outputs: int, unit: str, options: Reader) -> Protocol:
    """Protocol of a multiplexer: its first `outputs` inputs, asked one after the other.

    Raises UserError for more than nine, which its one digit cannot count.
    """
    if outputs > 9:
        raise UserError(f'{options.where}: channels: a multiplexer has nine inputs at most')
    queries = tuple(_ask(b'%d' % (index + 1)) for index in range(outputs))
    return Protocol(queries=queries, terminator=b'\r', line=_LINE, rate=_RATE, longest=32)


def _ask(number: bytes) -> Query:
    def read(frame: bytes) -> tuple[Reading, ...]:
        status = _STATUS.fullmatch(frame)
        match = status or _MUX.fullmatch(frame)
        if match is None:
            raise IllegalFrame(f'{frame!r} is no answer of a multiplexer')
        if match[1] != number:
            raise OtherAnswer(f'{frame!r} does not answer for input {number.decode()}')
        if status is not None:
            return bad(Status.DEVICE_ERROR, f'the multiplexer reports {frame.decode()}')
        return (Reading(float(match[2])),)

    return Query(number + b'\r', 1, read)


def digimatic(outputs: int, unit: str, options: Reader) -> Protocol:
    """Protocol of a converter that passes the 13 nibbles of one gauge on.

    The option `query` is what makes it ask the gauge. Raises UserError.
    """
    if outputs != 1:
        raise UserError(f'{options.where}: channels: expected one, got {outputs}')
    query = options.data.get('query', '1\r')
    if not isinstance(query, str) or not query.isascii():
        raise UserError(f'{options.where}: query: expected ASCII text, got {query!r}')

    def read(frame: bytes) -> tuple[Reading, ...]:
        match = _NIBBLES.fullmatch(frame.strip(b'\n'))
        if match is None:
            raise IllegalFrame(f'{frame!r} are no 13 nibbles of a gauge')
        sign, digits, decimals, shown = match.groups()
        if _UNITS[shown] != unit:
            reason = f'the gauge shows {_UNITS[shown]}, expected {unit}'
            return bad(Status.DEVICE_ERROR, reason)
        value = int(digits) / 10 ** int(decimals)
        return (Reading(-value if sign == b'8' else value),)

    return Protocol(
        queries=(Query(query.encode(), 1, read),), terminator=b'\r', line=_LINE, rate=_RATE,
        longest=32,
    )
