"""OPC UA: backend 'opcua' of the CNC driver.

A device file, here with node ids in the style of a SINUMERIK (position of the first encoder of
each machine axis; node ids are case-sensitive):

    url: opc.tcp://192.168.214.241:4840
    user: OpcUaClient
    password: secret
    security: ''             # or Basic256Sha256,SignAndEncrypt,certificate.pem,key.pem
    period_ms: 20            # of sampling and publishing that is asked for
    stamp: source            # or arrival
    skew_ms: 5               # samples of axes that are no farther apart are one feedback
    axes:
      X: {node: 'ns=2;s=/Channel/MachineAxis/measPos1[u1,1]', unit: mm}
      B: {node: 'ns=2;s=/Channel/MachineAxis/measPos1[u1,4]', unit: deg, sign: -1}
    estop: {node: 'ns=2;s=/Plc/E10.0', value: true}     # the value that means E-stop

`stamp: source` takes the time at which the controller sampled a value, brought to this host's
clock (`clock.DeviceClock`): right wherever the server stamps what it samples, since a value waits
for its publication. `stamp: arrival` is for servers whose time stamps are missing or coarse; then
a moving axis seems late by up to one publishing interval and the way here. Standing axes, which is
what a static cycle looks at, are the same with both but for the ends of a stop.

How axes come to one feedback is in `join.Joiner`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any

from rtest_drivers.addresses import split_url
from rtest_drivers.clock import HostClock
from rtest_drivers.cnc.axes import AxisSource, names
from rtest_drivers.cnc.clock import DeviceClock, Recent
from rtest_drivers.cnc.device_file import DeviceReader, load
from rtest_drivers.cnc.join import Joiner, Sample
from rtest_drivers.cnc.opcua_link import Batch, Link, LinkSettings
from rtest_estimation.errors import UserError
from rtest_estimation.records import Feedback

STAMPS = ('source', 'arrival')
# Of security: OPC 10000-7, as asyncua knows them.
POLICIES = (
    'Basic256Sha256', 'Aes128Sha256RsaOaep', 'Aes256Sha256RsaPss', 'Basic256', 'Basic128Rsa15',
)
MODES = ('Sign', 'SignAndEncrypt')
_KEYS = {
    'url', 'user', 'password', 'security', 'period_ms', 'stamp', 'skew_ms', 'axes', 'estop',
}
_ESTOP = 'estop'
_ESTOP_WORDS = {True: 'on', False: 'off', None: 'unknown'}
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)


@dataclass(frozen=True)
class OpcUaFile:
    """A device file.

    source_stamps : whether the controller's stamps are used, or the arrival
    together : samples that are no farther apart are one feedback [ns]
    estop : value of the node 'estop' that means E-stop, None where there is no such node
    """

    link: LinkSettings
    axes: tuple[AxisSource, ...]
    source_stamps: bool
    together: int
    estop: bool | float | str | None = None


def load_opcua(path: str) -> OpcUaFile:
    """Read a device file; raises UserError naming file, key and what is expected."""
    reader = load(path, _KEYS)
    axes = reader.axes('node', str)
    nodes = {axis.name: axis.source for axis in axes}
    estop = None
    if 'estop' in reader.data:
        section = reader.section('estop', {'node', 'value'})
        estop = section.required('value')
        if not isinstance(estop, bool | int | float | str):
            raise UserError(
                f'{section.where}: value: expected true, false, a number or a text, got {estop!r}'
            )
        nodes[_ESTOP] = DeviceReader(section.where, section.data).text('node')
    url, security = reader.text('url'), reader.text('security', '')
    parts = split_url(url)
    if parts is None or parts.scheme != 'opc.tcp' or parts.port is None:
        raise UserError(f'{path}: url: expected opc.tcp://HOST:PORT, got {url!r}')
    words = security.split(',')
    if security and (
        len(words) < 4 or words[0] not in POLICIES or words[1] not in MODES or not all(words)
    ):
        raise UserError(
            f'{path}: security: expected POLICY,MODE,CERTIFICATE,KEY with a policy of '
            f'{list(POLICIES)} and a mode of {list(MODES)}, got {security!r}'
        )
    link = LinkSettings(
        url, reader.text('user', ''), reader.text('password', ''),
        security, nodes, reader.number('period_ms', 20.0, (1.0, 1000.0)) * 1e-3,
    )
    return OpcUaFile(
        link, axes, reader.choice('stamp', STAMPS) == 'source',
        round(reader.number('skew_ms', 5.0, (0.001, 1000.0)) * 1e6), estop,
    )


def position(value: Any, axis: AxisSource) -> tuple[float | None, str]:
    """A DataValue's number; None with the reason where it is not good or no position."""
    said, why = _good(value)
    if why:
        return None, why
    if isinstance(said, bool) or not isinstance(said, int | float):
        return None, f'{type(said).__name__} instead of a number'
    if not axis.plausible(said):
        return None, f'{said:g} {axis.unit}' if math.isfinite(said) else 'not finite'
    return float(said), ''


def estop_state(value: Any, on: bool | float | str) -> tuple[bool | None, str]:
    """Whether a DataValue means E-stop; None with the reason where that is not known.

    on : the value that means it
    """
    said, why = _good(value)
    if why:
        return None, why
    kinds = str if isinstance(on, str) else (bool, int, float)
    if not isinstance(said, kinds):
        return None, f'{type(said).__name__} {said!r:.40} is never {on!r}'
    return said == on, ''


def _good(value: Any) -> tuple[Any, str]:
    """What a DataValue says; None with the reason where it is not good or says nothing."""
    if not value.StatusCode.is_good():
        return None, value.StatusCode.name
    said = None if value.Value is None else value.Value.Value
    return said, '' if said is not None else 'no value'


def source_time(value: Any) -> int | None:
    """A DataValue's source time stamp [ns since the epoch]; None where it has none."""
    stamp = value.SourceTimestamp
    if stamp is None:
        return None
    if stamp.tzinfo is None:
        stamp = stamp.replace(tzinfo=timezone.utc)
    return (stamp - _EPOCH) // timedelta(microseconds=1) * 1000


class OpcUa:
    """Subscribes to one node an axis."""

    def __init__(self, address: str) -> None:
        """Read the device file; raises UserError."""
        self._file = load_opcua(address)
        self._axes = {axis.name: axis for axis in self._file.axes}
        self._host = HostClock()
        self._link: Link | None = None

    @property
    def axes(self) -> tuple[str, ...]:
        """Letters of the axes in the device file."""
        return names(self._file.axes)

    @property
    def rate(self) -> float:
        """What the device file asks for [1/s]."""
        return 1.0 / self._file.link.period

    def open(self) -> None:
        """Connect; raises ConnectionError saying what failed and what to do."""
        self.close()
        self._device = DeviceClock()
        self._joiner = Joiner(self._file.axes, self._file.together)
        self._bad: dict[str, str] = {}
        # Axes whose first value has come: it may have been sampled long before.
        self._seen: set[str] = set()
        # None: not known.
        self._estop: bool | None = None
        self._stampless = False
        self._under_way, self._round_trip = Recent(), Recent()
        link = Link(self._file.link, self._host.now)
        link.start()
        self._link = link

    def read(self, timeout: float) -> list[Feedback]:
        """Feedback, waiting up to `timeout` [s]; raises ConnectionError when it is lost."""
        if self._link is None:
            raise ConnectionError('OPC UA is not open')
        batches = self._link.take(timeout)
        return [one for batch in batches for one in self._joiner.add(self._samples(batch))]

    def close(self) -> None:
        """Disconnect; does nothing where it is not open."""
        link, self._link = self._link, None
        if link is not None:
            link.stop()

    def problem(self) -> str:
        """What is wrong while the connection stands, in one line; '' where all is well."""
        if self._link is None:
            return ''
        if self._estop:
            return 'E-stop is on; release it and run the cycle again'
        for name, why in self._bad.copy().items():
            what, so = f'axis {name}', 'there is no feedback'
            if name == _ESTOP:
                what, so = name, 'an E-stop would not be seen'
            return (
                f'{what}: the controller has no good value ({why}), so {so}; look at the node in '
                'the server'
            )
        if self._stampless and self._file.source_stamps:
            return 'values come without source time stamps; set stamp: arrival in the device file'
        return self._device.problem() or self._host.problem()

    def uncertainty(self) -> float:
        """Of the stamps [s].

        Of the arrival: how differently long values are under way. Of the source: the way here,
        which is at most the round trip of a question; what the controller takes between sampling
        and stamping is not in it.
        """
        if self._link is None:
            return math.nan
        largest = self._round_trip if self._file.source_stamps else self._under_way
        return largest.largest * 1e-9

    def told(self) -> dict[str, str]:
        """What diagnostics show; the offset is this host's clock minus the controller's."""
        if self._link is None:
            return {}
        offset = self._device.offset
        return {
            **({'estop': _ESTOP_WORDS[self._estop]} if self._file.estop is not None else {}),
            'clock_offset_ms': '' if offset is None else f'{offset * 1e-6:.1f}',
            'under_way_ms': f'{self._under_way.largest * 1e-6:.1f}',
            'skew_ms': f'{self._joiner.skew.largest * 1e-6:.1f}',
            'lost': str(self._link.lost),
        }

    def _samples(self, batch: Batch) -> list[Sample]:
        if not batch.values:
            self._round_trip.add(batch.round_trip)
            return [Sample(batch.stamp)]
        samples = []
        stamps = self._stamps(batch)
        for (name, value), stamp in zip(batch.values, stamps, strict=True):
            if name == _ESTOP:
                self._estop, why = estop_state(value, self._file.estop)
            else:
                number, why = position(value, self._axes[name])
                samples.append(Sample(stamp, name, number))
            if why:
                self._bad[name] = why
            else:
                self._bad.pop(name, None)
        return samples

    def _stamps(self, batch: Batch) -> list[int]:
        """When the values of a message were so, in this host's time."""
        stamps = [batch.stamp] * len(batch.values)
        sources = {}
        for at, (name, value) in enumerate(batch.values):
            if name == _ESTOP:
                continue
            source = source_time(value)
            # A value that is none needs no time.
            self._stampless |= source is None and not _good(value)[1]
            if source is not None and name in self._seen:
                sources[at] = source
            self._seen.add(name)
        if sources:
            known = self._device.to_host(list(sources.values()), batch.stamp)
            self._under_way.add(batch.stamp - min(known))
            if self._file.source_stamps:
                for at, stamp in zip(sources, known, strict=True):
                    stamps[at] = stamp
        return stamps
