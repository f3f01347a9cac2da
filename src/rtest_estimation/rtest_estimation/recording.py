"""Reads a recorded session for identification at a desk; needs no ROS."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rtest_estimation import messages
from rtest_estimation.bagfile import Bag, read_bag
from rtest_estimation.columns import GaugeColumns, Stream
from rtest_estimation.errors import UserError
from rtest_estimation.message_reader import DamagedMessage
from rtest_estimation.records import CyclePlan, Feedback, GaugeBlock, Temperature
from rtest_estimation.sequence import Loss, SequenceCheck

# What a recording is read for: message type and the name the graph gives the topic.
ROLES = {
    'gauges': ('rtest_msgs/msg/GaugeSamples', 'rtest/gauges'),
    'feedback': ('sensor_msgs/msg/JointState', 'rtest/cnc/feedback'),
    'plan': ('rtest_msgs/msg/CyclePlan', 'rtest/plan'),
    'machine': ('std_msgs/msg/String', 'rtest/machine'),
    'nest': ('rtest_msgs/msg/NestCalibration', 'rtest/nest'),
    'cycle': ('rtest_msgs/msg/Cycle', 'rtest/cycle'),
    'location_errors': ('rtest_msgs/msg/LocationErrors', 'rtest/location_errors'),
}
TEMPERATURE = 'sensor_msgs/msg/Temperature'
TYPES = frozenset((
    TEMPERATURE,
    # Readings and feedback may be too many to be kept; see `columns`.
    *(kind for role, (kind, _) in ROLES.items() if role not in ('gauges', 'feedback')),
))
NEEDED = {
    'gauges': 'gauge readings',
    'feedback': 'encoder feedback',
    'plan': 'plan of a cycle',
}
# Gaps that a warning lists one by one.
LISTED_GAPS = 5
# A session has a few cycles at each of a few sphere positions.
MAX_PLANS = 10_000

Stamped = TypeVar('Stamped', CyclePlan, Temperature)


@dataclass(frozen=True)
class Recording:
    """One recorded session.

    machine_text : YAML of the machine, None where it was not recorded
    plans, gauges, feedback : in the order of their stamps; gauges and feedback stay in the file
    nests, cycles, location_errors : messages that were published during the session, if any
    warnings : everything that is missing or damaged, one sentence each
    topics : name to (type, number of messages), of everything in the file
    start, end : first and last reception [ns]; size : [bytes]
    lost : readings missing by their running index
    closed : whether the recorder could close the file
    """

    path: Path
    session: str
    machine_text: str | None
    plans: tuple[CyclePlan, ...]
    gauges: Stream[GaugeBlock]
    feedback: Stream[Feedback]
    nests: tuple[Any, ...]
    cycles: tuple[Any, ...]
    location_errors: tuple[Any, ...]
    warnings: tuple[str, ...]
    topics: dict[str, tuple[str, int]]
    start: int
    end: int
    size: int
    lost: int = 0
    closed: bool = True


def read_recording(path: str | Path, topics: Mapping[str, str] | None = None) -> Recording:
    """Read a session from a bag directory or an .mcap file, whole or cut.

    topics : role (key of `ROLES`) to topic name, where the name cannot be found by itself

    Raises UserError where there is no recording, where readings, feedback or plans are missing,
    and where several topics could be meant.
    """
    return recording_of(read_bag(path, TYPES), topics)


def recording_of(bag: Bag, topics: Mapping[str, str] | None = None) -> Recording:
    """The session in a bag that was read with `TYPES`; see `read_recording`."""
    warnings = list(bag.warnings)
    chosen = _find_topics(bag, topics)
    gauges, lost = _gauges(bag, chosen['gauges'], warnings)
    feedback = _feedback(bag, chosen['feedback'], warnings)
    plans = _plans(_convert(bag, chosen['plan'], messages.cycle_plan, warnings), warnings)
    for role, records in (('gauges', gauges), ('feedback', feedback), ('plan', plans)):
        if not records:
            raise UserError(
                f'{bag.path}: no usable {NEEDED[role]} on {chosen[role]}: {warnings[-1]}'
            )
    machine = _raw_messages(bag, chosen['machine'], warnings)
    folder = bag.path if bag.path.is_dir() else bag.path.with_suffix('')
    return Recording(
        bag.path,
        plans[0].session or folder.name,
        str(machine[-1].data) if machine else None,
        plans,
        gauges,
        feedback,
        _raw_messages(bag, chosen['nest'], warnings),
        _raw_messages(bag, chosen['cycle'], warnings),
        _raw_messages(bag, chosen['location_errors'], warnings),
        tuple(warnings),
        bag.topics,
        bag.start,
        bag.end,
        bag.size,
        lost,
        bag.closed,
    )


def recorded_machine(bag: Bag, topics: Mapping[str, str] | None = None) -> str | None:
    """YAML of the machine alone, None where it was not recorded; raises as `read_recording`."""
    machine = _raw_messages(bag, _find_topics(bag, topics)['machine'], [])
    return str(machine[-1].data) if machine else None


def temperatures(bag: Bag, warnings: list[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Sensor to stamps [ns], in order, and temperatures [deg C], whatever the topic.

    warnings : to which is added what had to be left out
    """
    records = [
        record
        for topic, (message_type, _) in bag.topics.items()
        if message_type == TEMPERATURE
        for record in _convert(bag, topic, messages.temperature, warnings)
    ]
    found: dict[str, tuple[list[int], list[float]]] = {}
    for record in sorted(records, key=lambda record: record.stamp):
        stamps, values = found.setdefault(record.sensor, ([], []))
        stamps.append(record.stamp)
        values.append(record.value)
    return {sensor: (np.array(t), np.array(v)) for sensor, (t, v) in found.items()}


def _find_topics(bag: Bag, topics: Mapping[str, str] | None) -> dict[str, str | None]:
    """Topic of every role; raises UserError where one is missing that is needed."""
    chosen = {role: find_topic(bag, role, (topics or {}).get(role)) for role in ROLES}
    for role, name in NEEDED.items():
        if chosen[role] is None:
            message_type, topic = ROLES[role]
            why = bag.warnings[0] if bag.warnings else 'record the session with this topic'
            raise UserError(f'{bag.path}: no {name} (topic /{topic}, type {message_type}); {why}')
    return chosen


def find_topic(bag: Bag, role: str, name: str | None = None) -> str | None:
    """Topic of a role (key of `ROLES`): by `name`, by its usual name, by its type.

    Returns None where nothing fits; raises UserError where several do.
    """
    message_type, usual = ROLES[role]
    fitting = [topic for topic, (found, _) in bag.topics.items() if found == message_type]
    if name is not None:
        if name not in fitting:
            raise UserError(
                f'{bag.path}: no topic {name} of type {message_type} for {role}; '
                f'there is {", ".join(sorted(fitting)) or "none of this type"}'
            )
        return name
    if role == 'machine':
        # Any text is a String: under another name it must look like a machine file.
        fitting = [topic for topic in fitting if _is(topic, usual) or _machine_like(bag, topic)]
    for candidates in (
        [topic for topic in fitting if topic == f'/{usual}'],
        [topic for topic in fitting if _is(topic, usual)],
        fitting,
    ):
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            raise UserError(
                f'{bag.path}: {role} could be any of {", ".join(sorted(candidates))}; '
                f'choose with --topic {role}=NAME'
            )
    return None


def _is(topic: str, usual: str) -> bool:
    """Whether a topic has its usual name, in whatever namespace."""
    return topic.endswith(f'/{usual}')


def _machine_like(bag: Bag, topic: str) -> bool:
    return any(
        not isinstance(message, DamagedMessage)
        and all(re.search(rf'^{key}\s*:', message.data, re.MULTILINE) for key in ('chain', 'axes'))
        for message in bag.messages(topic)
    )


def _convert(
    bag: Bag, topic: str, convert: Callable[[Any], Stamped], warnings: list[str]
) -> list[Stamped]:
    """Records of a topic in order of arrival; damaged messages are counted in a warning."""
    records: list[Stamped] = []
    reasons: list[str] = []
    for message in bag.messages(topic):
        if isinstance(message, DamagedMessage):
            reasons.append(message.reason)
            continue
        try:
            record = convert(message)
        except messages.MessageError as error:
            reasons.append(str(error))
            continue
        if record.stamp <= 0:
            reasons.append('its time stamp is 0')
            continue
        records.append(record)
    if reasons:
        warnings.append(f'{topic}: {_plural(len(reasons), "message")} left out ({reasons[0]})')
    return records


def _raw_messages(bag: Bag, topic: str | None, warnings: list[str]) -> tuple[Any, ...]:
    """Messages of a topic that identification does not need, as they are."""
    if topic is None:
        return ()
    found = tuple(bag.messages(topic))
    good = tuple(message for message in found if not isinstance(message, DamagedMessage))
    if len(good) < len(found):
        warnings.append(f'{topic}: {_plural(len(found) - len(good), "damaged message")} left out')
    return good


def _gauges(bag: Bag, topic: str, warnings: list[str]) -> tuple[Stream[GaugeBlock], int]:
    """Readings, and how many are lost; gaps are named in a warning."""
    check = SequenceCheck()
    gaps: list[Loss] = []

    def look(columns: GaugeColumns) -> None:
        readings = columns.displacement.shape[1]
        numbers = zip(columns.stamps.tolist(), columns.sequence.tolist(), strict=True)
        for stamp, sequence in numbers:
            if (loss := check.add(stamp, sequence, readings)) is not None:
                gaps.append(loss)

    stream = Stream(bag, topic, look)
    _note_left_out(stream, topic, warnings)
    if gaps:
        listed = [
            f'{gap.count} before {_seconds(gap.stamp, bag.start)}' for gap in gaps[:LISTED_GAPS]
        ]
        more = f' and {len(gaps) - LISTED_GAPS} more' if len(gaps) > LISTED_GAPS else ''
        warnings.append(
            f'{topic}: {_plural(check.lost, "reading")} lost in {_plural(len(gaps), "gap")} '
            f'({", ".join(listed)}{more})'
        )
    if check.restarts:
        warnings.append(f'{topic}: the driver was restarted {_plural(check.restarts, "time")}')
    _note_steps(stream, topic, bag.start, warnings)
    return stream, check.lost


def _feedback(bag: Bag, topic: str, warnings: list[str]) -> Stream[Feedback]:
    stream = Stream(bag, topic)
    _note_left_out(stream, topic, warnings)
    _note_steps(stream, topic, bag.start, warnings)
    return stream


def _note_left_out(stream: Stream, topic: str, warnings: list[str]) -> None:
    if stream.damaged:
        warnings.append(
            f'{topic}: {_plural(stream.damaged, "message")} left out ({stream.left_out})'
        )


def _note_steps(stream: Stream, topic: str, start: int, warnings: list[str]) -> None:
    if stream.back:
        warnings.append(
            f'{topic}: stamps step back {_plural(len(stream.back), "time")}, first to '
            f'{_seconds(stream.back[0], start)}; sorted'
        )


def _plans(arrived: list[CyclePlan], warnings: list[str]) -> tuple[CyclePlan, ...]:
    """Plans by stamp; one that was delivered twice (latched topic) counts once."""
    unique = {(plan.session, plan.cycle, plan.stamp): plan for plan in arrived}
    if len(unique) > MAX_PLANS:
        raise UserError(f'{len(unique)} plans in one recording, expected {MAX_PLANS} at most')
    sessions = sorted({plan.session for plan in arrived})
    if len(sessions) > 1:
        listed = ', '.join(sessions[:LISTED_GAPS])
        more = f' and {len(sessions) - LISTED_GAPS} more' if len(sessions) > LISTED_GAPS else ''
        warnings.append(f'plans of several sessions in one recording: {listed}{more}')
    return tuple(sorted(unique.values(), key=lambda plan: plan.stamp))


def _seconds(stamp: int, start: int) -> str:
    return f'{(stamp - start) / 1e9:.3f} s'


def _plural(count: int, noun: str) -> str:
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'
