"""From readings and feedback to nest calibrations and finished cycles.

One class serves the live node and the offline command. What it gives depends on the acquisition
times of the data only, not on how the topics interleave, so that a recording gives bit for bit
what the node published.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from rtest_estimation import laser
from rtest_estimation import nest as nests
from rtest_estimation.average import Average, NoAverageError, average
from rtest_estimation.buffers import FeedbackBuffer, GaugeBuffer
from rtest_estimation.columns import FeedbackColumns
from rtest_estimation.cycle_end import CycleEnd, arrivals
from rtest_estimation.cycle_start import CycleStart
from rtest_estimation.dwell import ROTARY_LETTERS, Dwell, DwellRules, find_dwells
from rtest_estimation.records import (
    Cycle,
    CyclePlan,
    CyclePoint,
    Feedback,
    GaugeBlock,
    Kind,
    Missing,
    NestCalibration,
    NestKind,
)

# Readings and feedback from before a plan arrives are kept this long: the plan travels on another
# topic and may come late. The same before the axes come to the first pose, for the approach to it.
KEEP_BEFORE_NS = 10_000_000_000
# The end of a cycle waits for gauge readings up to it, until the feedback is this far ahead.
GAUGE_PATIENCE_NS = 2_000_000_000
# Feedback that ends by more before the readings has failed; less is how a session ends.
_STOPPED_NS = 5_000_000_000
# A dwell mean scattered more than this is vibration or a machine still moving [m].
MAX_SCATTER = 20e-6


@dataclass(frozen=True)
class EstimationRules:
    """Parameters of the estimation: of which kind the nest is, and its sphere_radius [m]."""

    dwell: DwellRules = field(default_factory=DwellRules)
    sphere_radius: float = float('nan')
    nest: NestKind = NestKind.CONTACT


@dataclass(frozen=True)
class Finished:
    """A finished cycle; after a nest calibration also its result or why there is none.

    means : poses with mean readings, also where these give no sphere centre
    """

    cycle: Cycle
    nest: NestCalibration | None = None
    problem: str = ''
    means: tuple[tuple[Dwell, Average], ...] = ()


class Estimator:
    """Collects one session's data in any interleaving and gives finished cycles.

    given : nest calibrations by set-up that are used instead of the session's own

    Feed it with `add_plan`, `add_feedback` and `add_gauges`, then ask `finished`; `finish` closes
    what is still open at the end of a session.
    """

    def __init__(
        self,
        rules: EstimationRules | None = None,
        given: Mapping[str, NestCalibration] | None = None,
    ) -> None:
        self.rules = rules or EstimationRules()
        self.nests: dict[str, NestCalibration] = {}
        self._given = given or {}
        self._plans: list[CyclePlan] = []
        self._feedback = FeedbackBuffer()
        self._gauges = GaugeBuffer()
        self._start, self._end = CycleStart(self.rules.dwell), CycleEnd(self.rules.dwell)
        self.discarded = 0

    @property
    def current(self) -> CyclePlan | None:
        """The cycle being measured."""
        return self._plans[0] if self._plans else None

    @property
    def feedback_stamp(self) -> int:
        """Stamp of the newest encoder feedback [ns]; 0 before the first."""
        return self._feedback.last

    @property
    def nest(self) -> NestCalibration | None:
        """Calibration of the set-up that is measured, or else the newest."""
        plan = self.current
        if plan and plan.setup in self.nests:
            return self.nests[plan.setup]
        return next(reversed(self.nests.values()), None)

    def add_plan(self, plan: CyclePlan) -> None:
        """A cycle begins at the plan's stamp; it ends the one before where that is still open."""
        if (plan.cycle, plan.stamp) not in [(p.cycle, p.stamp) for p in self._plans]:
            self._plans.append(plan)
            self._plans.sort(key=lambda p: p.stamp)
            self._reset()

    def add_feedback(self, sample: Feedback) -> None:
        """Encoder positions; a sample not newer than the one before is dropped (frozen source)."""
        stamps = np.array([sample.stamp], dtype=np.int64)
        self.extend(FeedbackColumns(sample.axes, stamps, sample.position[None]))

    def extend(self, samples: FeedbackColumns) -> None:
        """Many samples at once; see `add_feedback`."""
        self.discarded += self._feedback.extend(samples.axes, samples.stamps, samples.positions)
        last = self._feedback.last
        if last - self._feedback.first > 2 * KEEP_BEFORE_NS and self._waits():
            self._feedback.forget(last - KEEP_BEFORE_NS)

    def add_gauges(self, block: GaugeBlock) -> None:
        """Gauge readings, one message's worth."""
        self._gauges.append(block)
        if block.stamp - self._gauges.first > 2 * KEEP_BEFORE_NS and self._waits():
            self._gauges.forget(block.stamp - KEEP_BEFORE_NS)

    def finished(self) -> Finished | None:
        """The next cycle whose data are complete, or None."""
        plan = self.current
        if plan is None or not len(self._feedback):
            return None
        limit = self._plans[1].stamp if len(self._plans) > 1 else None
        end = self._end.find(plan, self._feedback, self._begin(plan), limit)
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
                # At the end of a session the drivers stop one a little before the other.
                if self._gauges.last - last > _STOPPED_NS:
                    last = self._gauges.last
                ready = self._close(plan, last if limit is None else limit)
            done.append(ready)
        return done

    def progress(self) -> tuple[CyclePlan, int] | None:
        """The current cycle and how many of its poses were reached so far."""
        plan = self.current
        if plan is None:
            return None
        stamps, positions = self._feedback.window(plan, self._begin(plan), self._feedback.last)
        dwells, _ = find_dwells(plan, stamps, positions, self.rules.dwell)
        return plan, len(dwells)

    def _waits(self) -> bool:
        """Whether no cycle has begun."""
        if len(self._plans) > 1:
            return False
        return not self._plans or self._start.find(self._plans[0], self._feedback) is None

    def _begin(self, plan: CyclePlan) -> int:
        """From when data count for the current cycle [ns]."""
        start = self._start.find(plan, self._feedback)
        return plan.stamp if start is None else max(plan.stamp, start - KEEP_BEFORE_NS)

    def _reset(self) -> None:
        self._start.reset()
        self._end.reset()

    def _close(self, plan: CyclePlan, end: int) -> Finished:
        begin = self._begin(plan)
        stamps, positions = self._feedback.window(plan, begin, end)
        times, displacement, status = self._gauges.window(begin, end)
        self._plans.pop(0)
        self._reset()
        self._forget(self._plans[0].stamp if self._plans else end)
        if plan.kind is Kind.DYNAMIC:
            # Its readings are evaluated one by one, not as poses.
            came = len(arrivals(plan, positions, self.rules.dwell))
            rest = range(came, len(plan.commands))
            missing = tuple(Missing(row, 'never reached') for row in rest)
            return Finished(Cycle(plan, (), missing, '', end))
        newest = int(times[-1]) if len(times) else None
        dwells, missing = find_dwells(plan, stamps, positions, self.rules.dwell, end, newest)
        data = (times, displacement, status)
        if plan.kind is Kind.NEST_CALIBRATION:
            return self._calibrate(plan, dwells, missing, data, end)
        nest = self._given.get(plan.setup) or self.nests.get(plan.setup)
        if nest is None:
            problem = f'no nest calibration of set-up {plan.setup}'
            everything = tuple(Missing(row, problem) for row in range(len(plan.commands)))
            return Finished(Cycle(plan, (), everything, '', end), problem=problem)
        points, missing, means = _points(plan, nest, dwells, missing, data)
        return Finished(Cycle(plan, points, missing, nest.calibration, end), means=means)

    def _calibrate(
        self,
        plan: CyclePlan,
        dwells: list[Dwell],
        missing: list[Missing],
        data: tuple[np.ndarray, np.ndarray, np.ndarray],
        end: int,
    ) -> Finished:
        """Eq. 2-5, of lasers Eq. 5-3, on the dwells whose gauges were all valid."""
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
        calibrate = laser.calibrate if self.rules.nest is NestKind.LASER else nests.calibrate
        try:
            nest = calibrate(
                steps, np.array(readings), f'{plan.session}/{plan.cycle}', plan.setup, end,
                self.rules.sphere_radius,
            )
        except nests.CalibrationError as error:
            lost.sort(key=lambda m: m.index)
            return Finished(Cycle(plan, (), tuple(lost), '', end), problem=str(error))
        self.nests[plan.setup] = nest
        points, lost_points, means = _points(plan, nest, dwells, missing, data)
        cycle = Cycle(plan, points, lost_points, nest.calibration, end)
        return Finished(cycle, nest, means=means)

    def _forget(self, before: int) -> None:
        self._feedback.forget(before)
        self._gauges.forget(before)


def _mean(
    dwell: Dwell, data: tuple[np.ndarray, np.ndarray, np.ndarray], needed: int
) -> Average:
    """Mean of the readings of a dwell; NoAverageError also where they scatter too much."""
    times, displacement, status = data
    used = slice(*np.searchsorted(times, [dwell.start, dwell.end + 1]))
    mean = average(displacement[used], status[used], needed)
    scatter = float(np.sqrt(np.trace(mean.covariance) * mean.readings / len(mean.gauges)))
    if scatter > MAX_SCATTER:
        raise NoAverageError(f'readings scatter {scatter * 1e6:.0f} µm: vibration or not settled')
    return mean


def _points(
    plan: CyclePlan,
    nest: NestCalibration,
    dwells: list[Dwell],
    missing: list[Missing],
    data: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[
    tuple[CyclePoint, ...], tuple[Missing, ...], tuple[tuple[Dwell, Average], ...]
]:
    """Sphere centres of the dwells, relative to the first of them (initial reset, Eq. 3-2).

    Also the poses that have none, and the mean readings of those that have some.
    """
    points, lost, means = [], list(missing), []
    needed, locate = _locator(nest)
    for dwell in dwells:
        try:
            if data[1].shape[1] and data[1].shape[1] != len(nest.direction):
                raise NoAverageError(
                    f'{data[1].shape[1]} gauges, the nest was calibrated with '
                    f'{len(nest.direction)}'
                )
            mean = _mean(dwell, data, needed)
            means.append((dwell, mean))
            position, covariance, disagreement = locate(mean)
        except NoAverageError as error:
            lost.append(Missing(dwell.index, str(error)))
            continue
        points.append(
            CyclePoint(
                dwell.index, (dwell.start + dwell.end) // 2, dwell.feedback, dwell.approach,
                position, covariance, mean.readings, disagreement,
            )
        )
    if points:
        reset = points[0].displacement
        points = [replace(p, displacement=p.displacement - reset) for p in points]
    return tuple(points), tuple(sorted(lost, key=lambda m: m.index)), tuple(means)


def _locator(
    nest: NestCalibration,
) -> tuple[int, Callable[[Average], tuple[np.ndarray, np.ndarray, float]]]:
    """How many gauges a sphere centre needs, and what finds it from their mean readings."""
    if nest.kind is NestKind.LASER:
        # The correction belongs to all the lasers together.
        return len(nest.direction), laser.CentreSolver(nest).centre
    return 3, partial(nests.centre, nest)
