"""Files of a correction: tables, positions, programs, compensation of single axes, figures."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtest_identification.correction.compensation import AxisTable, ini_text
from rtest_identification.correction.known import KnownErrors
from rtest_identification.correction.step import Correction, Deviation, axis_slopes
from rtest_identification.correction.table import Table
from rtest_identification.machine import Machine

_SIGN = (
    '# Correction of the commands of machine {name}. Places x, y, z: tool point, frame table '
    '(turns with the table, machine axes at zero). Axis letters: commanded positions. d and a '
    'letter: to be ADDED to the command of that axis, in the same unit and the sense of the axis.'
)
_LEFT = (
    '# before, after: predicted distance of the tool point from its place; tilt_before, '
    'tilt_after: of the tool axis from its direction; spin: rotation about the tool axis, which '
    'no five axes take away.'
)


@dataclass(frozen=True)
class Remains:
    """Predicted deviations of a set of poses; root mean square, and largest [m] or [rad].

    shift : distance of the tool point; tilt : of the tool axis; spin : about the tool axis
    """

    shift: float
    shift_largest: float
    tilt: float
    tilt_largest: float
    spin: float
    spin_largest: float


@dataclass(frozen=True)
class Judged:
    """What a correction is predicted to do.

    placed : rms of the tool point's shift before, less what one constant shift of the linear axes
        takes away, which is what a workpiece zero does [m]
    spread : what the tool point is uncertain by, rms [m]; None where it is not known
    near_pole : poses where a part of the tilt is left on purpose
    """

    poses: int
    before: Remains
    after: Remains
    placed: float
    spread: float | None
    near_pole: int


def judge(known: KnownErrors, correction: Correction) -> Judged:
    """Sum a correction up."""
    spread = None
    if known.spread is not None:
        values = known.spread(correction.nominal)
        values = values[np.isfinite(values)]
        spread = float(np.sqrt(np.mean(values**2))) if len(values) else None
    return Judged(
        len(correction.nominal), remains(correction.before), remains(correction.after),
        _placed(correction), spread, int(correction.near_pole.sum()),
    )


def remains(one: Deviation) -> Remains:
    """Root mean square and largest of deviations."""
    found = []
    for size in (np.linalg.norm(one.shift, axis=1), np.linalg.norm(one.tilt, axis=1), one.spin):
        found += [float(np.sqrt(np.mean(size**2))), float(np.abs(size).max())]
    return Remains(*found)


def _placed(correction: Correction) -> float:
    machine, shift = correction.machine, correction.before.shift
    linear = [k for k, name in enumerate(machine.letters) if not machine.axes[name].rotary]
    slope = axis_slopes(machine, correction.nominal)[0][:, :, linear].reshape(-1, len(linear))
    zero = np.linalg.lstsq(slope, shift.ravel(), rcond=None)[0]
    left = (shift.ravel() - slope @ zero).reshape(shift.shape)
    return float(np.sqrt(np.mean((left**2).sum(axis=1))))


def summary(what: str, judged: Judged, counted: str = 'poses') -> str:
    """One line: what is predicted before and after. counted : what the poses are."""
    before, after = judged.before, judged.after
    known = '' if judged.spread is None else (
        f' (the errors are known to {judged.spread * 1e6:.2f} µm, k = 1)'
    )
    return (
        f'{what}: {judged.poses} {counted}, tool point {before.shift * 1e6:.2f} (but for a '
        f'constant offset {judged.placed * 1e6:.2f}) -> {after.shift * 1e6:.3f} µm rms, '
        f'{after.shift_largest * 1e6:.3f} at most, as predicted{known}, tilt of the tool '
        f'{before.tilt * 1e6:.2f} -> {after.tilt * 1e6:.2f} µrad'
    )


def told(judged: Judged) -> list[str]:
    """What is left and why, for a person."""
    before, after = judged.before, judged.after
    lines = [
        f'rotation about the tool axis: {after.spin * 1e6:.2f} µrad rms, '
        f'{after.spin_largest * 1e6:.2f} at most; no five axes take it away (it was '
        f'{before.spin * 1e6:.2f})',
    ]
    if judged.near_pole:
        lines.append(
            f'{judged.near_pole} of {judged.poses} poses have the tool within 5 deg of a pole, '
            f'where tilt in one direction is left: {after.tilt_largest * 1e6:.2f} µrad at most'
        )
    return lines


def table_text(table: Table) -> str:
    """CSV of corrections at places and stations."""
    x = [f'{name}_mm' for name in 'xyz']
    return _csv(table.correction, x, table.place * 1e3)


def positions_text(correction: Correction) -> str:
    """CSV of one correction, pose by pose."""
    count = len(correction.nominal)
    return _csv(correction, ['pose'], np.arange(count, dtype=float)[:, None])


def as_dict(
    known: KnownErrors, judged: dict[str, Judged], tables: list[AxisTable],
    refused: dict[str, str], elsewhere: list[str], alone: dict[str, Judged], notes: list[str],
) -> dict[str, Any]:
    """Everything that was computed; SI units, numbers unrounded.

    elsewhere : errors that are in no table of one axis
    alone : what the compensation of single axes does without the rest
    """

    def plain(one: Judged) -> dict[str, Any]:
        return {**vars(one), 'before': vars(one.before), 'after': vars(one.after)}

    return {
        'machine': known.machine.name,
        'predicted': {name: plain(one) for name, one in judged.items()},
        'compensation_files': {
            'axes': [one.axis.name for one in tables],
            'refused': refused,
            'in_none': elsewhere,
            'predicted_with_them_alone': {name: plain(one) for name, one in alone.items()},
        },
        'notes': notes,
    }


def write_all(
    out: Path, data: dict[str, Any], texts: dict[str, str], tables: list[AxisTable]
) -> Path:
    """Write correction.json, the texts by file name, and the compensation of single axes.

    Returns the path of correction.json. Each file appears whole or not at all.
    """
    files = dict(texts)
    for one in tables:
        files[f'{one.axis.name}.comp'] = one.text()
    if tables:
        files['compensation.ini'] = ini_text(tables)
    files['correction.json'] = json.dumps(data, indent=1, allow_nan=False) + '\n'
    out.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        part = out / f'{name}.part'
        part.write_text(text, encoding='utf-8')
        os.replace(part, out / name)
    return out / 'correction.json'


def _csv(correction: Correction, names: list[str], first: np.ndarray) -> str:
    machine = correction.machine
    scale = np.array([180.0 / math.pi if machine.axes[n].rotary else 1e3 for n in machine.letters])
    axes = _axes(machine)
    left = [
        np.linalg.norm(one, axis=1) * 1e6
        for one in (correction.before.shift, correction.after.shift, correction.before.tilt,
                    correction.after.tilt)
    ]
    rows = np.column_stack([
        first, correction.nominal * scale, correction.change * scale, *left,
        correction.after.spin * 1e6,
    ])
    head = [*names, *axes, *(f'd{name}' for name in axes), 'before_um', 'after_um',
            'tilt_before_urad', 'tilt_after_urad', 'spin_urad']
    digits = [0 if name == 'pose' else 3 if name.endswith(('um', 'urad')) else 7 for name in head]
    lines = [_SIGN.format(name=machine.name), _LEFT, ','.join(head)]
    lines += [
        ','.join(f'{round(v, d) + 0.0:.{d}f}' for v, d in zip(row, digits, strict=True))
        for row in rows
    ]
    return '\n'.join(lines) + '\n'


def _axes(machine: Machine) -> list[str]:
    return [f'{n}_{"deg" if machine.axes[n].rotary else "mm"}' for n in machine.letters]
