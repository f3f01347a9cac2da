"""Figures of laser nests: a scanned sphere (Figs. 5-4, 5-15) and verified centres (Fig. 5-16)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from rtest_estimation.laser import CentreStatus
from rtest_estimation.laser.correction import THESIS
from rtest_estimation.laser.profile import TOLERANCE
from rtest_identification.figures.style import COLOURS, magnification, times
from rtest_identification.laser.output import kernel_name
from rtest_identification.laser.recorded import LaserResult, NestCheck, Scan

_MM, _UM = 1e3, 1e6
_AREAS = ('-', '--', ':')
# Room for the longest error arrow in the verified cube, as a share of its edge.
_ROOM = 0.2
# The distances that are drawn [µm].
_SHOWN = 0.1


def scan_figure(scan: Scan, result: LaserResult) -> Figure:
    """One scan: the raw profile, its error over the sphere, and along and across the lines."""
    profile = scan.profile
    figure = Figure(figsize=(10.5, 8.6), layout='constrained')
    (raw, area), (along, across) = figure.subplots(2, 2)
    place, lost = (scan.place - profile.top) * _MM, ~scan.valid
    raw.plot(place[scan.valid, 0], scan.reading[scan.valid] * _UM, '.', markersize=1.5,
             color=COLOURS[0])
    raw.set(title='Reading along the lines', ylabel='reading [µm]')
    limit = np.nanpercentile(np.abs(profile.error), 99.5) * _UM
    drawn = area.scatter(*place[scan.valid].T, c=profile.error[scan.valid] * _UM, s=3,
                         cmap='RdBu_r', vmin=-limit, vmax=limit)
    figure.colorbar(drawn, ax=area, label='profile error [µm]')
    if lost.any():
        area.plot(*place[lost].T, 'x', color='0.6', markersize=2, label='area 4: no signal')
    for radius, style, name in _areas(scan):
        area.add_patch(Circle((0.0, 0.0), radius * _MM, fill=False, linestyle=style))
        area.plot([], [], color='black', linestyle=style, label=name)
    area.set(title='Error over the sphere, best-fit sphere removed', aspect='equal',
             ylabel='across the lines, from the top [mm]')
    for axes, column, name in ((along, 0, 'along'), (across, 1, 'across')):
        _superimposed(axes, scan, place[:, column], limit)
        axes.set(title=f'Error {name} the lines, all lines superimposed',
                 ylabel='profile error [µm]')
    for axes, name in ((raw, 'along'), (area, 'along'), (along, 'along'), (across, 'across')):
        axes.set_xlabel(f'{name} the lines, from the top [mm]')
        axes.grid(alpha=0.3)
    (marks, names), more = area.get_legend_handles_labels(), along.get_legend_handles_labels()
    figure.legend(marks + more[0], names + more[1], loc='outside lower center', ncols=3,
                  fontsize=9, markerscale=4)
    figure.suptitle(
        f'{result.session}, {scan.cycle}: laser {scan.laser} on a sphere of '
        f'{result.sphere_radius * _MM:g} mm radius; noise level {profile.noise * _UM:.2f} µm (1σ)'
    )
    return figure


def _areas(scan: Scan) -> list[tuple[float, str, str]]:
    """Radius, line and name of areas 1 to 3."""
    profile, limit = scan.profile, f'{TOLERANCE * _UM:g} µm'
    end = 'signal everywhere' if profile.bounded else 'signal to the end of the scan'
    radii = (profile.flat, profile.accurate, profile.measurable)
    names = (f'reading within {limit}', f'error within {limit}', end)
    return [
        (radius, style, f'area {number}: {name}, ±{radius * _MM:.2f} mm')
        for number, (radius, style, name) in enumerate(zip(radii, _AREAS, names, strict=True), 1)
    ]


def _superimposed(axes: Axes, scan: Scan, place: np.ndarray, limit: float) -> None:
    profile, valid = scan.profile, scan.valid
    axes.plot(place[valid], profile.error[valid] * _UM, '.', markersize=1.5, color='0.7',
              label='error of each reading')
    axes.plot(place[valid], profile.smooth[valid] * _UM, '.', markersize=1.5, color=COLOURS[1],
              label='its smooth part: inclination')
    for radius, style, _ in _areas(scan):
        for sign in (-1, 1):
            axes.axvline(sign * radius * _MM, linestyle=style, color='black', linewidth=0.8)
    axes.set_ylim(-1.3 * limit, 1.3 * limit)


def verification_figure(check: NestCheck, result: LaserResult) -> Figure:
    """Errors at the verification points: their distribution, and as arrows in the cube."""
    verification = check.verification
    valid = verification.status == CentreStatus.VALID
    figure = Figure(figsize=(13.0, 5.0), layout='constrained')
    spread, raw, corrected = figure.subplots(1, 3)
    curves = [
        ('contact algorithm (Eq. 2-6)', check.contact_error, '0.6'),
        ('lasers, Eq. 5-4, not corrected', verification.raw_error, COLOURS[1]),
        (f'corrected, {kernel_name(check.chosen)}', verification.error, COLOURS[0]),
    ]
    for name, error, colour in curves:
        distance = np.sort(np.linalg.norm(error[valid], axis=1)) * _UM
        share = np.arange(1, len(distance) + 1) / len(distance) * 100.0
        spread.plot(distance, share, color=colour, label=f'{name}: mean {distance.mean():.2f} µm')
    thesis = next((k.verified for k in check.kernels if k.kernel == THESIS), None)
    if thesis is not None:
        spread.axvline(thesis.mean * _UM, color='black', linestyle=':', linewidth=1.0,
                       label=f"mean with the thesis's kernel: {thesis.mean * _UM:.2f} µm")
    spread.set(xscale='log', xlim=(_SHOWN, None), ylim=(0, 100),
               xlabel='distance from the position by the encoders [µm]',
               ylabel='share of the points [%]',
               title=f'{int(valid.sum()):,} of {len(valid):,} points in the calibrated volume')
    spread.legend(fontsize=8, loc='upper center', bbox_to_anchor=(0.5, -0.16))
    spread.grid(alpha=0.3, which='both')
    middle = valid & (np.abs(check.positions[:, 2]) < 1e-5)
    place = check.positions[middle]
    room = _ROOM * float(np.ptp(check.positions, axis=0).max())
    for axes, error, colour, name in (
        (raw, verification.raw_error, COLOURS[1], 'Not corrected'),
        (corrected, verification.error, COLOURS[0], 'Corrected'),
    ):
        factor = magnification([error[middle]], room)
        shift = factor * error[middle]
        axes.plot(*place[:, :2].T * _MM, '.', color='0.6', markersize=3)
        axes.quiver(*place[:, :2].T * _MM, *shift[:, :2].T * _MM, angles='xy',
                    scale_units='xy', scale=1.0, color=colour, width=0.004)
        axes.set(title=f'{name}: error at Z = 0, {times(factor)}', aspect='equal',
                 xlabel='X [mm]', ylabel='Y [mm]')
        axes.grid(alpha=0.3)
    figure.suptitle(f'{result.session}, nest {check.nest.setup}: centres at known positions')
    return figure
