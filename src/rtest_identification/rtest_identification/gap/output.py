"""`gap.json` (schema in the README) of one session."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

from rtest_identification.gap.size import Found
from rtest_identification.gap.where import Place
from rtest_identification.gap.workflow import GapResult

# Above this many times the noise on held-out poses the report says so.
HELD_OUT_LIMIT = 1.1


def as_dict(session: str, result: GapResult, model: str | None = None) -> dict[str, Any]:
    """The result as JSON data; SI units, numbers unrounded. model : file it was written to."""
    gap = result.gap
    return {
        'session': session,
        'verdict': result.verdict,
        'effects': [_effect(found) for found in result.found],
        'invisible': list(result.invisible),
        'undetermined': undetermined(result),
        'carried': [
            {
                'key': now.effect.key,
                'parameters': dict(zip(names, now.value.tolist(), strict=True)),
                'stddev': dict(zip(names, map(_number, now.stddev.tolist()), strict=True)),
            }
            for now in result.carried for names in [[p.name for p in now.effect.parameters]]
        ],
        'model_differs': [
            {'name': d.name, 'model': d.model, 'found': d.found, 'stddev': d.stddev,
             'unit': d.unit}
            for d in result.differs
        ],
        'where': [
            {'by': place.by, 'value': place.value, 'rms': place.rms, 'p': place.p}
            for place in result.where
        ],
        'gap': {
            'noise': gap.noise,
            'before': gap.before,
            'after': gap.after,
            'heldout_before': _number(gap.heldout_before),
            'heldout_after': _number(gap.heldout_after),
            'heldout_noise': _number(gap.heldout_noise),
        },
        'noise_correlation': result.rows.correlation,
        'left_out': [{'cycle': cycle, 'pose': pose} for cycle, pose in result.odd],
        'probability': result.probability,
        'rest_probability': result.rest_probability,
        'model': model,
    }


def undetermined(result: GapResult) -> list[str]:
    """Symbols of the constants that these poses leave open."""
    constants = result.constants
    return [p.symbol for p, s in zip(constants.parameters, constants.stddev, strict=True)
            if not math.isfinite(s)]


def write(session: str, result: GapResult, out: Path, model: str | None = None) -> Path:
    """Write gap.json into `out`, whole or not at all; returns its path."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / 'gap.json'
    part = path.with_name('gap.json.part')
    data = as_dict(session, result, model)
    part.write_text(json.dumps(data, indent=1, allow_nan=False) + '\n', encoding='utf-8')
    os.replace(part, path)
    return path


def _effect(found: Found) -> dict[str, Any]:
    names = [p.name for p in (*found.effect.parameters, *found.effect.shape)]
    units = [p.unit for p in (*found.effect.parameters, *found.effect.shape)]
    return {
        'key': found.effect.key,
        'symbol': ', '.join(found.effect.symbols),
        'name': found.effect.name,
        'formula': found.effect.formula,
        'parameters': dict(zip(names, found.value.tolist(), strict=True)),
        'stddev': {n: _number(s) for n, s in zip(names, found.stddev.tolist(), strict=True)},
        'units': dict(zip(names, units, strict=True)),
        'signal_to_noise': found.strength,
        'seen_rms': found.seen,
        'confidence': found.confidence,
        'rivals': list(found.rivals),
        'separate_by': found.separate_by,
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def summary(result: GapResult) -> str:
    """One line: verdict, effects, gap before and after against the noise."""
    gap = result.gap
    names = ' + '.join(found.effect.key for found in result.found)
    change = f'gap {gap.before * 1e6:.2f} µm'
    if result.found:
        change += f' -> {gap.after * 1e6:.2f} µm'
    return f'{result.verdict}{": " + names if names else ""}, {change}, noise ' \
           f'{gap.noise * 1e6:.2f} µm'


def lines(result: GapResult) -> list[str]:
    """What a person wants to know of each effect, and where an unexplained gap sits."""
    told = []
    for found in result.found:
        numbers = list(zip(
            (*found.effect.parameters, *found.effect.shape), found.value, found.stddev,
            strict=True,
        ))
        sizes = ', '.join(
            f'{p.name} = {v:.3g} ± {2 * s:.2g} {p.unit}' for p, v, s in numbers if math.isfinite(s)
        )
        told.append(f'{found.effect.key}: {found.effect.name}; {found.effect.formula}')
        if sizes:
            told.append(f'  {sizes} (k = 2)')
        left = [p.name for p, _, s in numbers if not math.isfinite(s)]
        if left:
            told.append(f'  these data show {", ".join(left)} only together, not each')
        told.append(
            f'  moves the sphere by {found.seen * 1e6:.2f} µm rms beyond what the constants can, '
            f'{found.strength:.0f} standard deviations; confidence {found.confidence:.2f}'
        )
        if found.rivals:
            told.append(f'  could also be {", ".join(found.rivals)}')
            told.append(f'  to tell them apart: {found.separate_by}')
    left = undetermined(result)
    if left:
        told.append(f'not determined by these poses, each by itself: {", ".join(left)}')
    for now in result.carried:
        sizes = ', '.join(
            f'{p.name} = {v:.3g} ± {2 * s:.2g} {p.unit}' if math.isfinite(s)
            else f'{p.name} open'
            for p, v, s in zip(now.effect.parameters, now.value, now.stddev, strict=True)
        )
        told.append(f'{now.effect.key} of the model: {sizes} (k = 2) in this session')
    for d in result.differs:
        told.append(
            f'{d.name} does not hold here: the model has {d.model:.3g}, this session '
            f'{d.found:.3g} ± {2 * d.stddev:.2g} {d.unit} (k = 2)'
        )
    if result.odd:
        poses = ', '.join(f'{cycle} {pose}' for cycle, pose in result.odd[:5])
        more = f' and {len(result.odd) - 5} more' if len(result.odd) > 5 else ''
        told.append(f'left out, far from what the same pose shows elsewhere: {poses}{more}')
    if result.rows.correlation:
        told.append(
            f'noise goes on from pose to pose (correlation {result.rows.correlation:.2f}); '
            'allowed for'
        )
    held, noise = result.gap.heldout_after, result.gap.heldout_noise
    if result.verdict == 'explained' and held > HELD_OUT_LIMIT * noise:
        told.append(
            f'poses held out keep {held * 1e6:.2f} µm where their noise is {noise * 1e6:.2f} µm: '
            'between the levels the model is less sure than at them'
        )
    if result.verdict in ('unknown effect', 'partly explained'):
        for place in result.where[:5]:
            told.append(f'unexplained at {where(place)}: rms {place.rms * 1e6:.2f} µm')
    return told


def where(place: Place) -> str:
    """A place for a person: degrees, seconds, words."""
    if isinstance(place.value, str):
        # 'component, table frame' and 'X': component X, table frame.
        kind, comma, frame = place.by.partition(', ')
        return f'{kind} {place.value}{comma}{frame}'
    if place.by.startswith('direction of'):
        return f'{place.by} {"+" if place.value > 0 else "-"}'
    if place.by == 'time':
        return f'times from {place.value:.0f} s'
    return f'{place.by} = {math.degrees(place.value):.1f} deg'
