"""Times, values and findings in words, for the report and the command."""

from __future__ import annotations

import math

from rtest_estimation.missing import grouped
from rtest_identification.symbols import ErrorParameter
from rtest_identification.thermal.pipeline import History, Thermal
from rtest_identification.thermal.sensors import FEWEST_INDEPENDENT, Dependence
from rtest_identification.thermal.temperature import Thermometer
from rtest_identification.thermal.time_constants import TimeConstant
from rtest_identification.uncertainty import COVERAGE_FACTOR

# A session shorter than this is told in minutes [s].
HOURS = 7200.0
# What is shorter is told in seconds [s].
_FEW = 120.0


def minutes(seconds: float) -> str:
    """For example 15 min; seconds where it is few, hours where it is many."""
    if not math.isfinite(seconds):
        return '∞'
    if abs(seconds) < _FEW:
        return f'{seconds:.0f} s'
    if abs(seconds) < HOURS:
        return f'{seconds / 60.0:.0f} min'
    return f'{seconds / 3600.0:.1f} h'


def moment(seconds: float, span: float) -> str:
    """A time within a session of this length: 1.5 h, or 45 min where the session is short."""
    if span >= HOURS:
        return f'{round(seconds / 3600.0, 2) + 0.0:g} h'
    return f'{round(seconds / 60.0) + 0:d} min'


def unit(parameter: ErrorParameter) -> str:
    """Unit that a person reads."""
    return 'µrad' if parameter.angular else 'µm'


def with_uncertainty(value: float, stddev: float) -> str:
    """For example -6.02 ± 0.21, micrometres or microradians with U (k = 2)."""
    if not math.isfinite(value):
        return 'not determined'
    return f'{1e6 * value:+.2f} ± {COVERAGE_FACTOR * 1e6 * stddev:.2f}'


def tau(constant: TimeConstant) -> str:
    """Time constant with its interval, or why there is none."""
    if constant.undetermined:
        return f'not determined: {constant.undetermined}'
    low, high = constant.interval
    return f'{minutes(constant.tau)} ({minutes(low)} to {minutes(high)})'


def lag(one: Dependence) -> str:
    """Lag with its interval, or why there is none."""
    low, high = (value / 60.0 for value in one.lag.interval)
    if one.lag.undetermined:
        between = f' ({low:+.0f} to {high:+.0f} min)' if math.isfinite(low) else ''
        return f'not determined: {one.lag.undetermined}{between}'
    return f'{one.lag.value / 60.0:+.0f} min ({low:+.0f} to {high:+.0f})'


def correlation(one: Dependence) -> str:
    """Coefficient with U, and what it is worth."""
    text = f'{one.correlation:+.3f} ± {COVERAGE_FACTOR * one.correlation_stddev:.3f}'
    worth = f'{one.independent:.1f} independent values'
    if one.independent < FEWEST_INDEPENDENT:
        worth += ': says nothing of a cause'
    return f'{text} ({worth})'


def warming(result: Thermal, one: Thermometer) -> str:
    """Change of a temperature from the reference to the last cycle, +1.40 ± 0.04 K (k = 2).

    '' where the sensor was silent in one of them.
    """
    celsius, stddev = result.during_cycles(one)
    change = float(celsius[-1] - celsius[result.place])
    if not math.isfinite(change) or result.place == len(celsius) - 1:
        return ''
    # Both readings scatter.
    return f'{change:+.2f} ± {COVERAGE_FACTOR * math.sqrt(2.0) * stddev:.2f} K'


def drift(one: History) -> str:
    """For example E_Y(0Y)B: -6.02 ± 0.21 µm in 3.0 h, beyond U since 15 min."""
    known = one.series.time[one.series.known]
    text = f'{one.parameter.symbol}: {with_uncertainty(*one.drift.last)} {unit(one.parameter)} ' \
           f'in {minutes(float(known[-1]))}'
    if one.drift.beyond_since is None:
        largest = with_uncertainty(*one.drift.largest)
        return f'{text}, {largest} in between'
    return f'{text}, beyond U since {minutes(one.drift.beyond_since)}'


def explained(one: History) -> str:
    """Which sensor explains an error, and how well; '' where that cannot be said."""
    if one.best is None:
        return ''
    (chosen,) = (d for d in one.dependence if d.sensor == one.best.sensor)
    per = f'{with_uncertainty(chosen.delayed_sensitivity, chosen.delayed_stddev)} ' \
          f'{unit(one.parameter)}/K'
    when = f' of {minutes(chosen.delay)} before' if chosen.delay > 0.0 else ''
    text = f'{chosen.sensor}{when} explains {100.0 * chosen.explained:.1f} % with {per}'
    if one.best.rivals:
        text += f'; not told from {", ".join(one.best.rivals)}'
    return text


def probability(value: float) -> str:
    """For example 0.03; a very small one is told as such."""
    return '< 1e-6' if value < 1e-6 else f'{value:.2g}'


def missing(result: Thermal) -> list[str]:
    """Missing poses by cycle and reason, for example `thermal-05 13-26: not reached`."""
    return [
        f'{cycle.plan.cycle} {line}' for cycle in result.cycles for line in grouped(cycle.missing)
    ]


def summary(result: Thermal) -> str:
    """One line: cycles, what drifts, the sensor that explains most of it."""
    head = f'{len(result.cycles)} cycles in {minutes(float(result.time[-1] - result.time[0]))}'
    if len(result.cycles) < 2:
        return f'{head}: nothing to compare'
    if not result.drifting:
        return f'{head}, nothing drifts beyond U'
    told = ', '.join(_size(one) for one in result.drifting)
    count = len(result.drifting)
    return f'{head}, {count} error{"s" if count > 1 else ""} beyond U: {told} (k = 2)'


def _size(one: History) -> str:
    """Last change of an error; its largest one where it has come back."""
    back = one.drift.beyond_since is None
    size = with_uncertainty(*(one.drift.largest if back else one.drift.last))
    return f'{one.parameter.symbol} {"up to " if back else ""}{size} {unit(one.parameter)}'
