"""Direction of the turning axis against the stepping one (Fig. 3-12)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtest_identification.axis_lines import Tilts
from rtest_identification.figures.style import COLOURS, COVERAGE
from rtest_identification.squareness import Separation

_MARKERS = 'os^Dv'
_FILLS = ('full', 'none')


def directions(found: Separation, turning: str) -> Figure:
    """Circles against X and Y, centre lines against Z, their difference: panels (a), (b), (c)."""
    step = found.stepping
    has_line = found.lines.along is not None
    count = 3 if has_line else 1
    figure = Figure(figsize=(9.0, 2.7 * count + 0.3), layout='constrained')
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    _panel(panels[0], found, found.lines.across, f'(a) {turning} by its average circles')
    if has_line:
        _panel(
            panels[1], found, (found.lines.along,),
            f'(b) {turning} by the line through the centres {found.lines.along.name}',
        )
        _panel(panels[2], found, found.differences, '(c) difference (a) − (b): squareness of the '
               'linear axes')
        for agreement in found.agreements:
            k = found.lines.letters.index(agreement.letter)
            panels[2].plot(
                np.degrees(found.levels), 1e6 * agreement.curve, color=COLOURS[k], linewidth=1.6,
                linestyle='--', zorder=1,
                label=f'{agreement.name} of constants:\n{agreement.law}',
            )
            panels[2].legend(fontsize=7, loc='center left', bbox_to_anchor=(1.005, 0.5))
    panels[-1].set_xlabel(f'{step} [deg]' if step else '')
    levels = np.degrees(found.levels)
    if len(levels) <= 12:
        panels[-1].set_xticks(np.round(levels, 1))
    return figure


def _panel(axes: Axes, found: Separation, tilts: tuple[Tilts, ...], title: str) -> None:
    levels = np.degrees(found.levels)
    # Side by side, so that bars do not cover each other.
    gap = float(np.min(np.diff(levels))) if len(levels) > 1 else 1.0
    lanes = 2 * len(tilts)
    for number, one in enumerate(tilts):
        stddev = one.stddev(found.lines.variance)
        for k, letter in enumerate(found.lines.letters):
            lane = 2 * number + k
            shift = 0.06 * gap * (lane - (lanes - 1) / 2.0)
            about = 'XYZ'['ABC'.index(letter)]
            name = f'{one.name}, ' if len(tilts) > 1 else ''
            axes.errorbar(
                levels + shift, 1e6 * one.value[:, k], 1e6 * COVERAGE * stddev[:, k],
                color=COLOURS[k], marker=_MARKERS[(2 * (number % 2) + k) % 5],
                fillstyle=_FILLS[number % 2], markersize=4.5, capsize=2, linewidth=0.8,
                elinewidth=0.9, label=f'{name}about {about}',
            )
    axes.axhline(0.0, color='0.6', linewidth=0.8)
    axes.set_title(title, fontsize=9, loc='left')
    axes.set_ylabel('tilt [µrad]', fontsize=8)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc='center left', bbox_to_anchor=(1.005, 0.5))
