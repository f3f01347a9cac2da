"""Figures of the cone frustum test: set-up, commands, contour errors, ranking, tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtest_identification.figures.style import (
    COLOURS,
    COVERAGE,
    SETUP_COLOURS,
    SETUP_MARKERS,
    round_down,
    scale_bar,
    times,
)
from rtest_identification.frustum.commands import Commands
from rtest_identification.frustum.cone import Frustum
from rtest_identification.frustum.prediction import Prediction, Ranked
from rtest_identification.frustum.tables import Line

_CONSTANT, _VARYING = COLOURS[0], COLOURS[1]
_TOTAL = '#000000'
# Part of the circle's radius that the largest deviation is drawn with.
_SHARE = 0.3
_MOST_RANKED = 30
_TURN = np.linspace(0.0, 2.0 * np.pi, 181)


def setup(cone: Frustum) -> Figure:
    """The frustum on the table, from the side and from above (Fig. 6-1)."""
    figure = Figure(figsize=(10.0, 5.2), layout='constrained')
    side, above = figure.subplots(1, 2)
    turn, circle = cone.frame, np.stack([np.cos(_TURN), np.sin(_TURN), 0 * _TURN])
    centre, half = np.asarray(cone.centre) * 1e3, 0.5e3 * cone.diameter
    top = cone.circle_centre * 1e3
    path = top[:, None] + turn @ (half * circle)
    slope = np.tan(cone.half_apex)
    # As high as half its path is wide, less for a flat cone.
    foot = min(half, 0.6 * half / max(slope, 1e-9))
    low = top[:, None] + turn @ ((half + foot * slope) * circle - foot * np.eye(3)[:, 2:])
    for axes, second in ((side, 2), (above, 1)):
        for ends in np.linspace(0, 180, 13).astype(int):
            axes.plot([path[0, ends], low[0, ends]], [path[second, ends], low[second, ends]],
                      color='0.8', linewidth=0.8)
        axes.plot(low[0], low[second], color='0.6', linewidth=0.8)
        axes.plot(path[0], path[second], color=_CONSTANT, linewidth=2.0,
                  label=f'tool path, D {cone.diameter * 1e3:g} mm')
        axes.plot(path[0, 0], path[second, 0], 'o', color=_CONSTANT, label='start')
        for k, end in enumerate((0, 90)):
            axes.plot([centre[0], path[0, end]], [centre[second], path[second, end]], '--',
                      color=_VARYING, linewidth=1.0, label='normals (ball bar)' if not k else None)
        axes.plot(centre[0], centre[second], 's', color=_VARYING,
                  label='where they meet ({:g}, {:g}, {:g}) mm'.format(*centre))
        axes.plot(0.0, 0.0, 'k+', markersize=10, label='origin: the rotary axes cross')
        axes.set_aspect('equal', adjustable='datalim')
        axes.grid(alpha=0.3)
        axes.set_xlabel('X of the table [mm]')
        axes.set_ylabel(f'{"XYZ"[second]} of the table [mm]')
    across, axis = turn[[0, 2], 0], turn[[0, 2], 2]
    at, up = centre[[0, 2]], np.array([0.0, 1.0])
    for start, direction in ((at, axis), (at, up), (path[[0, 2], 90], axis)):
        side.plot(*np.stack([start, start + 2.0 * half * direction]).T, '-.', color='0.3',
                  linewidth=1.0)
    # From the left end of the path towards the apex.
    edge = np.sin(cone.half_apex) * across + np.cos(cone.half_apex) * axis
    side.plot(*np.stack([path[[0, 2], 90], path[[0, 2], 90] + 1.6 * half * edge]).T, color='0.8',
              linewidth=0.8)
    _angle(side, at, up, axis, 1.6 * half, f'φ {np.degrees(cone.tilt):g}°')
    _angle(side, path[[0, 2], 90], axis, edge, 1.3 * half, f'ψ {np.degrees(cone.half_apex):g}°')
    side.set_title('seen along +Y', fontsize=9, loc='left')
    above.set_title('from above', fontsize=9, loc='left')
    figure.legend(*side.get_legend_handles_labels(), loc='outside lower center', ncols=5,
                  fontsize=8, frameon=False)
    return figure


def _angle(
    axes: Axes, at: np.ndarray, start: np.ndarray, end: np.ndarray, radius: float, label: str
) -> None:
    """An arc between two directions (2,) with its label outside it."""
    share = np.linspace(0.0, 1.0, 25)[:, None]
    between = np.arccos(np.clip(start @ end, -1.0, 1.0))
    if between > 1e-6:
        ways = (np.sin((1.0 - share) * between) * start + np.sin(share * between) * end)
        arc = at + radius * ways / np.sin(between)
        axes.plot(*arc.T, color='0.3', linewidth=1.0)
    middle = (start + end) / np.linalg.norm(start + end)
    axes.annotate(label, at + radius * middle, textcoords='offset points', xytext=11 * middle,
                  ha='center', va='center', fontsize=9)


def commands(made: Commands, feed: float) -> Figure:
    """Position of every axis against time (Fig. 6-2). feed : of the tool on the part [m/s]."""
    letters = made.machine.letters
    figure = Figure(figsize=(8.0, 1.35 * len(letters) + 0.4), layout='constrained')
    panels = figure.subplots(len(letters), 1, sharex=True, squeeze=False)[:, 0]
    time = made.feature.length / feed
    for axes, name in zip(panels, letters, strict=True):
        rotary = made.machine.axes[name].rotary
        axes.plot(time, made.axis(name) * (180.0 / np.pi if rotary else 1e3), color=_CONSTANT)
        axes.set_ylabel(f'{name} [{"deg" if rotary else "mm"}]')
        axes.margins(y=0.12)
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel(f'time if the tool keeps {feed * 6e4:g} mm/min on the part [s]')
    return figure


def contour(found: Prediction, cone: Frustum | None) -> Figure:
    """Predicted error with U, all errors and location errors alone (Fig. 6-9)."""
    unit = 1e6
    curves = [
        (found.form.profile, _TOTAL, '-', f'all errors, {found.form.deviation * unit:.2f} µm'),
        (found.constant.profile, _CONSTANT, '--',
         f'location errors and squareness alone, {found.constant.deviation * unit:.2f} µm'),
        (found.varying.profile, _VARYING, ':',
         f'what changes along the path alone, {found.varying.deviation * unit:.2f} µm'),
    ]
    band = COVERAGE * found.profile_stddev
    if cone is None:
        figure = Figure(figsize=(9.0, 3.8), layout='constrained')
        axes = figure.subplots()
        place = found.commands.feature.length * 1e3
        profile = found.form.profile
        axes.fill_between(place, unit * (profile - band), unit * (profile + band), color='0.5',
                          alpha=0.3, linewidth=0, label='U (k = 2) of all errors')
        for values, colour, style, label in curves:
            axes.plot(place, unit * values, style, color=colour, label=label)
        axes.axhline(0.0, color='0.6', linewidth=0.8)
        axes.set_xlabel('way along the path [mm]')
        axes.set_ylabel('deviation along the normal [µm]')
        axes.grid(alpha=0.3)
    else:
        figure = Figure(figsize=(7.0, 7.4), layout='constrained')
        axes = figure.subplots()
        largest = max(float((np.abs(found.form.profile) + band).max()),
                      *(float(np.abs(values).max()) for values, *_ in curves))
        factor = round_down(_SHARE * 0.5 * cone.diameter / max(largest, 1e-9))
        _ring(axes, cone, factor)
        inner, outer = (_around(cone, found.form.profile + s * band, factor) for s in (-1, 1))
        axes.fill(*np.hstack([outer, inner[:, ::-1]]), color='0.5', alpha=0.3, linewidth=0,
                  label='U (k = 2) of all errors')
        for values, colour, style, label in curves:
            axes.plot(*_around(cone, values, factor), style, color=colour, label=label)
        axes.set_title(f'axes: mm of the part; deviations from the grey circle magnified '
                       f'{times(factor)}: read them by the bar', fontsize=9, loc='left')
        axes.set_xlabel("x' across the cone's axis, in the plane of the tilt [mm]")
        axes.set_ylabel("y' [mm]")
    figure.legend(*axes.get_legend_handles_labels(), loc='outside lower center',
                  ncols=2, fontsize=8, frameon=False)
    return figure


def profiles(cone: Frustum, named: Sequence[tuple[str, np.ndarray]]) -> Figure:
    """What each error does to the circle, one panel an error, each magnified as stated (Fig. 6-3).

    named : label and profile (n,) [m]
    """
    columns = 4
    rows = -(-len(named) // columns)
    figure = Figure(figsize=(11.0, 2.9 * rows), layout='constrained')
    for axes in figure.subplots(rows, columns, squeeze=False).ravel()[len(named):]:
        axes.set_axis_off()
    for axes, (name, values) in zip(figure.axes, named, strict=False):
        largest = float(np.abs(values).max())
        flat = largest < 1e-9
        factor = round_down(_SHARE * 0.5 * cone.diameter / (1e-5 if flat else largest))
        _ring(axes, cone, factor)
        axes.plot(*_around(cone, values, factor), color=_VARYING)
        axes.set_title(f'{name}: {np.ptp(values) * 1e6:.1f} µm', fontsize=9)
        axes.tick_params(labelsize=7)
    figure.supxlabel("x' [mm], deviations magnified to the bar of each panel", fontsize=9)
    figure.supylabel("y' [mm]", fontsize=9)
    return figure


def ranking(ranked: Sequence[Ranked], quantity: str) -> Figure:
    """What every error does alone, the largest on top."""
    shown = [one for one in ranked if one.alone > 5e-9][:_MOST_RANKED]
    figure = Figure(figsize=(10.0, 0.9 + 0.34 * max(len(shown), 3)), layout='constrained')
    axes = figure.subplots()
    axes.set_xlabel(f'{quantity} by this error alone [µm]')
    if not shown:
        axes.text(0.5, 0.5, 'no error makes 0.005 µm', ha='center', transform=axes.transAxes)
        axes.set_yticks([])
        return figure
    names = [
        f'{one.name}  ({one.size})' + (f'\n{one.formula}' if one.formula else '') for one in shown
    ]
    colours = [_CONSTANT if one.constant else _VARYING for one in shown]
    values = [1e6 * one.alone for one in shown]
    axes.barh(range(len(shown)), values, color=colours, height=0.65)
    for place, value in enumerate(values):
        axes.annotate(f' {value:.2f}', (value, place), va='center', fontsize=8)
    axes.set_yticks(range(len(shown)), names, fontsize=7)
    axes.invert_yaxis()
    axes.margins(x=0.1, y=0.01)
    axes.grid(axis='x', alpha=0.3)
    for colour, label in ((_CONSTANT, 'constant'), (_VARYING, 'changes along the path')):
        if colour in colours:
            axes.barh([0], [0.0], color=colour, label=label)
    axes.legend(fontsize=8, loc='lower right')
    return figure


def tables(lines: Sequence[Line]) -> Figure:
    """Printed and computed circularity of every row, in both cases."""
    figure = Figure(figsize=(11.0, 7.6), layout='constrained')
    panels = figure.subplots(1, 2, sharey=True)
    for axes, case in zip(panels, 'ab', strict=True):
        chosen = [one for one in lines if one.case == case]
        for lane, name in enumerate(('printed', 'least_squares', 'minimum_zone')):
            place = np.arange(len(chosen)) + 0.24 * (lane - 1)
            spread = [1e6 * one.spreads[lane] if one.spreads else 0.0 for one in chosen]
            axes.errorbar(
                [1e6 * getattr(one, name) for one in chosen], place, xerr=spread,
                fmt=SETUP_MARKERS[lane], color=('black', *SETUP_COLOURS)[lane], markersize=4,
                linewidth=0.0, elinewidth=0.9,
                label=('as printed', 'computed, least-squares circle',
                       'computed, minimum-zone circle')[lane],
            )
        axes.set_yticks(range(len(chosen)), [f'{one.table}  {one.name}' for one in chosen],
                        fontsize=8)
        axes.set_ylim(len(chosen) - 0.4, -0.6)
        for place in range(len(chosen) - 1):
            axes.axhline(place + 0.5, color='0.9', linewidth=0.6)
        axes.set_title(f'({case}) φ {15 if case == "a" else 75}°, ψ 30°', fontsize=10)
        axes.set_xlabel('circularity [µm]')
        axes.grid(axis='x', alpha=0.3)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc='outside lower center', ncols=3, fontsize=9,
        frameon=False, title='point: mean over simulated machines; bar: their standard deviation, '
        'how much machines differ, no uncertainty of the mean', title_fontsize=9,
    )
    return figure


def _around(cone: Frustum, profile: np.ndarray, factor: float) -> np.ndarray:
    """(2, n + 1) closed curve about the circle [mm], deviations magnified."""
    closed = np.append(profile, profile[0])
    angle = np.linspace(0.0, 2.0 * np.pi, len(closed))
    radius = 1e3 * (0.5 * cone.diameter + factor * closed)
    return radius * np.stack([np.cos(angle), np.sin(angle)])


def _ring(axes: Axes, cone: Frustum, factor: float) -> None:
    """The nominal circle with its start and a scale bar of the deviations."""
    half = 0.5e3 * cone.diameter
    axes.plot(half * np.cos(_TURN), half * np.sin(_TURN), color='0.6', linewidth=0.9)
    axes.plot(half, 0.0, 'o', color='black', markersize=5, markeredgecolor='white', zorder=10)
    axes.set_aspect('equal')
    wide = 2.0 * half * (1.0 + 1.2 * _SHARE)
    axes.set_xlim(-0.5 * wide, 0.5 * wide)
    axes.set_ylim(-0.5 * wide, 0.5 * wide)
    axes.grid(alpha=0.2)
    length = round_down(0.2 * half / factor * 1e3)
    scale_bar(axes, 1e-3 * length * factor, f'{length:g} µm', wide)
