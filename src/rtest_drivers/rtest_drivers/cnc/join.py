"""Brings positions that a controller tells axis by axis to feedback of all axes at one time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rtest_drivers.cnc.axes import AxisSource, names, scales
from rtest_drivers.cnc.clock import Recent
from rtest_estimation.records import Feedback


@dataclass(frozen=True)
class Sample:
    """One value of one axis.

    stamp : [ns]
    axis : its letter; '' for a sign of life, which says that until then nothing else changed
    value : in the controller's unit; None where the controller does not know it
    """

    stamp: int
    axis: str = ''
    value: float | None = None


class Joiner:
    """The last value of every axis, and feedback whenever something new is known.

    A controller that tells changes only is right until it tells another one: an axis keeps its
    value until then. Samples that lie within `together` of the first of them are one feedback with
    the stamp of the last; how far they lay apart is the `skew` [ns]. There is no feedback while
    the value of any axis is not known, and stamps always rise.
    """

    def __init__(self, axes: Sequence[AxisSource], together: int) -> None:
        """`together` in [ns]."""
        self.names, self._scales, self._together = names(axes), scales(axes), together
        self._values: dict[str, float | None] = dict.fromkeys(self.names)
        self._last = 0
        self.skew = Recent()

    @property
    def unknown(self) -> tuple[str, ...]:
        """Axes without a value."""
        return tuple(name for name, value in self._values.items() if value is None)

    def add(self, samples: Iterable[Sample]) -> list[Feedback]:
        """What came together, in any order, to feedback."""
        feedback = []
        group: list[Sample] = []
        for sample in sorted(samples, key=lambda sample: sample.stamp):
            if group and sample.stamp - group[0].stamp > self._together:
                feedback += self._join(group)
                group = []
            group.append(sample)
        return feedback + (self._join(group) if group else [])

    def _join(self, group: list[Sample]) -> list[Feedback]:
        self._values.update({s.axis: s.value for s in group if s.axis})
        moved = [s.stamp for s in group if s.axis]
        if moved:
            self.skew.add(moved[-1] - moved[0])
        if self.unknown or (not moved and group[-1].stamp <= self._last):
            return []
        self._last = max(group[-1].stamp, self._last + 1)
        values = np.array([self._values[name] for name in self.names], dtype=float)
        return [Feedback(self._last, self.names, values * self._scales)]
