"""MTConnect: backend 'mtconnect' of the CNC driver.

A device file; items are ids or names of data items as the agent's /probe document has them, of
positions of machine axes with subType ACTUAL:

    url: http://192.168.1.20:5000
    device: VMC-1            # where the agent serves several
    period_ms: 50            # between questions
    stamp: source            # or arrival
    skew_ms: 5               # samples of axes that are no farther apart are one feedback
    axes:
      X: {item: Xact, unit: mm}
      B: {item: Bact, unit: deg, sign: -1}

`stamp: source` takes the time stamps of the observations, brought to this host's clock
(`clock.DeviceClock`): right wherever the adapter stamps what it reads. `stamp: arrival` is for
adapters without a usable clock: a moving axis then seems late by up to a period and the way here.

An agent tells changes; as long as it answers and tells none, the axes are taken to stand still.
How axes come to one feedback is in `join.Joiner`.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from urllib.parse import quote

from rtest_drivers.clock import HostClock
from rtest_drivers.cnc.axes import AxisSource, names
from rtest_drivers.cnc.clock import DeviceClock, Recent
from rtest_drivers.cnc.device_file import load
from rtest_drivers.cnc.join import Joiner, Sample
from rtest_drivers.cnc.mtconnect_agent import Agent
from rtest_drivers.cnc.mtconnect_xml import (
    UNAVAILABLE,
    UNIT_WORDS,
    DocumentError,
    Header,
    Item,
    Observation,
    OutOfRange,
    parse_devices,
    parse_streams,
)
from rtest_estimation.errors import UserError
from rtest_estimation.records import Feedback

STAMPS = ('source', 'arrival')
_KEYS = {'url', 'device', 'period_ms', 'stamp', 'skew_ms', 'axes'}
# Observations asked for at once.
_COUNT = 1000
_TOLD_S = 2.0
# For a whole /probe document, which is large.
_PROBE_S = 5.0
# Types of data items that say something of the whole machine, found by themselves.
_ESTOP, _AVAILABILITY = 'EMERGENCY_STOP', 'AVAILABILITY'


@dataclass(frozen=True)
class MtConnectFile:
    """A device file; `period` in [s], `together` in [ns]."""

    url: str
    device: str
    period: float
    axes: tuple[AxisSource, ...]
    source_stamps: bool
    together: int


def load_mtconnect(path: str) -> MtConnectFile:
    """Read a device file; raises UserError naming file, key and what is expected."""
    reader = load(path, _KEYS)
    try:
        Agent(reader.text('url'))
    except UserError as error:
        raise UserError(f'{path}: {error}') from None
    return MtConnectFile(
        reader.text('url'),
        reader.text('device', ''),
        reader.number('period_ms', 50.0, (5.0, 1000.0)) * 1e-3,
        reader.axes('item', str),
        reader.choice('stamp', STAMPS) == 'source',
        round(reader.number('skew_ms', 5.0, (0.001, 1000.0)) * 1e6),
    )


class MtConnect:
    """Asks the agent for what is new."""

    def __init__(self, address: str) -> None:
        """Read the device file; raises UserError."""
        self._file = load_mtconnect(address)
        self._axes = {axis.name: axis for axis in self._file.axes}
        self._host = HostClock()
        self._agent: Agent | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        """Letters of the axes in the device file."""
        return names(self._file.axes)

    @property
    def rate(self) -> float:
        """What the device file asks for [1/s]."""
        return 1.0 / self._file.period

    def open(self) -> None:
        """Connect; raises ConnectionError saying what failed and what to do."""
        self.close()
        file = self._file
        self._device = DeviceClock()
        self._joiner = Joiner(file.axes, file.together)
        self._under_way, self._round_trip = Recent(), Recent()
        # Id of a data item to what was last said of it.
        self._states: dict[str, str] = {}
        self._was_available = False
        self._lost = 0
        self._lost_at = -math.inf
        agent = Agent(file.url)
        try:
            self._probe(agent)
        except ConnectionError:
            agent.close()
            raise
        # None: to be asked for where to go on.
        self._from: int | None = None
        self._next = time.monotonic()
        self._agent = agent

    def read(self, timeout: float) -> list[Feedback]:
        """Feedback, waiting up to `timeout` [s]; raises ConnectionError when the agent is lost."""
        if self._agent is None:
            raise ConnectionError('MTConnect is not open')
        wait = self._next - time.monotonic()
        time.sleep(min(max(wait, 0.0), timeout))
        if wait > timeout:
            return []
        self._next = max(self._next + self._file.period, time.monotonic())
        try:
            return self._joiner.add(self._ask(self._agent))
        except ConnectionError:
            self.close()
            raise

    def close(self) -> None:
        """Hang up; does nothing where it is not open."""
        agent, self._agent = self._agent, None
        if agent is not None:
            agent.close()

    def problem(self) -> str:
        """What is wrong while the connection stands, in one line; '' where all is well."""
        if self._agent is None:
            return ''
        if not self._states:
            return ''  # Not asked yet.
        # An agent that has only just started does not know it, with or without a connection.
        gone = UNAVAILABLE in self._said(_AVAILABILITY)
        if gone and (self._was_available or self._joiner.unknown):
            return 'the agent has no connection to the controller; look at its adapter'
        if self._estop() == 'on':
            return 'E-stop is on; release it and run the cycle again'
        if unknown := self._joiner.unknown:
            said = ''.join(self._said(unknown[0])) or 'nothing'
            return (
                f'axis {", ".join(unknown)}: the agent says {said}, so there is no feedback; look '
                'at its adapter'
            )
        if time.monotonic() - self._lost_at < _TOLD_S:
            return (
                f'{self._lost} observations lost, the agent no longer had them; make its buffer '
                'larger or period_ms shorter'
            )
        return self._device.problem() or self._host.problem()

    def uncertainty(self) -> float:
        """Of the stamps [s].

        Of the arrival: how differently long observations are under way. Of the source: the way
        here, which is at most the round trip of a question; what the adapter takes is not in it.
        """
        if self._agent is None:
            return math.nan
        largest = self._round_trip if self._file.source_stamps else self._under_way
        return largest.largest * 1e-9

    def told(self) -> dict[str, str]:
        """What diagnostics show; the offset is this host's clock minus the controller's."""
        if self._agent is None:
            return {}
        offset = self._device.offset
        return {
            'estop': self._estop(),
            'clock_offset_ms': '' if offset is None else f'{offset * 1e-6:.1f}',
            'under_way_ms': f'{self._under_way.largest * 1e-6:.1f}',
            'skew_ms': f'{self._joiner.skew.largest * 1e-6:.1f}',
            'lost': str(self._lost),
        }

    def _said(self, name: str) -> list[str]:
        """Of the data items of a type, or of the one of an axis; without those never heard of."""
        items = (item for item, one in self._names.items() if one == name)
        return [self._states[item] for item in items if item in self._states]

    def _estop(self) -> str:
        """On where any E-stop of the machine is triggered, off where all are armed."""
        said = set(self._said(_ESTOP))
        return 'on' if 'TRIGGERED' in said else 'off' if said == {'ARMED'} else 'unknown'

    def _ask(self, agent: Agent) -> list[Sample]:
        """What is new, or everything where nothing is known or something was lost."""
        sent = self._host.now()
        if self._from is None:
            header, observations = parse_streams(agent.get(self._path('current')))
            self._check(header)
            self._from = header.next
            # Their stamps are of their last change: it may have been long before.
            return [*self._samples(observations, sent, False), Sample(sent)]
        query = f'from={self._from}&count={min(_COUNT, self._header.size or _COUNT)}'
        try:
            header, observations = parse_streams(agent.get(self._path('sample', query)))
        except OutOfRange:
            # Of another run of the agent, or overwritten since: /current tells which.
            header, _ = parse_streams(agent.get(self._path('current')))
            self._check(header)
            self._lose(header.first - self._from)
            self._from = None
            return []
        arrival = self._host.now()
        self._round_trip.add(arrival - sent)
        self._check(header)
        if header.first > self._from:
            self._lose(header.first - self._from)
        if header.next < self._from or header.next == self._from <= header.last:
            raise self._nonsense(header)
        self._from = header.next
        samples = self._samples(observations, arrival, True)
        if header.next <= header.last:
            self._next = time.monotonic()  # There is more.
            return samples
        return [*samples, Sample(sent)]

    def _samples(
        self, observations: list[Observation], arrival: int, stamped: bool
    ) -> list[Sample]:
        """The positions among them; `stamped` where their stamps say when they were so."""
        for one in observations:
            self._states[one.item] = one.text[:40]
        self._was_available |= 'AVAILABLE' in self._said(_AVAILABILITY)
        letters = self._joiner.names
        wanted = [one for one in observations if self._names.get(one.item) in letters]
        stamps = [arrival] * len(wanted)
        if stamped and wanted:
            sources = self._device.to_host([one.stamp for one in wanted], arrival)
            self._under_way.add(arrival - min(sources))
            stamps = sources if self._file.source_stamps else stamps
        return [
            Sample(stamp, self._names[one.item], self._position(one))
            for stamp, one in zip(stamps, wanted, strict=True)
        ]

    def _position(self, one: Observation) -> float | None:
        """None where it is no number or cannot be a position."""
        axis = self._axes[self._names[one.item]]
        known = one.number is not None and axis.plausible(one.number)
        return one.number if known else None

    def _probe(self, agent: Agent) -> None:
        """Find the data items, and hold the device file to what they are."""
        path = self._path('probe', filtered=False)
        self._header, devices = parse_devices(agent.get(path, _PROBE_S))
        counts = [len(self._found(items)) for items in devices]
        if counts.count(len(self._file.axes)) > 1:
            raise ConnectionError(
                f'the agent at {self._file.url} has several devices with these items; set device '
                'in the device file'
            )
        items = devices[counts.index(max(counts))] if devices else {}
        found = {}
        for axis in self._file.axes:
            where = f'axes: {axis.name}: item {axis.source!r}'
            twins = self._found(items).get(axis.name)
            if twins is None:
                raise ConnectionError(
                    f'{where}: the agent at {self._file.url} has no device with it and the '
                    'others; correct the device file'
                )
            found[axis.name] = item = twins[0]
            if len(twins) > 1:
                ids = ', '.join(one.id for one in twins)
                raise ConnectionError(
                    f'{where}: the agent has {len(twins)} items of this name; give the id of one '
                    f'in the device file: {ids}'
                )
            if item.subtype not in ('', 'ACTUAL'):
                raise ConnectionError(
                    f'{where}: its subType is {item.subtype}; give the item with subType ACTUAL '
                    'in the device file'
                )
            if item.units and UNIT_WORDS.get(item.units) != axis.unit:
                raise ConnectionError(
                    f'axes: {axis.name}: unit: the agent says {item.units}, the device file '
                    f'{axis.unit}; correct the device file'
                )
        self._names = {item.id: name for name, item in found.items()}
        self._names |= {item.id: item.type for item in items.values()
                        if item.type in (_ESTOP, _AVAILABILITY)}

    def _found(self, items: dict[str, Item]) -> dict[str, list[Item]]:
        """Axes to the data items of one device that have its id, or else its name."""
        found = {}
        for axis in self._file.axes:
            named = [item for item in items.values() if item.name == axis.source]
            if one := items.get(axis.source):
                named = [one]
            if named:
                found[axis.name] = named
        return found

    def _path(self, request: str, query: str = '', filtered: bool = True) -> str:
        if filtered:
            items = ' or '.join(f'@id="{item}"' for item in self._names)
            query += f'{"&" if query else ""}path={quote(f"//DataItem[{items}]")}'
        device = f'{quote(self._file.device)}/' if self._file.device else ''
        return f'{device}{request}{"?" if query else ""}{query}'

    def _check(self, header: Header) -> None:
        if header.instance != self._header.instance:
            raise ConnectionError(
                f'the MTConnect agent at {self._file.url} was started again; what it saw '
                'meanwhile is lost'
            )
        if not 0 < header.next <= header.last + 1:
            raise self._nonsense(header)

    def _nonsense(self, header: Header) -> DocumentError:
        return DocumentError(
            f'the MTConnect agent at {self._file.url} has observations {header.first} to '
            f'{header.last} but says that the next is {header.next}, asked from '
            f'{self._from or "the start"}; start it again'
        )

    def _lose(self, count: int) -> None:
        self._lost += max(count, 1)
        self._lost_at = time.monotonic()
