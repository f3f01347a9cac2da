"""Error maps of the rotary axes (Fig. 3-14)."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from rtest_identification.error_map import AxisMap
from rtest_identification.figures.style import COLOURS, COVERAGE
from rtest_identification.grid_map import GridMap

# More lines than this in a panel cannot be told apart.
_LINES = 12


def error_map(result: AxisMap) -> Figure:
    """Position-dependent errors against the axis, with U (k = 2) bands (Fig. 3-14)."""
    figure = Figure(figsize=(9.0, 3.8), layout='constrained')
    stations = np.degrees(result.stations)
    for axes, angular in zip(figure.subplots(1, 2), (False, True), strict=True):
        colours = iter(COLOURS)
        markers = iter('os^')
        for p, value, stddev in zip(result.parameters, result.value, result.stddev, strict=True):
            if p.angular is not angular:
                continue
            colour = next(colours)
            axes.fill_between(
                stations, 1e6 * (value - COVERAGE * stddev), 1e6 * (value + COVERAGE * stddev),
                color=colour, alpha=0.18, linewidth=0,
            )
            axes.plot(
                stations, 1e6 * value, f'{next(markers)}-', color=colour, label=p.symbol,
                markersize=4,
            )
        axes.axhline(0.0, color='0.6', linewidth=0.8)
        axes.set_xlabel(f'{result.axis} [deg]')
        axes.set_ylabel('rotation [µrad]' if angular else 'displacement [µm]')
        if len(stations) <= 12:
            axes.set_xticks(np.round(stations, 1))
        axes.legend(fontsize=8, ncols=3, loc='lower center', bbox_to_anchor=(0.5, 1.0))
        axes.grid(alpha=0.3)
    return figure


def grid_map(result: GridMap, outer_axis: str) -> Figure:
    """The inner axis's six errors: lines against it, or colours over both where lines are many."""
    figure = Figure(figsize=(9.0, 8.4), layout='constrained')
    panels = figure.subplots(3, 2, sharex=True, sharey=len(result.outer) > _LINES or 'col')
    draw = _as_colours if len(result.outer) > _LINES else _as_lines
    draw(figure, panels, result, outer_axis)
    inner = np.degrees(result.inner)
    for place, p in enumerate(result.parameters):
        axes = panels[place % 3, place // 3]
        axes.set_title(p.symbol, fontsize=9, loc='left')
        if not np.isfinite(result.value[place]).any():
            axes.text(
                0.5, 0.5, 'not determined by these sphere positions', ha='center', va='center',
                transform=axes.transAxes, color='0.35', fontsize=8,
            )
    for axes in panels[2]:
        axes.set_xlabel(f'{result.axis} [deg]')
        if len(inner) <= 9:
            axes.set_xticks(np.round(inner, 1))
        elif inner.max() - inner.min() >= 240.0:
            first = np.ceil(inner.min() / 60.0 - 0.02) * 60.0
            axes.set_xticks(np.arange(first, inner.max() + 1.0, 60.0))
    return figure


def _as_lines(figure: Figure, panels: np.ndarray, result: GridMap, outer_axis: str) -> None:
    inner, outer = np.degrees(result.inner), np.degrees(result.outer)
    norm = Normalize(outer.min(), max(outer.max(), outer.min() + 1e-9))
    # Without the yellow end, which white paper swallows.
    colours = ListedColormap(colormaps['viridis'](np.linspace(0.0, 0.9, 256)))
    for place, (value, stddev) in enumerate(zip(result.value, result.stddev, strict=True)):
        axes = panels[place % 3, place // 3]
        axes.axhline(0.0, color='0.6', linewidth=0.8)
        axes.set_ylabel('rotation [µrad]' if place > 2 else 'displacement [µm]', fontsize=8)
        axes.grid(alpha=0.3)
        if not np.isfinite(value).any():
            continue
        for level, station in enumerate(outer):
            # NaN breaks the line: nothing is drawn across what is not determined.
            axes.plot(
                inner, 1e6 * value[level], '.-', color=colours(norm(station)), linewidth=1.0,
                markersize=4,
            )
        typical = 1e6 * COVERAGE * float(np.nanmedian(stddev))
        axes.axhspan(-typical, typical, color='0.85', zorder=0)
    bar = figure.colorbar(
        ScalarMappable(norm, colours), ax=panels, location='bottom', fraction=0.025, aspect=50,
        label=f'{outer_axis} [deg]',
    )
    bar.set_ticks(np.round(outer, 1))


def _as_colours(figure: Figure, panels: np.ndarray, result: GridMap, outer_axis: str) -> None:
    inner, outer = np.degrees(result.inner), np.degrees(result.outer)
    for column in (0, 1):
        values = 1e6 * result.value[3 * column : 3 * column + 3]
        largest = float(np.nanmax(np.abs(values), initial=1e-3))
        for axes, value in zip(panels[:, column], values, strict=True):
            mesh = axes.pcolormesh(
                inner, outer, value, cmap='RdBu_r', vmin=-largest, vmax=largest, shading='nearest'
            )
            axes.set_facecolor('0.8')
            axes.set_ylabel(f'{outer_axis} [deg]', fontsize=8)
        figure.colorbar(
            mesh, ax=panels[:, column], location='bottom', fraction=0.025, aspect=30,
            label='rotation [µrad]' if column else 'displacement [µm]',
        )
