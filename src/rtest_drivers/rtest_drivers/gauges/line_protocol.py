"""A display that answers with lines of text, described in the device file.

query : what asks for a reading; terminator : what ends a line
pattern : regular expression of a whole line, with one group for each gauge
no_signal, over_range : texts of a group that are no number, such as ``-----``

A group that is neither of these texts must be a decimal number.
"""

from __future__ import annotations

import re

from rtest_drivers.gauges.frames import IllegalFrame, Line, Protocol, Query, Reading, by_table
from rtest_estimation.errors import UserError
from rtest_estimation.records import Status
from rtest_identification.session_reader import Reader

OPTIONS = {'query', 'terminator', 'pattern', 'no_signal', 'over_range'}
# A repeated group is what makes matching take exponential time. Without any the time grows with a
# power of the length, one for each `.*` that fits everything: few of them and short lines.
_REPEATED_GROUP, _ANYTHING = re.compile(r'\)[*+{]'), re.compile(r'\.[*+{]')
_ESCAPED = re.compile(r'\\.|\[\^?\]?[^\]]*\]')
_MOST_ANYTHING = 2
_LONGEST = 80
_NUMBER = re.compile(rb'[+-]?\d{1,12}(\.\d{1,12})?')


def line(outputs: int, unit: str, options: Reader) -> Protocol:
    """Protocol from the options of the device file; raises UserError."""
    where = options.where
    text = {key: _text(options, key) for key in ('query', 'terminator', 'pattern')}
    if not text['query'] or not text['terminator']:
        raise UserError(f'{where}: query and terminator: expected at least one character')
    bare = _ESCAPED.sub('', text['pattern'])
    if _REPEATED_GROUP.search(bare):
        raise UserError(f'{where}: pattern: a group must not be repeated, see )* )+ or ){{ in it')
    if len(_ANYTHING.findall(bare)) > _MOST_ANYTHING:
        raise UserError(f'{where}: pattern: expected at most {_MOST_ANYTHING} times .* or .+')
    try:
        pattern = re.compile(text['pattern'].encode())
    except (re.error, OverflowError) as error:
        raise UserError(f'{where}: pattern: no regular expression: {error}') from None
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


def _text(options: Reader, key: str) -> str:
    value = options.required(key)
    if not isinstance(value, str) or not value.isascii():
        raise UserError(f'{options.where}: {key}: expected ASCII text, got {value!r}')
    return value
