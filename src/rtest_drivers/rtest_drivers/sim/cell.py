"""The simulated machine cell: carries out plans in simulated time, yields readings and feedback.

Readings and feedback lie on fixed grids of simulated time and draw their noise in order; the
random parts of a dwell or a mounting are drawn from the seed and its name. So what comes out does
not depend on how time is chopped into steps.
"""

from __future__ import annotations

import zlib
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from rtest_drivers.sim import gauges, laser
from rtest_drivers.sim.encoders import EncoderReadings
from rtest_drivers.sim.faults import Window, of_cycle, skipped_poses, timed
from rtest_drivers.sim.gauge_readings import GaugeReadings
from rtest_drivers.sim.kinematics import sphere_in_table, table_to_sphere
from rtest_drivers.sim.limits import check
from rtest_drivers.sim.motion import SPINDLE, Timeline
from rtest_drivers.sim.truth import Truth
from rtest_drivers.sim.warming import Thermometers, WarmErrors
from rtest_estimation.dwell import turns
from rtest_estimation.records import (
    CyclePlan,
    Feedback,
    GaugeBlock,
    Kind,
    Status,
    Temperature,
)

_READINGS, _OUTLIERS, _ENCODERS, _THERMOMETERS = 1, 2, 3, 4
# Around a cycle everything is read as usual for so long: the end of one and the start of the next
# are seen in the readings [ns].
_NEAR_NS = 5_000_000_000
# A dynamic cycle rests so long wherever it turns round; half the time over which speeds are
# differences [ns].
_REST, _HALF_SPAN = 1_000_000_000, 1_000_000
# What goes wrong in a whole cycle does so until its last pose is over also by the encoders, which
# are read a little after the axes have stopped; no next pose is as near [ns].
_LINGER_NS = 100_000_000
# From and to [ns].
Wait = tuple[int, int] | None


@dataclass(frozen=True)
class Run:
    """A plan being or having been carried out: from start to end [ns]."""

    plan: CyclePlan
    start: int
    end: int


@dataclass(frozen=True)
class Output:
    """What the cell yielded in a step, in order of time."""

    blocks: list[GaugeBlock]
    feedback: list[Feedback]
    temperatures: list[Temperature] = field(default_factory=list)


class Cell:
    """A machine, a nest and encoders; `epoch` [ns] is where simulated time starts.

    Plans are carried out in the order they are queued, none before its own stamp.
    """

    def __init__(self, truth: Truth, epoch: int) -> None:
        self.truth, self.epoch, self.now = truth, epoch, epoch
        self._timeline = Timeline(truth.machine, truth.drives, epoch)
        self._plans: deque[CyclePlan] = deque()
        self._run: Run | None = None
        self._setup: str | None = None
        self._nests: list[gauges.Nest | laser.LaserNest] = []
        self._windows: list[Window] = timed(truth.faults, epoch)
        self._warm_from: int | None = None
        # Numbers of the next reading, feedback and temperature.
        self._reading = self._feedback = self._temperature = 0
        readings, outliers, encoders, thermometers = (
            np.random.default_rng([truth.seed, stream])
            for stream in (_READINGS, _OUTLIERS, _ENCODERS, _THERMOMETERS)
        )
        self._gauges = GaugeReadings(truth.gauges, readings, outliers)
        self._encoders = EncoderReadings(truth.encoders, truth.machine, self.axes, encoders)
        self._thermometers = Thermometers(truth.warming, thermometers) if truth.warming else None

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the feedback: the machine's letters and the spindle S."""
        return self._timeline.axes

    @property
    def run(self) -> Run | None:
        """The plan being carried out, or the last one."""
        return self._run

    @property
    def waiting(self) -> int:
        """Plans that have not started."""
        return len(self._plans)

    @property
    def busy(self) -> bool:
        """Whether a plan waits or is being carried out."""
        return bool(self._plans) or (self._run is not None and self.now < self._run.end)

    @property
    def waits_until(self) -> int | None:
        """When readings are as usual again [ns]; None while they are."""
        wait = self._long_wait()
        return wait[1] if wait is not None and wait[0] <= self.now < wait[1] else None

    def queue(self, plan: CyclePlan) -> None:
        """Carry out a plan when those before it are done and its stamp has come.

        Raises UserError where the machine cannot do it.
        """
        check(plan, self.truth)
        self._plans.append(plan)

    def advance(self, until: int) -> Output:
        """Go on to simulated time `until` [ns]; yields what was complete by then."""
        output = Output([], [])
        while self.now < until:
            self._start_plans()
            step = until
            # A plan must start when it is due, not at the end of the step.
            due = self._next_start()
            if due is not None and self.now < due < until:
                step = due
            self.now = step
            # Before the plan that ends it is taken.
            wait = self._long_wait()
            self._start_plans()
            self._read_gauges(output.blocks, wait)
            self._read_encoders(output.feedback, wait)
            self._read_thermometers(output.temperatures)
        return output

    # --- plans ---

    def _next_start(self) -> int | None:
        if not self._plans:
            return None
        free = self._run.end if self._run else self.epoch
        return max(self._plans[0].stamp, free)

    def _long_wait(self) -> Wait:
        """The stretch before the next cycle in which little is read; None without one."""
        due = self._next_start()
        if not self.truth.thin or due is None:
            return None
        free = self._run.end if self._run else self.epoch
        return free + _NEAR_NS, due - _NEAR_NS

    def _wanted(self, numbers: np.ndarray, period: int, wait: Wait) -> np.ndarray:
        """Which of the readings with these numbers are given, one every `period` [ns]."""
        if wait is None:
            return numbers
        times = self.epoch + (numbers + 1) * period
        near = (times < wait[0]) | (times >= wait[1])
        return numbers[near | (numbers % max(self.truth.thin // period, 1) == 0)]

    def _start_plans(self) -> None:
        due = self._next_start()
        if due is not None and due <= self.now:
            self._start(self._plans.popleft(), self.now)

    def _start(self, plan: CyclePlan, start: int) -> None:
        if plan.kind is Kind.STATIC and self._warm_from is None:
            self._warm_from = start
        skipped = skipped_poses(self.truth.faults, plan.cycle)
        turning = turns(plan)
        dwell = _REST if turning else round(plan.dwell * 1e9)
        columns = [self.axes.index(name) for name in plan.axes]
        poses: dict[int, tuple[int, int]] = {}
        clock = start
        for pose, row in enumerate(plan.commands):
            if pose in skipped:
                continue
            target = self._timeline.last.end.copy()
            if SPINDLE not in plan.axes:
                target[-1] = 0.0
            target[columns] = row
            # Nothing settles anew where a dynamic cycle turns round.
            name = plan.cycle if turning else f'{plan.cycle}/{pose}'
            offset = self.truth.gauges.dwell_noise * self._named(name).standard_normal(3)
            speed = plan.feed if plan.kind is Kind.DYNAMIC and poses else 0.0
            if plan.setup != self._setup:
                self._setup = plan.setup
                leg = self._timeline.append(clock, target, -1, offset)
                clock = max(leg.arrival, clock + round(self.truth.remount * 1e9))
                self._mount(plan)
                self._timeline.rest(clock, len(self._nests) - 1, offset)
            else:
                clock = self._timeline.append(
                    clock, target, len(self._nests) - 1, offset, speed, turning
                ).arrival
            poses[pose] = (clock, clock + dwell)
            clock += dwell
        self._run = Run(plan, start, clock)
        whole = start, clock + _LINGER_NS
        self._windows += of_cycle(self.truth.faults, plan.cycle, poses, whole)

    def _mount(self, plan: CyclePlan) -> None:
        rng = self._named(f'nest/{len(self._nests)}/{plan.setup}')
        self._nests.append(gauges.mount(self.truth.gauges, plan.sphere, rng))

    def _named(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self.truth.seed, zlib.crc32(name.encode())])

    # --- what is read ---

    def _read_gauges(self, blocks: list[GaugeBlock], wait: Wait) -> None:
        data = self.truth.gauges
        # Readings lie at epoch + 1, 2, ... periods; a block is complete with its last one.
        complete = (self.now - self.epoch) // data.period // data.batch * data.batch
        while self._reading < complete:
            stop = min(complete, self._reading + 64 * data.batch)
            firsts = self._wanted(
                np.arange(self._reading // data.batch, stop // data.batch),
                data.batch * data.period, wait,
            )
            numbers = (firsts[:, None] * data.batch + np.arange(data.batch)).ravel()
            times = self.epoch + (numbers + 1) * data.period
            blocks += self._gauges.blocks(times, *self._measure(times), self._windows)
            self._reading = stop

    def _measure(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        data = self.truth.gauges
        # Drawn whatever the state, so that every reading keeps its own noise.
        noise = self._gauges.noise(len(times))
        values = np.zeros(noise.shape)
        status = np.full(noise.shape, Status.NO_SIGNAL, dtype=np.uint8)
        state = self._timeline.at(times)
        mounted = state.nest >= 0
        if mounted.any():
            sphere = self._sphere(state.positions[mounted], times[mounted])
            sphere += state.offset[mounted]
            if data.friction:
                velocity = self._velocity(times[mounted], state.positions[mounted])
                sphere += gauges.friction(data, velocity)
            surface = None
            if data.laser:
                surface = table_to_sphere(self.truth.machine, state.positions[mounted])
            held, found = values[mounted], status[mounted]
            for index in np.unique(state.nest[mounted]):
                rows = state.nest[mounted] == index
                held[rows], found[rows] = self._nests[index].measure(
                    sphere[rows], noise[mounted][rows], None if surface is None else surface[rows]
                )
            values[mounted], status[mounted] = held, found
        return values, status

    def _sphere(self, positions: np.ndarray, times: np.ndarray) -> np.ndarray:
        """True sphere centre in the table frame (n, 3) [m]; the run-out turns with the spindle.

        positions : (n, k); times : (n,) [ns]
        """
        cosine, sine = np.cos(positions[:, -1]), np.sin(positions[:, -1])
        x, y = self.truth.runout
        runout = np.column_stack([x * cosine - y * sine, x * sine + y * cosine, 0.0 * sine])
        errors = self.truth.errors
        if self.truth.warming is not None:
            errors = WarmErrors(errors, self.truth.warming, self._warm_for(times))
        return sphere_in_table(self.truth.machine, positions[:, :-1], errors, runout)

    def _warm_for(self, times: np.ndarray) -> np.ndarray:
        """How long the heat has been on at these times [s], negative before."""
        if self._warm_from is None:
            return np.full(len(times), -1.0)
        return (times - self._warm_from) * 1e-9

    def _velocity(self, times: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """(n, 3) how the linear axes carry the sphere, frame ``table`` [m/s]."""
        machine = self.truth.machine
        linear = [machine.letters.index(name) for name in machine.linear]
        ends = []
        for step in (-_HALF_SPAN, _HALF_SPAN):
            moved = positions[:, :-1].copy()
            moved[:, linear] = self._timeline.at(times + step).positions[:, linear]
            ends.append(sphere_in_table(machine, moved))
        return (ends[1] - ends[0]) / (2e-9 * _HALF_SPAN)

    def _read_encoders(self, feedback: list[Feedback], wait: Wait) -> None:
        period = self.truth.encoders.period
        complete = (self.now - self.epoch) // period
        if complete <= self._feedback:
            return
        numbers = self._wanted(np.arange(self._feedback, complete), period, wait)
        times = self.epoch + (numbers + 1) * period
        feedback += self._encoders.read(times, self._timeline.at(times).positions, self._windows)
        self._feedback = complete

    def _read_thermometers(self, temperatures: list[Temperature]) -> None:
        if self._thermometers is None:
            return
        period = self.truth.warming.period
        complete = (self.now - self.epoch) // period
        times = self.epoch + (np.arange(self._temperature, complete) + 1) * period
        temperatures += self._thermometers.read(times, self._warm_for(times))
        self._temperature = complete
