"""Figures of the model gap: where it is, and how far it closed."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from rtest_identification.error_map import stations
from rtest_identification.gap.workflow import GapResult
from rtest_identification.kinematics import rotation

_BEFORE, _AFTER, _NOISE = '#D55E00', '#0072B2', '0.6'
_COMPONENTS = ('#0072B2', '#D55E00', '#009E73')
# Factors by which residuals are drawn larger than the machine.
_FACTORS = np.array([1, 2, 5]) * 10.0 ** np.arange(3, 7)[:, None]


def closing(result: GapResult) -> Figure:
    """The gap before and after, of all poses and of held-out ones, against the noise of each."""
    gap = result.gap
    figure = Figure(figsize=(7.5, 3.8), layout='constrained')
    axes = figure.subplots()
    groups = [('all poses', gap.before, gap.after, gap.noise)]
    if np.isfinite(gap.heldout_before):
        groups.append(('poses held out of naming and fitting', gap.heldout_before,
                       gap.heldout_after, gap.heldout_noise))
    for place, (_, before, after, noise) in enumerate(groups):
        bars = []
        for shift, value, colour in ((-0.2, before, _BEFORE), (0.2, after, _AFTER)):
            bars.append(axes.bar(place + shift, value * 1e6, 0.36, color=colour))
            # Above the line where that is just above the bar, so that it can be read.
            axes.annotate(f'{value * 1e6:.2f}', (place + shift, max(value, noise) * 1e6), (0, 2),
                          ha='center', va='bottom', textcoords='offset points')
        line = axes.hlines(noise * 1e6, place - 0.44, place + 0.44, '0.1', '--')
    axes.set_xticks(range(len(groups)), [
        f'{name}\nnoise {noise * 1e6:.2f} µm' for name, _, _, noise in groups
    ])
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_ylim(0.0, 1.25e6 * max(max(values) for _, *values in groups))
    axes.set_ylabel('rms difference [µm]')
    after_label = 'model with the effect' if result.found else 'after'
    figure.legend([*bars, line], ['model before', after_label, 'noise of these poses'],
                  loc='outside upper center', ncols=3, frameon=False)
    return figure


def over_axes(result: GapResult) -> Figure:
    """Residual against both rotary axes, before and after, per set-up and component."""
    scene = result.rows.scene
    observations = scene.observations
    outer, inner = scene.machine.rotary
    (b, at_b), (c, at_c) = (stations(scene.position(axis)) for axis in (outer, inner))
    count = len(observations.cycles)
    figure = Figure(figsize=(12.0, 1.2 + 1.7 * count), layout='constrained')
    grid = figure.subplots(count, 6, sharex=True, sharey=True, squeeze=False)
    both = (result.rows.residual, result.residual)
    limit = 1e6 * max(float(np.percentile(np.abs(values), 98)) for values in both)
    image = None
    for row in range(count):
        mine = observations.cycle == row
        for half, values in enumerate(both):
            for component in range(3):
                axes = grid[row, 3 * half + component]
                total = np.zeros((len(b), len(c)))
                number = np.zeros((len(b), len(c)))
                np.add.at(total, (at_b[mine], at_c[mine]), 1e6 * values[mine, component])
                np.add.at(number, (at_b[mine], at_c[mine]), 1.0)
                mean = np.ma.masked_invalid(
                    np.divide(total, number, out=np.full_like(total, np.nan), where=number > 0)
                )
                image = axes.pcolormesh(
                    np.degrees(c), np.degrees(b), mean, cmap='PuOr', vmin=-limit, vmax=limit,
                    shading='nearest',
                )
                if row == 0:
                    axes.set_title(f'{"XYZ"[component]} {"before" if half == 0 else "after"}',
                                   fontsize=9)
                if 3 * half + component == 0:
                    axes.set_ylabel(f'{observations.cycles[row]}\n{outer} [deg]', fontsize=8)
                if row == count - 1:
                    axes.set_xlabel(f'{inner} [deg]', fontsize=8)
    figure.colorbar(image, ax=grid, label='residual, table frame [µm]', shrink=0.8)
    return figure


def over_time_and_direction(result: GapResult) -> Figure:
    """Residual over time, and its mean by the direction in which each axis arrived."""
    scene = result.rows.scene
    figure = Figure(figsize=(12.0, 4.2), layout='constrained')
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    for number in range(len(scene.observations.cycles)):
        mine = np.flatnonzero(scene.observations.cycle == number)
        mine = mine[np.argsort(scene.time[mine])]
        width = min(max(len(mine) // 10, 5), len(mine))
        for component, colour in enumerate(_COMPONENTS):
            values = 1e6 * result.rows.residual[mine, component]
            left.plot(scene.time[mine], values, '.', color=colour, markersize=3, alpha=0.5)
            mean = np.convolve(values, np.ones(width) / width, 'valid')
            middle = np.convolve(scene.time[mine], np.ones(width) / width, 'valid')
            label = f'{"XYZ"[component]}, running mean' if number == 0 else None
            left.plot(middle, mean, color=colour, label=label)
    left.set_xlabel('time since the start of the session [s]')
    left.set_ylabel('residual before, table frame [µm]')
    left.legend(fontsize=8, loc='upper right')
    left.grid(alpha=0.3)
    letters = scene.machine.letters
    for component, colour in enumerate(_COMPONENTS):
        for sign, marker in ((-1.0, '<'), (1.0, '>')):
            places, means, bars = [], [], []
            for number, axis in enumerate(letters):
                chosen = scene.direction(axis) == sign
                if chosen.sum() > 3:
                    values = 1e6 * result.rows.residual[chosen, component]
                    places.append(number + 0.2 * (component - 1) + 0.05 * sign)
                    means.append(values.mean())
                    bars.append(2.0 * values.std(ddof=1) / np.sqrt(len(values)))
            right.errorbar(places, means, bars, fmt=marker, color=colour, markersize=5,
                           label=f'{"XYZ"[component]}' if sign > 0 else None)
    right.axhline(0.0, color=_NOISE, linewidth=0.8)
    right.set_xticks(range(len(letters)), letters)
    right.set_xlabel('axis; < arrived from above, > from below')
    right.set_ylabel('mean residual ± 2 standard errors [µm]')
    right.legend(fontsize=8)
    right.grid(alpha=0.3)
    return figure


def in_space(result: GapResult) -> Figure:
    """Residual vectors at the sphere's places in the machine, before and after, magnified."""
    scene = result.rows.scene
    machine = scene.machine
    place = np.stack([scene.position(axis) for axis in machine.linear], axis=1) * 1e3
    size = max(float(np.percentile(np.abs(result.rows.residual), 98)), 1e-9)
    wanted = 0.12 * float(np.ptp(place, axis=0).max()) * 1e-3 / size
    factor = float(_FACTORS.ravel()[np.argmin(np.abs(np.log(_FACTORS.ravel() / wanted)))])
    figure = Figure(figsize=(11.0, 5.2), layout='constrained')
    for number, (name, values, colour) in enumerate((
        ('before', result.rows.residual, _BEFORE), ('after', result.residual, _AFTER),
    )):
        axes = figure.add_subplot(1, 2, number + 1, projection='3d')
        arrows = 1e3 * factor * _in_machine(result, values)
        axes.quiver(*place.T, *arrows.T, color=colour, linewidth=0.7, arrow_length_ratio=0.25)
        axes.set_title(f'{name}, magnified {factor:,.0f} times', fontsize=10)
        for setter, axis in zip(
            (axes.set_xlabel, axes.set_ylabel, axes.set_zlabel), machine.linear, strict=True
        ):
            setter(f'{axis} [mm]')
        axes.set_box_aspect(np.maximum(np.ptp(place, axis=0), 20.0), zoom=0.85)
    return figure


def _in_machine(result: GapResult, values: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of the table frame as the machine frame sees them."""
    scene = result.rows.scene
    for axis in reversed(scene.machine.table_side):
        one = scene.machine.axes[axis]
        if one.rotary:
            turn = rotation(one.direction, one.sense * scene.position(axis))
            values = np.einsum('nij,nj->ni', turn, values)
    return values
