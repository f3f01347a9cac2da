"""Missing poses in words: grouped by reason, so that a whole lost cycle is one line."""

from __future__ import annotations

import re
from collections.abc import Iterable

from rtest_estimation.records import Missing

_NUMBER = re.compile(r'(\d+(?:\.\d+)?)')


def grouped(missing: Iterable[Missing]) -> list[str]:
    """For example ``3-17, 20: no gauge readings``: one text per reason, in order of the poses.

    Reasons that differ in their numbers only are one, with the range of each number.
    """
    groups: dict[tuple[str, ...], tuple[list[int], list[list[str]]]] = {}
    for item in sorted(missing, key=lambda item: item.index):
        parts = _NUMBER.split(item.reason)
        poses, numbers = groups.setdefault(tuple(parts[::2]), ([], []))
        poses.append(item.index)
        numbers.append(parts[1::2])
    return [
        f'{_ranges(poses)}: {_reason(words, numbers)}'
        for words, (poses, numbers) in groups.items()
    ]


def _ranges(poses: list[int]) -> str:
    """For example ``3-17, 20`` of ascending indices."""
    runs: list[list[int]] = []
    for pose in poses:
        if runs and pose == runs[-1][-1] + 1:
            runs[-1].append(pose)
        else:
            runs.append([pose])
    return ', '.join(f'{run[0]}-{run[-1]}' if len(run) > 1 else str(run[0]) for run in runs)


def _reason(words: tuple[str, ...], numbers: list[list[str]]) -> str:
    text = words[0]
    for values, after in zip(zip(*numbers, strict=True), words[1:], strict=True):
        low, high = min(values, key=float), max(values, key=float)
        text += (low if float(low) == float(high) else f'{low} to {high}') + after
    return text
