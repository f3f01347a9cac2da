"""How often the model gap is right: simulated sessions with hidden effects, as a table.

    python bench/gap_power.py [SESSIONS PER ROW]

The machine is the one of the tests, plain matrices that share no code with the packages. An effect
is right when its key, or a declared rival's, is the one that was hidden.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'src/rtest_identification/test'))

from independent import NMV, SETUPS, nest_cycle, noisy, static_cycle, turn

from rtest_identification.gap.offline import gap_session
from rtest_identification.machine import parse_machine

MACHINE = parse_machine(NMV)
NOISE = 2.5e-7
UNEVEN = np.radians([0, 22, 51, 77, 106, 139, 163, 198, 229, 251, 289, 322])
Errors = dict[str, dict[str, float]]


def _add(errors: Errors, axis: str, letter: str, value: float) -> None:
    own = errors.setdefault(axis, {})
    own[letter] = own.get(letter, 0.0) + value


def _scale(axis: str) -> Callable:
    return lambda e, b, c, p, a: _add(e, axis, axis, 1.2e-5 * a * p[axis])


def _angle(letter: str, axis: str) -> Callable:
    return lambda e, b, c, p, a: _add(e, axis, letter, 1.0e-4 * a * p[axis])


def _pair(letters: str, size: float, first: Callable, second: Callable) -> Callable:
    def effect(e: Errors, b: float, c: float, p: dict, a: float) -> None:
        _add(e, 'C', letters[0], size * a * first(b, c))
        _add(e, 'C', letters[1], size * a * second(b, c))

    return effect


EFFECTS: dict[str, Callable] = {
    **{f'scale/{k}': _scale(k) for k in 'XYZ'},
    **{f'angle/{k}': _angle(*k) for k in ('AX', 'BX', 'AY', 'CY', 'BY', 'AZ', 'BZ')},
    'radial/C.3': _pair('XY', 4e-7, lambda b, c: np.cos(3 * c), lambda b, c: np.sin(3 * c)),
    'coning/C.2': _pair('AB', 4e-6, lambda b, c: np.cos(2 * c), lambda b, c: np.sin(2 * c)),
    'runout-grows/C': _pair('XY', 9e-7, lambda b, c: np.cos(c) * abs(b),
                            lambda b, c: np.sin(c) * abs(b)),
    'line-shift-grows/C': _pair('XY', 7e-7, lambda b, c: abs(b), lambda b, c: 0.5 * abs(b)),
    'line-tilt-grows/C': _pair('AB', 7e-6, lambda b, c: abs(b), lambda b, c: 0.5 * abs(b)),
    'angular-scale/B': lambda e, b, c, p, a: _add(e, 'B', 'B', 3e-6 * a * b),
    'sag/B': lambda e, b, c, p, a: _add(e, 'B', 'Z', -1.2e-6 * a * (1 - np.cos(b))),
    'axial/C.3': lambda e, b, c, p, a: _add(e, 'C', 'Z', 3.5e-7 * a * np.cos(3 * c)),
}


def session(
    rng: np.random.Generator, effects: list[tuple[Callable, float]], uneven: bool, ends: bool
) -> list:
    """Finished cycles of one machine with random constants."""
    size = {'X': 1e-5, 'Y': 1e-5, 'Z': 1e-5, 'A': 2e-5, 'B': 2e-5, 'C': 2e-5}
    base = {'B': {k: v * rng.normal() for k, v in size.items()}}
    base |= {'C': {'X': 8e-6 * rng.normal(), 'A': 2e-5 * rng.normal()}}
    base |= {'Z': {'A': 1e-5 * rng.normal(), 'B': 1e-5 * rng.normal()}}
    base['X'] = {'C': 1e-5 * rng.normal()}
    setups = tuple(SETUPS) if not uneven else ('1a', '2b')
    cycles = []
    for setup in setups:
        sphere = np.array(SETUPS[setup])

        def errors_at(b: float, c: float, sphere: np.ndarray = sphere) -> Errors:
            place = (turn('B', b) @ turn('C', c) @ [*sphere, 1])[:3]
            errors = {axis: dict(own) for axis, own in base.items()}
            for effect, amplitude in effects:
                effect(errors, b, c, dict(zip('XYZ', place, strict=True)), amplitude)
            return errors

        cycle = static_cycle(setup, errors_at, **({'c': UNEVEN} if uneven else {}))
        cycle = noisy(cycle, NOISE, rng)
        if ends:
            for point in cycle.points:
                if abs(point.feedback[3]) > 1.2:
                    point.displacement[:] += 7e-7 * rng.normal(size=3)
        cycles += [nest_cycle(setup), cycle]
    return cycles


def run(count: int) -> None:
    """Print the table."""
    names = list(EFFECTS)
    rows = {'clean': 0, 'clean, noisy ends': 0, 'one effect': 1, 'two effects': 2, 'outside': -1}
    print(f'{"sessions":20}{"right":>9}{"s each":>8}')
    for row, hidden in rows.items():
        right, begin = 0, time.monotonic()
        for number in range(count):
            rng = np.random.default_rng([len(row), number])
            keys = [names[i] for i in rng.choice(len(names), max(hidden, 0), replace=False)]
            effects = [(EFFECTS[k], rng.uniform(0.8, 2.0)) for k in keys]
            if hidden < 0:
                n, m, s = rng.integers(5, 9), rng.uniform(2, 3), rng.uniform(0.8e-6, 2e-6)
                effects = [(
                    lambda e, b, c, p, a, n=n, m=m, s=s: _add(
                        e, 'C', 'Z', s * np.sin(m * b) * np.cos(n * c) * np.sign(np.sin(c))
                    ), 1.0,
                )]
            cycles = session(rng, effects, number % 2 == 1, 'ends' in row)
            result = gap_session(MACHINE, cycles, {}).result
            named = [{f.effect.key, *f.rivals} for f in result.found]
            if hidden < 0:
                good = result.verdict == 'unknown effect'
            elif hidden == 0:
                good = result.verdict == 'no gap'
            else:
                good = len(named) == hidden and all(any(k in n for n in named) for k in keys)
            right += good
        print(f'{row:20}{right:5} / {count}{(time.monotonic() - begin) / count:7.2f}', flush=True)


if __name__ == '__main__':
    run(int(sys.argv[1]) if len(sys.argv) > 1 else 60)
