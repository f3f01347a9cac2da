"""A display that answers with lines of text, described in the device file.

query : what asks for a reading; terminator : what ends a line
pattern : regular expression of a whole line, with one group for each gauge
no_signal, over_range : texts of a group that are no number, such as ``-----``

A group that is neither of these texts must be a decimal number.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from typing import Any

from rtest_drivers.gauges.frames import IllegalFrame, Line, Protocol, Query, Reading, by_table
from rtest_estimation.errors import UserError
from rtest_estimation.records import Status
from rtest_identification.session_reader import Reader

try:
    from re import _parser as parser
except ImportError:  # Before Python 3.11.
    import sre_parse as parser

OPTIONS = {'query', 'terminator', 'pattern', 'no_signal', 'over_range'}
_LONGEST = 80
# Ways in which a pattern can be laid over a line; one that does not match may take all of them. As
# many as those of four times `.*` cost half a second at worst.
_MOST_WAYS = (_LONGEST + 1) ** 4
_REPEATS = ('MAX_REPEAT', 'MIN_REPEAT', 'POSSESSIVE_REPEAT')
_NUMBER = re.compile(rb'[+-]?\d{1,12}(\.\d{1,12})?')


def line(outputs: int, unit: str, options: Reader) -> Protocol:
    """Protocol from the options of the device file; raises UserError."""
    where = options.where
    text = {key: _text(options, key) for key in ('query', 'terminator', 'pattern')}
    if not text['query'] or not text['terminator']:
        raise UserError(f'{where}: query and terminator: expected at least one character')
    try:
        if _ways(parser.parse(text['pattern'])) > math.log(_MOST_WAYS):
            raise UserError(
                f'{where}: pattern: matching it could take too long; write how often a thing '
                'comes, such as {1,6}, instead of more than four * and +, and repeat no group'
            )
        pattern = re.compile(text['pattern'].encode())
    except (re.error, OverflowError) as error:
        raise UserError(f'{where}: pattern: no regular expression: {error}') from None
    except RecursionError:
        raise UserError(f'{where}: pattern: its groups are nested too deep') from None
    if pattern.groups != outputs:
        raise UserError(
            f'{where}: pattern: expected one group for each of {outputs} channels, '
            f'got {pattern.groups}; write (?: for a group that is no reading'
        )
    table = [(_NUMBER, Status.VALID, '')]
    for key, status in (('no_signal', Status.NO_SIGNAL), ('over_range', Status.OUT_OF_RANGE)):
        if key in options.data:
            literal = re.compile(re.escape(_text(options, key).encode()))
            table.insert(0, (literal, status, key.replace('_', ' ')))

    def read(frame: bytes) -> tuple[Reading, ...]:
        match = pattern.fullmatch(frame)
        if match is None:
            raise IllegalFrame(f'{frame!r} does not match the pattern')
        return tuple(reading for field in match.groups(b'') for reading in by_table(field, table))

    return Protocol(
        queries=(Query(text['query'].encode(), outputs, read),),
        terminator=text['terminator'].encode(),
        line=Line(9600),
        rate=10.0,
        longest=_LONGEST,
    )


def _ways(tree: Iterable[Any]) -> float:
    """Logarithm of a bound of the ways in which a parsed pattern can lie over a line."""
    total = 0.0
    for kind, value in tree:
        inner = sum(map(_ways, _inside(value)))
        if str(kind) in _REPEATS:
            least, most = value[0], min(value[1], _LONGEST)
            inner = most * inner + math.log(max(most - least, 0) + 1)
        elif str(kind) == 'BRANCH':
            inner += math.log(len(value[1]))
        total += inner
    return total


def _inside(value: Any) -> Iterator[Iterable[Any]]:
    """The patterns that a part of a pattern is made of."""
    if isinstance(value, parser.SubPattern):
        yield value
    elif isinstance(value, tuple | list):
        for one in value:
            yield from _inside(one)


def _text(options: Reader, key: str) -> str:
    value = options.required(key)
    if not isinstance(value, str) or not value.isascii():
        raise UserError(f'{options.where}: {key}: expected ASCII text, got {value!r}')
    return value
