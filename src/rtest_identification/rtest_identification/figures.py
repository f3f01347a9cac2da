"""Figures of an identification, each as PNG and SVG. One function a figure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rtest_identification.location import AxisMap
from rtest_identification.pipeline import Identification

# Colour-blind safe (Okabe and Ito 2008), in the order X Y Z.
COLOURS = ('#0072B2', '#D55E00', '#009E73')
# Coverage factor of the uncertainties shown.
COVERAGE = 2.0


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.svg; returns their paths."""
    FigureCanvasAgg(figure)
    paths = [folder / f'{name}.png', folder / f'{name}.svg']
    for path in paths:
        figure.savefig(path, dpi=130)
    return paths


def error_map(result: AxisMap) -> Figure:
    """Position-dependent errors against the axis, with U (k = 2) bands (Fig. 3-14)."""
    figure = Figure(figsize=(9.0, 3.8), layout='constrained')
    stations = np.degrees(result.stations)
    for axes, angular in zip(figure.subplots(1, 2), (False, True), strict=True):
        colours = iter(COLOURS)
        for p, value, stddev in zip(result.parameters, result.value, result.stddev, strict=True):
            if p.angular is not angular:
                continue
            colour = next(colours)
            axes.fill_between(
                stations, 1e6 * (value - COVERAGE * stddev), 1e6 * (value + COVERAGE * stddev),
                color=colour, alpha=0.18, linewidth=0,
            )
            axes.plot(stations, 1e6 * value, 'o-', color=colour, label=p.symbol, markersize=4)
        axes.axhline(0.0, color='0.6', linewidth=0.8)
        axes.set_xlabel(f'{result.axis} [deg]')
        axes.set_ylabel('rotation [µrad]' if angular else 'displacement [µm]')
        axes.set_xticks(stations if len(stations) <= 12 else stations[::2])
        axes.legend(fontsize=8, ncols=3, loc='upper center', bbox_to_anchor=(0.5, 1.14))
        axes.grid(alpha=0.3)
    return figure


def residuals(result: Identification) -> Figure:
    """What the fit leaves at every pose, per set-up, in the order measured."""
    data = result.observations.keep(
        np.setdiff1d(np.arange(len(result.observations)), result.fit.outliers)
    )
    figure = Figure(figsize=(9.0, 1.3 + 1.5 * len(data.cycles)), layout='constrained')
    rows = figure.subplots(len(data.cycles), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for number, axes in enumerate(rows):
        mine = data.cycle == number
        for component, colour in enumerate(COLOURS):
            axes.plot(
                data.pose[mine], 1e6 * result.fit.residual[mine, component], '.',
                color=colour, label='XYZ'[component], markersize=4,
            )
        if np.isfinite(result.noise):
            axes.axhspan(
                -2e6 * result.noise, 2e6 * result.noise, color='0.85', zorder=0,
                label='±2 × repeatability' if number == 0 else None,
            )
        axes.set_ylabel(f'{data.cycles[number]}\n[µm]', fontsize=8)
        axes.grid(alpha=0.3)
    rows[-1].set_xlabel('pose (row of the plan)')
    figure.legend(*rows[0].get_legend_handles_labels(), loc='outside upper center', ncols=4)
    return figure
