"""What the pictures of the nest's positions are made of, true to scale or magnified."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_identification.axis_lines import AxisLines, axis_lines
from rtest_identification.circles import Circle
from rtest_identification.figures.style import magnification
from rtest_identification.presentation import Presentation

# Part of the sphere's distance from the axis that the largest error is drawn with.
_SHARE = 0.4
# A gap between stations that is wider than this is not bridged by the circles drawn.
_WIDEST_GAP = np.radians(100.0)
_ROUND = np.radians(np.arange(0.0, 361.0, 5.0))


@dataclass(frozen=True)
class Magnified:
    """Positions with one kind of error, drawn `factor` times as large.

    view : where the nominal positions are; error : (n, 3) [m]; lines : circles and centres of it
    """

    view: Presentation
    error: np.ndarray
    lines: AxisLines
    factor: float

    @property
    def positions(self) -> np.ndarray:
        """(n, 3) where the measured positions are drawn [m]."""
        return self.view.nominal + self.factor * self.error

    def command_circle(self, cycle: int, level: int) -> np.ndarray:
        """(m, 3) nominal circle of a set-up [m]."""
        view = self.view
        return view.setups[cycle].height * view.normal(level) + self._around(cycle, level)

    def average_circle(self, cycle: int, level: int) -> np.ndarray | None:
        """(m, 3) average circle, its deviation from the nominal one magnified; None without."""
        circle = self.lines.circles.get((cycle, level))
        if circle is None:
            return None
        nominal = self.command_circle(cycle, level)
        arm = self._around(cycle, level)
        return nominal + self.factor * (_on(circle, arm) - nominal)

    def centre(self, cycle: int, level: int) -> np.ndarray | None:
        """(3,) centre of a set-up's turn, its deviation magnified."""
        view = self.view
        nominal = view.setups[cycle].height * view.normal(level)
        if (cycle, level) in self.lines.circles:
            return nominal + self.factor * (self.lines.circles[cycle, level].centre - nominal)
        if (cycle, level) in self.lines.centres:
            found = view.frame(level) @ self.lines.centres[cycle, level].displacement
            return nominal + self.factor * found
        return None

    def table(self, level: int) -> np.ndarray:
        """(m, 3) outline of a round table: where it is and how it is tilted, not its size [m].

        Nothing (0, 3) where it is the head that turns.
        """
        if self.view.seen == 'sphere':
            return np.empty((0, 3))
        setups = self.view.setups
        reach = max((s.radius for s in setups), default=0.0)
        radius = max(1.25 * reach, 0.06)
        height = min(0.0, min(s.height for s in setups) - 0.3 * radius)
        frame = self.view.frame(level)
        u, v = _across(self.view.direction)
        flat = np.cos(_ROUND)[:, None] * u + np.sin(_ROUND)[:, None] * v
        return (radius * flat + height * self.view.direction) @ frame.T

    def _around(self, cycle: int, level: int) -> np.ndarray:
        """Arms from the centre to a circle's points: all around, or the arc that was measured."""
        view = self.view
        u, v = _across(view.direction)
        angles = _ROUND
        rows = view.rows(cycle, level)
        local = view.nominal[rows] @ view.frame(level)
        at = np.sort(np.arctan2(local @ v, local @ u))
        gaps = np.diff([*at, at[0] + 2.0 * np.pi]) if len(at) else np.zeros(1)
        widest = int(gaps.argmax())
        if gaps[widest] > _WIDEST_GAP:
            start = at[(widest + 1) % len(at)]
            angles = np.linspace(start, start + 2.0 * np.pi - gaps[widest], len(_ROUND))
        flat = np.cos(angles)[:, None] * u + np.sin(angles)[:, None] * v
        return view.setups[cycle].radius * flat @ view.frame(level).T


def magnify(
    view: Presentation, errors: list[np.ndarray], outer: bool | None = None
) -> list[Magnified]:
    """The same positions with several kinds of error, all drawn with one factor.

    outer : the factor is chosen for the outer set-ups or for the centre ones alone
    """
    setups = [s for s in view.setups if outer in (None, s.outer)]
    meant = [c for c, s in enumerate(view.setups) if s in setups]
    rows = np.isin(view.cycle, meant)
    room = max((s.radius for s in setups if s.outer), default=0.0)
    if not room:
        heights = [s.height for s in setups]
        room = max(max(heights) - min(heights), 0.05)
    factor = magnification([error[rows] for error in errors], _SHARE * room)
    return [Magnified(view, error, axis_lines(view, error), factor) for error in errors]


def _on(circle: Circle, arms: np.ndarray) -> np.ndarray:
    """Points of a circle in the directions of nominal arms (m, 3)."""
    across = arms - (arms @ circle.normal)[:, None] * circle.normal
    across /= np.linalg.norm(across, axis=1)[:, None]
    return circle.centre + circle.radius * across


def _across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    u = np.cross(np.eye(3)[np.argmin(np.abs(direction))], direction)
    u /= np.linalg.norm(u)
    return u, np.cross(direction, u)
