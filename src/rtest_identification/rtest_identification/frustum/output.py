"""`frustum.json`, `commands.csv` and what is printed."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rtest_identification.frustum.commands import Commands
from rtest_identification.frustum.cone import Frustum
from rtest_identification.frustum.prediction import Form, Prediction, Ranked
from rtest_identification.frustum.tables import Line
from rtest_identification.uncertainty import COVERAGE_FACTOR

# Ranked errors that are printed; the files hold them all.
_PRINTED = 10


def feature_as_dict(commands: Commands, cone: Frustum | None) -> dict[str, Any]:
    """Machine and feature; SI units."""
    return {
        'machine': commands.machine.name,
        'feature': commands.feature.name,
        'quantity': commands.feature.quantity,
        'points': len(commands.feature),
        'cone': None if cone is None else asdict(cone),
    }


def prediction_as_dict(found: Prediction, cone: Frustum | None) -> dict[str, Any]:
    """A prediction; SI units, numbers unrounded."""
    return {
        **feature_as_dict(found.commands, cone),
        **_form(found.form),
        'stddev': found.stddev,
        'minimum_zone_stddev': found.zone_stddev,
        'by_uncertainty_alone': found.floor,
        'constant_errors_alone': {**_form(found.constant), 'stddev': found.constant_stddev},
        'varying_errors_alone': _form(found.varying),
        'profile': found.form.profile.tolist(),
        'profile_stddev': found.profile_stddev.tolist(),
        'motions': found.motions,
        'ranking': ranking_as_list(found.ranking),
        'not_determined': list(found.unknown),
        'notes': list(found.notes),
    }


def ranking_as_list(ranked: Sequence[Ranked]) -> list[dict[str, Any]]:
    """Errors by what they do alone, the largest first."""
    return [asdict(one) for one in ranked]


def tables_as_dict(lines: Sequence[Line]) -> dict[str, Any]:
    """The thesis's tables beside ours."""
    return {'tables': [asdict(one) for one in lines]}


def write_json(data: dict[str, Any], out: Path) -> Path:
    """Write frustum.json into `out`, whole or not at all; returns its path."""
    return _write(out / 'frustum.json', json.dumps(data, indent=1, allow_nan=False) + '\n')


def write_commands(commands: Commands, out: Path) -> Path:
    """Write commands.csv: positions of the axes, as `--path` takes them, with the normals."""
    machine = commands.machine
    scale = np.array([180.0 / math.pi if machine.axes[n].rotary else 1e3 for n in machine.letters])
    names = [f'{n}_{"deg" if machine.axes[n].rotary else "mm"}' for n in machine.letters]
    rows = np.hstack([commands.positions * scale, commands.feature.normal])
    lines = [','.join([*names, 'nx', 'ny', 'nz'])]
    lines += [','.join(f'{value:.7f}' for value in row) for row in rows]
    return _write(out / 'commands.csv', '\n'.join(lines) + '\n')


def figures(found: Prediction) -> list[tuple[str, str, str, str]]:
    """Quantity, of what, value and U (k = 2) of everything predicted, for a person [µm]."""
    feature, form = found.commands.feature, found.form
    rows = [(feature.quantity, 'all errors', form.deviation, found.stddev)]
    if form.zone is not None:
        rows[0] = ('circularity, least-squares circle', *rows[0][1:])
        rows += [
            ('circularity, minimum-zone circle', 'all errors', form.zone, found.zone_stddev),
            ('ball-bar circularity, least-squares circle', 'all errors', form.bar,
             found.stddev / feature.scale),
        ]
    name = rows[0][0]
    rows += [
        (name, 'location errors and squareness alone', found.constant.deviation,
         found.constant_stddev),
        (name, 'what changes along the path alone', found.varying.deviation, None),
        *((name, f'{motion} alone', size, None) for motion, size in found.motions.items()),
        (name, 'uncertainty alone (mean)', found.floor, None),
        ('lowest deviation along the normal, as cut', 'all errors', form.lowest, None),
        ('highest deviation along the normal, as cut', 'all errors', form.highest, None),
    ]
    return [
        (quantity, what, f'{value * 1e6:.2f}',
         '' if stddev is None else f'{COVERAGE_FACTOR * stddev * 1e6:.2f}')
        for quantity, what, value, stddev in rows
    ]


def lines(ranked: Sequence[Ranked], quantity: str) -> list[str]:
    """The errors that matter most, for a person."""
    told = [f'{quantity} by each error alone [µm]:']
    for one in ranked[:_PRINTED]:
        formula = f': {one.formula}' if one.formula else ''
        told.append(f'  {1e6 * one.alone:8.2f}  {one.name} ({one.size}){formula}')
    rest = len(ranked) - _PRINTED
    return told + ([f'  and {rest} more in frustum.json'] if rest > 0 else [])


def summary(found: Prediction) -> str:
    """One line: the form with its uncertainty."""
    form, unit = found.form, 1e6
    text = (
        f'{found.commands.feature.name}: {found.commands.feature.quantity} '
        f'{form.deviation * unit:.2f} ± {COVERAGE_FACTOR * found.stddev * unit:.2f} µm (k = 2)'
    )
    if form.zone is not None:
        text += f', minimum zone {form.zone * unit:.2f} µm, ball bar {form.bar * unit:.2f} µm'
    if found.unknown:
        text += f'; without {", ".join(found.unknown)}, not determined and in no value or U'
    return text


def ranking_summary(commands: Commands, ranked: Sequence[Ranked]) -> str:
    """One line: how many errors, and the one that matters most."""
    worst = ranked[0]
    return (
        f'{commands.feature.name}: {len(ranked)} errors ranked, largest {worst.name}: '
        f'{commands.feature.quantity} {worst.alone * 1e6:.1f} µm by {worst.size}'
    )


def _form(form: Form) -> dict[str, Any]:
    return {
        'deviation': form.deviation, 'minimum_zone': form.zone, 'ball_bar': form.bar,
        'lowest': form.lowest, 'highest': form.highest,
    }


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + '.part')
    part.write_text(text, encoding='utf-8')
    os.replace(part, path)
    return path
