"""Figures of a thermal session (Figs. 4-4 to 4-7), one function a figure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from rtest_identification.figures.style import COVERAGE, SETUP_COLOURS, SETUP_MARKERS
from rtest_identification.thermal.pipeline import History, Thermal
from rtest_identification.thermal.series import SIGNIFICANCE
from rtest_identification.thermal.words import HOURS, unit

# Without the yellow end, which white paper swallows.
_COLOURS = ListedColormap(colormaps['viridis'](np.linspace(0.0, 0.9, 256)))
_SENSOR_STYLES = ('-', '--', ':', '-.')
_WIDTH = 9.0


class _Time:
    """Axis of time: hours, or minutes in a short session."""

    def __init__(self, result: Thermal) -> None:
        long = result.time[-1] - result.time[0] >= HOURS
        self._scale, self.unit = (3600.0, 'h') if long else (60.0, 'min')

    def __call__(self, seconds: np.ndarray) -> np.ndarray:
        return np.asarray(seconds) / self._scale

    @property
    def label(self) -> str:
        """What stands at the axis."""
        return f'time since the reference cycle [{self.unit}]'


def temperatures(result: Thermal) -> Figure:
    """Change of every sensor since the reference cycle, with the cycles (Fig. 4-4)."""
    figure = Figure(figsize=(_WIDTH, 3.6), layout='constrained')
    axes = figure.subplots()
    time = _Time(result)
    _cycles(axes, result, time)
    origin = result.clock.origin
    for number, one in enumerate(result.thermometers):
        if not len(one):
            continue
        start = float(one.mean(np.array([origin]), result.clock.duration)[0])
        seconds = (one.stamp - origin) * 1e-9
        colour = SETUP_COLOURS[number % len(SETUP_COLOURS)]
        axes.plot(time(seconds), one.celsius - start, color=colour, alpha=0.25, linewidth=0.6)
        stamps = np.linspace(one.stamp[0], one.stamp[-1], 400).astype(np.int64)
        smooth = one.mean(stamps, result.clock.window) - start
        axes.plot(
            time((stamps - origin) * 1e-9), smooth, color=colour, linewidth=1.6,
            linestyle=_SENSOR_STYLES[number // len(SETUP_COLOURS) % len(_SENSOR_STYLES)],
            label=f'{one.sensor} ({start:.1f} °C)',
        )
    axes.axhline(0.0, color='0.6', linewidth=0.8)
    axes.set_xlabel(time.label)
    axes.set_ylabel('temperature change [K]')
    axes.legend(fontsize=8, loc='center left', bbox_to_anchor=(1.005, 0.5))
    axes.grid(alpha=0.3)
    return figure


def drifts(result: Thermal) -> Figure:
    """Change of every error over time, with U and the exponentials of those that drift."""
    groups = _groups(result)
    figure = Figure(figsize=(_WIDTH, 0.6 + 2.5 * len(groups)), layout='constrained')
    panels = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    time = _Time(result)
    gap = float(np.median(np.diff(result.time))) if len(result.time) > 1 else 60.0
    for axes, (title, errors) in zip(panels, groups, strict=True):
        for number, one in enumerate(errors):
            # Side by side, so that bars do not cover each other.
            shift = 0.09 * gap * (number - (len(errors) - 1) / 2.0)
            _drift(axes, one, number, time, shift)
        axes.axhline(0.0, color='0.6', linewidth=0.8)
        axes.set_title(title, fontsize=9, loc='left')
        axes.set_ylabel(f'change [{unit(errors[0].parameter)}]', fontsize=8)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7.5, loc='center left', bbox_to_anchor=(1.005, 0.5))
    panels[-1].set_xlabel(time.label)
    return figure


def _drift(axes: Axes, one: History, number: int, time: _Time, shift: float) -> None:
    colour = SETUP_COLOURS[number % len(SETUP_COLOURS)]
    series, moves = one.series, one.drift.significant
    known = series.known
    axes.errorbar(
        time(series.time[known] + shift), 1e6 * series.value[known],
        1e6 * COVERAGE * series.stddev[known], color=colour, capsize=2, elinewidth=0.9,
        marker=SETUP_MARKERS[number % len(SETUP_MARKERS)], markersize=4.5,
        fillstyle='full' if moves else 'none', linestyle='none', alpha=1.0 if moves else 0.55,
        label=f'{one.parameter.symbol}{", drifts" if moves else ""}',
    )
    for constant in one.constants:
        fine = np.linspace(constant.start, constant.phase.end, 200)
        axes.plot(
            time(fine + shift), 1e6 * constant.curve(fine), color=colour, linewidth=1.2,
            linestyle='--' if constant.undetermined else '-',
        )


def _groups(result: Thermal) -> list[tuple[str, list[History]]]:
    """Errors that go into one panel: displacements, rotations, squareness."""
    rotary = set(result.machine.rotary)
    found = [
        ('Location: displacements', [e for e in result.errors if e.parameter.axis in rotary
                                     and not e.parameter.angular]),
        ('Location: rotations', [e for e in result.errors if e.parameter.axis in rotary
                                 and e.parameter.angular]),
        ('Squareness of the linear axes', [e for e in result.errors
                                           if e.parameter.axis not in rotary]),
    ]
    return [(title, errors) for title, errors in found if errors]


def over_stations(result: Thermal) -> Figure:
    """Change of the outer axis's errors at its stations, a line a cycle (Fig. 4-7)."""
    found = result.map
    figure = Figure(figsize=(_WIDTH, 6.2), layout='constrained')
    panels = figure.subplots(2, 3, sharey='row')
    time = _Time(result)
    hours = time(result.time)
    norm = Normalize(float(hours.min()), float(max(hours.max(), hours.min() + 1e-9)))
    stations = np.degrees(found.levels)
    for number, (axes, p) in enumerate(zip(panels.flat, found.parameters, strict=True)):
        for cycle, values in enumerate(found.total[:, number]):
            if np.isfinite(values).all() and cycle != result.place:
                axes.plot(
                    stations, 1e6 * values, '.-', color=_COLOURS(norm(hours[cycle])),
                    linewidth=1.0, markersize=5,
                )
        spread = found.total_stddev[:, number]
        typical = spread[np.isfinite(spread).all(axis=1) & (spread.max(axis=1) > 0.0)]
        if len(typical):
            band = 1e6 * COVERAGE * np.median(typical, axis=0)
            axes.fill_between(stations, -band, band, color='0.87', linewidth=0, zorder=0)
        axes.axhline(0.0, color='0.6', linewidth=0.8)
        way = f'about {"XYZ"["ABC".index(p.letter)]}' if p.angular else f'along {p.letter}'
        more = f', changes with {found.axis}' if found.probability[number] < SIGNIFICANCE else ''
        axes.set_title(f'({"abcdef"[number]}) {way}{more}', fontsize=9, loc='left')
        axes.grid(alpha=0.3)
        if number % 3 == 0:
            axes.set_ylabel(f'change [{unit(p)}]', fontsize=8)
        if number > 2:
            axes.set_xlabel(f'{found.axis} [deg]')
        if len(stations) <= 9:
            axes.set_xticks(np.round(stations, 1))
    figure.colorbar(
        ScalarMappable(norm, _COLOURS), ax=panels, location='bottom', fraction=0.03, aspect=50,
        label=time.label,
    )
    return figure


def against_temperature(result: Thermal) -> Figure | None:
    """Every error that drifts against the sensor that explains it best; None without any."""
    errors = [one for one in result.drifting if one.best is not None][:6]
    if not errors:
        return None
    columns = min(3, len(errors))
    rows = -(-len(errors) // columns)
    figure = Figure(figsize=(_WIDTH, 0.7 + 3.0 * rows), layout='constrained')
    panels = figure.subplots(rows, columns, squeeze=False)
    time = _Time(result)
    hours = time(result.time)
    norm = Normalize(float(hours.min()), float(max(hours.max(), hours.min() + 1e-9)))
    for axes in panels.flat[len(errors) :]:
        axes.set_visible(False)
    for axes, one in zip(panels.flat, errors, strict=False):
        _against(axes, result, one, _COLOURS(norm(hours)))
    figure.colorbar(
        ScalarMappable(norm, _COLOURS), ax=panels, location='bottom', fraction=0.03, aspect=50,
        label=time.label,
    )
    return figure


def _against(axes: Axes, result: Thermal, one: History, colours: Sequence) -> None:
    (chosen,) = (d for d in one.dependence if d.sensor == one.best.sensor)
    (sensor,) = (t for t in result.thermometers if t.sensor == chosen.sensor)
    asked = result.stamp - round(chosen.delay * 1e9)
    celsius = sensor.mean(asked, result.clock.window)
    celsius = celsius - celsius[result.place]
    value, stddev = 1e6 * one.series.value, 1e6 * COVERAGE * one.series.stddev
    known = one.series.known & np.isfinite(celsius)
    axes.plot(celsius[known], value[known], color='0.7', linewidth=0.8, zorder=1)
    for n in np.flatnonzero(known):
        axes.errorbar(
            celsius[n], value[n], stddev[n], color=colours[n], marker='o', markersize=4.5,
            capsize=2, elinewidth=0.9, zorder=2,
        )
    weight = 1.0 / one.series.scatter[known] ** 2
    slope = 1e6 * chosen.delayed_sensitivity
    level = float(weight @ (value[known] - slope * celsius[known]) / weight.sum())
    ends = np.array([celsius[known].min(), celsius[known].max()])
    axes.plot(ends, level + slope * ends, color='black', linewidth=1.0, linestyle='--', zorder=1)
    before = f', {chosen.delay / 60.0:.0f} min before' if chosen.delay > 0.0 else ''
    axes.set_xlabel(f'{chosen.sensor}{before}: change [K]', fontsize=8)
    axes.set_ylabel(f'change [{unit(one.parameter)}]', fontsize=8)
    per = 2e6 * chosen.delayed_stddev
    axes.set_title(
        f'{one.parameter.symbol}: {slope:+.2f} ± {per:.2f} {unit(one.parameter)}/K', fontsize=9,
        loc='left',
    )
    axes.grid(alpha=0.3)


def _cycles(axes: Axes, result: Thermal, time: _Time) -> None:
    """The cycles as grey bars."""
    half = 0.5 * result.clock.duration
    for number, middle in enumerate(result.time):
        left, right = time(middle - half), time(middle + half)
        axes.axvspan(left, right, color='0.88', zorder=0, label='cycles' if not number else None)
