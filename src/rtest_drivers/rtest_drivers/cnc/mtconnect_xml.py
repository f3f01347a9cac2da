"""Documents of an MTConnect agent (ANSI/MTC1.4, parts 1 to 3): XML in, observations out.

Element names differ between versions of the standard and between kinds of data; what is needed is
in the attributes, which do not. A document type declaration, with which entities come, is refused.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from xml.etree import ElementTree

# A probe document of a large machine has some hundred kilobytes.
LARGEST = 8_000_000
# What an agent calls the units of a position along or about one axis.
UNIT_WORDS = {'MILLIMETER': 'mm', 'DEGREE': 'deg', 'INCH': 'inch', 'METER': 'm', 'RADIAN': 'rad'}
UNAVAILABLE = 'UNAVAILABLE'
_TIME = re.compile(
    r'(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)(?:\.(\d{1,9})\d*)?(?:Z|([+-])(\d\d):?(\d\d))?',
    re.ASCII,
)
_NUMBER = re.compile(r'[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?', re.ASCII)
_ITEM_KEYS = ('id', 'name', 'type', 'units', 'subType')
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


class DocumentError(ConnectionError):
    """Not a document of an MTConnect agent, or one that says an error."""


class OutOfRange(DocumentError):
    """The agent no longer has what was asked for."""


@dataclass(frozen=True)
class Header:
    """What a document says of the agent.

    instance : another one after every restart of the agent
    first, last : sequence numbers the agent has; next : to be asked for from
    size : of its buffer
    """

    instance: int
    first: int = 0
    last: int = 0
    next: int = 0
    size: int = 0


@dataclass(frozen=True)
class Item:
    """A data item of a device, as /probe tells it; units and subtype are '' where it has none."""

    id: str
    name: str
    type: str
    units: str
    subtype: str


@dataclass(frozen=True)
class Observation:
    """One value of a data item; stamp of its source [ns]."""

    item: str
    stamp: int
    text: str

    @property
    def number(self) -> float | None:
        """The value, None where it is no number."""
        return float(self.text) if _NUMBER.fullmatch(self.text) else None


def parse_devices(body: bytes) -> tuple[Header, list[dict[str, Item]]]:
    """A /probe document: the data items of each device by id."""
    root = _parse(body, 'MTConnectDevices')
    devices = []
    for device in root.iter():
        if _tag(device) == 'Device':
            items = [
                Item(*(one.get(key, '') for key in _ITEM_KEYS))
                for one in device.iter() if _tag(one) == 'DataItem'
            ]
            devices.append({item.id: item for item in items})
    return _header(root), devices


def parse_streams(body: bytes) -> tuple[Header, list[Observation]]:
    """A /current or /sample document: its observations in the order of their sequence numbers."""
    root = _parse(body, 'MTConnectStreams')
    found = []
    for one in root.iter():
        item, sequence, stamp = (one.get(k) for k in ('dataItemId', 'sequence', 'timestamp'))
        if item is not None and sequence is not None and stamp is not None:
            text = (one.text or '').strip()
            found.append((_whole(sequence), Observation(item, parse_time(stamp), text)))
    return _header(root), [observation for _, observation in sorted(found, key=lambda f: f[0])]


def parse_time(text: str) -> int:
    """An ISO 8601 time stamp, with up to nine decimals [ns since the epoch]; UTC without zone."""
    match = _TIME.fullmatch(text.strip())
    if match is None:
        raise DocumentError(f'the agent says {text[:40]!r} for a time')
    *date, decimals, sign, hours, minutes = match.groups()
    try:
        time = datetime(*map(int, date), tzinfo=timezone.utc)
        if sign:
            zone = timedelta(hours=int(hours), minutes=int(minutes))
            time -= zone if sign == '+' else -zone
    except (ValueError, OverflowError):  # In the year 0 or 10000.
        raise DocumentError(f'the agent says {text[:40]!r} for a time') from None
    return (time - _EPOCH) // timedelta(seconds=1) * 10**9 + int((decimals or '').ljust(9, '0'))


def _parse(body: bytes, expected: str) -> ElementTree.Element:
    if len(body) > LARGEST:
        raise DocumentError(f'the agent sent more than {LARGEST} bytes; is it one?')
    try:
        # Parsed as the text that was looked through, whatever encoding it declares.
        text = body.decode('utf-8')
        if '<!DOCTYPE' in text or '<!ENTITY' in text:
            raise DocumentError('the agent sent a document type declaration, which is not read')
        root = ElementTree.fromstring(text)
    except (UnicodeDecodeError, ElementTree.ParseError) as error:
        raise DocumentError(f'the agent sent no XML ({error}); does url lead to one?') from None
    if _tag(root) == 'MTConnectError':
        raise _error(root)
    if _tag(root) != expected:
        raise DocumentError(f'the agent sent {_tag(root)[:40]} instead of {expected}')
    return root


def _error(root: ElementTree.Element) -> DocumentError:
    for one in root.iter():
        if code := one.get('errorCode'):
            said = f'the agent says {code}: {" ".join("".join(one.itertext()).split())[:100]}'
            return (OutOfRange if code == 'OUT_OF_RANGE' else DocumentError)(said)
    return DocumentError('the agent says an error without a code')


def _header(root: ElementTree.Element) -> Header:
    for one in root:
        if _tag(one) == 'Header':
            keys = ('instanceId', 'firstSequence', 'lastSequence', 'nextSequence', 'bufferSize')
            return Header(*(_whole(one.get(key, '0')) for key in keys))
    raise DocumentError('the agent sent a document without a header')


def _whole(text: str) -> int:
    if not re.fullmatch(r'[0-9]{1,20}', text):
        raise DocumentError(f'the agent says {text[:40]!r} for a sequence number')
    return int(text)


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition('}')[2]
