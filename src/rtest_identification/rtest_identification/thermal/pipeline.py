"""From the cycles and temperatures of one session to errors over time: for node and command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from rtest_estimation.records import Cycle, Kind
from rtest_identification.location import MAP_SIGNIFICANCE
from rtest_identification.machine import Machine
from rtest_identification.pipeline import Identification, Unused, identify
from rtest_identification.symbols import ErrorParameter
from rtest_identification.thermal.changes import Changes, changes, readings
from rtest_identification.thermal.cycles import (
    FEWEST_POSES,
    duration,
    middle,
    reference,
    repeated,
    without_drift,
)
from rtest_identification.thermal.map_history import (
    MapHistory,
    any_change,
    complete,
    map_history,
)
from rtest_identification.thermal.poses import Poses, poses_of
from rtest_identification.thermal.sensors import (
    Best,
    Clock,
    Dependence,
    best,
    changed,
    dependence,
)
from rtest_identification.thermal.series import Drift, Series, drifts
from rtest_identification.thermal.temperature import Thermometer
from rtest_identification.thermal.time_constants import (
    Phase,
    TimeConstant,
    phases,
    time_constant,
)
from rtest_identification.thermal.within import Within, within
from rtest_identification.uncertainty import AxisPrior

# A cycle that scatters so much more than all of them is told where chance does it this rarely.
_SCATTER_PROBABILITY = 0.01


@dataclass(frozen=True)
class History:
    """Everything about one error over the session.

    constants : time constants by phase; empty where the error does not drift
    dependence : on each sensor that changed
    best : the sensor that explains it; None where it does not drift or no sensor changed
    """

    series: Series
    drift: Drift
    constants: tuple[TimeConstant, ...] = ()
    dependence: tuple[Dependence, ...] = ()
    best: Best | None = None

    @property
    def parameter(self) -> ErrorParameter:
        """The error."""
        return self.series.parameter


@dataclass(frozen=True)
class Thermal:
    """Result for one session.

    cycles : those evaluated, in order of time; others : everything else that was given
    reference : the cycle against which changes are counted, identified by itself
    place : its index in `cycles`
    stamp : (k,) middle of each cycle [ns]; clock : duration and distance of the cycles
    joint : whether the map changes, so that the constants were fitted together with it
    map_probability : of changes of the map this large by noise alone
    restless : names of cycles that scatter more than the others
    notes : what to mind about the values of the reference
    """

    session: str
    machine: Machine
    cycles: tuple[Cycle, ...]
    others: tuple[Cycle, ...]
    thermometers: tuple[Thermometer, ...]
    reference: Identification
    place: int
    stamp: np.ndarray
    clock: Clock
    changes: Changes
    joint: bool
    map_probability: float
    errors: tuple[History, ...]
    map: MapHistory | None
    phases: tuple[Phase, ...]
    within: tuple[Within, ...]
    outliers: tuple[Unused, ...]
    missing: tuple[Unused, ...]
    restless: tuple[str, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    priors: dict[str, AxisPrior] | None = field(default=None, repr=False)

    @property
    def time(self) -> np.ndarray:
        """(k,) middle of each cycle since that of the reference [s]."""
        return (self.stamp - self.stamp[self.place]) * 1e-9

    @property
    def drifting(self) -> tuple[History, ...]:
        """Errors that drift beyond U, the one farthest beyond it first."""
        found = [one for one in self.errors if one.drift.significant]
        return tuple(sorted(found, key=lambda one: -one.drift.size))

    def during_cycles(self, one: Thermometer) -> tuple[np.ndarray, float]:
        """Mean temperature during each cycle (k,) [degC] and its standard uncertainty [K].

        NaN where the sensor was silent. Over no more than the cycle: a longer mean is less noisy,
        but too warm where the heat has just begun, by more than its scatter tells.
        """
        celsius = one.mean(self.stamp, self.clock.duration)
        silent = ~one.covers(self.stamp, self.clock.near)
        return np.where(silent, np.nan, celsius), one.mean_stddev(self.clock.duration)


def identify_thermal(
    machine: Machine,
    cycles: Sequence[Cycle],
    thermometers: Sequence[Thermometer] = (),
    priors: dict[str, AxisPrior] | None = None,
) -> Thermal:
    """Identify every cycle of a thermal session: what changed since the first one.

    cycles : finished cycles of one session, in any order: nest calibration, run-out, and the
        repeated cycle, also cut short or with poses missing
    priors : what is known of the linear axes' error motions, for the reference

    Raises UserError where no cycle can be evaluated.
    """
    cycles = sorted(cycles, key=lambda c: (c.plan.stamp, c.plan.cycle))
    chosen, model, warnings = repeated(cycles)
    poses = poses_of(machine, model.plan)
    place, some = reference(poses, model, chosen)
    before = [
        c for c in cycles
        if c.plan.kind is not Kind.STATIC and c.plan.stamp < chosen[place].plan.stamp
    ]
    stamp = np.array([middle(c) for c in chosen], dtype=np.int64)
    time = (stamp - stamp[place]) * 1e-9
    taken, moving = chosen, []
    for last in (False, True):
        # When the drift from cycle to cycle is known, that within the cycles can be taken off;
        # only then an outlier can be told from it.
        taken = [without_drift(c, model, poses, moving, int(stamp[place])) for c in taken]
        start = identify(machine, [*before, taken[place]], priors)
        found = _changes(poses, taken, place, start, last)
        probability = any_change(found)
        joint = probability < MAP_SIGNIFICANCE
        series = _series(found, time, joint)
        judged = drifts(series, found.freedom)
        moving = [s for s, d in zip(series, judged, strict=True) if d.significant]
    period = float(np.median(np.diff(stamp))) * 1e-9 if len(stamp) > 1 else 0.0
    clock = Clock(int(stamp[place]), duration(chosen[place]), period)
    parts = phases(moving, time)
    warm = [t for t in thermometers if changed(t, time, clock)]
    names = [c.plan.cycle for c in chosen]
    restless = [names[n] for n in _restless(found)]
    warnings += [*some, *_about(found, names, restless), *_silent(thermometers, stamp, clock)]
    single = found.noise if np.isfinite(found.noise) else start.fit.rms
    visited = readings(poses, chosen[place], np.zeros((len(machine.letters), 6))).stamp
    used = {id(c) for c in chosen}
    return Thermal(
        next((c.plan.session for c in chosen if c.plan.session), ''), machine, tuple(chosen),
        tuple(c for c in cycles if id(c) not in used), tuple(thermometers), start, place, stamp,
        clock, found, joint, probability,
        tuple(_history(s, d, parts, warm, clock) for s, d in zip(series, judged, strict=True)),
        map_history(found), parts,
        tuple(within(poses, visited, found.used[place], single, moving)),
        _outliers(found, names), _missing(chosen), tuple(restless), tuple(warnings),
        (*start.warnings, *start.notes), priors,
    )


def extend(
    result: Thermal, cycle: Cycle, thermometers: Sequence[Thermometer] | None = None
) -> Thermal:
    """The same session with one more finished cycle, as if all had been given at once.

    thermometers : everything they have read so far; as before where omitted
    """
    known = result.thermometers if thermometers is None else thermometers
    cycles = [*result.others, *result.cycles, cycle]
    return identify_thermal(result.machine, cycles, known, result.priors)


def _changes(
    poses: Poses, cycles: Sequence[Cycle], place: int, start: Identification, last: bool
) -> Changes:
    errors = np.zeros((len(poses.machine.letters), 6))
    errors.flat[[p.column for p in start.location.parameters]] = start.location.value
    return changes(poses, [readings(poses, cycle, errors) for cycle in cycles], place, last)


def _series(found: Changes, time: np.ndarray, joint: bool) -> list[Series]:
    """Every constant over the cycles.

    joint : whether they are fitted with the map; a mean over stations is then known only where no
        station is missing
    """
    gain = [g.joint if joint else g.alone for g in found.gains]
    values, stddev, scatter = found.values(gain), found.stddev(gain), found.scatter(gain)
    enough, whole = _enough(found), complete(found)
    series = []
    for number, parameter in enumerate(found.poses.constants):
        known = [
            bool(e) and bool(g.determined[number]) and (not joint or bool(w))
            for e, w, g in zip(enough, whole, found.gains, strict=True)
        ]
        series.append(Series(
            parameter, time, np.where(known, values[:, number], np.nan),
            np.where(known, stddev[:, number], np.nan),
            np.sqrt([c[number, number] for c in scatter]),
        ))
    return series


def _enough(found: Changes) -> np.ndarray:
    """(k,) cycles that share enough poses with the reference."""
    return found.used.sum(axis=1) >= FEWEST_POSES


def _history(
    one: Series,
    drift: Drift,
    parts: Sequence[Phase],
    thermometers: Sequence[Thermometer],
    clock: Clock,
) -> History:
    found = [dependence(one, t, clock, drift.significant) for t in thermometers]
    known = tuple(f for f in found if f is not None)
    if not drift.significant:
        return History(one, drift, (), known)
    constants = [time_constant(one, part, clock.period) for part in parts]
    return History(one, drift, tuple(c for c in constants if c), known, best(known))


def _restless(found: Changes) -> list[int]:
    """Cycles that leave more than all of them do."""
    count = int((found.used.sum(axis=1) > 0).sum())
    if count < 3 or not found.freedom:
        return []
    told = []
    for number, gain in enumerate(found.gains):
        # The mean over the cycles, which is taken off, has its share of every one.
        freedom = (3 * int(found.used[number].sum()) - gain.rank) * (count - 1) / count
        if freedom <= 0.0:
            continue
        ratio = float(np.nansum(found.residual[number] ** 2)) / freedom / found.noise**2
        if stats.f.sf(ratio, freedom, found.freedom) * count < _SCATTER_PROBABILITY:
            told.append(number)
    return told


def _about(found: Changes, names: Sequence[str], restless: Sequence[str]) -> list[str]:
    """What to mind about the cycles."""
    warnings = []
    enough, whole = _enough(found), complete(found)
    short = [names[n] for n in np.flatnonzero(~enough)]
    if short:
        warnings.append(f'fewer than {FEWEST_POSES} poses, not evaluated: {", ".join(short)}')
    lost = [
        p.symbol for n, p in enumerate(found.poses.constants)
        if not any(gain.determined[n] for gain in found.gains)
    ]
    if lost:
        warnings.append(f'not determined at this sphere position: {", ".join(lost)}')
    part = [names[n] for n in np.flatnonzero(enough & ~whole)]
    if part:
        warnings.append(f'cut short, not everything is determined: {", ".join(part)}')
    if restless:
        warnings.append(
            f'more scatter than in the other cycles: {", ".join(restless)}; something changed '
            'there that is neither a constant error nor in the map'
        )
    if len(names) == 1:
        warnings.append('one cycle only: nothing can be said of changes yet')
    return warnings


def _silent(
    thermometers: Sequence[Thermometer], stamp: np.ndarray, clock: Clock
) -> list[str]:
    return [
        f'thermometer {t.sensor} was silent during some cycles, which are not compared with it'
        for t in thermometers
        if not t.covers(stamp, clock.near).all()
    ]


def _outliers(found: Changes, names: Sequence[str]) -> tuple[Unused, ...]:
    return tuple(
        Unused(names[cycle], int(pose), 'far from the same pose in the other cycles')
        for cycle, pose in np.argwhere(found.outliers)
    )


def _missing(static: Sequence[Cycle]) -> tuple[Unused, ...]:
    return tuple(
        Unused(cycle.plan.cycle, item.index, item.reason)
        for cycle in static
        for item in cycle.missing
    )
