"""What `rtest info` says about a recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rtest_drivers.provenance import TOPIC
from rtest_estimation.bagfile import Bag, read_bag
from rtest_estimation.errors import UserError
from rtest_estimation.message_reader import DamagedMessage, message_reader
from rtest_estimation.missing import grouped
from rtest_estimation.pipeline import Finished
from rtest_estimation.plain_text import printable
from rtest_estimation.recording import TYPES, Recording, recording_of
from rtest_estimation.records import CyclePlan
from rtest_estimation.yaml_text import load_yaml
from rtest_identification.offline import estimate_recording


def describe(path: str | Path, topics: Mapping[str, str] | None = None) -> list[str]:
    """Lines that describe a recording: topics, session, plans, losses, missing poses, warnings.

    Works for any bag; one that cannot be identified from is described with the reason.

    topics : role to topic name, as in `rtest_estimation.recording.read_recording`

    Raises UserError where there is no recording at `path`.
    """
    bag = read_bag(path, TYPES)
    lines = _file_lines(bag)
    try:
        recording = recording_of(bag, topics)
    except UserError as error:
        warnings: tuple[str, ...] = (*bag.warnings, f'not a complete session: {error}')
    else:
        finished = estimate_recording(recording)
        lines += _session_lines(recording) + _missing_lines(finished)
        warnings = (*recording.warnings, *_problems(finished), *_not_begun(bag, recording))
    lines += _mark_lines(bag) + _software_lines(bag)
    return lines + _topic_lines(bag) + [f'warning   {warning}' for warning in warnings]


def _file_lines(bag: Bag) -> list[str]:
    lines = [f'recording {bag.path}', f'size      {bag.size / 1e6:.1f} MB']
    if bag.start:
        start = datetime.fromtimestamp(bag.start / 1e9, tz=timezone.utc)
        lines += [
            f'start     {start:%Y-%m-%d %H:%M:%S} UTC',
            f'duration  {(bag.end - bag.start) / 1e9:.1f} s',
        ]
    return [*lines, f'closed    {"yes" if bag.closed else "no"}']


def _texts(bag: Bag, ending: str) -> Iterator[tuple[int, str, str | None]]:
    """Log time [ns], topic, text of all texts on topics that end so; None for a damaged one."""
    topics = [
        topic for topic, (kind, _) in bag.topics.items()
        if topic.endswith(f'/{ending}') and kind == 'std_msgs/msg/String'
    ]
    for topic, definition, time, data in bag.stored(topics) if topics else ():
        message = message_reader(definition, f'{bag.path}: topic {topic}')(data)
        yield time, topic, None if isinstance(message, DamagedMessage) else message.data


def _mark_lines(bag: Bag) -> list[str]:
    """What people marked, and how long after the start of the recording."""
    return [
        f'mark      at {(time - bag.start) / 1e9:.1f} s: '
        + ('(damaged)' if text is None else printable(text))
        for time, _, text in _texts(bag, 'rtest/mark')
    ]


def _configuration(bag: Bag, key: str) -> dict[str, Any] | None:
    """A mapping of what the session recorded of itself; None where it did not.

    Raises UserError where it cannot be read.
    """
    for _, topic, text in _texts(bag, TOPIC):
        data = None if text is None else load_yaml(text, topic)
        found = data.get(key, {}) if isinstance(data, dict) else None
        if not isinstance(found, dict):
            raise UserError(f'{topic} cannot be read')
        return found
    return None


def _software_lines(bag: Bag) -> list[str]:
    """By which code the session was measured, where the recording says it."""
    try:
        found = _configuration(bag, 'software') or {}
    except UserError as error:
        return [f'software  {error}']
    return [f'software  {printable(f"{package} {version}")}' for package, version in found.items()]


def _not_begun(bag: Bag, recording: Recording) -> list[str]:
    """Cycles that were to be measured and were not begun: a session that was cut short."""
    try:
        wanted = _configuration(bag, 'cycles') or {}
    except UserError:
        # Told with the software.
        return []
    begun = {plan.cycle for plan in recording.plans}
    left = [printable(str(name)) for name in wanted if name not in begun]
    if not left:
        return []
    poses = sum(n for name, n in wanted.items() if name not in begun and isinstance(n, int))
    return [f'the session ended before {", ".join(left)}: {poses} poses were not begun']


def _session_lines(recording: Recording) -> list[str]:
    return [
        f'session   {recording.session}',
        f'machine   {_machine_name(recording.machine_text)}',
        f'lost      {recording.lost} readings',
        *(f'plan      {_plan(plan)}' for plan in recording.plans),
    ]


def _missing_lines(finished: list[Finished]) -> list[str]:
    """Poses without a valid point, estimated anew: how many, and which for which reason."""
    lost = sum(len(item.cycle.missing) for item in finished)
    poses = sum(len(item.cycle.plan.commands) for item in finished)
    return [
        f'missing   {lost} of {poses} poses',
        *(
            f'missing   {item.cycle.plan.cycle} {line}'
            for item in finished
            for line in grouped(item.cycle.missing)
        ),
    ]


def _problems(finished: list[Finished]) -> list[str]:
    """Why cycles could not be evaluated, where that is not the reason of a missing pose."""
    return [
        f'{item.cycle.plan.cycle}: {item.problem}'
        for item in finished
        if item.problem and item.problem not in {m.reason for m in item.cycle.missing}
    ]


def _machine_name(text: str | None) -> str:
    if text is None:
        return 'not recorded'
    try:
        return printable(str(load_yaml(text, 'machine')['name']))
    except (UserError, KeyError, TypeError):
        return 'recorded, without a name'


def _plan(plan: CyclePlan) -> str:
    kind = plan.kind.name.lower().replace('_', ' ')
    sphere = ', '.join(f'{1e3 * value:g}' for value in plan.sphere)
    return (
        f'{plan.cycle}: {kind}, {len(plan.commands)} poses of {" ".join(plan.axes)}, '
        f'sphere at ({sphere}) mm'
    )


def _topic_lines(bag: Bag) -> list[str]:
    """One line a topic; the rate is over the whole recording."""
    duration = (bag.end - bag.start) / 1e9
    width = max((len(name) for name in bag.topics), default=0)
    type_width = max((len(kind) for kind, _ in bag.topics.values()), default=0)
    return [
        f'topic     {name:{width}}  {kind:{type_width}}  {count:8d} messages'
        + (f'  {count / duration:8.2f} Hz' if duration > 0 and count > 1 else '')
        for name, (kind, count) in sorted(bag.topics.items())
    ]
