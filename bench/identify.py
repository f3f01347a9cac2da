"""Time of an identification and of its error table beside plain scripts, in one run.

    python bench/identify.py

4 x 84 poses: location errors, squareness, both maps, uncertainty budget (`identify`), against
`scipy.linalg.lstsq` on the location errors alone with the Jacobian given, and on the same with a
Jacobian from finite differences, as a script would do it.

Then the predicted error with its covariance at 500 poses from the identified maps (`ErrorField`),
all poses at once against one pose after the other.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import scipy.linalg

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'src/rtest_identification/test'))

from independent import NMV, SETUPS, nest_cycle, noisy, static_cycle

from rtest_identification.error_field import ErrorField
from rtest_identification.kinematics import predict
from rtest_identification.machine import parse_machine
from rtest_identification.observations import stack
from rtest_identification.pipeline import identify
from rtest_identification.symbols import location_parameters

_REPEATS = 9
_POSES = 500


def _median(function: Callable[[], object], repeats: int = _REPEATS) -> float:
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def main() -> None:
    """Print the table."""
    machine = parse_machine(NMV)
    rng = np.random.default_rng(1)
    cycles = []
    for setup in SETUPS:
        clean = static_cycle(setup, lambda b, c: {'C': {'X': 1e-6 * np.cos(2 * c)}})
        cycles += [nest_cycle(setup), noisy(clean, 2.5e-7, rng)]
    data = stack(machine, cycles)
    columns = [p.column for p in location_parameters(machine)]
    offsets = data.offsets().reshape(-1, 12)
    jacobian = predict(machine, data.positions, None, True).jacobian[:, :, columns]
    design = np.hstack([jacobian.reshape(-1, len(columns)), offsets])
    y = (data.displacement - data.predict()[0]).reshape(-1)

    def script() -> np.ndarray:
        found = np.empty((y.size, len(columns)))
        for k, column in enumerate(columns):
            step = np.zeros(30)
            step[column] = 1e-6
            up, down = (
                predict(machine, data.positions, s * step.reshape(5, 6)).centre for s in (1, -1)
            )
            found[:, k] = ((up - down) / 2e-6).reshape(-1)
        return scipy.linalg.lstsq(np.hstack([found, offsets]), y)[0]

    plain = _median(lambda: scipy.linalg.lstsq(design, y))
    scripted = _median(script)
    whole = _median(lambda: identify(machine, cycles))
    print(f'{"":44}{"s":>8}{"ratio":>8}')
    for name, value in (
        ('location errors, plain lstsq, Jacobian given', plain),
        ('the same, Jacobian by finite differences', scripted),
        ('identify: errors, both maps, budget', whole),
    ):
        print(f'{name:44}{value:8.4f}{value / plain:8.1f}')
    field = ErrorField.from_identification(identify(machine, cycles), every_map=True)
    rotary = np.column_stack([rng.uniform(-1.3, 1.3, _POSES), rng.uniform(0.0, 6.0, _POSES)])
    rows = np.column_stack([rng.uniform(-0.1, 0.1, (_POSES, 3)), rotary])
    zero = [0.0, 0.0]
    together = _median(lambda: field.at(rows, zero))
    singly = _median(lambda: [field.at(row, zero) for row in rows], 1)
    print(f'{f"error table, {_POSES} poses at once":44}{together:8.4f}{1.0:8.1f}')
    print(f'{"the same, one pose after the other":44}{singly:8.4f}{singly / together:8.1f}')


if __name__ == '__main__':
    main()
