"""What of a recording is replayed, and when: topics, time window, batches. Needs no ROS node."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rtest_drivers.message_types import MessageTypeError, MessageTypes
from rtest_estimation.bagfile import Bag, read_bag
from rtest_estimation.errors import UserError
from rtest_estimation.message_reader import type_hash
from rtest_estimation.recording import ROLES, TEMPERATURE, TYPES, find_topic

# What drivers and session have published, from which the other nodes compute everything else.
SOURCES = ('machine', 'plan', 'gauges', 'feedback')
# Latched also where they were not when they were recorded: nodes that start later need them.
LATCHED = ('machine', 'plan')
# A batch is no longer than this in the time of the recording [ns]: the estimator waits four times
# as long for readings that are behind the feedback.
BATCH_NS = 500_000_000
# Nor has it more messages: what is on its way fits several times into any queue of the graph.
BATCH_MESSAGES = 200


@dataclass(frozen=True)
class Topic:
    """One topic that is replayed.

    role : key of `ROLES` for what the estimator reads, '' for others
    latched : whether late subscribers get it too, as when it was recorded
    """

    name: str
    type_name: str
    role: str
    latched: bool


@dataclass(frozen=True)
class Message:
    """One recorded message, serialised (CDR); time : of its reception [ns]."""

    topic: str
    time: int
    data: bytes


class Playlist:
    """What is replayed of one recording.

    path : bag directory or file; topics : role to topic name, as for `read_recording`
    everything : also what estimator, identifier and the others have published
    start, stop : from and until when [s] after the first message; the end where `stop` is 0

    Attributes: `topics` by name, `start` and `end` of the replay [ns], `warnings`.

    Raises UserError where there is nothing to replay.
    """

    def __init__(
        self,
        path: Path,
        topics: Mapping[str, str] | None = None,
        everything: bool = False,
        start: float = 0.0,
        stop: float = 0.0,
    ) -> None:
        self._bag = read_bag(path, TYPES)
        self.warnings = list(self._bag.warnings)
        wanted = _topics(self._bag, topics or {}, everything)
        self.topics = {topic.name: topic for topic in wanted if self._known(topic)}
        if not self.topics:
            raise UserError(
                f'{path}: no topic to replay; expected readings, feedback, plans '
                f'({", ".join("/" + ROLES[role][1] for role in SOURCES)})'
            )
        length = (self._bag.end - self._bag.start) * 1e-9
        if not 0.0 <= start <= length:
            raise UserError(f'--start {start:g}: expected 0 to {length:.1f} s, as long as {path}')
        if stop and stop <= start:
            raise UserError(f'--stop {stop:g}: expected a time after --start {start:g}')
        self.start = self._bag.start + round(start * 1e9)
        self.end = min(self._bag.end, self._bag.start + round((stop or length) * 1e9))

    def batches(self) -> Iterator[list[Message]]:
        """Messages in the order of their time, a few at a time.

        What is latched comes by itself, so that everybody has it before what follows; from before
        the start too, as to any late subscriber.
        """
        batch: list[Message] = []
        for name, _, time, data in self._bag.stream(self.topics):
            latched = self.topics[name].latched
            if time > self.end or (time < self.start and not latched):
                continue
            full = len(batch) >= BATCH_MESSAGES or (batch and time - batch[0].time >= BATCH_NS)
            if batch and (full or latched):
                yield batch
                batch = []
            batch.append(Message(name, max(time, self.start), data))
            if latched:
                yield batch
                batch = []
        if batch:
            yield batch

    def _known(self, topic: Topic) -> bool:
        """Whether the installed type is the recorded one, so that the data mean the same."""
        try:
            installed = MessageTypes().definition(topic.type_name).type_hash
        except MessageTypeError as error:
            self.warnings.append(f'{topic.name} is not replayed: {error}')
            return False
        definition = self._bag.definitions[topic.name]
        if definition.text and type_hash(definition) != installed:
            self.warnings.append(
                f'{topic.name} is not replayed: it was recorded with another definition of '
                f'{topic.type_name} than the installed one'
            )
            return False
        return True


def _topics(bag: Bag, chosen: Mapping[str, str], everything: bool) -> Iterator[Topic]:
    roles = {find_topic(bag, role, chosen.get(role)): role for role in SOURCES}
    for name, (type_name, _) in bag.topics.items():
        role = roles.get(name, '')
        if role or everything or type_name == TEMPERATURE:
            yield Topic(name, type_name, role, role in LATCHED or bag.latched.get(name, False))
