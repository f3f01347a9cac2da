"""Time of the cone frustum's Monte Carlo tables beside plainer ways, in one run.

    python bench/frustum.py

1,000 simulations of every row of Tables 6-3 to 6-7 in both cases, about both circles, against the
exact kinematics for every simulation; and the minimum-zone circle by exchange against the same
linear programme by `scipy.optimize.linprog`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import linprog

from rtest_identification.frustum.circles import zone_width
from rtest_identification.frustum.commands import NEGATIVE, command
from rtest_identification.frustum.contour import along_normal, contour_error, response
from rtest_identification.frustum.tables import SIMULATIONS, compare, draw_errors, simulate
from rtest_identification.frustum.thesis import CASES, ROWS
from rtest_identification.machine import load_machine

_MACHINE = Path(__file__).resolve().parents[1] / 'src/rtest_drivers/config/nmv1500dcg.yaml'
_REPEATS, _FEW = 5, 20


def _median(function: Callable[[], object]) -> float:
    times = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def main() -> None:
    """Print the tables."""
    machine = load_machine(_MACHINE)
    commands = command(machine, CASES['a'].feature(), NEGATIVE)
    slope, row = response(commands), ROWS[-1]

    def linear() -> np.ndarray:
        return simulate(commands, slope, row, SIMULATIONS, np.random.default_rng(1))

    def exact() -> None:
        drawn = list(draw_errors(commands, row, _FEW, np.random.default_rng(1)))
        for number in range(_FEW):
            errors = np.zeros((len(slope), 30))
            for error, column in drawn:
                errors[:, column] = error[number]
            deviation = contour_error(commands, errors.reshape(-1, 5, 6))
            commands.feature.form(along_normal(commands, deviation))

    print(f'all rows, both cases, both circles, {SIMULATIONS} simulations each: '
          f'{_median(lambda: compare(machine)):.2f} s')
    fast, slow = _median(linear) / SIMULATIONS, _median(exact) / _FEW
    print(f'one simulation of {row.name}: linear {fast * 1e6:.0f} µs, exact kinematics '
          f'{slow * 1e6:.0f} µs, ratio {slow / fast:.0f}')

    profiles = linear()
    angle = np.radians(np.arange(360.0))
    basis = np.stack([np.ones(360), np.cos(angle), np.sin(angle)], axis=1)
    one = np.ones((360, 1))

    def programme() -> None:
        for profile in profiles[:_FEW] * 1e6:
            linprog(
                [0, 0, 0, 1], np.block([[basis, -one], [-basis, -one]]), np.r_[profile, -profile],
                bounds=[(None, None)] * 4,
            )

    fast = _median(lambda: zone_width(angle, profiles)) / len(profiles)
    slow = _median(programme) / _FEW
    print(f'minimum-zone circle of 360 points: exchange {fast * 1e6:.0f} µs, linear programme '
          f'{slow * 1e6:.0f} µs, ratio {slow / fast:.0f}')


if __name__ == '__main__':
    main()
