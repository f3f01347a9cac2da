"""What is wrong in one MCAP file: counted, and told in sentences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

# Places that are named; of more there is the number only, also in a file of nothing else.
_NAMED = 3


@dataclass
class Damage:
    """Of one file; bytes count from its beginning.

    left_out : chunks and records left out, `why` the first of them was
    orphans : messages left out whose topic is not known
    skipped : stretches in which no record was found, `skipped_bytes` of them together
    frames : chunks whose opcode or length is damaged, and which are whole themselves
    cut : from where on nothing is found
    """

    left_out: int = 0
    why: str = ''
    orphans: int = 0
    skipped: int = 0
    skipped_bytes: int = 0
    frames: int = 0
    cut: int | None = None
    _stretches: list[str] = field(default_factory=list)
    _frames: list[str] = field(default_factory=list)

    def __bool__(self) -> bool:
        return bool(
            self.left_out or self.orphans or self.framing or self.cut is not None
        )

    @property
    def framing(self) -> bool:
        """Whether records were not where those before them say."""
        return bool(self.skipped or self.frames)

    def leave_out(self, why: str) -> None:
        """Count a chunk or record that is left out."""
        self.left_out += 1
        self.why = self.why or why

    def skip(self, place: int, count: int) -> None:
        """Count bytes that are no record."""
        self.skipped += 1
        self.skipped_bytes += count
        if self.skipped <= _NAMED:
            self._stretches.append(f'{count} bytes at byte {place}')

    def mend_frame(self, place: int) -> None:
        """Count a chunk that was read although its frame is damaged."""
        self.frames += 1
        if self.frames <= _NAMED:
            self._frames.append(str(place))

    def of_framing(self, name: str) -> Iterator[str]:
        """Sentences about the places of records.

        name : of the file
        """
        if self.frames:
            yield (
                f'{name} is damaged at byte {_listed(self._frames, self.frames)}: the kind or '
                'length of a chunk is wrong there; the chunk itself is whole and is used'
            )
        if self.skipped:
            total = f', {self.skipped_bytes} bytes together' if self.skipped > 1 else ''
            yield (
                f'{name} is damaged: skipped {_listed(self._stretches, self.skipped)}{total}; '
                'what was recorded before and after is used'
            )
        if self.cut is not None:
            yield (
                f'{name} is cut or damaged at byte {self.cut}: what was recorded before is used, '
                'nothing after'
            )

    def of_records(self, name: str) -> Iterator[str]:
        """Sentences about what is in the records.

        name : of the file
        """
        if self.left_out:
            yield f'{name}: damaged chunks or records left out: {self.left_out} ({self.why})'
        if self.orphans:
            yield (
                f'{name}: {self.orphans} messages left out whose topic was in a damaged chunk'
            )


def _listed(named: list[str], count: int) -> str:
    more = [f'{count - len(named)} more'] if count > len(named) else []
    *first, last = named + more
    return f'{", ".join(first)} and {last}' if first else last
