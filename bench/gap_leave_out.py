"""What the model gap says of an effect that its library does not have: each is left out in turn.

    python bench/gap_leave_out.py [--sessions N] [--processes P]

One effect of each key at delta 25, N sessions each, analysed without that key. The distance is
what no other single effect of the library can take over, in standard deviations. Where it is 12 or
more the session must be an unknown effect; where it is less, whoever is named must be a rival that
the whole library declares; a wrong name without rivals is wrong anywhere.
"""

from __future__ import annotations

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
from gap_blind import LEVELS, PAIRS, SETUPS, UNEVEN, machine, percent

from rtest_drivers.sim.blind import Noise, make, setting
from rtest_drivers.sim.hidden import families
from rtest_identification.gap.effects import library
from rtest_identification.gap.projection import Projection
from rtest_identification.gap.rows import nest_spread
from rtest_identification.gap.workflow import analyse
from rtest_identification.observations import stack
from rtest_identification.plans import diagnostic, static

DELTA = 25.0
FAR = 12.0


@dataclass(frozen=True)
class Outcome:
    """One session: distance to the nearest other effect, and what was said."""

    key: str
    distance: float
    verdict: str
    found: tuple[str, ...]
    declared: bool


def one(key: str, number: int) -> Outcome | None:
    """Analyse a session without the effect that is in it; None where it cannot be seen."""
    rng = np.random.default_rng([number, *key.encode()])
    if number % 2 == 0:
        even = np.radians(np.arange(12) * 30)
        plans = [static(machine(), s, np.array(p), LEVELS, even) for s, p in SETUPS.items()]
    else:
        pair = PAIRS[rng.integers(len(PAIRS))]
        plans = [diagnostic(machine(), s, np.array(SETUPS[s]), LEVELS, UNEVEN) for s in pair]
    where = setting(machine(), plans, rng)
    hidden = families(machine())[key](rng, where.poses)
    session = make(where, [hidden], [DELTA], Noise(2.5e-7), rng)
    if session is None:
        return None
    observations = stack(machine(), session.cycles)
    start = min(cycle.plan.stamp for cycle in session.cycles)
    spread = nest_spread(session.cycles)
    result = analyse(observations, start, session.directions, without=(key,), spread=spread)
    others = [e for e in library(result.rows.scene) if e.key != key]
    (left,) = session.left
    near = max(
        float(np.linalg.norm(c.basis.T @ left)) for c in Projection(result.rows, others).candidates
    )
    whole = analyse(observations, start, session.directions, spread=spread)
    rivals = {k for f in whole.found for k in (f.effect.key, *f.rivals)}
    found = tuple(f.effect.key for f in result.found)
    return Outcome(
        key, float(np.sqrt(max(DELTA**2 - near**2, 0.0))), result.verdict, found,
        bool(set(found) & rivals) or any(f.rivals for f in result.found),
    )


def main() -> None:
    """Print what was said, far from and near to other effects."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--sessions', type=int, default=4, help='of each effect')
    parser.add_argument('--processes', type=int, default=2)
    args = parser.parse_args()
    keys = [k for k in families(machine()) for _ in range(args.sessions)]
    numbers = list(range(args.sessions)) * (len(keys) // args.sessions)
    with ProcessPoolExecutor(args.processes) as pool:
        outcomes = [o for o in pool.map(one, keys, numbers) if o is not None]
    for name, group in (
        (f'{FAR:g} or more from everything else', [o for o in outcomes if o.distance >= FAR]),
        ('nearer', [o for o in outcomes if o.distance < FAR]),
    ):
        said = Counter(o.verdict for o in group)
        print(f'{name}: {len(group)} sessions, {dict(said)}')
        unknown = sum(o.verdict == 'unknown effect' for o in group)
        wrong = [o for o in group if o.found and not o.declared]
        print(f'  unknown effect {percent(unknown, len(group))}')
        print(f"  wrong name that is nobody's rival {percent(len(wrong), len(group))}")
        for o in group:
            if o in wrong or (o.distance >= FAR and o.verdict != 'unknown effect'):
                print(f'    {o.key}: {o.verdict} {o.found}, distance {o.distance:.1f}')


if __name__ == '__main__':
    main()
