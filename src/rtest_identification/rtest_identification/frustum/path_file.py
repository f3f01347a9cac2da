"""A user's own feature: its path from a CSV file or an NC program.

CSV with one header line and one point a line, of either kind; lines that start with # are
comments:

- ``x_mm, y_mm, z_mm, i, j, k``: tool tip and direction into the spindle in the frame ``table``,
  and where it is known ``nx, ny, nz``, the normal of the surface out of the material;
- every axis of the machine with its unit, ``X_mm, Y_mm, Z_mm, B_deg, C_deg``: positions of the
  axes, and ``nx, ny, nz`` likewise.

Every other suffix is an NC program of axis positions (`gcode`); its G1 blocks cut the feature.
Without normals the surface is that which the side or the end of the tool makes (`SURFACES`).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.frustum.commands import (
    AUTO,
    Commands,
    command,
    out_of_range,
    tool_axis,
)
from rtest_identification.frustum.feature import Feature
from rtest_identification.frustum.gcode import read_blocks
from rtest_identification.kinematics import predict
from rtest_identification.machine import Machine

# Where the surface is, seen from the spindle along the travel: flank milling with the part on one
# side, or what the end of the tool leaves.
LEFT, RIGHT, FLOOR = 'left', 'right', 'floor'
SURFACES = (LEFT, RIGHT, FLOOR)
_TIP, _AXIS, _NORMAL = ('x_mm', 'y_mm', 'z_mm'), ('i', 'j', 'k'), ('nx', 'ny', 'nz')
# NC blocks are looked at in pieces of this length at most [m], [rad].
_PIECE, _PIECE_TURN = 1e-3, math.radians(1.0)
# Sine of the angle to the tool axis below which a tool plunges and cuts no flank.
_PLUNGE = 0.02
# More points than these say nothing new of a surface and would fill the memory.
_FEWEST, _MOST = 7, 20_000


def load_path(
    path: Path,
    machine: Machine,
    surface: str | None = None,
    solution: str | None = None,
    inside: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Commands:
    """Read a path and command it on a machine.

    surface : one of SURFACES, where the file has no normals; LEFT where omitted
    solution, inside : as in `commands.command`, for paths of tip and axis

    Raises UserError naming file, line and what is expected.
    """
    if surface is not None and surface not in SURFACES:
        raise UserError(f'surface {surface!r}: expected one of {", ".join(SURFACES)}')
    try:
        text = path.read_text(encoding='utf-8-sig')
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'{path}: cannot read the path: {error}') from None
    if path.suffix.lower() != '.csv':
        _refuse(path, solution)
        return _program(path, text, machine, surface or LEFT)
    columns, lines = _table(path, text)
    given = _vectors(columns, _NORMAL, path, lines) if _NORMAL[0] in columns else None
    if given is not None and surface is not None:
        raise UserError(f'{path}: has normals, so --surface says nothing: leave one of them out')
    axes = [f'{n}_{"deg" if machine.axes[n].rotary else "mm"}' for n in machine.letters]
    if set(_AXIS) <= set(columns):
        _expect(path, columns, (*_TIP, *_AXIS), axes)
        tip = 1e-3 * np.stack([columns[name] for name in _TIP], axis=1)
        axis = _vectors(columns, _AXIS, path, lines)
        feature = _feature(path, lines, tip, axis, given, surface or LEFT)
        return replace(command(machine, feature, solution or AUTO, inside), lines=tuple(lines))
    _expect(path, columns, axes, axes)
    _refuse(path, solution)
    scale = [math.pi / 180 if machine.axes[n].rotary else 1e-3 for n in machine.letters]
    positions = np.stack([columns[name] for name in axes], axis=1) * scale
    tip, axis = predict(machine, positions).centre, tool_axis(machine, positions)
    feature = _feature(path, lines, tip, axis, given, surface or LEFT)
    return _commanded(machine, feature, positions, lines)


def _refuse(path: Path, solution: str | None) -> None:
    if solution is not None:
        raise UserError(
            f'{path}: gives the positions of the axes: leave --solution out, it chooses between '
            'those that point the tool one way'
        )


def _program(path: Path, text: str, machine: Machine, surface: str) -> Commands:
    blocks = read_blocks(path, text, machine)
    limit = np.array([_PIECE_TURN if machine.axes[n].rotary else _PIECE for n in machine.letters])
    starts, ends, lines = [], [], []
    for start, end, line in zip(blocks.start, blocks.end, blocks.line, strict=True):
        pieces = max(1, math.ceil(float((np.abs(end - start) / limit).max())))
        rows = start + np.linspace(0.0, 1.0, pieces + 1)[:, None] * (end - start)
        starts.append(rows[:-1])
        ends.append(rows[1:])
        lines += [line] * pieces
    start, end = np.concatenate(starts), np.concatenate(ends)
    if len(start) > _MOST:
        raise UserError(
            f'{path}: {len(start)} pieces of 1 mm or 1 deg, expected {_MOST} at most; give a part '
            'of the program'
        )
    positions = 0.5 * (start + end)
    travel = predict(machine, end).centre - predict(machine, start).centre
    axis = tool_axis(machine, positions)
    normal, good = _across(travel, axis, surface)
    if good.sum() < _FEWEST:
        raise UserError(
            f'{path}: the tool cuts no {"floor" if surface == FLOOR else "flank"}: it moves along '
            'its own axis only'
        )
    feature = Feature(
        path.name, predict(machine, positions[good]).centre, axis[good], normal[good],
        weight=np.linalg.norm(travel[good], axis=1),
    )
    note = f'{(~good).sum()} of {len(good)} pieces along the tool axis cut no flank: left out'
    kept = [line for line, cuts in zip(lines, good, strict=True) if cuts]
    return _commanded(machine, feature, positions[good], kept, () if good.all() else (note,))


def _commanded(
    machine: Machine, feature: Feature, positions: np.ndarray, lines: Sequence[int],
    notes: tuple[str, ...] = (),
) -> Commands:
    beyond = out_of_range(machine, positions).values()
    return Commands(machine, feature, positions, (*notes, *beyond), tuple(lines))


def _table(path: Path, text: str) -> tuple[dict[str, np.ndarray], list[int]]:
    """Columns by name, and the line of each row."""
    rows, lines, names = [], [], []
    for number, row in enumerate(csv.reader(text.splitlines()), 1):
        if not any(cell.strip() for cell in row) or row[0].lstrip().startswith('#'):
            continue
        if not names:
            names = [cell.strip() for cell in row]
            if len(set(names)) < len(names):
                raise UserError(f'{path}:{number}: two columns of one name')
            continue
        try:
            values = [float(cell) for cell in row]
        except ValueError as error:
            raise UserError(f'{path}:{number}: expected numbers: {error}') from None
        if len(values) != len(names):
            raise UserError(f'{path}:{number}: {len(values)} numbers, expected {len(names)}')
        if not all(map(math.isfinite, values)):
            raise UserError(f'{path}:{number}: a number is not finite')
        rows.append(values)
        lines.append(number)
    if not _FEWEST <= len(rows) <= _MOST:
        raise UserError(f'{path}: {len(rows)} points, expected {_FEWEST} to {_MOST}')
    return dict(zip(names, np.array(rows).T, strict=True)), lines


def _expect(
    path: Path, columns: dict[str, np.ndarray], names: Sequence[str], axes: Sequence[str]
) -> None:
    """Refuse other columns than `names`. axes : columns of positions of the axes."""
    optional = set(_NORMAL) if _NORMAL[0] in columns else set()
    if set(columns) != set(names) | optional:
        raise UserError(
            f'{path}: columns {", ".join(columns)}; expected {", ".join((*_TIP, *_AXIS))}, or '
            f'{", ".join(axes)}, each with or without {", ".join(_NORMAL)}'
        )


def _vectors(
    columns: dict[str, np.ndarray], names: tuple[str, ...], path: Path, lines: list[int]
) -> np.ndarray:
    """(n, 3) unit vectors; they may be given to three digits."""
    absent = [name for name in names if name not in columns]
    if absent:
        raise UserError(f'{path}: no column {", ".join(absent)}')
    vectors = np.stack([columns[name] for name in names], axis=1)
    length = np.linalg.norm(vectors, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1.0) > 2e-3)
    if len(wrong):
        raise UserError(
            f'{path}:{lines[wrong[0]]}: {", ".join(names)}: expected a unit vector, got length '
            f'{length[wrong[0]]:.4g}'
        )
    return vectors / length[:, None]


def _travel(tip: np.ndarray) -> np.ndarray:
    """(n, 3) direction of travel at the points of a path, over the seam where it closes."""
    steps = np.linalg.norm(np.diff(tip, axis=0), axis=1)
    if np.linalg.norm(tip[0] - tip[-1]) <= 1.5 * steps.max():
        return np.roll(tip, -1, axis=0) - np.roll(tip, 1, axis=0)
    return np.gradient(tip, axis=0)


def _across(
    travel: np.ndarray, axis: np.ndarray, surface: str
) -> tuple[np.ndarray, np.ndarray]:
    """Normals (n, 3), and (n,) bool where there is one."""
    length = np.linalg.norm(travel, axis=1)
    right = np.cross(travel, axis)
    sine = np.linalg.norm(right, axis=1) / np.maximum(length, 1e-300)
    good = (length > 1e-12) & (sine > _PLUNGE)
    if surface == FLOOR:
        return axis, good
    # Material on the left: the surface faces right, towards the tool.
    right = right / np.maximum(np.linalg.norm(right, axis=1), 1e-300)[:, None]
    return (right if surface == LEFT else -right), good


def _feature(
    path: Path, lines: list[int], tip: np.ndarray, axis: np.ndarray, normal: np.ndarray | None,
    surface: str,
) -> Feature:
    """Of the points of a table; normal : (n, 3) where they were given."""
    travel = _travel(tip)
    if normal is None:
        normal, good = _across(travel, axis, surface)
        if not good.all():
            raise UserError(
                f'{path}:{lines[int(np.argmin(good))]}: the tool does not move across its axis '
                f'here, so that the surface is not known; give {", ".join(_NORMAL)}'
            )
    length = np.linalg.norm(travel, axis=1)
    if not length.any():
        raise UserError(f'{path}: all points are one point')
    # Where the tool only turns a point stands for next to nothing.
    return Feature(path.name, tip, axis, normal, weight=np.maximum(length, 1e-6 * length.max()))
