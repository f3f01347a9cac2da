"""NC programs with corrected positions.

`rewrite` changes the positions in a program of axis positions (`frustum.gcode` reads the same) and
leaves everything else as it is, feed included. `path_program` writes straight blocks through
corrected points. Both cut blocks where the correction along them is no straight line (`pieces`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtest_identification.correction.known import KnownErrors
from rtest_identification.correction.pieces import STRAIGHT, Moves
from rtest_identification.correction.pieces import cut as cut_moves
from rtest_identification.correction.step import Correction, correct
from rtest_identification.frustum.commands import Commands
from rtest_identification.frustum.gcode import executed, read_blocks
from rtest_identification.machine import Machine
from rtest_identification.moves import Speeds
from rtest_identification.nc_controllers import CONTROLLERS
from rtest_identification.nc_program import LINEAR_DIGITS, ROTARY_DIGITS

# Shortest time of a block [s], feed to the first point [mm/min].
_SHORTEST, _APPROACH = 1e-3, 500.0
# The tip does not travel where it moves less [m].
_STANDS = 1e-6
_COMMENT = re.compile(r'(\([^()]*\)|;.*)')
_WORD = re.compile(r'([A-Z])\s*([+-]?(?:\d+\.?\d*|\.\d+))', re.IGNORECASE)
# A comment on the line of the number stays with it.
_HEAD = re.compile(r'\s*(%|O\d+\s*(\([^()]*\)\s*|;.*)*)?\s*', re.IGNORECASE)
# M functions that act before their block's motion on any controller: they stay with its first
# piece. Others would act in the middle of what was one block.
_BEFORE = frozenset((3.0, 4.0, 6.0, 7.0, 8.0))


@dataclass(frozen=True)
class Program:
    """A corrected program.

    correction : at the ends of all blocks of which every axis's position is known, or at the
        points of a path
    along : at points along the cutting blocks (G1), run as they are written
    notes : what a person should know: blocks that could not be corrected
    """

    text: str
    correction: Correction
    along: Correction
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Block:
    """A block that moves axes, positions [m] or [rad].

    start : None where an axis's position is not known before; end : None where not known after
    feed : its F word under G93, else 0
    cutting : whether it is G1; whole : whether it must stay one block
    """

    line: int
    start: np.ndarray | None
    end: np.ndarray | None
    feed: float
    cutting: bool
    whole: bool


def words(machine: Machine, row: np.ndarray) -> str:
    """Words of all axes, for example `X1.0000 Y0.0000 Z40.6000 B-75.00000 C30.00000`."""
    shown = []
    for name, value in zip(machine.letters, row, strict=True):
        rotary = machine.axes[name].rotary
        digits = ROTARY_DIGITS if rotary else LINEAR_DIGITS
        number = round(math.degrees(value) if rotary else value * 1e3, digits) + 0.0
        shown.append(f'{name}{number:.{digits}f}')
    return ' '.join(shown)


def rewrite(path: Path, text: str, known: KnownErrors) -> Program:
    """Correct the positions of a program.

    Raises UserError naming file and line where it has anything but straight blocks of axis
    positions, or leaves the measured stations.
    """
    machine = known.machine
    read_blocks(path, text, machine)  # refuses what moves axes elsewhere
    lines = text.splitlines()
    blocks = _blocks(path, text, machine)
    whole = [block for block in blocks if block.end is not None]
    approach = _signs(whole)
    ends = np.array([block.end for block in whole])
    correction = correct(machine, ends, known.named(
        ends, approach, lambda row: f'{path}:{whole[row].line + 1}'
    ))
    corrected = dict(zip((block.line for block in whole), correction.positions, strict=True))
    chosen = [k for k, block in enumerate(whole) if block.cutting and block.start is not None]
    cutting = [whole[k] for k in chosen]
    cut = cut_moves(known, Moves(
        np.array([block.start for block in cutting]), ends[chosen],
        approach[np.array(chosen) - 1], approach[chosen],
        np.array([block.whole for block in cutting]),
        [f'{path}:{block.line + 1}' for block in cutting],
    ))
    pieces = {block.line: k for k, block in enumerate(cutting) if len(cut.rows[k]) > 1}
    written = []
    for number, line in enumerate(lines):
        if number not in corrected:
            written.append(line)
        elif number not in pieces:
            written.append(_replaced(line, machine, corrected[number]))
        else:
            k = pieces[number]
            feeds = [_feed(cutting[k].feed, share)
                     for share in np.diff(cut.shares[k], prepend=0.0)]
            written.append(_replaced(line, machine, cut.rows[k][0], feeds[0]))
            written += [words(machine, row) + (f' F{feed:.3f}' if feed else '')
                        for row, feed in zip(cut.rows[k][1:], feeds[1:], strict=True)]
    # After the percent sign and the program's number, which are first on any controller.
    head = next((n for n, line in enumerate(lines) if not _HEAD.fullmatch(line)), len(lines))
    written.insert(head, f'({_told(machine)})')
    notes = []
    left = [block.line for block in blocks if block.end is None]
    if left:
        notes.append(
            f'{path}: {_lines(left)}: not corrected: the positions of other axes are not known '
            'there'
        )
    bent = {block.line: off for block, off in zip(cutting, cut.bent, strict=True)
            if block.whole and off > STRAIGHT}
    if bent:
        notes.append(
            f'{path}: {_lines(list(bent))}: corrected at the end only, because of its M word; in '
            f'between off by up to {max(bent.values()) * 1e6:.1f} µm'
        )
    return Program('\n'.join(written) + '\n', correction, cut.along, tuple(notes))


def path_program(
    commands: Commands, known: KnownErrors, feed: float, controller: str = 'linuxcnc'
) -> Program:
    """Straight blocks through corrected points; the tool comes to the first one straight.

    feed : of the tool tip on the part [m/s]
    controller : a key of `CONTROLLERS`

    Raises UserError naming the point where the path leaves the measured stations.
    """
    machine, dialect = commands.machine, CONTROLLERS[controller]
    positions, approach = commands.positions, commands.approach
    correction = correct(machine, positions, known.named(positions, approach, commands.where))
    cut = cut_moves(known, Moves(
        positions[:-1], positions[1:], approach[:-1], approach[1:],
        np.zeros(len(positions) - 1, dtype=bool),
        [commands.where(row) for row in range(1, len(positions))],
    ))
    travel = np.linalg.norm(np.diff(commands.feature.tip, axis=0), axis=1)
    rotary = [machine.letters.index(name) for name in machine.rotary]
    turns = np.abs(np.diff(positions[:, rotary], axis=0)).max(axis=1, initial=0.0)
    seconds = np.where(travel > _STANDS, travel / feed, turns / Speeds().rotary)
    lines = [
        '%', *(['O0001'] if controller == 'iso' else []), f'({_told(machine)})',
        '(X Y Z AND ROTARY AXES: POSITIONS OF THE AXES. NO TCP MODE, NO TOOL LENGTH)',
        'G21 G90 G17 G40 G49 G80 G94', 'G54',
        '(MSG,NEXT: STRAIGHT TO THE FIRST POINT. IS THE WAY FREE)', 'M0',
        f'G1 {words(machine, correction.positions[0])} F{_APPROACH:.1f}', 'G93',
        dialect.blend.format(mm=1e-3),
    ]
    for time, shares, rows in zip(seconds, cut.shares, cut.rows, strict=True):
        times = np.maximum(time * np.diff(shares, prepend=0.0), _SHORTEST)
        lines += [f'G1 {words(machine, row)} F{60.0 / one:.3f}'
                  for row, one in zip(rows, times, strict=True)]
    text = '\n'.join([*lines, 'G94', dialect.end, '%']) + '\n'
    return Program(text, correction, cut.along, ())


def _feed(feed: float, share: float) -> float:
    """F of a share of a block whose F is one over its time (G93); 0 where it is none."""
    shortest = 60.0 / _SHORTEST
    if not feed:
        return 0.0
    return shortest if not share else min(feed / share, shortest)


def _lines(numbers: Sequence[int]) -> str:
    """For example `line 5, 7`, counted from 1."""
    shown = ', '.join(str(number + 1) for number in numbers[:5])
    return f'line {shown}{" and more" if len(numbers) > 5 else ""}'


def _told(machine: Machine) -> str:
    name = re.sub(r'[^A-Z0-9 _-]', ' ', machine.name.upper())
    return f'POSITIONS CORRECTED FOR THE ERRORS OF MACHINE {name}'


def _blocks(path: Path, text: str, machine: Machine) -> list[_Block]:
    """Blocks that move axes, in order."""
    scale = {n: math.pi / 180 if machine.axes[n].rotary else 1e-3 for n in machine.letters}
    position: dict[str, float] = {}
    cutting = inverse = False
    found = []
    for number, given in executed(path, text):
        codes = {value for letter, value in given if letter == 'G'}
        cutting = 1.0 in codes or (cutting and 0.0 not in codes)
        inverse = 93.0 in codes or (inverse and not codes & {94.0, 95.0})
        if 4.0 in codes:  # its X is a time
            continue
        before = _row(machine, position)
        position |= {letter: value * scale[letter] for letter, value in given if letter in scale}
        functions = {value for letter, value in given if letter == 'M'}
        if any(letter in scale for letter, _ in given):
            feed = dict(given).get('F', 0.0) if inverse else 0.0
            found.append(_Block(
                number - 1, before, _row(machine, position), feed, cutting,
                not functions <= _BEFORE,
            ))
    return found


def _row(machine: Machine, position: dict[str, float]) -> np.ndarray | None:
    if len(position) < len(machine.letters):
        return None
    return np.array([position[name] for name in machine.letters])


def _signs(blocks: Sequence[_Block]) -> np.ndarray:
    """(m, k) sign of each axis's last motion at the end of each block."""
    sign = np.zeros(len(blocks[0].end))
    rows = []
    for block in blocks:
        if block.start is not None:
            step = block.end - block.start
            sign = np.where(np.abs(step) > 1e-9, np.sign(step), sign)
        rows.append(sign)
    return np.array(rows)


def _replaced(line: str, machine: Machine, row: np.ndarray, feed: float = 0.0) -> str:
    """A line with other positions, and with another F word where feed is not 0."""
    parts = _COMMENT.split(line)
    done = False

    def change(match: re.Match[str]) -> str:
        nonlocal done
        letter = match[1].upper()
        if letter == 'F' and feed:
            return f'F{feed:.3f}'
        if letter not in machine.letters:
            return match[0]
        text, done = ('' if done else words(machine, row)), True
        return text

    # Every other part is a comment.
    parts[::2] = [re.sub(' +', ' ', _WORD.sub(change, part)) for part in parts[::2]]
    return ''.join(parts).strip()
