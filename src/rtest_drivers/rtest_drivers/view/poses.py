"""The cycle as a map of poses: which are measured, which are missing and why."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rtest_estimation.records import Cycle, CyclePlan, Kind
from rtest_identification.machine import Machine

OPEN, REACHED, DONE, MISSING = 'open', 'reached', 'done', 'missing'
KINDS = {
    Kind.STATIC: 'static cycle',
    Kind.DYNAMIC: 'dynamic cycle',
    Kind.NEST_CALIBRATION: 'nest calibration',
    Kind.SPINDLE_RUNOUT: 'sphere run-out',
}


class PoseMap:
    """One cycle: poses are reached in the order of the plan; its end says which were measured."""

    def __init__(self, plan: CyclePlan, machine: Machine | None) -> None:
        self.plan = plan
        self.finished = False
        self._ended: int | None = None
        self._reached = 0
        self._missing: dict[int, str] = {}
        self._done: frozenset[int] = frozenset()
        self._cells = _cells(plan, machine)

    @property
    def key(self) -> tuple[str, int]:
        """Name and start [ns]: an attempt of a cycle."""
        return self.plan.cycle, self.plan.stamp

    def reach(self, poses: int) -> bool:
        """So many poses were reached; returns whether that is news."""
        news = poses != self._reached and not self.finished
        self._reached = poses if news else self._reached
        return news

    def finish(self, cycle: Cycle) -> None:
        """The finished cycle says which poses were measured and which were not."""
        self.finished, self._ended = True, cycle.stamp
        self._done = frozenset(point.index for point in cycle.points)
        self._missing = {
            item.index: self._missing.get(item.index) or 'missing' for item in cycle.missing
        }

    def explain(self, reasons: dict[int, str]) -> None:
        """Reasons of missing poses; they may come before or after the cycle itself."""
        self._missing.update(reasons)

    def shown(self) -> dict[str, Any]:
        """For the page: cells with state and words, and how they are laid out."""
        rows, columns, places, names = self._cells
        states = [self._state(index) for index in range(len(places))]
        return {
            'cycle': self.plan.cycle,
            'kind': KINDS[self.plan.kind],
            'setup': self.plan.setup,
            'finished': self.finished,
            # As text: a number of JavaScript has not so many digits.
            'ended': str(self._ended),
            'rows': rows,
            'columns': columns,
            'places': places,
            'names': names,
            'states': states,
            'reasons': {str(index): text for index, text in sorted(self._missing.items())},
            'reached': states.count(REACHED),
            'done': states.count(DONE),
            'missing': states.count(MISSING),
        }

    def _state(self, index: int) -> str:
        if not self.finished:
            return REACHED if index < self._reached else OPEN
        return DONE if index in self._done else MISSING


def _cells(
    plan: CyclePlan, machine: Machine | None
) -> tuple[list[str], list[str], list[tuple[int, int]], list[str]]:
    """Names of rows and columns, the place of each pose (row, column), and its name.

    Stations of the outer rotary axis are rows, those of the inner one columns. Where the rotary
    axes do not spread the poses (nest calibration, run-out) there are no names, and poses follow
    each other in rows of at most 28.
    """
    count = len(plan.commands)
    rotary = [n for n in (machine.rotary if machine else ()) if n in plan.axes]
    turned = [np.degrees(plan.commands[:, plan.axes.index(name)]) for name in rotary]
    names = [
        ', '.join(
            _position(axis, value, machine)
            for axis, value in zip(plan.axes, row, strict=True)
        )
        for row in plan.commands
    ]
    if plan.kind is not Kind.STATIC or len(rotary) < 2:
        wide = 28 if count % 12 else 12
        places = [divmod(index, wide) for index in range(count)]
        return [], [], places, names
    outer, inner = (np.round(values, 3) + 0.0 for values in turned[:2])
    rows, columns = np.unique(outer), np.unique(inner)
    places = [
        (int(np.searchsorted(rows, b)), int(np.searchsorted(columns, c)))
        for b, c in zip(outer, inner, strict=True)
    ]
    return (
        [f'{rotary[0]} {_number(value)}°' for value in rows],
        [f'{rotary[1]} {_number(value)}°' for value in columns],
        places,
        names,
    )


def _position(axis: str, value: float, machine: Machine | None) -> str:
    turns = axis == 'S' or (machine is not None and machine.axes[axis].rotary)
    if turns:
        return f'{axis} {_number(math.degrees(value))}°'
    return f'{axis} {_number(value * 1e3)} mm'


def _number(value: float) -> str:
    """As a person writes it, with a minus sign."""
    return f'{round(value, 4) + 0.0:.6g}'.replace('-', '−')
