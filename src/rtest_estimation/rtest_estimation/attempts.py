"""Cycles that were measured more than once, as after an E-stop."""

from __future__ import annotations

from collections.abc import Iterable

from rtest_estimation.records import Cycle


def counted(cycles: Iterable[Cycle]) -> list[Cycle]:
    """Of the attempts at each cycle the one with the most poses, the later one of equals.

    In the order of their start.
    """
    best: dict[str, Cycle] = {}
    for cycle in sorted(cycles, key=lambda one: one.plan.stamp):
        name = cycle.plan.cycle
        if name not in best or len(cycle.points) >= len(best[name].points):
            best[name] = cycle
    return sorted(best.values(), key=lambda one: one.plan.stamp)
