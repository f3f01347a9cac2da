"""Whether devices and nodes are alive: rate and age of what they send, and what they say."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

# Levels as the page names them, the worst last.
IDLE, OK, WARN, ERROR = 'idle', 'ok', 'warn', 'error'
# Of diagnostic_msgs/DiagnosticStatus.level: OK, WARN, ERROR, STALE.
_LEVELS = (OK, WARN, ERROR, ERROR)
# Silence after which a stream is dead: so many of its usual intervals, but at least this [s].
_INTERVALS, _SHORTEST_S = 5.0, 1.0
# The drivers say how they are twice a second, the other nodes once a second [s].
_DRIVER_SILENT_S, _NODE_SILENT_S = 1.5, 3.0
# A node that computes says nothing meanwhile: so long it may be busy [s].
_BUSY_S = {'identifier': 120.0, 'thermal': 120.0}
_LONGEST_BUSY_S = 10.0
# Who must not be silent: what it does not take is lost.
_NEVER_BUSY = ('recorder',)
# After a cycle it computes for some seconds; nothing is wrong with that [s].
_COMPUTES_S = 30.0
# The rate is that of the last so many seconds.
_RATE_S = 2.0


@dataclass(frozen=True)
class Report:
    """One status of /diagnostics. level : 0 to 3 as in diagnostic_msgs; heard : wall time [s]."""

    name: str
    level: int
    text: str
    values: Mapping[str, str] = field(default_factory=dict)
    heard: float = 0.0

    @property
    def source(self) -> str:
        """The node that says it: 'gauges: driver' and '/cell_1/gauges' are both of gauges."""
        return self.name.partition(':')[0].rpartition('/')[2].strip()


class Stream:
    """Messages of one topic: their rate in the time of their stamps, their age on the wall."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, int, int]] = deque(maxlen=1000)

    def add(self, stamp: int, total: int, now: float) -> None:
        """The newest message.

        stamp : [ns]; total : readings until then, however many messages were not looked at;
        now : wall time [s]
        """
        if self._seen and (stamp < self._seen[-1][1] or total < self._seen[-1][2]):
            # A driver that was restarted, or another recording.
            self._seen.clear()
        self._seen.append((now, stamp, total))
        while self._seen[0][0] < now - _RATE_S and len(self._seen) > 2:
            self._seen.popleft()

    @property
    def rate(self) -> float | None:
        """Readings per second; None where that is not known."""
        if len(self._seen) < 2:
            return None
        (_, first, before), (_, last, total) = self._seen[0], self._seen[-1]
        return (total - before) / ((last - first) * 1e-9) if last > first else None

    def age(self, now: float) -> float | None:
        """Wall time since the last message [s]; None where there was none."""
        return now - self._seen[-1][0] if self._seen else None

    def silent(self, now: float) -> bool:
        """Whether messages have stopped."""
        age = self.age(now)
        if age is None:
            return True
        times = [wall for wall, _, _ in self._seen]
        usual = (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.0
        return age > max(_SHORTEST_S, _INTERVALS * usual)


@dataclass(frozen=True)
class Health:
    """State of a device or a node: level, one line, rate [1/s] and age [s] where known."""

    name: str
    level: str
    text: str
    rate: float | None = None
    age: float | None = None


def device_health(
    name: str, stream: Stream, report: Report | None, ended: bool, now: float
) -> Health:
    """A device by its stream and by what its driver says.

    report : the driver's last one; None where it never said anything, as somebody else's driver
    ended : whether the session is over, so that silence is no fault
    """
    age, rate = stream.age(now), stream.rate
    said = None if report is None else now - report.heard
    if ended:
        return Health(name, IDLE, 'ended with the session', None, age)
    if report is not None and said > _DRIVER_SILENT_S:
        text = f'driver silent for {said:.1f} s: the process has ended or hangs'
        return Health(name, ERROR, text, None, age)
    if report is not None and _LEVELS[report.level] == ERROR:
        return Health(name, ERROR, report.text, None, age)
    if report is not None and report.values.get('state', 'active') != 'active':
        return Health(name, IDLE, report.text, None, age)
    if age is None:
        level = IDLE if report is None else WARN
        return Health(name, level, 'nothing heard yet', None, None)
    if stream.silent(now):
        return Health(name, ERROR, f'no data for {age:.1f} s: device or cable', None, age)
    if report is not None and _LEVELS[report.level] == WARN:
        return Health(name, WARN, report.text, rate, age)
    return Health(name, OK, 'sends', rate, age)


def node_health(reports: list[Report], ended: bool, now: float) -> Health:
    """A node by all that it says, the worst first."""
    name = reports[0].source
    said = now - max(report.heard for report in reports)
    if ended:
        return Health(name, IDLE, 'ended with the session', None, said)
    if said > _NODE_SILENT_S:
        if name in _BUSY_S and said <= _COMPUTES_S:
            return Health(name, OK, f'computes: silent for {said:.0f} s', None, said)
        if name not in _NEVER_BUSY and said <= _BUSY_S.get(name, _LONGEST_BUSY_S):
            return Health(name, WARN, f'busy: silent for {said:.0f} s', None, said)
        text = f'silent for {said:.0f} s: the process has ended or hangs'
        return Health(name, ERROR, text, None, said)
    worst = max(reports, key=lambda report: report.level)
    # The identifier sums up what it found and has its warnings beside that.
    text = worst.values.get('warning 1', worst.text)
    more = sum(key.startswith('warning ') for key in worst.values) - 1
    text += f' (and {more} more)' if more > 0 else ''
    return Health(name, _LEVELS[worst.level], text, None, said)
