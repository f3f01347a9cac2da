"""The nest's positions in space, error magnified (Fig. 3-9): a picture, and one that turns."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from rtest_identification.figures.shapes import Magnified
from rtest_identification.figures.style import (
    TABLE,
    chosen_levels,
    full_levels,
    level_name,
    nearest_to_zero,
    setup_colour,
    setup_marker,
    times,
)

# Levels side by side in the picture.
_PICTURES = 3
# Markers that plotly can draw in space, in the order of the set-ups.
_SYMBOLS = ('circle', 'square', 'diamond', 'cross', 'x')
_PIXELS = 620


def picture(drawn: Magnified) -> Figure:
    """Positions at the first, the middle and the last level (Fig. 3-9)."""
    view = drawn.view
    levels = chosen_levels(view, _PICTURES)
    low, high = _limits(drawn, levels)
    figure = Figure(figsize=(3.3 * len(levels) + 0.3, 3.9))
    for place, level in enumerate(levels):
        axes = figure.add_subplot(1, len(levels), place + 1, projection='3d')
        table = 1e3 * drawn.table(level)
        if len(table):
            axes.add_collection3d(Poly3DCollection([table], facecolor=TABLE, alpha=0.35))
        for cycle, setup in enumerate(view.setups):
            _turn(axes, drawn, cycle, level, setup.name if place == 0 else '_')
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(high - low, zoom=1.0)
        axes.view_init(elev=22, azim=-60)
        axes.set_title(level_name(view, level), fontsize=10, y=1.0)
        # Else it hides the labels of its neighbour.
        axes.patch.set_visible(False)
        for name in 'xyz':
            getattr(axes, f'set_{name}label')(f'{name.upper()} [mm]', fontsize=8, labelpad=-4)
            axes.tick_params(axis=name, labelsize=7, pad=-2)
            axes.locator_params(axis=name, nbins=4)
    figure.legend(
        loc='lower center', ncols=6, fontsize=8, frameon=False,
        title=f'set-up: measured, error {times(drawn.factor)}; dots: command', title_fontsize=8,
    )
    figure.subplots_adjust(left=0.0, right=0.97, bottom=0.15, top=0.95, wspace=0.0)
    return figure


def _turn(axes: Axes3D, drawn: Magnified, cycle: int, level: int, label: str) -> None:
    view, colour = drawn.view, setup_colour(cycle)
    rows = view.rows(cycle, level)
    if not len(rows):
        return
    command, measured = 1e3 * view.nominal[rows], 1e3 * drawn.positions[rows]
    if view.setups[cycle].outer:
        axes.plot(*1e3 * drawn.command_circle(cycle, level).T, color='0.45', linewidth=0.7)
        circle = drawn.average_circle(cycle, level)
        if circle is not None:
            axes.add_collection3d(Poly3DCollection([1e3 * circle], facecolor=colour, alpha=0.15))
            axes.plot(*1e3 * circle.T, color=colour, linewidth=1.0)
        for ends in np.stack([command, measured], axis=1):
            axes.plot(*ends.T, color=colour, linewidth=0.6)
    axes.plot(*command.T, '.', color='0.25', markersize=3)
    axes.plot(
        *measured.T, setup_marker(cycle), color=colour, fillstyle='none', markersize=4,
        markeredgewidth=0.9, label=label,
    )


def _limits(drawn: Magnified, levels: list[int]) -> tuple[np.ndarray, np.ndarray]:
    rows = np.isin(drawn.view.level, levels)
    points = np.vstack([drawn.positions[rows], *(drawn.table(level) for level in levels)])
    low, high = 1e3 * points.min(axis=0), 1e3 * points.max(axis=0)
    margin = 0.03 * (high - low).max()
    return low - margin, high + margin


def turnable(drawn: Magnified, element: str) -> str:
    """Script that draws the positions of every level into an element, to turn with the mouse.

    A menu chooses the level, the legend the set-ups. Needs plotly.js in the page; nothing is
    fetched.
    """
    view = drawn.view
    traces: list[dict[str, Any]] = []
    owners: list[int] = []
    levels = full_levels(view)
    for level in levels:
        for trace in _traces(drawn, level):
            traces.append(trace)
            owners.append(level)
    start = nearest_to_zero(view, levels)
    for trace, owner in zip(traces, owners, strict=True):
        trace['visible'] = owner == start
    buttons = [
        {
            'method': 'restyle',
            'label': level_name(view, level) or 'all',
            'args': ['visible', [owner == level for owner in owners]],
        }
        for level in levels
    ]
    low, high = _limits(drawn, levels)
    span = high - low

    def axis(name: str, number: int) -> dict[str, Any]:
        return {
            'title': {'text': f'{name} [mm]'},
            'range': [_short(low[number]), _short(high[number])],
            'backgroundcolor': '#fafafa', 'gridcolor': '#dddddd', 'showbackground': True,
            'zeroline': False,
        }

    layout = {
        'height': _PIXELS,
        'margin': {'l': 0, 'r': 0, 't': 40, 'b': 0},
        'legend': {'orientation': 'h', 'y': -0.02, 'itemsizing': 'constant'},
        'uirevision': 'same',
        'scene': {
            'xaxis': axis('X', 0), 'yaxis': axis('Y', 1), 'zaxis': axis('Z', 2),
            'aspectmode': 'manual',
            'aspectratio': dict(zip('xyz', (span / span.max()).round(3).tolist(), strict=True)),
            'camera': {
                'eye': {'x': 0.95, 'y': -1.45, 'z': 0.65}, 'center': {'x': 0, 'y': 0, 'z': -0.12},
            },
            'uirevision': 'same',
        },
        'updatemenus': [{
            'buttons': buttons, 'active': levels.index(start), 'visible': len(buttons) > 1,
            'x': 0.0, 'xanchor': 'left', 'y': 1.06, 'yanchor': 'top', 'direction': 'down',
        }],
    }
    # Only buttons that need no server.
    keep = ['toImage', 'zoom3d', 'pan3d', 'orbitRotation', 'resetCameraDefault3d']
    config = {
        'displaylogo': False, 'responsive': True, 'plotlyServerURL': '', 'modeBarButtons': [keep],
    }
    parts = ', '.join(_json(part) for part in (traces, layout, config))
    return f'Plotly.newPlot({_json(element)}, {parts});'


def _traces(drawn: Magnified, level: int) -> list[dict[str, Any]]:
    view = drawn.view
    table = 1e3 * drawn.table(level)
    common = {'name': 'table', 'showlegend': False}
    traces = [_disc(table, TABLE, 0.35, common)] if len(table) else []
    for cycle, setup in enumerate(view.setups):
        rows = view.rows(cycle, level)
        if not len(rows):
            continue
        colour, group = setup_colour(cycle), {'legendgroup': setup.name, 'showlegend': False}
        command, measured = 1e3 * view.nominal[rows], 1e3 * drawn.positions[rows]
        if setup.outer:
            traces.append(_line(1e3 * drawn.command_circle(cycle, level), '#707070', 2, group))
            circle = drawn.average_circle(cycle, level)
            if circle is not None:
                traces.append(_disc(1e3 * circle, colour, 0.15, group))
                traces.append(_line(1e3 * circle, colour, 4, group))
        gap = np.full_like(command, np.nan)
        traces.append(
            _line(np.stack([command, measured, gap], axis=1).reshape(-1, 3), colour, 2, group)
        )
        traces.append({
            **_points(command), **group, 'mode': 'markers', 'hoverinfo': 'skip',
            'marker': {'color': '#404040', 'size': 2},
        })
        error = 1e6 * drawn.error[rows]
        turned = np.degrees(view.turned[rows])
        traces.append({
            **_points(measured), 'legendgroup': setup.name, 'name': setup.name, 'mode': 'markers',
            'marker': {
                'color': colour, 'size': 3.5, 'symbol': _SYMBOLS[cycle % len(_SYMBOLS)],
            },
            'text': [
                f'{setup.name}, {view.turning} = {c:.0f}°<br>'
                f'error X {e[0]:+.2f}, Y {e[1]:+.2f}, Z {e[2]:+.2f} µm'
                for c, e in zip(turned, error, strict=True)
            ],
            'hoverinfo': 'text',
        })
    return traces


def _points(points: np.ndarray) -> dict[str, Any]:
    columns = ([None if np.isnan(v) else _short(v) for v in column] for column in points.T)
    return {'type': 'scatter3d', **dict(zip('xyz', columns, strict=True))}


def _line(
    points: np.ndarray, colour: str, width: float, common: dict[str, Any]
) -> dict[str, Any]:
    return {
        **_points(points), **common, 'mode': 'lines', 'hoverinfo': 'skip',
        'line': {'color': colour, 'width': width},
    }


def _disc(
    outline: np.ndarray, colour: str, opacity: float, common: dict[str, Any]
) -> dict[str, Any]:
    """A filled outline: triangles from its middle."""
    count = len(outline)
    points = np.vstack([outline, outline.mean(axis=0)])
    return {
        **_points(points), **common, 'type': 'mesh3d', 'hoverinfo': 'skip',
        'i': list(range(count - 1)), 'j': list(range(1, count)), 'k': [count] * (count - 1),
        'color': colour, 'opacity': opacity, 'flatshading': True,
    }


def _short(value: float) -> float:
    """Three decimals of a millimetre of a magnified picture are more than a screen shows."""
    return round(float(value), 3)


def _json(data: Any) -> str:
    """JSON that may stand in a script of a page."""
    text = json.dumps(data, ensure_ascii=False, separators=(',', ':'), allow_nan=False)
    return text.replace('</', '<\\/')
