"""`dynamic.json` (schema in docs/dynamic.md) of one session."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from rtest_identification.dynamic.error_motion import TurnMotion
from rtest_identification.dynamic.motion import COMPONENTS
from rtest_identification.dynamic.naming import NamedEffect
from rtest_identification.dynamic.offline import DynamicSession
from rtest_identification.dynamic.pipeline import DynamicResult
from rtest_identification.gap.workflow import REST_ALARM


def as_dict(session: DynamicSession) -> dict[str, Any]:
    """The session as JSON data; SI units, numbers unrounded."""
    return {
        'session': session.session,
        'setups': [_result(result) for result in session.results],
        'warnings': list(session.warnings),
    }


def write(session: DynamicSession, out: Path) -> Path:
    """Write dynamic.json into `out`, whole or not at all; returns its path."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / 'dynamic.json'
    part = path.with_name('dynamic.json.part')
    part.write_text(json.dumps(as_dict(session), indent=1, allow_nan=False) + '\n', 'utf-8')
    os.replace(part, path)
    return path


def _result(result: DynamicResult) -> dict[str, Any]:
    naming, motion = result.naming, result.scene.motion
    return {
        'setup': result.setup,
        'cycles': list(result.cycles),
        'axis': motion.axis,
        'sphere': motion.sphere.tolist(),
        'radius': motion.radius,
        'verdict': naming.verdict,
        'time_offset': {
            'value': _number(result.offset.value),
            'stddev': _number(result.offset.stddev),
            'unit': 's',
            'from': result.offset.why,
        },
        'effects': [_effect(one) for one in naming.effects],
        'invisible': {
            'encoders': list(naming.encoders.invisible), 'gauges': list(naming.gauges.invisible),
        },
        'rest': {
            'probability': naming.rest.probability,
            'largest': naming.rest.place,
            'size': naming.rest.size,
        },
        'channels': {
            name: {'noise': one.noise, 'before': one.before, 'after': one.after}
            for name, one in (('encoders', naming.encoders), ('gauges', naming.gauges))
        },
        'centre_offset': result.parts.centre_offset.tolist(),
        'feeds': [
            {
                'omega': float(motion.feeds[lag.feed]),
                'path_speed': float(motion.feeds[lag.feed] * motion.radius),
                'tangential_lag': {
                    name: {'value': _number(pair[0]), 'stddev': _number(pair[1])}
                    for name, pair in (('gauges', lag.gauges), ('encoders', lag.encoders),
                                       ('beyond_encoders', lag.beyond))
                },
            }
            for lag in result.lags
        ],
        'passes': [_pass(result, number) for number in range(len(motion.passes))],
        'warnings': list(result.warnings),
    }


def _pass(result: DynamicResult, number: int) -> dict[str, Any]:
    one, parts = result.scene.motion.passes[number], result.parts
    mine = result.scene.of_pass(number)
    mine = mine[result.scene.steady[mine]]
    start = next(t for t in result.transients if t.number == number)
    data: dict[str, Any] = {
        'cycle': result.cycles[one.cycle],
        'omega': one.sign * one.speed,
        'angle_rad': [float(result.scene.angle[mine[0]]), float(result.scene.angle[mine[-1]])],
        'rms': {
            name: _named(np.sqrt(np.mean(values[mine] ** 2, axis=0)))
            for name, values in (
                ('measured', parts.measured), ('servo', parts.servo),
                ('geometric', parts.geometric), ('dynamic', parts.dynamic),
                ('unexplained', parts.dynamic - parts.explained),
            )
        },
        'start': {
            'reversal': start.reverses, 'peak_gauges': start.peak[0],
            'peak_encoders': start.peak[1], 'settled': start.settled,
        },
    }
    for name, motions in (
        ('measured', result.measured), ('servo', result.servo), ('dynamic', result.rest)
    ):
        turn = next((t for t in motions if t.number == number), None)
        if turn is not None:
            data[f'error_motion_{name}'] = _turn(turn)
    return data


def _turn(turn: TurnMotion) -> dict[str, Any]:
    return {
        'turns': len(turn.turns),
        'covered': turn.covered,
        'synchronous': _named(turn.synchronous),
        'asynchronous': _named(turn.asynchronous),
        'harmonics': {
            name: turn.harmonics[:, k].tolist() for k, name in enumerate(COMPONENTS)
        },
    }


def _effect(one: NamedEffect) -> dict[str, Any]:
    return {
        'key': one.key,
        'name': one.name,
        'formula': one.formula,
        'channel': one.channel,
        'parameters': {name: value for name, value, _, _ in one.values},
        'stddev': {name: _number(stddev) for name, _, stddev, _ in one.values},
        'units': {name: unit for name, _, _, unit in one.values},
        'signal_to_noise': one.strength,
        'seen_rms': one.seen,
        'confidence': one.confidence,
        'rivals': list(one.rivals),
        'separate_by': one.separate_by,
    }


def _named(values: np.ndarray) -> dict[str, float | None]:
    return {name: _number(value) for name, value in zip(COMPONENTS, values, strict=True)}


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def summary(result: DynamicResult) -> str:
    """One line: effects by channel, time between the clocks, lag at each feed."""
    effects = ' + '.join(
        f'{one.key}{" (encoders)" if one.channel == "encoders" else ""}'
        for one in result.naming.effects
    )
    return f'{result.setup} {result.naming.verdict}{": " + effects if effects else ""}; ' + (
        f'gauges {1e3 * result.offset.value:+.3f} ± {2e3 * result.offset.stddev:.3f} ms'
        if result.offset.determined else 'time offset not determined'
    )


def lines(result: DynamicResult) -> list[str]:
    """What a person wants to know."""
    motion, naming, told = result.scene.motion, result.naming, []
    for lag in result.lags:
        feed = motion.feeds[lag.feed]
        pairs = (('gauges', lag.gauges), ('encoders', lag.encoders), ('beyond them', lag.beyond))
        values = ', '.join(
            f'{name} {round(1e6 * value, 3) + 0.0:+.3f} ± {2e6 * spread:.3f} µm'
            if math.isfinite(spread) else f'{name} not determined'
            for name, (value, spread) in pairs
        )
        told.append(
            f'{math.degrees(feed) * 60.0:,.0f} deg/min ({6e4 * feed * motion.radius:,.0f} '
            f'mm/min): tangential lag {values} (k = 2, of the noise)'
        )
    if result.offset.determined:
        told.append(
            f'gauges later than CNC by {1e3 * result.offset.value:+.3f} ± '
            f'{2e3 * result.offset.stddev:.3f} ms (k = 2)'
        )
    for one in naming.effects:
        sizes = ', '.join(
            f'{name} = {_read(value, stddev, unit)}'
            for name, value, stddev, unit in one.values if math.isfinite(stddev)
        )
        where = 'seen by the encoders' if one.channel == 'encoders' else 'not in the encoders'
        told.append(f'{one.key}: {one.name}, {where}; {one.formula}')
        told.append(
            f'  {sizes} (k = 2); moves the sphere by {1e6 * one.seen:.2f} µm rms beyond what '
            f'depends on the angle alone; confidence {one.confidence:.2f}'
        )
        if one.rivals:
            told.append(f'  could also be {", ".join(one.rivals)}')
        if one.separate_by:
            told.append(f'  to tell them apart: {one.separate_by}')
    if naming.rest.probability < REST_ALARM:
        told.append(
            f'unexplained beyond the noise, most of it {naming.rest.place}: '
            f'{1e6 * naming.rest.size:.2f} µm'
        )
    return told


def _read(value: float, stddev: float, unit: str) -> str:
    """A value with U (k = 2) in the unit a person reads, to the digits that U leaves."""
    known = {'m': (1e6, ' µm'), 'rad': (1e6, ' µrad'), 's': (1e3, ' ms')}
    scale, name = known.get(unit, (1.0, ''))
    spread = 2.0 * scale * stddev
    digits = min(max(1 - math.floor(math.log10(max(spread, 1e-9))), 0), 6)
    return f'{scale * value:.{digits}f} ± {spread:.{digits}f}{name}'
