"""A thermal session while it is measured: each finished cycle extends the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtest_estimation.records import Cycle, Kind, Temperature
from rtest_identification.machine import Machine
from rtest_identification.pipeline import Identification, identify
from rtest_identification.thermal.cycles import told_apart
from rtest_identification.thermal.pipeline import Thermal, identify_thermal
from rtest_identification.thermal.temperature import Thermometer


class LiveSession:
    """Finished cycles and temperatures of one session, in the order in which they came.

    What `result` gives is what `thermal_recording` gives from the recording of the same messages,
    but for the reasons of missing poses, which finished cycles do not carry.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget everything, for another session."""
        self._cycles: list[Cycle] = []
        self._temperatures: dict[str, list[tuple[int, float]]] = {}

    @property
    def session(self) -> str:
        """Name of the session; '' before the first cycle."""
        return self._cycles[0].plan.session if self._cycles else ''

    @property
    def static(self) -> int:
        """Static cycles so far."""
        return sum(cycle.plan.kind is Kind.STATIC for cycle in self._cycles)

    def add_cycle(self, cycle: Cycle) -> None:
        """A finished cycle of any kind; one that was delivered twice counts once."""
        key = (cycle.plan.cycle, cycle.plan.stamp)
        if key not in {(one.plan.cycle, one.plan.stamp) for one in self._cycles}:
            self._cycles.append(cycle)

    def add_temperature(self, reading: Temperature) -> None:
        """A reading of one thermometer."""
        self._temperatures.setdefault(reading.sensor, []).append((reading.stamp, reading.value))

    def result(self, machine: Machine) -> Thermal:
        """Every error over time and temperature so far.

        Raises UserError where no cycle can be evaluated.
        """
        cycles = sorted(self._cycles, key=lambda one: one.plan.stamp)
        plans = told_apart([cycle.plan for cycle in cycles])
        named = [replace(one, plan=plan) for one, plan in zip(cycles, plans, strict=True)]
        return identify_thermal(machine, named, [
            Thermometer.of(sensor, *np.array(readings, dtype=object).T)
            for sensor, readings in sorted(self._temperatures.items())
        ])

    def alone(self, machine: Machine, cycle: Cycle) -> Identification:
        """One cycle by itself, with what was measured before it of nest and spindle.

        Raises UserError where it cannot be evaluated.
        """
        before = [
            one for one in self._cycles
            if one.plan.kind is not Kind.STATIC and one.plan.stamp < cycle.plan.stamp
        ]
        return identify(machine, [*before, cycle])
