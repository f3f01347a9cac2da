"""Whether a measuring chain is fit to measure: judged from a short recorded session.

The session is a nest calibration, a run-out, a cycle of ten visits to one pose and one in which
the sphere stands still in the nest (session file with `kind: check`). Each finding has a value, a
limit, a verdict and what to do. The limits are those at which an R-test with a noise of some
tenths of a micrometre begins to suffer, not those of a standard.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_estimation import runout
from rtest_estimation.pipeline import Finished
from rtest_estimation.records import Kind, NestCalibration, NestKind
from rtest_estimation.standing import Standing, folded

RIGHT, WRONG, OPEN = 'right', 'wrong', 'open'
_WORSE = (RIGHT, OPEN, WRONG)
# A gauge that moves by less of its direction along the nest's axis hardly sees the sphere leave.
_LEAST_ALONG = 0.2
# A gain further from one is a wrong unit or scale, not a tilted gauge.
_GAIN = 0.05
_RESIDUAL, _CONDITION = 2e-6, 4.0
_RUNOUT, _RUNOUT_FORM = 10e-6, 1e-6
_REPEATABILITY = 1e-6
# Fewer visits say little of a scatter.
_FEWEST_VISITS = 5
_NOISE, _LINE = 0.5e-6, 0.2e-6
# So long must nothing move for a spectrum that tells 50 from 60 Hz and from a spindle [s].
_STANDING_S = 10.0
_DRIFT = 1e-6 / 600.0
_TEMPERATURE = 0.5
# Fewer say nothing of how sure a rate is; a thermometer that never changed is taken to show tenths
# [K].
_FEWEST_TEMPERATURES, _DISPLAY = 5, 0.1
_MAINS = (50.0, 60.0)
_HARMONICS = 3


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    verdict : RIGHT, WRONG, or OPEN where the session does not tell
    advice : what to do where it is not right
    """

    what: str
    value: str
    limit: str
    verdict: str
    advice: str = ''


def check_chain(
    cycles: Sequence[Finished],
    standing: Standing | None,
    temperatures: Mapping[str, tuple[np.ndarray, np.ndarray]],
    towards: np.ndarray,
    spindle_hz: float | None = None,
) -> list[Finding]:
    """Everything that a check session tells.

    temperatures : sensor to stamps [ns] and values [deg C]
    towards : (3,) unit vector from the nest to where the sphere comes from, frame ``table``
    spindle_hz : of the spindle, where it turns meanwhile
    """
    nests = [one.nest for one in cycles if one.nest is not None]
    problems = [one.problem for one in cycles if one.problem]
    found: list[Finding] = []
    if nests:
        nest = nests[-1]
        # A laser's beam need not go against the approach, and it has no gain.
        found += gauges(nest, towards) if nest.kind is NestKind.CONTACT else []
        found += calibration(nest)
    else:
        why = problems[0] if problems else 'measure a nest calibration'
        found.append(Finding('nest calibration', '', '', OPEN, why))
    return [
        *found, sphere_runout(cycles), repeatability(cycles), *noise(standing, spindle_hz),
        temperature(temperatures),
    ]


def gauges(nest: NestCalibration, towards: np.ndarray) -> list[Finding]:
    """Each gauge: is it pushed in when the sphere comes, and by as much as the axes move."""
    found = []
    for number, direction in enumerate(nest.direction, 1):
        along = -float(direction @ towards)
        verdict, advice = RIGHT, ''
        if along < _LEAST_ALONG:
            verdict = WRONG
            advice = 'it counts the other way: change its sign in the device file'
        if abs(along) < _LEAST_ALONG:
            advice = ('it hardly sees the sphere come; check its channel, its mounting, and '
                      '`direction` under `moves`')
        x, y, z = direction
        found.append(Finding(
            f'gauge {number} responds to', f'X {x:+.3f}, Y {y:+.3f}, Z {z:+.3f}',
            f'at least {_LEAST_ALONG:g} against the approach', verdict, advice,
        ))
    for number, gain in enumerate(nest.gain, 1):
        good = abs(gain - 1.0) <= _GAIN
        found.append(Finding(
            f'gauge {number} gain', f'{gain:.4f}', f'1 ± {_GAIN:g}', RIGHT if good else WRONG,
            '' if good else 'its unit or scale is wrong, or the axes moved by another step',
        ))
    return found


def calibration(nest: NestCalibration) -> list[Finding]:
    """Residual and geometry of the nest calibration."""
    residual, condition = nest.residual <= _RESIDUAL, nest.condition <= _CONDITION
    return [
        Finding(
            'nest calibration residual', f'{nest.residual * 1e6:.2f} µm',
            f'{_RESIDUAL * 1e6:g} µm', RIGHT if residual else WRONG,
            '' if residual else 'a gauge sticks or is loose, or the axes do not settle; use a '
            'smaller step or a longer dwell',
        ),
        Finding(
            'nest geometry, condition', f'{nest.condition:.2f}', f'{_CONDITION:g}',
            RIGHT if condition else WRONG,
            '' if condition else 'the gauges look nearly into one plane; set them at right angles '
            'to each other (1 is best)',
        ),
    ]


def sphere_runout(cycles: Sequence[Finished]) -> Finding:
    """Offset of the sphere from the spindle axis, and how round it runs."""
    what = 'sphere run-out'
    limit = f'{_RUNOUT * 1e6:g} µm, round within {_RUNOUT_FORM * 1e6:g} µm'
    turned = [one.cycle for one in cycles if one.cycle.plan.kind is Kind.SPINDLE_RUNOUT]
    if not turned:
        return Finding(what, '', limit, OPEN, 'measure it: `spindle_runout` in the session file')
    try:
        found = runout.fit(np.array([p.displacement[:2] for p in turned[-1].points]))
    except ValueError as error:
        return Finding(what, '', limit, OPEN, str(error))
    value = f'{found.radius * 1e6:.2f} µm, round within {found.residual * 1e6:.2f} µm'
    if found.residual > _RUNOUT_FORM:
        advice = 'the sphere or its stem is loose, or the spindle does not stand still'
        return Finding(what, value, limit, WRONG, advice)
    if found.radius > _RUNOUT:
        return Finding(what, value, limit, WRONG, 'centre the sphere in its holder')
    return Finding(what, value, limit, RIGHT)


def repeatability(cycles: Sequence[Finished]) -> Finding:
    """Scatter of the visits to the pose that one cycle visits most often."""
    what, limit = 'repeatability of one pose', f'{_REPEATABILITY * 1e6:g} µm rms'
    best = np.empty((0, 3))
    for one in cycles:
        if one.cycle.plan.kind is not Kind.STATIC or not one.cycle.points:
            continue
        commands = one.cycle.plan.commands[[p.index for p in one.cycle.points]]
        moved = np.array([p.displacement for p in one.cycle.points])
        _, which, counts = np.unique(
            commands.round(9), axis=0, return_inverse=True, return_counts=True
        )
        visits = moved[which.ravel() == counts.argmax()]
        best = visits if len(visits) > len(best) else best
    if len(best) < _FEWEST_VISITS:
        advice = 'measure a cycle of `kind: check`, which visits one pose ten times'
        return Finding(what, f'{len(best)} visits', limit, OPEN, advice)
    scatter = float(np.sqrt(best.var(axis=0, ddof=1).sum() / 3.0))
    value = f'{scatter * 1e6:.2f} µm in {len(best)} visits'
    if scatter <= _REPEATABILITY:
        return Finding(what, value, limit, RIGHT)
    steps = np.linalg.norm(np.diff(best, axis=0), axis=1)
    across = float(np.linalg.norm(best[-1] - best[0]))
    advice = 'something is loose: nest, sphere holder, table clamping; or an axis has backlash'
    # A drift adds up over the visits, scatter does not.
    if across > 0.7 * steps.sum():
        advice = 'it drifts: let the machine and the gauges warm up'
    return Finding(what, value, limit, WRONG, advice)


def noise(standing: Standing | None, spindle_hz: float | None = None) -> list[Finding]:
    """Scatter, lines of the spectrum and drift of each gauge while nothing moves."""
    if standing is None or standing.duration < _STANDING_S:
        seconds = 0.0 if standing is None else standing.duration
        return [Finding(
            'noise', f'{seconds:.1f} s without motion', f'at least {_STANDING_S:g} s', OPEN,
            'measure a session of `kind: check`, in which the sphere stands still',
        )]
    found = []
    for index, spread in enumerate(standing.noise):
        good = spread <= _NOISE
        found.append(Finding(
            f'gauge {index + 1} noise', f'{spread * 1e6:.3f} µm rms', f'{_NOISE * 1e6:g} µm',
            RIGHT if good else WRONG,
            '' if good else 'see its lines; check cable, shield, supply and mounting',
        ))
        lines = standing.lines(index)
        strongest = lines[0] if lines else None
        value = 'none' if strongest is None else (
            f'{strongest.amplitude * 1e6:.3f} µm at {strongest.frequency:.2f} Hz, '
            f'{source_of(strongest.frequency, standing, spindle_hz)}'
        )
        bad = strongest is not None and strongest.amplitude > _LINE
        found.append(Finding(
            f'gauge {index + 1} strongest line', value, f'{_LINE * 1e6:g} µm',
            WRONG if bad else RIGHT,
            'switch pumps, fans and the spindle off one by one, earth the shield' if bad else '',
        ))
        drift, spread = standing.drift[index] * 6e8, standing.drift_spread[index] * 6e8
        verdict = _exceeds(drift, spread, _DRIFT * 6e8)
        found.append(Finding(
            f'gauge {index + 1} drift', f'{drift:+.2f} ± {spread:.2f} µm in 10 min',
            f'{_DRIFT * 6e8:g} µm', verdict, {
                RIGHT: '', WRONG: 'let the gauges warm up, close the doors',
                OPEN: 'too much noise to tell in so short a time; mend the noise first',
            }[verdict],
        ))
    hidden = [f'{mains:g} Hz' for mains in _MAINS if folded(mains, standing.rate) * (
        standing.duration) < 4.0]
    if hidden:
        found.append(Finding(
            'mains hum', f'hum of {" and ".join(hidden)} cannot be seen at '
            f'{standing.rate:.1f} readings a second', '', OPEN,
            'it would look like a constant; read the gauges at another rate once',
        ))
    return found


def source_of(frequency: float, standing: Standing, spindle_hz: float | None = None) -> str:
    """What a line may come from, in words; it may be folded."""
    sources = [(f'mains {mains:g} Hz', mains) for mains in _MAINS]
    if spindle_hz:
        sources.append(('spindle', spindle_hz))
    for harmonic in range(1, _HARMONICS + 1):
        for name, base in sources:
            if abs(folded(harmonic * base, standing.rate) - frequency) < standing.resolution:
                order = '' if harmonic == 1 else f', harmonic {harmonic}'
                fold = ', folded' if harmonic * base > standing.rate / 2.0 else ''
                return f'{name}{order}{fold}'
    return 'source not known'


def temperature(sensors: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Finding:
    """Largest change of a thermometer an hour."""
    what, limit = 'temperature', f'{_TEMPERATURE:g} K/h'
    rates = {
        name: found for name, (stamps, values) in sensors.items()
        if (found := _hourly(stamps, values)) is not None
    }
    if not rates:
        return Finding(what, 'no thermometer', limit, OPEN, 'watch the room and the doors')
    verdicts = {name: _exceeds(*rate, _TEMPERATURE) for name, rate in rates.items()}
    name = max(rates, key=lambda key: (_WORSE.index(verdicts[key]), abs(rates[key][0])))
    (rate, spread), verdict = rates[name], verdicts[name]
    return Finding(what, f'{name} {rate:+.2f} ± {spread:.2f} K/h', limit, verdict, {
        RIGHT: '', WRONG: 'wait until the machine and the room are steady',
        OPEN: 'too short or too coarse to tell; record for an hour without measuring',
    }[verdict])


def _hourly(stamps: np.ndarray, values: np.ndarray) -> tuple[float, float] | None:
    """Change of a thermometer and its expanded uncertainty at 95 % [K/h]; None for too few.

    stamps : (n,) [ns]; values : (n,) [deg C]
    """
    good = np.isfinite(values)
    hours, values = (stamps[good] - stamps[0]) / 3.6e12, values[good]
    if len(values) < _FEWEST_TEMPERATURES or not hours[-1] > hours[0]:
        return None
    (rate, _), covariance = np.polyfit(hours, values, 1, cov=True)
    scatter = stats.t.ppf(0.975, len(values) - 2) * math.sqrt(max(covariance[0, 0], 0.0))
    # Of what lies between two steps of its display a thermometer says nothing.
    steps = np.abs(np.diff(np.unique(values)))
    step = float(steps.min()) if len(steps) else _DISPLAY
    return float(rate), scatter + step / float(hours[-1] - hours[0])


def _exceeds(value: float, spread: float, limit: float) -> str:
    """WRONG beyond the limit and RIGHT within it by more than the uncertainty, else OPEN."""
    if abs(value) - spread > limit:
        return WRONG
    return RIGHT if abs(value) + spread <= limit else OPEN
