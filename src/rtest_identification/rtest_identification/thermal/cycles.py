"""Which cycles of a session repeat each other, which the others are compared with, and when."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtest_estimation.dwell import ROTARY_LETTERS
from rtest_estimation.errors import UserError
from rtest_estimation.records import Cycle, CyclePlan, Kind
from rtest_identification.thermal.poses import Poses, places
from rtest_identification.thermal.series import Series, change_between

# Fewer poses in common tell nothing.
FEWEST_POSES = 6


def told_apart(plans: Sequence[CyclePlan]) -> tuple[CyclePlan, ...]:
    """Plans with a name each: a cycle that is there again is another one, not a second attempt."""
    count: Counter[str] = Counter(plan.cycle for plan in plans)
    seen: Counter[str] = Counter()
    named = []
    for plan in plans:
        seen[plan.cycle] += 1
        if count[plan.cycle] > 1:
            plan = replace(plan, cycle=f'{plan.cycle} ({seen[plan.cycle]})')
        named.append(plan)
    return tuple(named)


def repeated(cycles: Sequence[Cycle]) -> tuple[list[Cycle], Cycle, list[str]]:
    """Cycles that visit the same poses with the same sphere, in order of time.

    Returns them, the one with the longest plan, and warnings. Of several repeated cycles the one
    that is there most often is meant.

    Raises UserError where none has a valid point.
    """
    static = [c for c in cycles if c.plan.kind is Kind.STATIC and _swivels(c)]
    measured = [c for c in static if c.points]
    if not measured:
        raise UserError(
            'no static cycle with a valid point in this session; '
            'see the missing poses and their reasons in `rtest info`'
        )
    groups: dict[tuple, list[Cycle]] = {}
    for cycle in measured:
        sphere = tuple(np.round(cycle.plan.sphere, 6).tolist())
        groups.setdefault((cycle.plan.setup, sphere), []).append(cycle)
    chosen = max(groups.values(), key=len)
    model = max(chosen, key=lambda c: len(c.plan.commands))
    like = [c for c in chosen if (points_at(model, c) >= 0).any()]
    warnings = []
    names = {id(c) for c in like}
    left = [c.plan.cycle for c in measured if id(c) not in names]
    if left:
        warnings.append(
            f'not of the repeated cycle, left out: {", ".join(left)} (another sphere position or '
            'other poses)'
        )
    empty = [c.plan.cycle for c in static if not c.points]
    if empty:
        warnings.append(f'without a valid point: {", ".join(empty)}')
    nests = {c.calibration for c in like}
    if len(nests) > 1:
        warnings.append(
            f'the nest was calibrated {len(nests)} times; changes across a calibration hold what '
            'was moved with it'
        )
    return sorted(like, key=lambda c: (c.plan.stamp, c.plan.cycle)), model, warnings


def _swivels(cycle: Cycle) -> bool:
    """Whether a rotary axis of the machine moves: not where a nest is verified."""
    plan = cycle.plan
    columns = [k for k, axis in enumerate(plan.axes) if axis in ROTARY_LETTERS and axis != 'S']
    return bool(np.ptp(plan.commands[:, columns], axis=0).any())


def points_at(model: Cycle, cycle: Cycle) -> np.ndarray:
    """(n,) pose of the model's plan at which each point of a cycle was measured; -1 for none."""
    return places(model.plan, cycle.plan)[[point.index for point in cycle.points]]


def reference(poses: Poses, model: Cycle, cycles: Sequence[Cycle]) -> tuple[int, list[str]]:
    """The first of the cycles that determine most, and warnings."""
    ranks = []
    for cycle in cycles:
        measured = np.zeros(len(poses), dtype=bool)
        place = points_at(model, cycle)
        measured[place[place >= 0]] = True
        ranks.append(poses.gains(measured).rank)
    chosen = int(np.argmax(ranks))
    warnings = []
    if chosen:
        warnings.append(
            f'{cycles[0].plan.cycle} is cut short: changes are counted from '
            f'{cycles[chosen].plan.cycle}'
        )
    if ranks[chosen] < poses.full.rank:
        warnings.append('no cycle has all the poses that the plan needs to determine everything')
    return chosen, warnings


def middle(cycle: Cycle) -> int:
    """Mean time of a cycle's points [ns]."""
    stamps = np.array([point.stamp for point in cycle.points], dtype=np.int64)
    return int(stamps[0] + np.rint((stamps - stamps[0]).mean()))


def duration(cycle: Cycle) -> float:
    """Time from the first point to the last [s]."""
    stamps = [point.stamp for point in cycle.points]
    return max((max(stamps) - min(stamps)) * 1e-9, 1.0)


def without_drift(
    cycle: Cycle, model: Cycle, poses: Poses, drifting: Sequence[Series], origin: int
) -> Cycle:
    """A cycle as it would be had the machine stood still at its middle.

    One cycle cannot tell a drift while it runs from a dependence on the outer axis; the cycles
    before and after it can.

    drifting : of the errors that drift; origin : stamp of their time zero [ns]
    """
    place = points_at(model, cycle)
    times = np.array([(point.stamp - origin) * 1e-9 for point in cycle.points])
    centre = (middle(cycle) - origin) * 1e-9
    moved = np.zeros((len(place), 3))
    for one in drifting:
        change = change_between(one, centre, times)
        moved += poses.jacobian[place, :, one.parameter.column] * change[:, None]
    moved[place < 0] = 0.0
    points = tuple(
        replace(point, displacement=point.displacement - shift)
        for point, shift in zip(cycle.points, moved, strict=True)
    )
    return replace(cycle, points=points)
