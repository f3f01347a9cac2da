"""What was measured, and what the fit leaves, pose by pose."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtest_identification.error_map import stations
from rtest_identification.figures.style import COLOURS
from rtest_identification.observations import Observations
from rtest_identification.pipeline import Identification

# More changes of level than this in a cycle are shaded but not labelled.
_LABELS = 16


def displacements(result: Identification) -> Figure:
    """Measured displacements of the sphere against the pose, table frame (Fig. 3-8)."""
    data = result.observations
    figure, rows = _rows(data, 1.75)
    for number, axes in enumerate(rows):
        mine = np.flatnonzero(data.cycle == number)
        _shade_levels(axes, data, mine)
        for component, colour in enumerate(COLOURS):
            poses, values = _broken(data.pose[mine], 1e6 * data.displacement[mine, component])
            axes.plot(
                poses, values, f'{"os^"[component]}-', color=colour, label='XYZ'[component],
                markersize=2.5, linewidth=0.9,
            )
        out = np.intersect1d(mine, result.fit.outliers)
        if len(out):
            axes.plot(
                np.repeat(data.pose[out], 3), 1e6 * data.displacement[out].ravel(), 'o',
                color='black', fillstyle='none', markersize=8,
            )
        _name(axes, data, number)
    figure.legend(*rows[0].get_legend_handles_labels(), loc='outside upper center', ncols=4)
    return figure


def residuals(result: Identification) -> Figure:
    """What the fit leaves at every pose, per set-up, in the order measured."""
    whole = result.observations
    data = whole.keep(np.setdiff1d(np.arange(len(whole)), result.fit.outliers))
    figure, rows = _rows(data, 1.75)
    for number, axes in enumerate(rows):
        mine = np.flatnonzero(data.cycle == number)
        _shade_levels(axes, data, mine)
        for component, colour in enumerate(COLOURS):
            axes.plot(
                data.pose[mine], 1e6 * result.fit.residual[mine, component],
                'os^'[component], color=colour, label='XYZ'[component], markersize=2.8,
            )
        axes.axhline(0.0, color='0.6', linewidth=0.8)
        if np.isfinite(result.noise):
            for side in (-2e6, 2e6):
                axes.axhline(
                    side * result.noise, color='black', linewidth=0.9, linestyle='--',
                    label='±2 × repeatability' if number == 0 and side > 0 else None,
                )
        _name(axes, data, number)
    figure.legend(*rows[0].get_legend_handles_labels(), loc='outside upper center', ncols=4)
    return figure


def _rows(data: Observations, height: float) -> tuple[Figure, list[Axes]]:
    count = len(data.cycles)
    figure = Figure(figsize=(9.0, 1.2 + height * count), layout='constrained')
    panels = figure.subplots(count, 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    panels[-1].set_xlabel('pose (row of the plan)')
    return figure, list(panels)


def _name(axes: Axes, data: Observations, number: int) -> None:
    axes.set_ylabel(f'{data.cycles[number]}\n[µm]', fontsize=8)
    axes.grid(alpha=0.3, axis='y')
    axes.margins(x=0.01)


def _shade_levels(axes: Axes, data: Observations, rows: np.ndarray) -> None:
    """Bands for the stays at a station of the outer rotary axis, its angle above them."""
    if not data.machine.rotary or not len(rows):
        return
    outer = data.machine.rotary[0]
    places, station = stations(data.axis(outer))
    at, poses = station[rows], data.pose[rows]
    starts = np.flatnonzero(np.diff(at, prepend=-1))
    ends = [*starts[1:], len(rows)]
    for band, (start, end) in enumerate(zip(starts, ends, strict=True)):
        left, right = poses[start] - 0.5, poses[end - 1] + 0.5
        if band % 2:
            axes.axvspan(left, right, color='0.93', zorder=0, linewidth=0)
        if len(starts) <= _LABELS and right - left > 0.03 * (poses[-1] - poses[0]):
            degrees = round(float(np.degrees(places[at[start]])), 1) + 0.0
            axes.text(
                (left + right) / 2.0, 1.01, f'{outer} {degrees:g}°'.replace('-', '−'),
                transform=axes.get_xaxis_transform(), ha='center', va='bottom', fontsize=7,
                color='0.35',
            )


def _broken(poses: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The line is broken where poses are missing."""
    order = np.argsort(poses, kind='stable')
    poses, values = poses[order].astype(float), values[order]
    gaps = np.flatnonzero(np.diff(poses) > 1) + 1
    return np.insert(poses, gaps, np.nan), np.insert(values, gaps, np.nan)
