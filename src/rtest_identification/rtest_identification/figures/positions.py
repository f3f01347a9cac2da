"""Projections of the nest's positions, error magnified (Figs. 3-10, 3-11, 3-13 and 6-10)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rtest_identification.figures.shapes import Magnified
from rtest_identification.figures.style import (
    TABLE,
    chosen_levels,
    level_name,
    round_down,
    scale_bar,
    setup_colour,
    setup_marker,
)
from rtest_identification.presentation import Presentation

# Panels side by side, and levels in one figure.
_COLUMNS = 4
MOST_LEVELS = 8
_AXIS = 'XYZ'
# Sizes in inches: the figure, room for tick labels, between panels, axis labels, legend.
_WIDTH, _LEFT, _GAP, _LABEL, _HEADER = 9.0, 0.55, 0.1, 0.42, 0.5
# Part of the width that stays free below the data for the bar.
_BAR_ROOM = 0.12


def planes(view: Presentation) -> tuple[tuple[int, int], tuple[int, int]]:
    """Planes to look at: across the stepping axis and across the turning one (XZ and XY)."""
    turning = int(np.abs(view.direction).argmax())
    frames = np.array([view.frame(n) for n in range(len(view.levels))])
    stays = int(np.abs(frames - frames[0]).sum(axis=(0, 2)).argmin())
    if stays == turning or np.allclose(frames, frames[0]):
        stays = 1 if turning != 1 else 0
    return _plane(stays), _plane(turning)


def _plane(across: int) -> tuple[int, int]:
    first, second = (axis for axis in range(3) if axis != across)
    return first, second


def plane_name(plane: tuple[int, int]) -> str:
    """For example XZ."""
    return f'{_AXIS[plane[0]]}{_AXIS[plane[1]]}'


def projections(drawn: Magnified, outer: bool) -> Figure:
    """Positions of the outer or of the centre set-ups, per level, on two planes."""
    view = drawn.view
    cycles = [c for c, setup in enumerate(view.setups) if setup.outer is outer]
    table = outer

    def both(level: int) -> list[np.ndarray]:
        parts = [drawn.table(level)] if table else []
        for cycle in cycles:
            parts += [drawn.positions[view.rows(cycle, level)], drawn.command_circle(cycle, level)]
        return parts

    def draw(axes: Axes, level: int, plane: tuple[int, int]) -> None:
        if table:
            axes.fill(*1e3 * drawn.table(level).T[list(plane)], color=TABLE, alpha=0.5, zorder=0)
        if not outer:
            _centre_line(axes, drawn, cycles, level, plane)
        for cycle in cycles:
            _turn(axes, drawn, cycle, level, plane)

    return _grid(drawn, cycles, both, draw)


def level_frame(drawn: list[Magnified], titles: list[str]) -> Figure:
    """Outer set-ups in the frame that the stepping axis carries (the B frame, Fig. 6-10).

    Rows of panels: one for each way of looking at the errors, seen along the turning axis.
    """
    view = drawn[0].view
    levels = chosen_levels(view, MOST_LEVELS)
    plane = planes(view)[1]
    cycles = [c for c, setup in enumerate(view.setups) if setup.outer]
    reach = 0.0
    for one in drawn:
        for cycle in cycles:
            for level in levels:
                flat = one.positions[view.rows(cycle, level)] @ view.frame(level)
                reach = max(reach, float(np.abs(flat[:, list(plane)]).max(initial=0.0)))
    reach *= 1.08e3
    low, high = np.full(3, -reach), np.full(3, reach)
    figures = _Panels(len(levels) * len(drawn), [plane], low, high, len(levels), 0.4)
    for which, one in enumerate(drawn):
        for place, level in enumerate(levels):
            name = level_name(view, level)
            title = f'{name}\n{titles[which]}' if name else titles[which]
            axes = figures.add(which * len(levels) + place, 0, title)
            for cycle in cycles:
                _turn(axes, one, cycle, level, plane, view.frame(level))
            _bar(axes, one.factor, 2e-3 * reach)
    return figures.finished(view, cycles)


def _grid(
    drawn: Magnified,
    cycles: list[int],
    parts: Callable[[int], list[np.ndarray]],
    draw: Callable[[Axes, int, tuple[int, int]], None],
) -> Figure:
    """Panels of the chosen levels, two planes above each other, all to the same scale."""
    view = drawn.view
    levels = chosen_levels(view, MOST_LEVELS)
    points = np.vstack([part for level in levels for part in parts(level)])
    low, high = 1e3 * points.min(axis=0), 1e3 * points.max(axis=0)
    margin = 0.06 * float((high - low).max())
    low, high = low - margin, high + margin
    # Narrow panels cannot be read.
    thin = np.maximum(0.25 * (high - low).max() - (high - low), 0.0) / 2.0
    low, high = low - thin, high + thin
    both = planes(view)
    # One scale for both planes.
    widest = max((high - low)[plane[0]] for plane in both)
    for across in {plane[0] for plane in both}:
        more = (widest - (high - low)[across]) / 2.0
        low[across], high[across] = low[across] - more, high[across] + more
    figures = _Panels(len(levels), list(both), low, high)
    for place, level in enumerate(levels):
        for row, plane in enumerate(both):
            axes = figures.add(place, row, '' if row else level_name(view, level))
            draw(axes, level, plane)
            _bar(axes, drawn.factor, 1e-3 * (high - low)[plane[0]])
    return figures.finished(view, cycles)


class _Panels:
    """Blocks of panels placed in inches; constrained layout would take seconds for so many."""

    def __init__(
        self, count: int, rows: list[tuple[int, int]], low: np.ndarray, high: np.ndarray,
        group: int = 0, title: float = 0.25,
    ) -> None:
        """`count` blocks side by side, wrapped, and wrapped anew after every `group` of them."""
        self._rows, self._low, self._high = rows, low, high
        self._group, self._title = group or count, title
        self._columns = max(-(-self._group // -(-self._group // _COLUMNS)), 2)
        lines = -(-self._group // self._columns) * (count // self._group)
        span = high - low
        self._side = (_WIDTH - _LEFT - 0.1) / _COLUMNS - _GAP
        if len({plane[0] for plane in rows}) > 1:
            self._gap = 0.5
        else:
            self._gap = 0.1
        # Below the data a strip stays free for the bar.
        self._strips = [_BAR_ROOM * span[plane[0]] for plane in rows]
        self._heights = [
            self._side * (span[plane[1]] + strip) / span[plane[0]]
            for plane, strip in zip(rows, self._strips, strict=True)
        ]
        self._block = sum(self._heights) + self._gap * (len(rows) - 1) + title + _LABEL
        self._size = (
            _LEFT + self._columns * (self._side + _GAP) + 0.1, _HEADER + lines * self._block
        )
        self._figure = Figure(figsize=self._size)

    def add(self, place: int, row: int, title: str) -> Axes:
        """The panel of a block and a row of it."""
        group, within = divmod(place, self._group)
        line, column = divmod(within, self._columns)
        line += group * -(-self._group // self._columns)
        top = self._size[1] - _HEADER - line * self._block - self._title
        top -= sum(self._heights[:row]) + self._gap * row
        left = _LEFT + column * (self._side + _GAP)
        box = (left, top - self._heights[row], self._side, self._heights[row])
        scale = np.tile(self._size, 2)
        axes = self._figure.add_axes(tuple(np.array(box) / scale))
        plane = self._rows[row]
        axes.set(
            xlim=(self._low[plane[0]], self._high[plane[0]]),
            ylim=(self._low[plane[1]] - self._strips[row], self._high[plane[1]]),
        )
        axes.set_title(title, fontsize=8.5)
        axes.tick_params(labelsize=7)
        axes.xaxis.set_major_locator(MaxNLocator(4, prune='both'))
        axes.yaxis.set_major_locator(MaxNLocator(5, prune='both'))
        axes.grid(alpha=0.2)
        if row == len(self._rows) - 1 or self._gap > 0.2:
            axes.set_xlabel(f'{_AXIS[plane[0]]} [mm]', fontsize=8, labelpad=1)
        else:
            axes.tick_params(labelbottom=False)
        if column:
            axes.tick_params(labelleft=False)
        else:
            axes.set_ylabel(f'{_AXIS[plane[1]]} [mm]', fontsize=8, labelpad=1)
        return axes

    def finished(self, view: Presentation, cycles: list[int]) -> Figure:
        """The figure, with the legend above the panels."""
        handles = {}
        for axes in self._figure.axes:
            handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        names = [view.setups[c].name for c in cycles if view.setups[c].name in handles]
        self._figure.legend(
            [handles[name] for name in names], names, loc='upper center', ncols=6, fontsize=8,
            title='set-up: measured (error magnified); dots: command', title_fontsize=8,
            frameon=False,
        )
        return self._figure


def _turn(
    axes: Axes,
    drawn: Magnified,
    cycle: int,
    level: int,
    plane: tuple[int, int],
    frame: np.ndarray | None = None,
) -> None:
    """Command, measured positions and average circle of one turn, projected."""
    view = drawn.view
    rows = view.rows(cycle, level)
    if not len(rows):
        return
    turn = np.eye(3) if frame is None else frame
    colour = setup_colour(cycle)

    def flat(points: np.ndarray) -> np.ndarray:
        return 1e3 * (points @ turn)[..., list(plane)].T

    command, measured = flat(view.nominal[rows]), flat(drawn.positions[rows])
    outer = view.setups[cycle].outer
    if outer:
        axes.plot(*flat(drawn.command_circle(cycle, level)), color='0.45', linewidth=0.7)
        circle = drawn.average_circle(cycle, level)
        if circle is not None:
            if frame is None:
                axes.fill(*flat(circle), color=colour, alpha=0.1, linewidth=0)
            axes.plot(*flat(circle), color=colour, linewidth=1.0)
        axes.plot(
            *np.stack([command, measured], axis=1), color=colour, linewidth=0.5, alpha=0.6
        )
    axes.plot(*command, '.', color='0.25', markersize=3 if outer else 5)
    axes.plot(
        *measured, setup_marker(cycle), color=colour, fillstyle='none', markersize=3.5,
        markeredgewidth=0.9, label=view.setups[cycle].name,
    )


def _centre_line(
    axes: Axes, drawn: Magnified, cycles: list[int], level: int, plane: tuple[int, int]
) -> None:
    """Lines through the centres of the set-ups on the axis, nominal and measured."""
    view = drawn.view
    ends = [(c, drawn.centre(c, level)) for c in cycles]
    ends = [(view.setups[c].height * view.normal(level), centre) for c, centre in ends
            if centre is not None]
    if not ends:
        return
    nominal, measured = 1e3 * np.array(ends).transpose(1, 2, 0)[:, list(plane)]
    axes.plot(*nominal, color='0.45', linewidth=0.8, linestyle='--')
    axes.plot(*measured, color='black', linewidth=1.4)
    axes.plot(*measured, '+', color='black', markersize=7)


def _bar(axes: Axes, factor: float, wide: float) -> None:
    """A bar for a round error, about a fifth of the panel."""
    error = round_down(0.25 * wide / factor)
    micrometres = f'{1e6 * error:g} µm'
    scale_bar(axes, factor * error, micrometres, wide)
