"""How often the model gap is right about effects hidden in the simulated machine.

    python bench/gap_blind.py [--sessions N] [--only NAME ...] [--processes P] [--baselines]

Every row of the table is N sessions: half of the thesis's four set-ups with even stations of C,
half of two set-ups of the diagnostic cycle with uneven ones. Effects are drawn from all families
that such a session shows and scaled to a signal to noise delta. Shares come with the 95 % interval
of Clopper and Pearson. With --baselines other ways of choosing are scored on the same sessions:
AIC, orthogonal matching pursuit, the lasso, and the search without projection (needs
scikit-learn).
"""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache

os.environ.setdefault('OMP_NUM_THREADS', '1')

import numpy as np
from scipy import stats

from rtest_drivers.config import config_path
from rtest_drivers.sim.blind import Blind, Noise, Setting, make, setting
from rtest_drivers.sim.hidden import Hidden, families, outside
from rtest_identification.gap.offline import gap_session
from rtest_identification.gap.workflow import GapResult
from rtest_identification.machine import Machine, load_machine
from rtest_identification.plans import diagnostic, static

SETUPS = {'1a': (0, -0.09, 0.0406), '1b': (0, -0.09, 0.1406),
          '2a': (0, 0, 0.0406), '2b': (0, 0, 0.1406)}
LEVELS = np.radians([-75, -50, -25, 0, 25, 50, 75])
UNEVEN = np.radians([0, 21, 55, 84, 118, 143, 180, 214, 239, 277, 301, 338])
PAIRS = (('1a', '2b'), ('1a', '1b'), ('1b', '2a'))
OUTSIDE = ('random', 'product', 'dent', 'switch')
PLAIN = {'clean': {}, 'outliers': {'outliers': 0.01}, 'noisy ends': {'ends': 3.0},
         'correlated': {'correlation': 0.5}}


@dataclass(frozen=True)
class Row:
    """A kind of session: how many effects, at which delta, and the noise."""

    effects: int
    low: float = 0.0
    high: float = 0.0
    noise: dict = field(default_factory=dict)


ROWS = {
    **{f'no effect, {name}': Row(0, noise=noise) for name, noise in PLAIN.items()},
    **{f'one effect, delta {d:g}': Row(1, d, d) for d in (6.0, 8.0, 12.0, 20.0, 40.0)},
    'one effect, 8-40, spoilt': Row(1, 8.0, 40.0, {'outliers': 0.01, 'ends': 3.0}),
    'one effect, 8-40, correlated': Row(1, 8.0, 40.0, {'correlation': 0.5}),
    'two effects, delta 8-40': Row(2, 8.0, 40.0),
    'outside, delta 13-40': Row(-1, 13.0, 40.0),
    'outside, 13-40, spoilt': Row(-1, 13.0, 40.0, {'outliers': 0.01, 'ends': 3.0}),
}


@dataclass(frozen=True)
class Score:
    """One session scored; None where the question does not arise.

    detected : anything but "no gap"; named : the name, or a rival's, is right, for every effect
    sizes : of the declared sets; parameters : how many of how many are within U (k = 2)
    """

    row: str
    keys: tuple[str, ...]
    verdict: str
    found: tuple[str, ...]
    detected: bool
    named: bool
    sizes: tuple[int, ...]
    parameters: tuple[int, int]
    heldout: float
    seconds: float


@lru_cache
def machine() -> Machine:
    """The machine of the demo."""
    return load_machine(config_path('nmv1500dcg.yaml'))


def draw(row: str, number: int) -> Blind:
    """The session `number` of a row, always the same."""
    kind = ROWS[row]
    rng = np.random.default_rng([number, *row.encode()])
    while True:
        if number % 2 == 0:
            even = np.radians(np.arange(12) * 30)
            plans = [static(machine(), s, np.array(p), LEVELS, even) for s, p in SETUPS.items()]
        else:
            pair = PAIRS[rng.integers(len(PAIRS))]
            plans = [
                diagnostic(machine(), s, np.array(SETUPS[s]), LEVELS, UNEVEN) for s in pair
            ]
        where = setting(machine(), plans, rng)
        hidden = _effects(kind, where, rng)
        delta = rng.uniform(kind.low, kind.high, len(hidden))
        noise = Noise(rng.uniform(1.5e-7, 4.5e-7), **kind.noise)
        session = make(where, hidden, delta, noise, rng)
        if session is not None:
            return session


def _effects(kind: Row, where: Setting, rng: np.random.Generator) -> list[Hidden]:
    if kind.effects < 0:
        kind = str(rng.choice(OUTSIDE))
        return [replace(outside(kind, rng, where.poses), key=kind)]
    known = families(where.machine)
    # Families first, so that the harmonics of one do not crowd the others out.
    names = sorted({key.split('/')[0] for key in known})
    chosen = rng.choice(names, kind.effects, replace=False)
    keys = [rng.choice([k for k in known if k.split('/')[0] == name]) for name in chosen]
    return [known[key](rng, where.poses) for key in keys]


def score(row: str, number: int) -> Score:
    """Draw and analyse one session."""
    session = draw(row, number)
    begin = time.process_time()
    result = gap_session(session.machine, session.cycles, session.directions).result
    seconds = time.process_time() - begin
    sets = [{f.effect.key, *f.rivals} for f in result.found]
    keys = tuple(effect.key for effect, _ in session.hidden)
    if ROWS[row].effects < 0:
        named = result.verdict == 'unknown effect'
    else:
        named = len(sets) == len(keys) and _matched(keys, sets)
    gap = result.gap
    return Score(
        row, keys, result.verdict, tuple(f.effect.key for f in result.found),
        result.verdict != 'no gap', named, tuple(len(s) for s in sets),
        _parameters(session, result), gap.heldout_after / gap.heldout_noise, seconds,
    )


def _matched(keys: tuple[str, ...], sets: list[set[str]]) -> bool:
    """Whether every key has a set of its own."""
    if not keys:
        return True
    return any(
        keys[0] in one and _matched(keys[1:], sets[:k] + sets[k + 1 :])
        for k, one in enumerate(sets)
    )


def _parameters(session: Blind, result: GapResult) -> tuple[int, int]:
    """Of effects that are named right, how many parameters are within U (k = 2), of how many."""
    inside = count = 0
    for effect, amplitude in session.hidden:
        for found in result.found:
            if found.effect.key != effect.key or not effect.parameters:
                continue
            names = [p.name for p in (*found.effect.parameters, *found.effect.shape)]
            for name, value, stddev in zip(names, found.value, found.stddev, strict=True):
                scale = 1.0 if name in effect.shape else amplitude
                if np.isfinite(stddev):
                    inside += bool(abs(value - scale * effect.parameters[name]) <= 2.0 * stddev)
                    count += 1
    return inside, count


def interval(k: int, n: int) -> tuple[float, float]:
    """Share k of n within 95 % (Clopper and Pearson 1934)."""
    low = stats.beta.ppf(0.025, k, n - k + 1) if k else 0.0
    high = stats.beta.ppf(0.975, k + 1, n - k) if k < n else 1.0
    return float(low), float(high)


def percent(k: int, n: int) -> str:
    """A share with its interval."""
    if not n:
        return f'{"-":>22}'
    low, high = interval(k, n)
    return f'{k:5}/{n:<5}{100 * low:5.1f}-{100 * high:5.1f}%'


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--sessions', type=int, default=40, help='of each row')
    parser.add_argument('--only', nargs='*', default=[''], help='rows that contain one of these')
    parser.add_argument('--processes', type=int, default=2)
    parser.add_argument('--errors', action='store_true', help='tell every session that is wrong')
    args = parser.parse_args()
    print(f'{"sessions":30}{"detected":>22}{"right name or set":>22}{"set":>6}'
          f'{"parameters in U":>22}{"held out <= 1.1":>22}{"s":>6}')
    with ProcessPoolExecutor(args.processes) as pool:
        for row in ROWS:
            if not any(part in row for part in args.only):
                continue
            scores = list(pool.map(score, [row] * args.sessions, range(args.sessions)))
            print(_line(row, scores), flush=True)
            for number, one in enumerate(scores):
                if args.errors and not one.named:
                    print(f'    {number}: {one.keys} -> {one.verdict} {one.found}')


def _line(row: str, scores: list[Score]) -> str:
    sizes = [size for s in scores for size in s.sizes]
    inside, count = np.sum([s.parameters for s in scores], axis=0)
    explained = [s for s in scores if s.verdict in ('no gap', 'explained')]
    held = sum(s.heldout <= 1.1 for s in explained)
    width = f'{np.median(sizes):.0f}/{max(sizes)}' if sizes else '-'
    return (
        f'{row:30}{percent(sum(s.detected for s in scores), len(scores))}'
        f'{percent(sum(s.named for s in scores), len(scores))}{width:>6}'
        f'{percent(int(inside), int(count))}{percent(held, len(explained))}'
        f'{np.median([s.seconds for s in scores]):6.2f}'
    )


if __name__ == '__main__':
    main()
