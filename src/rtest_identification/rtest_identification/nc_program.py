"""NC programs of measurement cycles: G-code for LinuxCNC and for ISO controllers.

Two variants. One commands every axis: X Y Z and the rotary axes are positions of the machine's
axes, each move along the synchronous arc in straight blocks. The other leaves that to the
controller's tool centre point (TCP) mode: then X Y Z are where the centre of the sphere is in the
frame ``table``, which turns with the table, whatever the rotary axes do, and the rotary axes are
positions as before; a pose is one block.

All moves between poses are G93 blocks (F is one over the minutes the block takes): a feed in
mm/min would leave the rotary axes, which do most of the way, without a stated speed.
"""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtest_estimation.dwell import turns
from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan
from rtest_identification.kinematics import predict
from rtest_identification.machine import Machine
from rtest_identification.moves import ARC_TOLERANCE, Approach, AxisPath, clear_of_nest
from rtest_identification.nc_controllers import CONTROLLERS
from rtest_identification.plan_check import duration
from rtest_identification.plans import DYNAMIC_REST, SPINDLE

# 0.1 um and 1e-5 deg: the latter moves the sphere by 0.02 um at 100 mm.
LINEAR_DIGITS, ROTARY_DIGITS = 4, 5
# Part of the tolerance that a controller may use for rounding the corners between blocks.
_BLENDING = 0.4
_LETTERS = frozenset('XYZABCUVW')
_WIDTH = 72


@dataclass(frozen=True)
class NcSettings:
    """How a program is written.

    controller : a key of `CONTROLLERS`; tcp : in the controller's TCP mode
    pause : stop with M0 at every pose until somebody or something goes on
    tolerance : how far the sphere may be from its place while the axes move [m]
    """

    controller: str = 'linuxcnc'
    tcp: bool = False
    pause: bool = False
    tolerance: float = ARC_TOLERANCE

    @property
    def chord(self) -> float:
        """Part of the tolerance for straight blocks [m]; the rest is for rounded corners."""
        return (1.0 - _BLENDING) * self.tolerance


def nc_program(
    machine: Machine,
    plan: CyclePlan,
    path: AxisPath,
    approach: Approach,
    settings: NcSettings,
    session: str = '',
    sphere_radius: float | None = None,
    number: int = 1,
) -> str:
    """The program of one cycle, for `path` made with the tolerance ``settings.chord``.

    number : of the program, where the controller wants one (O number)

    Raises UserError where the machine has axes that no NC program can name, or where TCP mode
    would be switched with rotary axes not at zero.
    """
    strange = [name for name in machine.letters if name not in _LETTERS]
    if strange:
        raise UserError(
            f'machine {machine.name!r}: an NC program needs axis letters of '
            f'{"".join(sorted(_LETTERS))}, got {", ".join(strange)}'
        )
    if settings.tcp and machine.linear != ('X', 'Y', 'Z'):
        raise UserError(
            f'machine {machine.name!r}: TCP mode needs linear axes X, Y, Z, got '
            f'{", ".join(machine.linear)}'
        )
    turned = [machine.letters.index(name) for name in machine.rotary]
    # A full turn from zero the table is where it is at zero.
    ends = np.sin(0.5 * plan.commands[[0, -1]][:, turned])
    if settings.tcp and np.abs(ends).max(initial=0.0) > 1e-9:
        raise UserError(f'{plan.cycle}: in TCP mode a cycle must start and end with rotary axes 0')
    writer = _Writer(machine, plan.axes)
    lines = ['%', *([f'O{number:04d}'] if settings.controller == 'iso' else [])]
    lines += _header(machine, plan, path, approach, settings, session, sphere_radius)
    lines += _start(writer, plan, approach, settings)
    lines += _poses(writer, plan, path, settings)
    lines += _end(writer, plan, approach, settings)
    return '\n'.join(lines) + '\n'


class _Writer:
    """Words of a block: every letter with its sign and digits."""

    def __init__(self, machine: Machine, axes: tuple[str, ...]) -> None:
        self.machine, self.axes = machine, axes

    def words(self, row: np.ndarray, chosen: Any = None) -> str:
        """For example `X1.0000 Y0.0000 Z40.6000 B-75.00000 C30.00000`."""
        words = []
        for name, value in zip(self.machine.letters, row, strict=False):
            if chosen is None or name in chosen:
                rotary = self.machine.axes[name].rotary
                digits = ROTARY_DIGITS if rotary else LINEAR_DIGITS
                shown = math.degrees(value) if rotary else value * 1e3
                # Adding zero turns -0.0 into 0.0.
                words.append(f'{name}{round(shown, digits) + 0.0:.{digits}f}')
        return ' '.join(words)

    def tcp(self, rows: np.ndarray) -> np.ndarray:
        """Rows with the sphere's place in the table frame instead of the linear axes."""
        rows = np.array(rows, dtype=float, ndmin=2)
        count = len(self.machine.letters)
        columns = [self.machine.letters.index(name) for name in 'XYZ']
        rows[:, columns] = predict(self.machine, rows[:, :count]).centre
        return rows


def _header(
    machine: Machine,
    plan: CyclePlan,
    path: AxisPath,
    approach: Approach,
    settings: NcSettings,
    session: str,
    sphere_radius: float | None,
) -> list[str]:
    controller = CONTROLLERS[settings.controller]
    minutes, dwell = duration(plan, path, approach) / 60.0, plan.dwell or DYNAMIC_REST
    x, y, z = np.asarray(plan.sphere) * 1e3
    at_zero = machine.tool * 1e3
    said = [
        f'R-TEST CYCLE {plan.cycle}'
        + (f', SESSION {session}' if session else ''),
        f'MACHINE {machine.name}, CONTROLLER {controller.name}, MM AND DEG',
        f'SETUP {plan.setup}: SPHERE CENTRE AT X{x:.3f} Y{y:.3f} Z{z:.3f} OF THE TABLE FRAME'
        + (f', RADIUS {sphere_radius * 1e3:.4f}' if sphere_radius else ''),
        f'{len(plan.commands)} POSES, DWELL {dwell:g} S, ABOUT {minutes:.0f} MIN'
        + (' WITHOUT THE STOPS' if settings.pause else ''),
    ]
    said += [_axis(machine, name) for name in machine.letters]
    if settings.tcp:
        said += [
            'TCP MODE. X Y Z: SPHERE CENTRE IN THE FRAME THAT TURNS WITH THE TABLE',
            controller.tcp_note,
        ]
    else:
        said += [
            'X Y Z: POSITIONS OF THE AXES. NO TCP MODE, NO TOOL LENGTH',
            f'WHILE AXES MOVE THE SPHERE IS OFF BY {settings.tolerance * 1e3:g} MM AT MOST:',
            f'{settings.chord * 1e3:g} BY STRAIGHT BLOCKS, {_blend(settings):g} BY ROUND CORNERS',
        ]
    said.append(
        'G54: ALL AXES AT 0 PUT THE SPHERE CENTRE AT '
        f'X{at_zero[0] + 0.0:g} Y{at_zero[1] + 0.0:g} Z{at_zero[2] + 0.0:g} OF THE MACHINE'
    )
    return [line for text in said for line in _comments(text)]


def _axis(machine: Machine, name: str) -> str:
    axis = machine.axes[name]
    rotary = axis.rotary
    x, y, z = (f'{v + 0.0:g}' for v in axis.direction * axis.sense)
    side = 'TABLE' if name in machine.table_side else 'SPHERE'
    scale, unit = (180 / math.pi, 'DEG') if rotary else (1e3, 'MM')
    limits = f'{axis.lower * scale:g} TO {axis.upper * scale:g} {unit}'
    moves = f'TURNS THE {side} RIGHT-HANDED ABOUT' if rotary else f'MOVES THE {side} ALONG'
    return f'{name}+ {moves} {x} {y} {z}, {limits}'


def _blend(settings: NcSettings) -> float:
    return (settings.tolerance - settings.chord) * 1e3


def _start(
    writer: _Writer, plan: CyclePlan, approach: Approach, settings: NcSettings
) -> list[str]:
    machine, controller = writer.machine, CONTROLLERS[settings.controller]
    first = plan.commands[0]
    clear, reach = clear_of_nest(machine, first, approach)
    inward = {
        name for k, name in enumerate(machine.letters) if abs(clear[k] - first[k]) > 1e-7
    }
    if settings.tcp and settings.controller == 'iso':
        # Tool length on in the same block that goes to the clearance position.
        first, clear = writer.tcp(np.vstack([first, clear]))
    across = [name for name in machine.linear if name not in inward]
    here = ' '.join(machine.rotary)
    lines = ['G21 G90 G17 G40 G49 G80 G94', 'G54']
    if settings.tcp:
        # An interrupted program may have left it on.
        lines += controller.tcp_off
    lines += [
        f'(MSG,SPHERE CLEAR OF NEST, BEYOND {writer.words(clear, inward)}, {here} NEAR 0)', 'M0',
    ]
    if machine.rotary:
        lines.append(f'G0 {writer.words(clear, machine.rotary)}')
    if settings.tcp and settings.controller == 'iso':
        lines += controller.tcp_on
    if across:
        lines.append(f'G0 {writer.words(clear, across)}')
    if inward:
        lines.append(f'G0 {writer.words(clear, inward)}')
    lines += [
        *_comments(f'INTO THE NEST: {reach * 1e3:.1f} MM STRAIGHT'),
        f'G1 {writer.words(first)} F{approach.speed * 6e4:.1f}',
    ]
    if settings.tcp and settings.controller != 'iso':
        lines += controller.tcp_on
    lines.append('G93')
    if not settings.tcp:
        lines.append(controller.blend.format(mm=_blend(settings)))
    return lines


def _poses(
    writer: _Writer, plan: CyclePlan, path: AxisPath, settings: NcSettings
) -> list[str]:
    controller = CONTROLLERS[settings.controller]
    rows, poses, times = path.positions, path.pose, path.time
    if settings.tcp:
        reached = np.flatnonzero(poses >= 0)
        rows, poses = writer.tcp(plan.commands), np.arange(len(reached))
        times = np.add.reduceat(path.time, np.r_[0, reached[:-1] + 1])
    spindle = plan.axes.index(SPINDLE) if SPINDLE in plan.axes else None
    lines = []
    for row, pose, seconds in zip(rows, poses, times, strict=True):
        if pose != 0 and spindle is None:
            lines.append(f'G1 {writer.words(row)} F{60.0 / seconds:.3f}')
        if pose >= 0:
            if spindle is not None:
                angle = math.degrees(row[spindle]) % 360.0
                lines.append(f'M19 R{round(angle, 3) % 360.0:.3f}')
            # No message: LinuxCNC keeps some twenty for a screen to fetch, and where there is none
            # each further one holds the program, and what it tells of itself, for 5 s.
            lines.append(f'(POSE {pose})')
            if rest := plan.dwell or (DYNAMIC_REST if turns(plan) else 0.0):
                lines.append(controller.dwell(rest))
            if settings.pause:
                lines.append('M0')
    return lines


def _end(
    writer: _Writer, plan: CyclePlan, approach: Approach, settings: NcSettings
) -> list[str]:
    controller = CONTROLLERS[settings.controller]
    last = plan.commands[-1]
    clear, _ = clear_of_nest(writer.machine, last, approach)
    lines = ['G94']
    feed = f'F{approach.speed * 6e4:.1f}'
    off = controller.tcp_off if settings.tcp else ()
    if settings.controller == 'iso' and settings.tcp:
        clear = writer.tcp(clear)[0]
        out = [f'G1 {writer.words(clear)} {feed}', *off]
    else:
        out = [*off, f'G1 {writer.words(clear)} {feed}']
    return [*lines, *_comments('OUT OF THE NEST'), *out, controller.end, '%']


def _comments(text: str) -> list[str]:
    """Comment lines that any controller shows: ASCII capitals, no parentheses, short."""
    lines, line = [], ''
    for word in _plain(text).split():
        if line and len(line) + len(word) + 1 > _WIDTH - 2:
            lines.append(f'({line})')
            line = ' ' + word
        else:
            line = f'{line} {word}' if line else word
    return [*lines, f'({line})']


def _plain(text: str) -> str:
    ascii_only = unicodedata.normalize('NFKD', text).encode('ascii', 'ignore').decode()
    return re.sub(r'[^A-Z0-9 .,:;=_/+-]', ' ', ascii_only.upper())
