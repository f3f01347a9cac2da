"""From readings and feedback to nest calibrations and finished cycles.

One class serves the live node and the offline command. What it gives depends on the acquisition
times of the data only, not on how the topics interleave, so that a recording gives bit for bit
what the node published.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rtest_estimation import nest as nests
from rtest_estimation.average import NoAverageError, average
from rtest_estimation.dwell import ROTARY_LETTERS, Dwell, DwellRules, find_dwells, trailing
from rtest_estimation.records import (
    Cycle,
    CyclePlan,
    CyclePoint,
    Feedback,
    GaugeBlock,
    Kind,
    Missing,
    NestCalibration,
)

# Readings and feedback from before a plan arrives are kept this long: the plan travels on another
# topic and may come late.
KEEP_BEFORE_PLAN_NS = 10_000_000_000
# The end of a cycle waits for gauge readings up to it, until the feedback is this far ahead.
GAUGE_PATIENCE_NS = 2_000_000_000
# A dwell mean scattered more than this is vibration or a machine still moving [m].
MAX_SCATTER = 20e-6


@dataclass(frozen=True)
class EstimationRules:
    """Parameters of the estimation; sphere_radius [m] is passed on to the calibration."""

    dwell: DwellRules = DwellRules()
    sphere_radius: float = float('nan')


@dataclass(frozen=True)
class Finished:
    """A finished cycle; after a nest calibration also its result or why there is none."""

    cycle: Cycle
    nest: NestCalibration | None = None
    problem: str = ''


class Estimator:
    """Collects one session's data in any interleaving and gives finished cycles.

    Feed it with `add_plan`, `add_feedback` and `add_gauges`, then ask `finished`; `finish` closes
    what is still open at the end of a session.
    """

    def __init__(self, rules: EstimationRules | None = None) -> None:
        self.rules = rules or EstimationRules()
        self.nests: dict[str, NestCalibration] = {}
        self._plans: list[CyclePlan] = []
        self._feedback = _Series()
        self._gauges = _Blocks()
        self._end = _CycleEnd(self.rules.dwell)
        self.discarded = 0

    @property
    def current(self) -> CyclePlan | None:
        """The cycle being measured."""
        return self._plans[0] if self._plans else None

    @property
    def nest(self) -> NestCalibration | None:
        """Calibration of the set-up that is measured, or else the newest."""
        plan = self.current
        if plan and plan.setup in self.nests:
            return self.nests[plan.setup]
        return next(reversed(self.nests.values()), None)

    def add_plan(self, plan: CyclePlan) -> None:
        """A cycle begins at the plan's stamp; it ends the one before where that is still open."""
        same = next((p for p in self._plans if (p.cycle, p.stamp) == (plan.cycle, plan.stamp)), None)
        if same is None:
            self._plans.append(plan)
            self._plans.sort(key=lambda p: p.stamp)
            self._end.reset()

    def add_feedback(self, sample: Feedback) -> None:
        """Encoder positions; a sample not newer than the one before is dropped (frozen source)."""
        if not self._feedback.append(sample):
            self.discarded += 1
        elif not self._plans and sample.stamp - self._feedback.first > 2 * KEEP_BEFORE_PLAN_NS:
            self._forget(sample.stamp - KEEP_BEFORE_PLAN_NS)

    def add_gauges(self, block: GaugeBlock) -> None:
        """Gauge readings, one message's worth."""
        self._gauges.append(block)

    def finished(self) -> Finished | None:
        """The next cycle whose data are complete, or None."""
        plan = self.current
        if plan is None or not len(self._feedback):
            return None
        limit = self._plans[1].stamp if len(self._plans) > 1 else None
        end = self._end.find(plan, self._feedback, limit)
        if end is None:
            return None
        ahead = self._feedback.last - end > GAUGE_PATIENCE_NS
        if self._gauges.last < end and not ahead:
            return None
        return self._close(plan, end)

    def finish(self) -> list[Finished]:
        """Close every open cycle with the data there are (end of the session or recording)."""
        done = []
        while self._plans:
            ready = self.finished()
            if ready is None:
                plan = self._plans[0]
                limit = self._plans[1].stamp if len(self._plans) > 1 else None
                last = max(self._feedback.last, plan.stamp)
                ready = self._close(plan, last if limit is None else limit)
            done.append(ready)
        return done

    def progress(self) -> tuple[CyclePlan, int] | None:
        """The current cycle and how many of its poses were reached so far."""
        plan = self.current
        if plan is None:
            return None
        stamps, positions = self._feedback.window(plan, plan.stamp, self._feedback.last)
        dwells, _ = find_dwells(plan, stamps, positions, self.rules.dwell)
        return plan, len(dwells)

    def _close(self, plan: CyclePlan, end: int) -> Finished:
        stamps, positions = self._feedback.window(plan, plan.stamp, end)
        times, displacement, status = self._gauges.window(plan.stamp, end)
        self._plans.pop(0)
        self._end.reset()
        self._forget(self._plans[0].stamp if self._plans else end)
        if plan.kind is Kind.DYNAMIC:
            reason = 'dynamic cycles are recorded but not evaluated'
            missing = tuple(Missing(row, reason) for row in range(len(plan.commands)))
            return Finished(Cycle(plan, (), missing, '', end), problem=reason)
        dwells, missing = find_dwells(plan, stamps, positions, self.rules.dwell)
        data = (times, displacement, status)
        if plan.kind is Kind.NEST_CALIBRATION:
            return self._calibrate(plan, dwells, missing, data, end)
        nest = self.nests.get(plan.setup)
        if nest is None:
            problem = f'no nest calibration of set-up {plan.setup}'
            everything = tuple(Missing(row, problem) for row in range(len(plan.commands)))
            return Finished(Cycle(plan, (), everything, '', end), problem=problem)
        points, missing = _points(plan, nest, dwells, missing, data)
        return Finished(Cycle(plan, points, missing, nest.calibration, end))

    def _calibrate(
        self,
        plan: CyclePlan,
        dwells: list[Dwell],
        missing: list[Missing],
        data: tuple[np.ndarray, np.ndarray, np.ndarray],
        end: int,
    ) -> Finished:
        """Eq. 2-5 on the dwells whose gauges were all valid."""
        positions, readings, lost = [], [], list(missing)
        linear = [c for c, axis in enumerate(plan.axes) if axis not in ROTARY_LETTERS]
        if [plan.axes[c] for c in linear] != ['X', 'Y', 'Z']:
            problem = f'a nest calibration moves X, Y and Z, the plan has {list(plan.axes)}'
            everything = tuple(Missing(row, problem) for row in range(len(plan.commands)))
            return Finished(Cycle(plan, (), everything, '', end), problem=problem)
        for dwell in dwells:
            try:
                mean = _mean(dwell, data, data[1].shape[1])
            except NoAverageError as error:
                lost.append(Missing(dwell.index, str(error)))
                continue
            positions.append(dwell.feedback[linear])
            readings.append(mean.mean)
        if not readings:
            problem = f'no pose of {plan.cycle} has valid readings'
            return Finished(Cycle(plan, (), tuple(lost), '', end), problem=problem)
        steps = np.array(positions) - plan.commands[0, linear]
        try:
            nest = nests.calibrate(
                steps, np.array(readings), f'{plan.session}/{plan.cycle}', plan.setup, end,
                self.rules.sphere_radius,
            )
        except nests.CalibrationError as error:
            lost.sort(key=lambda m: m.index)
            return Finished(Cycle(plan, (), tuple(lost), '', end), problem=str(error))
        self.nests[plan.setup] = nest
        points, lost_points = _points(plan, nest, dwells, missing, data)
        return Finished(Cycle(plan, points, lost_points, nest.calibration, end), nest)

    def _forget(self, before: int) -> None:
        self._feedback.forget(before)
        self._gauges.forget(before)


def _mean(dwell: Dwell, data: tuple[np.ndarray, np.ndarray, np.ndarray], needed: int):
    times, displacement, status = data
    used = slice(*np.searchsorted(times, [dwell.start, dwell.end + 1]))
    mean = average(displacement[used], status[used], needed)
    scatter = float(np.sqrt(np.trace(mean.covariance) * mean.readings / len(mean.gauges)))
    if scatter > MAX_SCATTER:
        raise NoAverageError(f'readings scatter {scatter * 1e6:.0f} um: vibration or not settled')
    return mean


def _points(
    plan: CyclePlan,
    nest: NestCalibration,
    dwells: list[Dwell],
    missing: list[Missing],
    data: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[tuple[CyclePoint, ...], tuple[Missing, ...]]:
    """Sphere centres of the dwells, relative to the first of them (initial reset, Eq. 3-2)."""
    points, lost = [], list(missing)
    for dwell in dwells:
        try:
            if data[1].shape[1] and data[1].shape[1] != len(nest.direction):
                raise NoAverageError(
                    f'{data[1].shape[1]} gauges, the nest was calibrated with '
                    f'{len(nest.direction)}'
                )
            mean = _mean(dwell, data, 3)
        except NoAverageError as error:
            lost.append(Missing(dwell.index, str(error)))
            continue
        position, covariance, disagreement = nests.centre(nest, mean)
        points.append(
            CyclePoint(
                dwell.index, (dwell.start + dwell.end) // 2, dwell.feedback, dwell.approach,
                position, covariance, mean.readings, disagreement,
            )
        )
    if points:
        reset = points[0].displacement
        points = [replace(p, displacement=p.displacement - reset) for p in points]
    return tuple(points), tuple(sorted(lost, key=lambda m: m.index))


class _Series:
    """Encoder feedback in order of acquisition."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.samples: list[Feedback] = []

    def __len__(self) -> int:
        return len(self.stamps)

    @property
    def first(self) -> int:
        return self.stamps[0] if self.stamps else 0

    @property
    def last(self) -> int:
        return self.stamps[-1] if self.stamps else 0

    def append(self, sample: Feedback) -> bool:
        if self.stamps and sample.stamp <= self.stamps[-1]:
            return False
        self.stamps.append(sample.stamp)
        self.samples.append(sample)
        return True

    def window(self, plan: CyclePlan, start: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        """Stamps and positions in the plan's axes; NaN for an axis the feedback does not have."""
        stamps = np.array(self.stamps, dtype=np.int64)
        low, high = np.searchsorted(stamps, [start, end + 1])
        positions = np.full((high - low, len(plan.axes)), np.nan)
        order: dict[tuple[str, ...], tuple[list[int], list[int]]] = {}
        for row, sample in enumerate(self.samples[low:high]):
            if sample.axes not in order:
                pairs = [
                    (column, sample.axes.index(axis))
                    for column, axis in enumerate(plan.axes)
                    if axis in sample.axes
                ]
                order[sample.axes] = ([to for to, _ in pairs], [of for _, of in pairs])
            to, of = order[sample.axes]
            positions[row, to] = sample.position[of]
        finite = np.isfinite(positions)
        # A column that is never there is reported as a whole; single bad samples are left out.
        good = finite[:, finite.any(axis=0)].all(axis=1)
        return stamps[low:high][good], positions[good]

    def forget(self, before: int) -> None:
        keep = int(np.searchsorted(np.array(self.stamps, dtype=np.int64), before))
        del self.stamps[:keep], self.samples[:keep]


class _Blocks:
    """Gauge readings in order of acquisition."""

    def __init__(self) -> None:
        self.blocks: list[GaugeBlock] = []
        self.last = 0

    def append(self, block: GaugeBlock) -> None:
        self.blocks.append(block)
        self.last = max(self.last, int(block.stamps[-1]))

    def window(self, start: int, end: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stamps (n,), displacement and status (n, channels) of the readings in [start, end]."""
        blocks = [b for b in self.blocks if b.stamp <= end and b.stamps[-1] >= start]
        if not blocks:
            return np.empty(0, dtype=np.int64), np.empty((0, 0)), np.empty((0, 0), dtype=np.uint8)
        channels = blocks[-1].displacement.shape[1]
        blocks = [b for b in blocks if b.displacement.shape[1] == channels]
        times = np.concatenate([b.stamps for b in blocks])
        order = np.argsort(times, kind='stable')
        order = order[(times[order] >= start) & (times[order] <= end)]
        displacement = np.concatenate([b.displacement for b in blocks])[order]
        return times[order], displacement, np.concatenate([b.status for b in blocks])[order]

    def forget(self, before: int) -> None:
        self.blocks = [b for b in self.blocks if b.stamps[-1] >= before]


class _CycleEnd:
    """Finds when a cycle is over: its last pose was stood at for the dwell, or the next began."""

    def __init__(self, rules: DwellRules) -> None:
        self.rules = rules
        self.reset()

    def reset(self) -> None:
        self._seen = 0
        self._since: int | None = None
        self._tried: int | None = None

    def find(self, plan: CyclePlan, feedback: _Series, limit: int | None) -> int | None:
        """End of the cycle [ns], or None while it is going on. Looks at new samples only."""
        rotary = [axis in ROTARY_LETTERS for axis in plan.axes]
        near = [self.rules.near[turns] for turns in rotary]
        last = plan.commands[-1]
        start = max(self._seen, int(np.searchsorted(feedback.stamps, plan.stamp)))
        for number in range(start, len(feedback)):
            sample = feedback.samples[number]
            if limit is not None and sample.stamp >= limit:
                return limit
            self._seen = number + 1
            if not _there(plan.axes, sample, last, near):
                self._since = None
                continue
            if self._since is None:
                self._since = sample.stamp
            # Arrival is seen before the axes stand still; half a second covers the difference.
            end = self._since + int((trailing(plan) * plan.dwell + 0.5) * 1e9)
            if sample.stamp >= end and self._tried != self._since:
                self._tried = self._since
                stamps, positions = feedback.window(plan, plan.stamp, end)
                dwells, missing = find_dwells(plan, stamps, positions, self.rules)
                reached = {d.index for d in dwells}
                done = len(plan.commands) - 1 in reached
                if done and (plan.kind is not Kind.DYNAMIC) and (len(reached) > 1 or not missing):
                    return end
        return None


def _there(axes: tuple[str, ...], sample: Feedback, last: np.ndarray, near: list[float]) -> bool:
    """Whether a sample is at the last pose."""
    for axis, command, tolerance in zip(axes, last, near, strict=True):
        if axis in sample.axes:
            if not abs(sample.position[sample.axes.index(axis)] - command) <= tolerance:
                return False
    return True
