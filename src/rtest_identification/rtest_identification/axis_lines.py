"""Direction of the turning axis at every level: average circles, lines of centres (3.5 a, b)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_identification.circles import Centre, Circle, fit_centre, fit_circle
from rtest_identification.presentation import Presentation, Setup

# Centres nearer to each other along the axis than this give no direction [m].
SHORTEST_LINE = 5e-3


@dataclass(frozen=True)
class Tilts:
    """Direction of the turning axis at every level, as rotations from the nominal one.

    name : of the set-up or set-ups it comes from
    value : (s, 2) about the two axes across it [rad]; NaN where it could not be found
    cofactor : (s, 2, 2) covariance over the variance of a coordinate [1/m2]
    """

    name: str
    value: np.ndarray
    cofactor: np.ndarray

    def stddev(self, variance: float) -> np.ndarray:
        """(s, 2) standard uncertainties at the variance of a coordinate [m2]."""
        return np.sqrt(variance * np.diagonal(self.cofactor, axis1=1, axis2=2))


@dataclass(frozen=True)
class AxisLines:
    """What circles and centres say about the turning axis.

    letters : rotations of the two tilts, about the axes of the level's frame (the B frame)
    circles : by cycle and level; centres : the same, of set-ups on the axis
    across : of each outer set-up, against the axes across (Fig. 3-12a)
    along : through centres at different heights, against the axis along (Fig. 3-12b); or None
    variance : of a coordinate of a point, from the scatter about circles and centres [m2]
    notes : sentences about what was left out or stands in for something
    """

    letters: tuple[str, str]
    circles: dict[tuple[int, int], Circle]
    centres: dict[tuple[int, int], Centre]
    across: tuple[Tilts, ...]
    along: Tilts | None
    variance: float
    freedom: int
    notes: tuple[str, ...]


def axis_lines(view: Presentation, error: np.ndarray) -> AxisLines:
    """Fit circles and centres to the positions with these (n, 3) errors, and their directions."""
    circles: dict[tuple[int, int], Circle] = {}
    centres: dict[tuple[int, int], Centre] = {}
    notes = []
    for cycle, setup in enumerate(view.setups):
        for level, station in enumerate(view.levels):
            rows = view.rows(cycle, level)
            if not len(rows):
                continue
            frame = view.frame(level)
            try:
                if setup.outer:
                    circles[cycle, level] = fit_circle(
                        (view.nominal + error)[rows], view.normal(level)
                    )
                else:
                    centres[cycle, level] = fit_centre(
                        error[rows] @ frame, view.angle[rows], view.direction
                    )
            except ValueError as problem:
                at = f' at {view.stepping} = {np.degrees(station):.4g}°' if view.stepping else ''
                notes.append(f'{setup.name}{at} is left out: {problem}.')
    across = tuple(
        _across(view, setup.name, {n: f for (c, n), f in circles.items() if c == cycle})
        for cycle, setup in enumerate(view.setups)
        if setup.outer
    )
    along, note = _along(view, circles, centres)
    pieces = [*circles.values(), *centres.values()]
    squares, freedom = sum(p.squares for p in pieces), sum(p.freedom for p in pieces)
    return AxisLines(
        across_letters(view), circles, centres, across, along,
        squares / freedom if freedom else float('nan'), freedom, (*notes, *note),
    )


def across_letters(view: Presentation) -> tuple[str, str]:
    """Rotations about the two axes of the machine that are most across the turning axis."""
    first, second = _axes_across(view)
    return 'ABC'[first], 'ABC'[second]


def tilt_gain(view: Presentation, level: int) -> np.ndarray:
    """(2, 3) from a change of direction, machine frame, to tilts about the level's axes."""
    frame, normal = view.frame(level), view.normal(level)
    # The rotation is n x dn; its part along an axis e is dn . (e x n).
    return np.array([np.cross(frame[:, axis], normal) for axis in _axes_across(view)])


def _axes_across(view: Presentation) -> tuple[int, int]:
    order = np.argsort(np.abs(view.direction), kind='stable')
    first, second = sorted(order[:2].tolist())
    return first, second


def _across(view: Presentation, name: str, circles: dict[int, Circle]) -> Tilts:
    tilts = _nothing(name, len(view.levels))
    for level, circle in circles.items():
        gain = tilt_gain(view, level)
        tilts.value[level] = gain @ (circle.normal - view.normal(level))
        tilts.cofactor[level] = gain @ circle.cofactor[3:6, 3:6] @ gain.T
    return tilts


def _along(
    view: Presentation,
    circles: dict[tuple[int, int], Circle],
    centres: dict[tuple[int, int], Centre],
) -> tuple[Tilts | None, list[str]]:
    """Tilt of the line through centres, by least squares where there are more than two."""
    used, notes = [c for c, setup in enumerate(view.setups) if not setup.outer], []
    if _span(view.setups[c] for c in used) < SHORTEST_LINE:
        used = list(range(len(view.setups)))
        if _span(view.setups) < SHORTEST_LINE:
            return None, [
                'No two set-ups have their spheres at different heights: the direction of '
                f'{view.turning} against the motion along it cannot be seen.'
            ]
        notes.append(
            'There are no two set-ups with the sphere on the axis at different heights. Centres '
            'of average circles stand in for them; there, error motions of the linear axes along '
            'the circle take part.'
        )
    tilts = _nothing(' – '.join(view.setups[c].name for c in used), len(view.levels))
    for level in range(len(view.levels)):
        found = []
        for c in used:
            height = view.setups[c].height
            if (c, level) in circles:
                circle = circles[c, level]
                nominal = height * view.normal(level)
                found.append((height, circle.centre - nominal, circle.cofactor[:3, :3]))
            elif (c, level) in centres:
                centre, frame = centres[c, level], view.frame(level)
                cofactor = frame @ centre.cofactor @ frame.T
                found.append((height, frame @ centre.displacement, cofactor))
        heights = np.array([f[0] for f in found])
        if len(found) < 2 or np.ptp(heights) < SHORTEST_LINE:
            continue
        weight = heights - heights.mean()
        weight /= (weight**2).sum()
        gain = tilt_gain(view, level)
        tilts.value[level] = gain @ sum(w * f[1] for w, f in zip(weight, found, strict=True))
        total = sum(w**2 * f[2] for w, f in zip(weight, found, strict=True))
        tilts.cofactor[level] = gain @ total @ gain.T
    return tilts, notes


def _nothing(name: str, count: int) -> Tilts:
    return Tilts(name, np.full((count, 2), np.nan), np.full((count, 2, 2), np.nan))


def _span(setups: Sequence[Setup]) -> float:
    heights = [s.height for s in setups]
    return max(heights) - min(heights) if len(heights) > 1 else 0.0
