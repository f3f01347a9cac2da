"""Which figures a report has, in which order, and how to read each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rtest_identification.figures import directions, maps, poses, positions, space
from rtest_identification.figures.shapes import Magnified, magnify
from rtest_identification.figures.style import full_levels, save, times
from rtest_identification.pipeline import Identification
from rtest_identification.presentation import Presentation, present
from rtest_identification.squareness import Separation, separate


@dataclass(frozen=True)
class Picture:
    """One figure: its file (PNG), how to read it, and the script of its turnable form or ''."""

    name: str
    path: Path
    caption: str
    script: str = ''


# Name, figure, caption and script of a picture to the picture.
Draw = Callable[..., Picture]


@dataclass
class Sections:
    """Pictures of a report by section, and sentences about figures that do not apply.

    turning : what makes the circles, 'table' or 'head'
    """

    positions: list[Picture] = field(default_factory=list)
    maps: list[Picture] = field(default_factory=list)
    residuals: list[Picture] = field(default_factory=list)
    squareness: list[Picture] = field(default_factory=list)
    rest: list[Picture] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)
    separation: Separation | None = None
    turning: str = 'table'


def draw(result: Identification, folder: Path) -> Sections:
    """Draw every figure that applies, each as PNG and SVG into `folder`."""
    made = Sections()

    def picture(name: str, figure: Figure, caption: str, script: str = '') -> Picture:
        return Picture(name, save(figure, folder, name)[0], caption, script)

    view = present(result)
    if view is None:
        made.absent.append('The machine has no rotary axis: there are no circles to draw.')
    else:
        made.turning = 'head' if view.seen == 'sphere' else 'table'
        _positions(made, result, view, picture)
    for error_map in result.maps:
        shapes = ''
        if error_map.left_open:
            shapes = (
                ' Not told from constant errors by any R-test at these stations, and therefore '
                f'left out of the map: {"; ".join(error_map.left_open)}.'
            )
        made.maps.append(picture(
            f'error_map_{error_map.axis}', maps.error_map(error_map),
            f'Error map of {error_map.axis}: how its position and orientation change with '
            f'{error_map.axis}, in the frame of the axis that carries it. Left: displacements; '
            'right: rotations. Bands are U (k = 2); what stays within them about zero is not '
            'shown to change. The mean over the stations is zero: it is in the location '
            f'errors.{shapes}',
        ))
    if not result.maps:
        made.absent.append(
            'Error map of the outer rotary axis: it needs three stations of that axis.'
        )
    made.residuals.append(picture(
        'residuals', poses.residuals(result),
        'What the fit leaves at every pose, table frame, in the order measured; above, the '
        'station of the outer rotary axis. Points should fill the space between the dashed lines '
        'without a pattern; steps, waves or trends are effects that the model lacks.',
    ))
    inner = result.inner_map
    if inner is not None:
        outer = result.machine.rotary[0]
        typical = ', '.join(
            f'{p.symbol} {2e6 * float(np.nanmedian(s)):.2f} {"µrad" if p.angular else "µm"}'
            for p, s in zip(inner.parameters, inner.stddev, strict=True) if np.isfinite(s).any()
        )
        made.rest.append(picture(
            f'error_map_{inner.axis}', maps.grid_map(inner, outer),
            f'Error map of {inner.axis}: its six errors against {inner.axis} for every station '
            f'of {outer} (lines by colour with the median U as a grey band about zero; with many '
            'stations colours over both axes, grey where not determined). Their mean over '
            f'{inner.axis} is zero: it belongs to the map of {outer} and to the location errors. '
            f'Median U (k = 2): {typical}. What is alike at all stations of {outer} is a property '
            f'of {inner.axis} alone; what differs changes with {outer}.',
        ))
    made.rest.append(picture(
        'displacements', poses.displacements(result),
        'Raw displacements of the sphere relative to the nest, table frame, pose by pose; above, '
        'the station of the outer rotary axis. Zero is the initial reset. Waves at one station '
        'are offsets and tilts of the axis that turns there, steps between stations those of the '
        'other one. Circles mark poses left out as outliers.',
    ))
    return made


def _positions(
    made: Sections, result: Identification, view: Presentation, picture: Draw
) -> None:
    shown, without = magnify(view, [view.error(), view.error(squareness=False)])
    # The offsets would dwarf everything else: they have a scale of their own.
    raw = magnify(view, [view.error(offsets=True)])[0]
    outer = any(s.outer for s in view.setups)
    count = len(full_levels(view))
    some = ''
    if count > positions.MOST_LEVELS:
        some = f' {positions.MOST_LEVELS} of {count} stations are shown.'
    undetermined = not result.location.determined.all()
    guess = (
        ' Some location errors are not determined by these poses (see the warnings): what they '
        'and the initial reset share is drawn as the smallest possible.' if undetermined else ''
    )
    across, along = (positions.plane_name(p) for p in positions.planes(view))
    scale = f'Errors are magnified {times(shown.factor)}, positions are not'
    what = (
        f'Positions of the {view.seen} relative to the '
        f'{"sphere" if view.seen != "sphere" else "table"}, machine frame. {scale}. Dots: '
        'commanded; markers: measured, joined by lines; coloured discs: average circles. The '
        'initial reset is compensated, and the offsets of the rotary axes (a matter of setting '
        f'up) are removed.{guess}'
    )
    table = ' Grey: where the table is and how it is tilted, not its size.'
    if view.seen == 'sphere':
        table = ''
    made.positions.append(picture(
        'positions_3d', space.picture(shown),
        f'{what}{table} A disc tilted '
        f'against its thin command circle shows {view.turning} out of square with the motions '
        'across it; a wavy edge about a disc shows error motions of the axis.',
        space.turnable(shown, 'turnable'),
    ))
    if outer:
        made.positions.append(picture(
            'positions', positions.projections(shown, outer=True),
            f'The same on the planes {across} (rows 1, 3, ..) and {along}.{some} The bar gives '
            'the scale of the errors. Look from station to station: what tilts or shifts alike '
            'everywhere is constant, what changes is in the error map.',
        ))
        _squareness(made, result, view, without, picture)
        made.rest.append(picture(
            'positions_level_frame',
            positions.level_frame(
                [raw, shown],
                [f'offsets in, {times(raw.factor)}', f'offsets removed, {times(shown.factor)}'],
            ),
            f'The same in the frame that {view.stepping or "the bed"} carries, seen along '
            f'{view.turning}. First with the offsets of the rotary axes in: a shift from station '
            f'to station is mostly an offset of {view.stepping or "the axis"}. Then without '
            f'them: a circle that grows from station to station is a radial or tilt error motion '
            f'of {view.turning} that grows.{some}',
        ))
    else:
        made.absent.append(
            f'Average circles: no set-up has its sphere off the axis of {view.turning}.'
        )
    if any(not s.outer for s in view.setups):
        centred = magnify(view, [view.error()], outer=False)[0]
        line = (
            '; black: line through the centres. Its tilt shows '
            f'{view.turning} out of parallel with the motion along it'
            if sum(not s.outer for s in view.setups) > 1 else ''
        )
        made.rest.append(picture(
            'positions_centre', positions.projections(centred, outer=False),
            f'Set-ups with the sphere on the axis of {view.turning}, planes {across} and '
            f'{along}; errors magnified {times(centred.factor)}. Dots: commanded; markers: '
            f'measured; cross: centre of the turn{line}.{some}',
        ))
    else:
        made.absent.append(
            f'Centre set-ups: no set-up has its sphere on the axis of {view.turning}.'
        )


def _squareness(
    made: Sections,
    result: Identification,
    view: Presentation,
    without: Magnified,
    picture: Draw,
) -> None:
    found = separate(result, view)
    made.separation = found
    if found is None:
        made.absent.append(
            'Separation of squareness: the rotary axes do not turn the table; there are no '
            'circles of the nest to do it with.'
        )
        return
    x, y = ('XYZ'['ABC'.index(letter)] for letter in found.lines.letters)
    made.squareness.append(picture(
        'directions', directions.directions(found, view.turning),
        f'Direction of {view.turning} against {view.stepping or "its nominal one"}, as rotations '
        f'about {x} and {y} of the frame that {view.stepping or "the bed"} carries; bars are U '
        '(k = 2). (a) against the motions across it, from the average circles; (b) against the '
        'motion along it, from the line through the centres; (c) their difference, from which '
        'everything the rotary axes do falls out. Dashed: what constant squareness errors make '
        'of it. Points off the dashed lines by more than their bars: the squareness is not one '
        'number.',
    ))
    across, along = (positions.plane_name(p) for p in positions.planes(view))
    largest = float(np.linalg.norm(view.squareness, axis=1).max()) * 1e6
    made.squareness.append(picture(
        'positions_without_squareness', positions.projections(without, outer=True),
        f'Positions as above, on {across} and {along}, without the squareness errors of the '
        f'linear axes of the least-squares fit (they move a position by up to {largest:.1f} µm); '
        f'errors magnified {times(without.factor)} as above.',
    ))
