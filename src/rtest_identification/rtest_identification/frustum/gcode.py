"""Reads straight blocks of NC programs: every axis commanded, mm and degrees, absolute.

Strict: what would make the axes go elsewhere than the words say (arcs, offsets, compensation, TCP
mode, incremental words, inches) is refused with file and line; what does not move an axis is read
over.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.machine import Machine

_WORD = re.compile(r'([A-Z])\s*([+-]?(?:\d+\.?\d*|\.\d+))\s*')
_COMMENT = re.compile(r'\([^()]*\)|;.*')
_MOTION = {0.0: False, 1.0: True}
# Dwell, planes, mm, no compensation, no tool length, the work offset in which all axes at zero are
# the machine's zero, path modes, no cycle, absolute words, feed modes.
_HARMLESS_G = {4, 17, 18, 19, 21, 40, 49, 54, 61, 64, 80, 90, 93, 94, 95}
_REFUSED_G = {
    2: 'an arc; give straight blocks', 3: 'an arc; give straight blocks',
    20: 'inches; give mm', 28: 'a reference move', 30: 'a reference move',
    43: 'a tool length; give positions of the axes', 43.4: 'TCP mode; give positions of the axes',
    53: 'machine coordinates', 91: 'incremental; give absolute positions',
    92: 'a shift of the coordinates',
}
_HARMLESS_M = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 30}
_END_M = {2, 30}
_OTHER_WORDS = frozenset('NOFST')


@dataclass(frozen=True)
class Blocks:
    """Cutting moves of a program (G1), all axes going straight from start to end.

    start, end : (m, k) in the order of ``machine.letters`` [m] or [rad]
    line : (m,) of the program, counted from 1
    """

    start: np.ndarray
    end: np.ndarray
    line: tuple[int, ...]


def read_blocks(path: Path, text: str, machine: Machine) -> Blocks:
    """Read a program's cutting moves.

    Raises UserError naming file, line and what is expected.
    """
    scale = {n: math.pi / 180 if machine.axes[n].rotary else 1e-3 for n in machine.letters}
    position: dict[str, float] = {}
    cutting: bool | None = None
    found, at = [], []
    for number, words in executed(path, text):
        where = f'{path}:{number}'
        motion = [_MOTION[v] for letter, v in words if letter == 'G' and v in _MOTION]
        if len(motion) > 1:
            raise UserError(f'{where}: two of G0 and G1 in one block; give each its own')
        cutting = motion[0] if motion else cutting
        dwell = ('G', 4.0) in words
        timed = dwell or ('G', 64.0) in words
        if dwell:
            _check_dwell(words, scale, where)
        before = dict(position)
        for letter, value in words:
            if letter in 'GM':
                _check_code(letter, value, where)
            elif letter in scale:
                if not dwell:
                    position[letter] = value * scale[letter]
            elif letter not in _OTHER_WORDS and not (letter == 'P' and timed) and not (
                letter == 'X' and dwell
            ):
                raise UserError(f'{where}: {letter}{value:g}: not one of the words expected here')
        if position != before:
            if cutting is None:
                raise UserError(f'{where}: axes move before any G0 or G1')
            if cutting:
                missing = [name for name in machine.letters if name not in before]
                if missing:
                    raise UserError(
                        f'{where}: where {", ".join(missing)} start from is not known; go there '
                        'with G0 first'
                    )
                found.append((before, dict(position)))
                at.append(number)
    if not found:
        raise UserError(f'{path}: no cutting move (G1)')
    ends = np.array([[[p[name] for name in machine.letters] for p in pair] for pair in found])
    return Blocks(ends[:, 0], ends[:, 1], tuple(at))


def executed(path: Path, text: str) -> Iterator[tuple[int, list[tuple[str, float]]]]:
    """Line, counted from 1, and words of every block up to the program's end.

    The end is M2, M30 or a percent sign after a block. Raises UserError as `read_blocks` does.
    """
    begun = False
    for number, line in enumerate(text.splitlines(), 1):
        rest = _COMMENT.sub(' ', line).strip().upper()
        if rest == '%':
            if begun:
                return
            continue
        words = _words(rest, f'{path}:{number}')
        begun = begun or bool(words)
        yield number, words
        if any(letter == 'M' and v in _END_M for letter, v in words):
            return


def _words(rest: str, where: str) -> list[tuple[str, float]]:
    """Letters with their numbers of a line without its comments."""
    words, at = [], 0
    while at < len(rest):
        match = _WORD.match(rest, at)
        if match is None:
            raise UserError(f'{where}: {rest[at:at + 20]!r}: expected a letter with a number')
        letter, value = match.group(1), float(match.group(2))
        if letter not in 'GM' and any(letter == other for other, _ in words):
            raise UserError(f'{where}: two words {letter} in one block')
        words.append((letter, value))
        at = match.end()
    return words


def _check_dwell(words: list[tuple[str, float]], axes: dict[str, float], where: str) -> None:
    """A dwell moves nothing: `G4 P` or, as some controllers have it, `G4 X` with its time."""
    times = [letter for letter, _ in words if letter in axes or letter in 'PX']
    if times not in ([], ['P'], ['X']) or any(('G', code) in words for code in _MOTION):
        raise UserError(
            f'{where}: a dwell (G4) in one block with a move; give P or X with its time alone'
        )


def _check_code(letter: str, value: float, where: str) -> None:
    if letter == 'M':
        if value not in _HARMLESS_M:
            raise UserError(f'{where}: M{value:g}: what it does is not known here')
    elif value in _REFUSED_G:
        raise UserError(f'{where}: G{value:g} is {_REFUSED_G[value]}')
    elif value not in _MOTION and value not in _HARMLESS_G:
        raise UserError(f'{where}: G{value:g}: expected straight blocks (G0, G1)')
