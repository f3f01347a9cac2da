"""How often the effects that are hidden in dynamic measurements are named rightly.

    python bench/dynamic_blind.py [--clean N] [--each N] [--only NAME ...] [--processes P]

The measurements come from the tests' own simulation (`dynamic_machine`: plain numpy, none of the
package's numerics), gauges at 1 kHz, encoders at 500 Hz. Clean ones: C turns to and fro by 1.05
turns at 358 and 2.2 at 3,583 deg/min. With an effect: by 0.8 turns at 1,074 and 1.2 at 3,583
deg/min. Every effect has a signal to noise of 8, which is its size over the standard deviation
that the noise leaves of it. Shares come with the 95 % interval of Clopper and Pearson.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault('OMP_NUM_THREADS', '1')
sys.path.insert(0, str(Path(__file__).parents[1] / 'src' / 'rtest_identification' / 'test'))

from dynamic_machine import FAST, RADIUS, SLOW, SPHERE, Hidden, measurement
from independent import NMV
from scipy import stats

from rtest_identification.dynamic.motion import Readings
from rtest_identification.dynamic.pipeline import DynamicResult, analyse
from rtest_identification.machine import parse_machine

DELTA = 8.0
CLEAN = ((SLOW, 1.05), (FAST, 2.2))
FEEDS = ((3.0 * SLOW, 0.8), (FAST, 1.2))
ONE = ((FAST, 1.2),)
NOISES = {'white noise': {}, 'drift of 0.1 µm/√s': {'drift': 1e-7},
          'vibration of 0.2 µm': {'vibration': 2e-7}}


def _lag(slow: float, fast: float) -> dict[str, dict[float, float]]:
    return {'lag': {round(FEEDS[0][0], 6): slow, round(FAST, 6): fast}}


@dataclass(frozen=True)
class Case:
    """An effect to be hidden.

    key, channel : what it is to be called; alike : what else it must be told to resemble
    hide : size to the simulation's arguments, linear in its signature; large : a size that stands
        out, from which the size of the wanted signal to noise follows
    """

    key: str
    channel: str
    hide: Callable[[float], dict]
    large: float
    alike: tuple[str, ...] = ()
    contact: bool = True
    feeds: tuple = FEEDS


CASES = {
    'friction-lag as in the thesis, 1 : 2': Case(
        'friction-lag', 'gauges', lambda a: _lag(a, 2.0 * a), 1e-6),
    'friction-lag equal at both feeds': Case(
        'friction-lag', 'gauges', lambda a: _lag(a, a), 1e-6, ('backlash/C',)),
    'friction-lag, one feed only': Case(
        'friction-lag', 'gauges', lambda a: _lag(a, a), 1e-6, ('backlash/C', 'clock-offset'),
        feeds=ONE),
    'servo-mismatch/C': Case('servo-mismatch/C', 'encoders', lambda a: {'mismatch': a}, 1e-4),
    'clock-offset, tangential and late': Case(
        'clock-offset', 'gauges', lambda a: {'late': a, 'shift_late': True}, 1e-4),
    'clock-offset, features late': Case('clock-offset', 'gauges', lambda a: {'late': a}, 5e-3),
    'radius-shrink, gauges': Case(
        'radius-shrink', 'gauges', lambda a: {'shrink': a**0.5}, 1e-4),
    'radius-shrink, encoders': Case(
        'radius-shrink', 'encoders', lambda a: {'shrink': a**0.5, 'shrink_seen': True}, 1e-4),
    **{
        f'reversal-spike/{axis}, {channel}': Case(
            f'reversal-spike/{axis}', channel,
            lambda a, axis=axis, channel=channel: {
                'spike': (axis, a, 0.06), 'spike_seen': channel == 'encoders'}, 2e-6)
        for axis in 'XY' for channel in ('gauges', 'encoders')
    },
    'lag equal at both feeds, lasers': Case(
        'backlash/C', 'gauges', lambda a: _lag(a, a), 1e-6, contact=False),
}


def evaluated(
    hidden: Hidden, seed: int, contact: bool = True, feeds: tuple = FEEDS
) -> DynamicResult:
    """One measurement, simulated and evaluated."""
    cycles = [
        Readings(f'cycle {k}', '1a', SPHERE, one['time'], one['centre'], one['feedback_time'],
                 one['feedback'], contact)
        for k, one in enumerate(measurement(hidden, feeds, seed))
    ]
    return analyse(parse_machine(NMV), cycles)


def size(case: Case) -> float:
    """Size of the wanted signal to noise, in proportion to that of a large one."""
    result = evaluated(Hidden(**case.hide(case.large)), 1, case.contact, case.feeds)
    if case.key == 'clock-offset' and 'shift_late' not in case.hide(1.0):
        return DELTA * result.offset.stddev
    strengths = {e.key: e.strength for e in result.naming.effects}
    names = {case.key, *case.alike}
    return case.large * DELTA / next(v for k, v in strengths.items() if k in names)


def clean(job: tuple[str, int]) -> str:
    """What is found where nothing is hidden; empty for nothing."""
    kind, seed = job
    result = evaluated(Hidden(**NOISES[kind]), 10_000 + seed, feeds=CLEAN)
    found = [e.key for e in result.naming.effects]
    return ' + '.join(found) or ('' if result.naming.verdict == 'no gap' else 'unknown')


def hidden(job: tuple[str, float, int]) -> str:
    """'right', 'beside rivals', or what else was found."""
    name, amount, seed = job
    case = CASES[name]
    sign = 1.0 if seed % 2 or 'shrink' in name or 'lag' in name else -1.0
    base = replace(Hidden(), **case.hide(sign * amount))
    result = evaluated(base, 20_000 + seed, case.contact, case.feeds)
    effects = result.naming.effects
    if len(effects) != 1:
        return ' + '.join(e.key for e in effects) or result.naming.verdict
    told = {effects[0].key, *effects[0].rivals}
    if effects[0].channel != case.channel or case.key not in told:
        return f'{effects[0].key} ({effects[0].channel})'
    if not {case.key, *case.alike} <= told:
        return f'without rival {", ".join(set(case.alike) - told)}'
    if case.alike or (effects[0].key == case.key and not effects[0].rivals):
        return 'right'
    return 'beside rivals ' + ', '.join(sorted(told - {case.key}))


def share(hits: int, trials: int) -> str:
    """Share with the interval of Clopper and Pearson."""
    low = stats.beta.ppf(0.025, hits, trials - hits + 1) if hits else 0.0
    high = stats.beta.ppf(0.975, hits + 1, trials - hits) if hits < trials else 1.0
    return f'{hits}/{trials} ({100 * low:.1f} to {100 * high:.1f} %)'


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--clean', type=int, default=100, metavar='N', help='of each noise')
    parser.add_argument('--each', type=int, default=20, metavar='N', help='of each effect')
    parser.add_argument('--only', nargs='+', default=[], metavar='NAME')
    parser.add_argument('--processes', type=int, default=1)
    given = parser.parse_args()
    begin = time.monotonic()
    with ProcessPoolExecutor(given.processes) as pool:
        total = alarms = 0
        for kind in NOISES if given.clean else ():
            found = list(pool.map(clean, [(kind, seed) for seed in range(given.clean)]))
            false = [one for one in found if one]
            total, alarms = total + len(found), alarms + len(false)
            print(f'clean, {kind}: false alarms {share(len(false), len(found))} {false}',
                  flush=True)
        if total:
            print(f'clean, all: false alarms {share(alarms, total)}', flush=True)
        for name, case in CASES.items():
            if not given.each or (given.only and not any(o in name for o in given.only)):
                continue
            amount = size(case)
            found = list(pool.map(hidden, [(name, amount, s) for s in range(given.each)]))
            right = sum(one == 'right' for one in found)
            others = sorted({one for one in found if one != 'right'})
            told = ', '.join(f'{found.count(one)} {one}' for one in others)
            print(f'{name}, size {amount:.3g}: {share(right, len(found))} {told}', flush=True)
    print(f'sphere {RADIUS * 1e3:.1f} mm from C; {time.monotonic() - begin:.0f} s')


if __name__ == '__main__':
    main()
