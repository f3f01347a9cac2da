"""NC programs with corrected positions.

`rewrite` changes the positions in a program of axis positions (`frustum.gcode` reads the same) and
leaves everything else as it is, feed included; long blocks are cut where the correction along them
is no straight line. `path_program` writes straight blocks through corrected points.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.correction.known import KnownErrors
from rtest_identification.correction.step import Correction, correct
from rtest_identification.frustum.commands import Commands
from rtest_identification.frustum.gcode import read_blocks
from rtest_identification.machine import Machine
from rtest_identification.moves import Speeds
from rtest_identification.nc_controllers import CONTROLLERS
from rtest_identification.nc_program import LINEAR_DIGITS, ROTARY_DIGITS

# How far a correction along a block may be from a straight line [m], angles at this lever [m].
_STRAIGHT, _LEVER = 1e-7, 0.1
# Shortest time of a block [s], most pieces of one, feed to the first point [mm/min].
_SHORTEST, _PIECES, _APPROACH = 1e-3, 1000, 500.0
# The tip does not travel where it moves less [m].
_STANDS = 1e-6
_COMMENT = re.compile(r'(\([^()]*\)|;.*)')
_WORD = re.compile(r'([A-Z])\s*([+-]?(?:\d+\.?\d*|\.\d+))', re.IGNORECASE)
_HEAD = re.compile(r'\s*(%|O\d+)?\s*', re.IGNORECASE)
_END = (2.0, 30.0)
# M functions that act before their block's motion on any controller: they stay with its first
# piece. Others would act in the middle of what was one block.
_BEFORE = frozenset((3.0, 4.0, 6.0, 7.0, 8.0))


@dataclass(frozen=True)
class Rewritten:
    """A corrected program.

    correction : of the ends of all blocks of which every axis's position is known
    notes : what a person should know: blocks that could not be corrected
    """

    text: str
    correction: Correction
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


def rewrite(path: Path, text: str, known: KnownErrors) -> Rewritten:
    """Correct the positions of a program.

    Raises UserError naming file and line where it has anything but straight blocks of axis
    positions, or leaves the measured stations.
    """
    machine = known.machine
    read_blocks(path, text, machine)  # refuses what moves axes elsewhere
    lines = text.splitlines()
    blocks = _blocks(lines, machine)
    whole = [block for block in blocks if block.end is not None]
    approach = _signs(whole)
    ends = np.array([block.end for block in whole])
    correction = correct(machine, ends, known.at(ends, approach))
    corrected = dict(zip((block.line for block in whole), correction.positions, strict=True))
    pieces, bent = _pieces(known, whole, approach)
    written = []
    for number, line in enumerate(lines):
        if number not in corrected:
            written.append(line)
        elif number not in pieces:
            written.append(_replaced(line, machine, corrected[number]))
        else:
            feed, rows = pieces[number]
            written.append(_replaced(line, machine, rows[0], feed))
            written += [words(machine, row) + (f' F{feed:.3f}' if feed else '')
                        for row in rows[1:]]
    # After the percent sign and the program's number, which are first on any controller.
    head = next(n for n, line in enumerate(lines) if not _HEAD.fullmatch(line))
    written.insert(head, f'({_told(machine)})')
    notes = []
    left = [block.line for block in blocks if block.end is None]
    if left:
        notes.append(
            f'{path}: {_lines(left)}: not corrected: the positions of other axes are not known '
            'there'
        )
    if bent:
        notes.append(
            f'{path}: {_lines(list(bent))}: corrected at the end only, because of its M word; in '
            f'between off by up to {max(bent.values()) * 1e6:.1f} µm'
        )
    return Rewritten('\n'.join(written) + '\n', correction, tuple(notes))


def path_program(
    commands: Commands, correction: Correction, feed: float, controller: str = 'linuxcnc'
) -> str:
    """Straight blocks through corrected points; the tool comes to the first one straight.

    feed : of the tool tip on the part [m/s]
    controller : a key of `CONTROLLERS`
    """
    machine, dialect = commands.machine, CONTROLLERS[controller]
    travel = np.linalg.norm(np.diff(commands.feature.tip, axis=0), axis=1)
    rotary = [machine.letters.index(name) for name in machine.rotary]
    turns = np.abs(np.diff(commands.positions[:, rotary], axis=0)).max(axis=1, initial=0.0)
    seconds = np.where(travel > _STANDS, travel / feed, turns / Speeds().rotary)
    seconds = np.maximum(seconds, _SHORTEST)
    rows = correction.positions
    lines = [
        '%', *(['O0001'] if controller == 'iso' else []), f'({_told(machine)})',
        '(X Y Z AND ROTARY AXES: POSITIONS OF THE AXES. NO TCP MODE, NO TOOL LENGTH)',
        'G21 G90 G17 G40 G49 G80 G94', 'G54',
        '(MSG,NEXT: STRAIGHT TO THE FIRST POINT. IS THE WAY FREE)', 'M0',
        f'G1 {words(machine, rows[0])} F{_APPROACH:.1f}', 'G93', dialect.blend.format(mm=1e-3),
    ]
    lines += [
        f'G1 {words(machine, row)} F{60.0 / time:.3f}'
        for row, time in zip(rows[1:], seconds, strict=True)
    ]
    return '\n'.join([*lines, 'G94', dialect.end, '%']) + '\n'


def _lines(numbers: Sequence[int]) -> str:
    """For example `line 5, 7`, counted from 1."""
    shown = ', '.join(str(number + 1) for number in numbers[:5])
    return f'line {shown}{" and more" if len(numbers) > 5 else ""}'


def _told(machine: Machine) -> str:
    name = re.sub(r'[^A-Z0-9 _-]', ' ', machine.name.upper())
    return f'POSITIONS CORRECTED FOR THE ERRORS OF MACHINE {name}'


def _blocks(lines: Sequence[str], machine: Machine) -> list[_Block]:
    """Blocks that move axes, in order."""
    scale = {n: math.pi / 180 if machine.axes[n].rotary else 1e-3 for n in machine.letters}
    position: dict[str, float] = {}
    cutting = inverse = False
    found = []
    for number, line in enumerate(lines):
        code = _COMMENT.sub(' ', line).upper()
        given = [(letter, float(value)) for letter, value in _WORD.findall(code)]
        before = _row(machine, position)
        position |= {letter: value * scale[letter] for letter, value in given if letter in scale}
        codes = {value for letter, value in given if letter == 'G'}
        cutting = 1.0 in codes or (cutting and 0.0 not in codes)
        inverse = 93.0 in codes or (inverse and not codes & {94.0, 95.0})
        functions = {value for letter, value in given if letter == 'M'}
        if any(letter in scale for letter, _ in given):
            feed = dict(given).get('F', 0.0) if inverse else 0.0
            found.append(_Block(
                number, before, _row(machine, position), feed, cutting,
                not functions <= _BEFORE,
            ))
        if functions & set(_END):
            break
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


def _pieces(
    known: KnownErrors, blocks: Sequence[_Block], approach: np.ndarray
) -> tuple[dict[int, tuple[float, np.ndarray]], dict[int, float]]:
    """Blocks that must be cut: by line, feed (0 where it is not a time) and ends of pieces.

    Also how far those are off that must stay whole, by line [m].
    """
    machine = known.machine
    chosen = [k for k, block in enumerate(blocks) if block.cutting and block.start is not None]
    start, end = (
        np.array([getattr(blocks[k], name) for k in chosen]) for name in ('start', 'end')
    )
    share = np.linspace(0.0, 1.0, 5)[:, None, None]
    rows = (start + share * (end - start)).reshape(-1, start.shape[1])
    signs = np.tile(approach[chosen], (5, 1))
    change = correct(machine, rows, known.at(rows, signs)).change.reshape(5, *start.shape)
    bent = np.abs(change - (change[0] + share * (change[-1] - change[0])))
    lever = [_LEVER if machine.axes[name].rotary else 1.0 for name in machine.letters]
    worst = (bent * lever).max(axis=(0, 2))
    # The sagitta of a piece goes with the square of its length.
    counts = np.ceil(np.sqrt(worst / _STRAIGHT)).astype(int)
    if counts.max() > _PIECES:
        line = blocks[chosen[int(np.argmax(counts))]].line + 1
        raise UserError(
            f'line {line}: the correction bends too much along this block: give shorter ones'
        )
    many = [k for k in np.flatnonzero(counts > 1) if not blocks[chosen[k]].whole]
    off = {
        blocks[chosen[k]].line: float(worst[k]) for k in np.flatnonzero(counts > 1)
        if blocks[chosen[k]].whole
    }
    if not many:
        return {}, off
    inside = [
        start[k] + np.linspace(0.0, 1.0, counts[k] + 1)[1:, None] * (end[k] - start[k])
        for k in many
    ]
    rows, signs = np.concatenate(inside), np.repeat(approach[chosen][many], counts[many], axis=0)
    moved = correct(machine, rows, known.at(rows, signs)).positions
    parts = np.split(moved, np.cumsum(counts[many])[:-1])
    pieces = {
        blocks[chosen[k]].line: (blocks[chosen[k]].feed * counts[k], part)
        for k, part in zip(many, parts, strict=True)
    }
    return pieces, off


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
