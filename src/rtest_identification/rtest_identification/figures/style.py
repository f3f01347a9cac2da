"""What the figures share: colours, saving, magnification, choice of levels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rtest_identification.presentation import Presentation

# Colour-blind safe (Okabe and Ito 2008), in the order X Y Z.
COLOURS = ('#0072B2', '#D55E00', '#009E73')
# Set-ups: other colours than the components, and a marker each for who sees no colours.
SETUP_COLOURS = ('#0072B2', '#D55E00', '#CC79A7', '#1b7f5c', '#E69F00', '#56B4E9', '#000000')
SETUP_MARKERS = ('o', 's', '^', 'D', 'v', 'P', 'X')
TABLE = '#bdbdbd'
# Coverage factor of the uncertainties shown.
COVERAGE = 2.0
DPI = 130


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.svg; returns their paths."""
    FigureCanvasAgg(figure)
    paths = [folder / f'{name}.png', folder / f'{name}.svg']
    for path in paths:
        figure.savefig(path, dpi=DPI)
    return paths


def setup_colour(number: int) -> str:
    """Colour of a set-up."""
    return SETUP_COLOURS[number % len(SETUP_COLOURS)]


def setup_marker(number: int) -> str:
    """Marker of a set-up."""
    return SETUP_MARKERS[number % len(SETUP_MARKERS)]


def round_down(value: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1.0, 2.0, 5.0) if step <= value / power * 1.0001) * power)


def magnification(errors: Sequence[np.ndarray], room: float) -> float:
    """Factor by which errors (n, 3) are drawn so that the largest fills `room` [m], rounded."""
    largest = max(
        (float(np.linalg.norm(e, axis=1).max(initial=0.0)) for e in errors), default=0.0
    )
    return round_down(room / max(largest, 1e-9))


def times(factor: float) -> str:
    """For example 10,000×."""
    return f'{factor:,.0f}×'


def full_levels(view: Presentation) -> list[int]:
    """Levels at which some set-up turned: not those of a single pose at start and end."""
    cycles = range(len(view.setups))
    return [
        level for level in range(len(view.levels))
        if max(len(view.rows(cycle, level)) for cycle in cycles) > 2
    ] or list(range(len(view.levels)))


def chosen_levels(view: Presentation, most: int) -> list[int]:
    """At most so many levels: the first, the last, the one nearest to zero, others between."""
    full = full_levels(view)
    if len(full) <= most:
        return full
    picked = {full[round(x)] for x in np.linspace(0, len(full) - 1, most)}
    zero = nearest_to_zero(view, full)
    if zero not in picked:
        picked.discard(min(picked - {full[0], full[-1]}, key=lambda n: abs(n - zero)))
        picked.add(zero)
    return sorted(picked)


def nearest_to_zero(view: Presentation, levels: list[int]) -> int:
    """The level of these that is nearest to zero."""
    return min(levels, key=lambda level: abs(view.levels[level]))


def level_name(view: Presentation, level: int) -> str:
    """For example B = -75°; empty for a machine with one rotary axis."""
    if not view.stepping:
        return ''
    degrees = np.degrees(view.levels[level])
    return f'{view.stepping} = {round(float(degrees), 1) + 0.0:g}°'.replace('-', '−')


def scale_bar(axes: Axes, length: float, label: str, wide: float) -> None:
    """A bar of this length in data units, labelled, in the left lower corner of the plot.

    wide : width of the plot in data units
    """
    x, y = 0.04, 0.04
    axes.plot(
        [x, x + length / wide], [y, y], color='black', linewidth=2.5,
        transform=axes.transAxes, solid_capstyle='butt', zorder=5,
    )
    axes.annotate(
        label, (x, y), xycoords='axes fraction', xytext=(0, 2.5), textcoords='offset points',
        fontsize=7, va='bottom', zorder=5,
    )
