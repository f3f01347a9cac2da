"""Figures of a dynamic measurement, after Figs. 5-22 to 5-24."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from rtest_identification.dynamic.motion import COMPONENTS, Motion, Pass
from rtest_identification.dynamic.pipeline import DynamicResult
from rtest_identification.figures.style import COVERAGE, round_down, times

GAUGES, ENCODERS, REST, GEOMETRIC = '#0072B2', '#D55E00', '#CC79A7', '#009E73'
_ZERO = '0.55'
# Figs. 5-23 and 5-24.
MAGNIFICATION = 2500.0
# Errors are drawn within this part of the circle's radius.
_ROOM = 0.6
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 361)
_ORDERS = 8


def magnification(result: DynamicResult) -> float:
    """2,500 times as in the thesis; less where that would leave the picture."""
    shown = np.abs(np.concatenate([result.parts.measured[:, :2], result.parts.servo[:, :2]]))
    room = _ROOM * result.scene.motion.radius
    largest = max(float(shown.max()), 1e-9)
    return MAGNIFICATION if largest * MAGNIFICATION <= room else round_down(room / largest)


def polar(result: DynamicResult, component: int) -> Figure:
    """Trajectory of the sphere by gauges and by encoders, magnified (Figs. 5-23 a, b)."""
    scene, factor = result.scene, magnification(result)
    motion = scene.motion
    signs = sorted({one.sign for one in motion.passes}, reverse=True)
    rows = len(motion.feeds)
    figure = Figure(figsize=(5.2 * len(signs), 5.4 * rows + 0.5), layout='constrained')
    grid = figure.subplots(rows, len(signs), squeeze=False)
    radius = 1e3 * motion.radius
    limit = 0.0
    for feed in range(rows):
        for column, sign in enumerate(signs):
            axes = grid[feed, column]
            axes.plot(radius * np.cos(_CIRCLE), radius * np.sin(_CIRCLE), ':', color='black',
                      linewidth=1.0, label='no displacement', zorder=3)
            chosen = [
                n for n, one in enumerate(motion.passes)
                if one.feed == feed and one.sign == sign
            ]
            for number in chosen:
                mine = scene.of_pass(number)
                angle = scene.machine_angle[mine]
                for values, colour, label in (
                    (result.parts.measured, GAUGES, 'R-test'),
                    (result.parts.servo, ENCODERS, 'feedback'),
                ):
                    # Along the motion, so that behind is inside in both directions.
                    way = sign if component == 1 else 1
                    away = 1e3 * (motion.radius + factor * way * values[mine, component])
                    limit = max(limit, float(away.max()))
                    axes.plot(away * np.cos(angle), away * np.sin(angle), color=colour,
                              linewidth=0.8, label=label if number == chosen[0] else None)
            if chosen:
                _start(axes, scene.machine_angle[scene.of_pass(chosen[0])], radius)
            axes.set_title(_title(motion.passes[chosen[0]], motion) if chosen else '', fontsize=10)
    limit = 1.04 * max(limit, radius)
    first, second = _plane(result)
    scale = _scale(limit, factor)
    for axes in grid.ravel():
        axes.set_aspect('equal')
        axes.set_xlim(-limit, limit)
        axes.set_ylim(-limit, limit)
        axes.set_xlabel(f'{first} [mm]')
        axes.set_ylabel(f'{second} [mm]')
        axes.grid(alpha=0.25)
        width = 1e-3 * scale * factor
        axes.plot([-0.5 * width, 0.5 * width], [0, 0], color='black', linewidth=2.5,
                  solid_capstyle='butt')
        axes.annotate(f'{scale:g} µm', (0.0, 0.0), (0, 4), ha='center', fontsize=9,
                      textcoords='offset points')
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper center', ncols=3, frameon=False,
                  title=f'{COMPONENTS[component]} displacement magnified {times(factor)}')
    return figure


def axial(result: DynamicResult) -> Figure:
    """Axial displacement along the turn (Figs. 5-23 c)."""
    scene = result.scene
    motion = scene.motion
    rows = len(motion.feeds)
    figure = Figure(figsize=(10.0, 2.6 * rows + 0.6), layout='constrained')
    grid = figure.subplots(rows, 1, squeeze=False, sharex=True, sharey=True)[:, 0]
    for number, one in enumerate(motion.passes):
        mine = scene.of_pass(number)
        angle = np.degrees(scene.angle[mine])
        axes = grid[one.feed]
        for values, colour, label in (
            (result.parts.measured, GAUGES, 'R-test'), (result.parts.servo, ENCODERS, 'feedback'),
        ):
            axes.plot(angle, 1e6 * values[mine, 2], color=colour, linewidth=0.8,
                      alpha=1.0 if one.sign > 0 else 0.55,
                      label=f'{label} {"+" if one.sign > 0 else "−"}{motion.axis}')
        axes.set_title(_title(one, motion).rsplit(',', 1)[0], fontsize=10)
    for axes in grid:
        axes.set_ylabel('axial [µm]')
        axes.grid(alpha=0.3)
        axes.axhline(0.0, color=_ZERO, linewidth=0.8)
    grid[-1].set_xlabel(f'{motion.axis} [deg]')
    _degrees(grid[-1], np.degrees(np.ptp(scene.angle)))
    unique = dict(zip(*grid[0].get_legend_handles_labels()[::-1], strict=True))
    figure.legend(unique.values(), unique.keys(), loc='outside upper center', ncols=4,
                  frameon=False)
    return figure


def lag(result: DynamicResult) -> Figure:
    """Constant tangential delay against the feed."""
    motion = result.scene.motion
    figure = Figure(figsize=(7.5, 4.2), layout='constrained')
    axes = figure.subplots()
    speed = 6e4 * motion.feeds * motion.radius
    for name, label, colour, marker in (
        ('gauges', 'R-test', GAUGES, 'o'), ('encoders', 'feedback', ENCODERS, 's'),
    ):
        pairs = np.array([getattr(one, name) for one in result.lags])
        good = np.isfinite(pairs[:, 1])
        axes.errorbar(speed[good], 1e6 * pairs[good, 0], 1e6 * COVERAGE * pairs[good, 1],
                      fmt=f'{marker}-', color=colour, capsize=4, label=label, markersize=6,
                      linewidth=0.8)
        for x, y in zip(speed[good], 1e6 * pairs[good, 0], strict=True):
            axes.annotate(f'{round(float(y), 2) + 0.0:.2f}', (x, y), (8, 4), fontsize=9,
                          textcoords='offset points', color=colour)
    axes.axhline(0.0, color=_ZERO, linewidth=0.8)
    axes.set_xscale('log')
    axes.set_xlim(0.6 * speed[0], 1.8 * speed[-1])
    axes.margins(y=0.18)
    axes.minorticks_off()
    axes.set_xticks(speed, [
        f'{path:,.0f}\n({np.degrees(turn) * 60.0:,.0f} deg/min)'
        for path, turn in zip(speed, motion.feeds, strict=True)
    ])
    axes.set_xlabel('path feed of the linear axes [mm/min]')
    axes.set_ylabel('sphere behind the nest [µm]')
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9)
    return figure


def start(result: DynamicResult) -> Figure:
    """How each motion starts: tangential deviation from the steady mean."""
    motion = result.scene.motion
    shown = result.transients
    columns = 2 if len(shown) > 1 else 1
    rows = -(-len(shown) // columns)
    figure = Figure(figsize=(5.6 * columns, 2.6 * rows + 0.5), layout='constrained')
    grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axes, one in zip(grid.ravel(), shown, strict=False):
        axes.plot(1e3 * one.time, 1e6 * one.gauges, color=GAUGES, linewidth=0.9, label='R-test')
        axes.plot(1e3 * one.time, 1e6 * one.encoders, color=ENCODERS, linewidth=1.2,
                  label='feedback')
        word = 'reversal' if one.reverses else 'start'
        axes.set_title(f'{_minus(motion.passes[one.number].label)}: {word}', fontsize=10)
        axes.grid(alpha=0.3)
    for axes in grid.ravel()[len(shown) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel('tangential [µm]')
    for axes in grid[-1]:
        axes.set_xlabel('time since the start [ms]')
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc='outside upper center', ncols=2,
                  frameon=False)
    return figure


def parts(result: DynamicResult) -> Figure:
    """The split of every component: servo, geometric, dynamic rest, and what stays of it."""
    scene = result.scene
    motion, split = scene.motion, result.parts
    rows = len(motion.feeds)
    figure = Figure(figsize=(13.0, 2.7 * rows + 0.7), layout='constrained')
    grid = figure.subplots(rows, 3, squeeze=False, sharex=True, sharey=True)
    for number, one in enumerate(motion.passes):
        mine = scene.of_pass(number)
        mine = mine[scene.steady[mine]]
        angle = np.degrees(scene.angle[mine])
        faint = 1.0 if one.sign > 0 else 0.55
        for component in range(3):
            axes = grid[one.feed, component]
            for values, colour, label in (
                (split.geometric, GEOMETRIC, 'geometric'), (split.servo, ENCODERS, 'servo'),
                (split.dynamic, REST, 'dynamic rest'),
                (split.dynamic - split.explained, '0.25', 'left after the named effects'),
            ):
                axes.plot(angle, 1e6 * values[mine, component], color=colour, linewidth=0.9,
                          alpha=faint, label=label if number == 0 else None)
            if component == 0:
                axes.set_ylabel(f'{np.degrees(one.speed) * 60:,.0f} deg/min\n[µm]')
    for component, word in enumerate(COMPONENTS):
        grid[0, component].set_title(word, fontsize=10)
        grid[-1, component].set_xlabel(f'{motion.axis} [deg]')
    for axes in grid.ravel():
        axes.grid(alpha=0.3)
        _degrees(axes, np.degrees(np.ptp(scene.angle)))
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc='outside upper center', ncols=4,
                  frameon=False)
    return figure


def harmonics(result: DynamicResult) -> Figure:
    """Amplitudes of the synchronous error motion, gauges and encoders, by pass."""
    motion = result.scene.motion
    figure = Figure(figsize=(13.0, 3.6), layout='constrained')
    grid = figure.subplots(1, 3, sharey=True)
    count = max(len(result.measured), 1)
    width = 0.8 / count
    orders = np.arange(_ORDERS + 1)
    for place, (turn, servo) in enumerate(zip(result.measured, result.servo, strict=True)):
        one = motion.passes[turn.number]
        shift = orders + (place - 0.5 * (count - 1)) * width
        shade = 0.35 + 0.65 * (one.feed + 1) / len(motion.feeds)
        for component, axes in enumerate(grid):
            axes.bar(shift, 1e6 * turn.harmonics[: _ORDERS + 1, component], 0.9 * width,
                     color=GAUGES if one.sign > 0 else '#56B4E9', alpha=shade,
                     label=f'R-test {_minus(one.label)}')
            axes.plot(shift, 1e6 * servo.harmonics[: _ORDERS + 1, component], '_',
                      color=ENCODERS, markersize=7, markeredgewidth=2,
                      label='feedback' if place == 0 else None)
    for component, (axes, word) in enumerate(zip(grid, COMPONENTS, strict=True)):
        axes.set_title(word, fontsize=10)
        axes.set_xlabel('times a turn (0: size of the mean)')
        axes.set_xticks(orders)
        axes.grid(alpha=0.3, axis='y')
        if component == 0:
            axes.set_ylabel('amplitude [µm]')
    figure.legend(*grid[0].get_legend_handles_labels(), loc='outside upper center', ncols=5,
                  frameon=False)
    return figure


def _start(axes: Axes, angle: np.ndarray, radius: float) -> None:
    """Where the motion starts, and which way it goes."""
    first = angle[0]
    way = np.sign(np.sin(angle[min(8, len(angle) - 1)] - first)) or 1.0
    place = radius * np.array([np.cos(first), np.sin(first)])
    axes.plot(*place, 'ko', markersize=5)
    axes.annotate('start', 0.62 * place, ha='center', va='center', fontsize=9)
    turn = first + way * np.radians([4.0, 34.0])
    points = 0.78 * radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    axes.annotate('', points[1], points[0], arrowprops={
        'arrowstyle': '->', 'connectionstyle': f'arc3,rad={0.13 * way}', 'linewidth': 1.4,
    })


def _degrees(axes: Axes, span: float) -> None:
    """Ticks at parts of a turn. span : of the angles shown [deg]."""
    step = next((s for s in (30, 45, 90, 180) if span / s <= 8), 360)
    axes.xaxis.set_major_locator(MultipleLocator(step))


def _minus(text: str) -> str:
    return text.replace('-', '−')


def _title(one: Pass, motion: Motion) -> str:
    path = 6e4 * one.speed * motion.radius
    way = '+' if one.sign > 0 else '−'
    return f'{one.label[:-2]} ({path:,.0f} mm/min), {motion.axis}{way}'


def _plane(result: DynamicResult) -> tuple[str, str]:
    """Names of the two machine directions across the rotary axis."""
    motion = result.scene.motion
    along = int(np.argmax(np.abs(motion.machine.axes[motion.axis].direction)))
    return 'XYZ'[(along + 1) % 3], 'XYZ'[(along + 2) % 3]


def _scale(limit: float, factor: float) -> float:
    """Length of the scale bar [µm] for a plot to `limit` [mm]."""
    return round_down(0.35 * limit * 1e3 / factor)
