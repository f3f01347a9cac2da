"""The report of a thermal session: one HTML file that opens offline, and its figures."""

from __future__ import annotations

import base64
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib.figure import Figure

from rtest_identification.figures import positions, space
from rtest_identification.figures.shapes import magnify
from rtest_identification.figures.style import save, times
from rtest_identification.symbols import ErrorParameter
from rtest_identification.thermal import figures, words
from rtest_identification.thermal.pipeline import History, Thermal
from rtest_identification.thermal.positions import present_cycles, shown_cycles
from rtest_identification.thermal.within import Within


@dataclass(frozen=True)
class Picture:
    """One figure as PNG, how to read it, and the script of its turnable form or ''."""

    name: str
    data: str
    caption: str
    script: str = ''


def write_report(result: Thermal, out: Path) -> Path:
    """Write thermal_report.html and its figures (PNG and SVG) into `out`; returns its path."""
    from plotly.offline import get_plotlyjs

    out.mkdir(parents=True, exist_ok=True)
    pictures = _draw(result, out)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('rtest_identification', 'templates'), autoescape=True
    )
    page = environment.get_template('thermal.html.j2').render(
        result=result, pictures=pictures, words=words, summary=words.summary(result),
        drifts=[_drift_row(one, result) for one in result.errors],
        sensors=_sensor_rows(result), warming=_warming_rows(result), cycles=_cycle_rows(result),
        within=[_within_row(one) for one in result.within],
        plotly=get_plotlyjs() if any(p.script for p in pictures.values()) else '',
    )
    path = out / 'thermal_report.html'
    part = path.with_name(path.name + '.part')
    part.write_text(page, encoding='utf-8')
    os.replace(part, path)
    return path


def _draw(result: Thermal, out: Path) -> dict[str, Picture]:
    """Every figure that applies, by name."""
    made: dict[str, Picture] = {}

    def add(name: str, figure: Figure, caption: str, script: str = '') -> None:
        path = save(figure, out, f'thermal_{name}')[0]
        data = base64.b64encode(path.read_bytes()).decode()
        made[name] = Picture(name, data, caption, script)

    if any(len(one) for one in result.thermometers):
        add('temperatures', figures.temperatures(result),
            'Temperatures, change since the reference cycle (in brackets: there). Thin: readings; '
            f'thick: mean over {words.minutes(result.clock.window)}. Grey: the cycles.')
    if len(result.cycles) > 1:
        add('drift', figures.drifts(result),
            'Change of each error since the reference cycle; bars are U (k = 2), side by side '
            'within a cycle. Filled: drifts beyond U, with the exponential that fits (dashed '
            'where its time constant is not determined). Hollow: no more than noise makes of so '
            'many errors. A level that all cycles but the reference share is its noise.')
        _add_positions(result, add)
    against = figures.against_temperature(result)
    if against is not None:
        add('against_temperature', against,
            'Errors that drift against the sensor that explains each best; bars are U (k = 2), '
            'colours the time. Dashed: the sensitivity in the title. Points that leave the line '
            'on one side while warming up and on the other while cooling down show a lag.')
    if result.map is not None and len(result.cycles) > 1:
        axis = result.map.axis
        add('over_stations', figures.over_stations(result),
            f'What {axis} does at each of its stations, change since the reference cycle: '
            'constant error and error map together, in the frame of the axis that carries '
            f'{axis}. Lines: cycles; grey: U (k = 2) about zero. Lines that stay parallel shift '
            f'as a whole; what changes its shape from cycle to cycle depends on {axis}. A shape '
            'that all lines share is the noise of the reference cycle.')
    return made


def _add_positions(result: Thermal, add: Any) -> None:
    chosen = shown_cycles(result)
    view = present_cycles(result, chosen)
    if view is None:
        return
    shown = magnify(view, [view.error()])[0]
    still, flat = space.picture(shown), positions.projections(shown, view.setups[0].outer)
    for figure in (still, flat):
        figure.legends[0].set_title(
            f'measured so long after the reference cycle, error {times(shown.factor)}; dots: '
            'command', {'size': 8},
        )
    across, along = (positions.plane_name(p) for p in positions.planes(view))
    what = (
        f'Positions of the {view.seen}, machine frame, at several times; errors magnified '
        f'{times(shown.factor)}, positions not. The offsets of the rotary axes in the reference '
        'cycle are removed from all of them, and the reset of each cycle.'
    )
    add('positions_3d', still,
        f'{what} Discs that part from each other show how the axis of {view.turning} moves.',
        space.turnable(shown, 'turnable'))
    add('positions', flat, f'The same on the planes {across} and {along}.')


def _drift_row(one: History, result: Thermal) -> dict[str, Any]:
    location = result.reference.location
    place = location.symbols.index(one.parameter.symbol)
    start = words.with_uncertainty(location.value[place], location.stddev[place])
    drift = one.drift
    return {
        'symbol': one.parameter.symbol,
        'unit': words.unit(one.parameter),
        'start': start if location.determined[place] else 'not determined',
        'last': words.with_uncertainty(*drift.last),
        'largest': words.with_uncertainty(*drift.largest),
        'probability': words.probability(drift.adjusted),
        'drifts': drift.significant,
        'since': '' if drift.beyond_since is None else words.minutes(drift.beyond_since),
        'constants': [words.tau(c) for c in one.constants],
        'explained': words.explained(one),
    }


def _sensor_rows(result: Thermal) -> list[dict[str, Any]]:
    rows = []
    for one in result.drifting:
        for number, d in enumerate(one.dependence):
            rows.append({
                'symbol': one.parameter.symbol if number == 0 else '',
                'sensor': d.sensor,
                'sensitivity': f'{words.with_uncertainty(d.sensitivity, d.stddev)} '
                               f'{words.unit(one.parameter)}/K',
                'correlation': words.correlation(d),
                'lag': words.lag(d),
                'explained': f'{100.0 * d.explained:.1f} %',
                'best': one.best is not None and d.sensor == one.best.sensor,
            })
    return rows


def _warming_rows(result: Thermal) -> list[dict[str, str]]:
    rows = []
    for one in result.thermometers:
        start = float(result.during_cycles(one)[0][result.place])
        rows.append({
            'sensor': one.sensor,
            'start': '' if np.isnan(start) else f'{start:.2f}',
            'change': words.warming(result, one),
        })
    return rows


def _cycle_rows(result: Thermal) -> list[dict[str, Any]]:
    span = float(result.time[-1] - result.time[0])
    rows = []
    for number, cycle in enumerate(result.cycles):
        left = result.changes.residual[number][result.changes.used[number]]
        rows.append({
            'cycle': cycle.plan.cycle,
            'time': words.moment(float(result.time[number]), span),
            'poses': f'{int(result.changes.used[number].sum())} of {len(cycle.plan.commands)}',
            'residual': f'{1e6 * float(np.sqrt(np.mean(left**2))):.2f}' if left.size else '',
            'reference': number == result.place,
        })
    return rows


def _within_row(one: Within) -> dict[str, Any]:
    def taken(found: tuple[tuple[ErrorParameter, float], ...]) -> str:
        return ', '.join(
            f'{p.symbol} ({_per(one.parameter, p, size)})' for p, size in found
        ) or '–'

    return {
        'symbol': one.parameter.symbol,
        'unit': words.unit(one.parameter),
        'hidden': '' if np.isnan(one.hidden) else f'{100.0 * one.hidden:.0f} %',
        'inseparable': one.inseparable,
        'map': taken(one.as_map),
        'constants': taken(one.as_constants),
        'expanded': f'{2e6 * one.stddev:.2f}',
        'drift': f'{1e6 * one.drift:+.2f}' if one.drift else '',
    }


def _per(drifting: ErrorParameter, other: ErrorParameter, size: float) -> str:
    return f'{size:.2f} {words.unit(other)} per {words.unit(drifting)}'
