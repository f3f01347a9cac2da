"""Where the machine stood still: dwells found in the encoder feedback and matched to the plan."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass

import numpy as np

from rtest_estimation.records import CyclePlan, Kind, Missing

# ISO 841 letters of rotary axes, and S, the spindle angle of a plan. Only tolerances depend on it.
ROTARY_LETTERS = frozenset('ABCS')
# Six standard deviations of normal noise, in median absolute deviations.
_ENDS = 6 * 1.4826


def turns(plan: CyclePlan) -> bool:
    """Whether it is a dynamic cycle in which a rotary axis or the spindle turns."""
    columns = [column for column, axis in enumerate(plan.axes) if axis in ROTARY_LETTERS]
    return plan.kind is Kind.DYNAMIC and bool(np.ptp(plan.commands[:, columns], axis=0).any())


@dataclass(frozen=True)
class DwellRules:
    """When a pose counts as reached and settled. (linear [m], rotary [rad]) pairs, times [s].

    near : how far the feedback may stand from the command; wider than any following error or
        compensation, narrower than half of any step
    still : how much the feedback of a standing axis may change within `span`; wider than the
        resolution of coarse encoders
    span : time over which standing and moving are told apart, one feedback period at least, so
        that a slow move is not taken for a stop where the feedback is fast
    settle : time after the axes stop that is not used, for what the encoders do not see
    gap : longest time without feedback that still counts as fresh, at least; five feedback periods
        where that is longer
    """

    near: tuple[float, float] = (5e-5, 3.5e-4)
    still: tuple[float, float] = (5e-6, 5e-5)
    span: float = 0.04
    settle: float = 0.05
    gap: float = 0.1


@dataclass(frozen=True)
class Dwell:
    """One pose at which the machine stood.

    start, end : of the settled time [ns]
    feedback : (axes,) mean over it
    approach : (axes,) sign of each axis's last motion before, within the cycle
    """

    index: int
    start: int
    end: int
    feedback: np.ndarray
    approach: np.ndarray


def find_dwells(
    plan: CyclePlan,
    stamps: np.ndarray,
    positions: np.ndarray,
    rules: DwellRules | None = None,
    until: int | None = None,
    readings: int | None = None,
) -> tuple[list[Dwell], list[Missing]]:
    """Match the stretches in which every axis stood still to the poses of the plan, in order.

    Of a stop that is longer than planned the last part is used, the most settled one; of the last
    stop the first part, so that the result does not depend on how long the machine waits there.
    Where the data end in a stop before the plan's last one, its last part with readings is used.

    Parameters
    ----------
    stamps : (n,) int64, strictly increasing [ns]
    positions : (n, axes) in the order of ``plan.axes``; NaN where the feedback has no such axis
    until : when the cycle ended [ns]; the last feedback where it is not known
    readings : the last gauge reading [ns]; as until the last feedback where it is not known

    Returns
    -------
    the dwells, and every other pose with the reason.
    """
    rules = rules or DwellRules()
    count = len(plan.commands)
    if len(stamps) < 2:
        return [], [Missing(row, 'no encoder feedback') for row in range(count)]
    gone = np.isnan(positions).all(axis=0)
    absent = [axis for axis, none in zip(plan.axes, gone, strict=True) if none]
    if absent:
        reason = f'the encoder feedback has no axis {", ".join(absent)}'
        return [], [Missing(row, reason) for row in range(count)]
    rotary = np.array([axis in ROTARY_LETTERS for axis in plan.axes])
    near, still = np.where(rotary, rules.near[1], rules.near[0]), _still(rules, rotary)
    gaps = fresh_gap(stamps, rules)
    lag = max(1, round(rules.span * 1e9 / float(np.median(np.diff(stamps)))))
    runs = _standing(stamps, positions, still, gaps, lag)
    matched = _match(plan.commands, positions, runs, near)
    approaches = _approaches(positions, still, lag)
    shared = Counter(number for number, _ in matched.values())
    last_run = matched[count - 1][0] if count - 1 in matched else None
    reached = sorted(matched)
    dwells, missing = [], []
    ends = np.append(stamps, stamps[-1] if until is None else max(until, int(stamps[-1])))
    planned = round(plan.dwell * 1e9)
    for row in range(count):
        if row not in matched:
            missing.append(Missing(row, _why_absent(row, reached, matched, runs, ends, gaps)))
            continue
        number, place = matched[row]
        first, last = runs[number]
        arrived, left = int(stamps[first]), int(stamps[last])
        if number != last_run:
            length = shared[number] * planned
            if number == len(runs) - 1 and readings is not None and readings >= arrived + length:
                left = min(left, readings)
            arrived = max(arrived, left - length)
        arrived += place * planned
        start = arrived + int(rules.settle * 1e9)
        end = min(left, arrived + planned)
        if end - arrived < planned // 2 or end <= start:
            stood = max(end - arrived, 0) / 1e9
            reason = f'not settled: stood still {stood:.2f} s of {plan.dwell:.2f} s'
            missing.append(Missing(row, reason))
            continue
        inside = slice(first, last + 1)
        used = (stamps[inside] >= start) & (stamps[inside] <= end)
        kept = positions[inside][used] if used.any() else positions[inside][-1:]
        dwells.append(Dwell(row, start, end, kept.mean(axis=0), approaches[first]))
    return dwells, missing


def fresh_gap(stamps: np.ndarray, rules: DwellRules) -> int:
    """Longest time between two feedback samples that counts as fresh [ns]."""
    return max(int(rules.gap * 1e9), 5 * int(np.median(np.diff(stamps))))


def _still(rules: DwellRules, rotary: np.ndarray) -> np.ndarray:
    return np.where(rotary, rules.still[1], rules.still[0])


def _standing(
    stamps: np.ndarray, positions: np.ndarray, still: np.ndarray, gap: int, lag: int
) -> list[tuple[int, int]]:
    """First and last sample of every stretch in which nothing moved and the feedback was fresh."""
    if len(stamps) <= lag:
        return []
    stale = np.concatenate([[0], np.cumsum(np.diff(stamps) > gap)])
    quiet = (np.abs(positions[lag:] - positions[:-lag]) <= still).all(axis=1)
    quiet &= stale[lag:] == stale[:-lag]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], quiet, [False]]).astype(np.int8)))
    runs: list[tuple[int, int]] = []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        first, last = int(begin), int(end) - 1 + lag
        # The tails of a move are quiet over a short span but not where the axes come to rest:
        # the ends of a stop are held to the scatter of the encoders in it.
        off = positions[first : last + 1] - np.median(positions[first : last + 1], axis=0)
        scatter = _ENDS * np.median(np.abs(off), axis=0)
        settled = np.flatnonzero((np.abs(off) <= np.clip(scatter, still / 50, still)).all(axis=1))
        if len(settled) >= 2:
            runs.append((first + int(settled[0]), first + int(settled[-1])))
    return runs


def _match(
    commands: np.ndarray,
    positions: np.ndarray,
    runs: list[tuple[int, int]],
    near: np.ndarray,
) -> dict[int, tuple[int, int]]:
    """Row of the plan to (index of the run, how many dwells into it), in visiting order.

    Rows with equal commands one after the other share a run, each for its own dwell time. Rows
    that were skipped are left out.
    """
    matched: dict[int, tuple[int, int]] = {}
    row = -1
    for number, (first, last) in enumerate(runs):
        rest = np.median(positions[first : last + 1], axis=0)
        if row >= 0 and (np.abs(commands[row] - rest) <= near).all():
            before = matched[row][0]
            between = positions[runs[before][1] : first + 1]
            if not (np.abs(between - commands[row]) > near).any():
                # The same stop, interrupted by a loss of feedback: keep its longer part.
                if last - first > runs[before][1] - runs[before][0]:
                    for other in [r for r, (n, _) in matched.items() if n == before]:
                        matched[other] = (number, matched[other][1])
                continue
        hits = np.flatnonzero((np.abs(commands[row + 1 :] - rest) <= near).all(axis=1))
        if len(hits):
            row += 1 + int(hits[0])
            matched[row] = (number, 0)
            while row + 1 < len(commands) and (commands[row + 1] == commands[row]).all():
                row += 1
                matched[row] = (number, matched[row - 1][1] + 1)
    return matched


def trailing(plan: CyclePlan) -> int:
    """How many rows at the end of a plan command the same position."""
    same = (plan.commands == plan.commands[-1]).all(axis=1)[::-1]
    return int(np.argmin(same)) or len(same)


def _why_absent(
    row: int,
    reached: list[int],
    matched: dict[int, tuple[int, int]],
    runs: list[tuple[int, int]],
    stamps: np.ndarray,
    gap: int,
) -> str:
    """Say whether the feedback was lost between the neighbours, or the pose was not reached."""
    place = bisect_left(reached, row)
    first = runs[matched[reached[place - 1]][0]][0] if place else 0
    last = runs[matched[reached[place]][0]][1] if place < len(reached) else len(stamps) - 1
    pauses = np.diff(stamps[first : last + 1])
    if len(pauses) and pauses.max() > gap:
        return f'encoder feedback stale for {pauses.max() / 1e9:.2f} s'
    return 'never reached'


def _approaches(positions: np.ndarray, still: np.ndarray, lag: int) -> np.ndarray:
    """(n, axes) int8 sign of the last motion of every axis up to each sample."""
    signs = np.zeros(positions.shape, dtype=np.int8)
    if len(positions) <= lag:
        return signs
    steps = positions[lag:] - positions[:-lag]
    moving = np.abs(steps) > still
    last = np.maximum.accumulate(np.where(moving, np.arange(len(steps))[:, np.newaxis], -1))
    known = np.take_along_axis(np.sign(steps), np.maximum(last, 0), axis=0)
    signs[lag:] = np.where(last >= 0, known, 0.0)
    return signs
