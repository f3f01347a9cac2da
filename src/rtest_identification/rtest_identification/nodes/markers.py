"""The picture of section 3.4 as markers: where the nest is, error magnified, average circles."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from rtest_estimation.nodes.publish import header
from rtest_estimation.nodes.publish import point as one_point
from rtest_identification.figures.shapes import Magnified, magnify
from rtest_identification.figures.style import full_levels, level_name, setup_colour, times
from rtest_identification.pipeline import Identification
from rtest_identification.presentation import present

_GREY, _TABLE = '#595959', '#9e9e9e'
# Sizes of what is drawn [m].
_DOT, _LINE, _THICK, _LETTERS = 2.5e-3, 0.4e-3, 1.2e-3, 12e-3


def position_markers(result: Identification, stamp: int) -> MarkerArray:
    """Markers of a session in frame ``machine``; nothing for a machine without a rotary axis.

    Namespaces are `command/SETUP`, `measured/SETUP`, `error/SETUP` (lines from one to the other),
    `average circle/SETUP`, `table` and `magnification`; the ids in them are levels of the stepping
    axis, whose name is in `text`. Deviations from the commanded positions are drawn as many times
    as large as the text of `magnification` says.
    """
    view = present(result)
    # What was drawn before goes first: the factor may have changed.
    markers = [Marker(action=Marker.DELETEALL, header=header(stamp, 'machine'))]
    if view is None:
        return MarkerArray(markers=markers)
    (drawn,) = magnify(view, [view.error()])
    levels = full_levels(view)
    for level in levels:
        text = level_name(view, level)
        markers.append(_marker('table', level, text, Marker.LINE_STRIP, _TABLE, _LINE,
                               drawn.table(level), stamp))
        for cycle, setup in enumerate(view.setups):
            for kind, shape, colour, size, points in _turn(drawn, cycle, level):
                if len(points):
                    markers.append(_marker(f'{kind}/{setup.name}', level, text, shape, colour,
                                           size, points, stamp))
    note = _marker('magnification', 0, f'error {times(drawn.factor)}', Marker.TEXT_VIEW_FACING,
                   _GREY, _LETTERS, np.empty((0, 3)), stamp)
    note.pose.position = one_point(np.array([0.0, 0.0, 1.15 * _top(view.nominal)]))
    return MarkerArray(markers=[*markers, note])


def _turn(
    drawn: Magnified, cycle: int, level: int
) -> list[tuple[str, int, str, float, np.ndarray]]:
    """Kind, shape, colour, size and (n, 3) points of what one turn is drawn with."""
    rows = drawn.view.rows(cycle, level)
    command, measured = drawn.view.nominal[rows], drawn.positions[rows]
    colour = setup_colour(cycle)
    between = np.stack([command, measured], axis=1).reshape(-1, 3)
    circle = drawn.average_circle(cycle, level)
    return [
        ('command', Marker.SPHERE_LIST, _GREY, _DOT, command),
        ('measured', Marker.SPHERE_LIST, colour, _DOT, measured),
        ('error', Marker.LINE_LIST, colour, _LINE, between),
        ('average circle', Marker.LINE_STRIP, colour, _THICK,
         np.empty((0, 3)) if circle is None else circle),
    ]


def _marker(
    namespace: str, number: int, text: str, shape: int, colour: str, size: float,
    points: np.ndarray, stamp: int,
) -> Marker:
    marker = Marker(header=header(stamp, 'machine'), ns=namespace, id=number, type=shape,
                    action=Marker.ADD, text=text)
    marker.pose.orientation.w = 1.0
    marker.scale.x = marker.scale.y = marker.scale.z = size
    red, green, blue = (int(colour[i:i + 2], 16) / 255.0 for i in (1, 3, 5))
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]
    return marker


def _top(points: np.ndarray) -> float:
    return float(np.abs(points).max(initial=0.05))
