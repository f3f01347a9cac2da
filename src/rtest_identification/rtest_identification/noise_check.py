"""What goes on while nothing moves: noise, lines and change of the gauges, temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy import stats

from rtest_estimation.standing import Line, Standing, folded
from rtest_identification.finding import OPEN, RIGHT, WRONG, Finding, exceeds

_NOISE, _LINE = 0.5e-6, 0.2e-6
# So long must nothing move for a spectrum that tells 50 from 60 Hz and from a spindle [s].
_STANDING_S = 10.0
# Of a gauge while the sphere stands for half a minute; over minutes see the repeatability.
_CHANGE = 0.3e-6
_TEMPERATURE = 0.5
# Fewer say nothing of how sure a rate is; a thermometer that never changed is taken to show tenths
# [K].
_FEWEST_TEMPERATURES, _DISPLAY = 5, 0.1
_MAINS = (50.0, 60.0)
_HARMONICS = 3
_WORSE = (RIGHT, OPEN, WRONG)


def noise(standing: Standing | None, spindle_hz: float | None = None) -> list[Finding]:
    """Scatter, lines of the spectrum and drift of each gauge while nothing moves."""
    if standing is None or standing.duration < _STANDING_S:
        seconds = 0.0 if standing is None else standing.duration
        return [Finding(
            'noise', f'{seconds:.1f} s without motion', f'at least {_STANDING_S:g} s', OPEN,
            'measure a session of `kind: check`, in which the sphere stands still',
        )]
    found = []
    for index in range(standing.readings.shape[1]):
        found += _gauge_noise(index, standing, spindle_hz)
    hidden = [f'{mains:g} Hz' for mains in _MAINS if folded(mains, standing.rate) * (
        standing.duration) < 4.0]
    if hidden:
        found.append(Finding(
            'mains hum', f'hum of {" and ".join(hidden)} cannot be seen at '
            f'{standing.rate:.1f} readings a second', '', OPEN,
            'it would look like a constant; read the gauges at another rate once',
        ))
    return found


def _gauge_noise(index: int, standing: Standing, spindle_hz: float | None) -> list[Finding]:
    """Scatter, strongest line and change of one gauge."""
    gauge, spread, step = f'gauge {index + 1}', standing.noise[index], standing.steps[index]
    if not math.isfinite(step):
        return [Finding(
            f'{gauge} noise', 'always the same reading', f'{_NOISE * 1e6:g} µm', WRONG,
            'it is stuck, or another channel is read',
        )]
    # The readings then scatter by less than they are rounded.
    coarse = step / math.sqrt(12.0) >= spread
    good, lines = spread <= _NOISE, [] if coarse else standing.lines(index)
    value = f'{spread * 1e6:.3f} µm rms' + (f', of steps of {step * 1e6:g} µm' if coarse else '')
    advice = (
        'its resolution is too coarse' if coarse else
        'see its lines; check cable, shield, supply and mounting' if lines else
        'no single frequency: check contact, mounting, cable and supply, and look for outliers'
    )
    found = [Finding(
        f'{gauge} noise', value, f'{_NOISE * 1e6:g} µm', RIGHT if good else WRONG,
        '' if good else advice,
    )]
    found.append(_strongest_line(gauge, lines, coarse, standing, spindle_hz))
    change, spread = standing.change[index], standing.change_spread[index]
    verdict = exceeds(change, spread, _CHANGE)
    found.append(Finding(
        f'{gauge} change', f'{change * 1e6:+.2f} ± {spread * 1e6:.2f} µm in '
        f'{standing.duration:.0f} s', f'{_CHANGE * 1e6:g} µm', verdict, {
            RIGHT: '', WRONG: 'let the gauges warm up, close the doors; look for what swings',
            OPEN: 'too coarse or too noisy to tell',
        }[verdict],
    ))
    return found


def _strongest_line(
    gauge: str, lines: list[Line], coarse: bool, standing: Standing, spindle_hz: float | None
) -> Finding:
    what, limit = f'{gauge} strongest line', f'{_LINE * 1e6:g} µm'
    if coarse:
        return Finding(what, 'lost in the resolution', limit, OPEN,
                       'a gauge that resolves more would tell')
    if not lines:
        return Finding(what, 'none', limit, RIGHT)
    value = (f'{lines[0].amplitude * 1e6:.3f} µm at {lines[0].frequency:.2f} Hz, '
             f'{source_of(lines[0].frequency, standing, spindle_hz)}')
    if lines[0].amplitude <= _LINE:
        return Finding(what, value, limit, RIGHT)
    return Finding(what, value, limit, WRONG,
                   'switch pumps, fans and the spindle off one by one, earth the shield')


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
    verdicts = {name: exceeds(*rate, _TEMPERATURE) for name, rate in rates.items()}
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
