"""Time of laser sphere centres in blocks beside SciPy reading by reading, in one run.

    python bench/laser.py [BAG]

The readings of a recording (bags/laser) during which the sphere is in the calibrated volume.
Eq. 5-4 for every reading by `scipy.optimize.least_squares`, with its own derivative by differences
and with the analytic one and the faster Levenberg-Marquardt, against whole blocks.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from rtest_estimation.laser import CentreSolver, CentreStatus
from rtest_estimation.recording import read_recording
from rtest_estimation.records import NestCalibration, Status
from rtest_identification.offline import estimate_recording

_BAG = Path(__file__).resolve().parents[1] / 'bags' / 'laser'
_SLOW, _REPEATS = 1000, 5
# What the blocks must reach: ratio, and agreement [m].
_RATIO, _AGREEMENT = 100.0, 1e-9


def _median(function: Callable[[], object], repeats: int = _REPEATS) -> float:
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def recorded(bag: Path) -> tuple[NestCalibration, np.ndarray]:
    """The first nest of a recording, and the readings (n, lasers) of its set-up [m]."""
    recording = read_recording(bag)
    nest = next(f.nest for f in estimate_recording(recording) if f.nest is not None)
    other = [plan.stamp for plan in recording.plans if plan.setup != nest.setup]
    blocks = [b for b in recording.gauges if b.stamp < min(other, default=np.inf)]
    status = np.concatenate([block.status for block in blocks])
    readings = np.concatenate([block.displacement for block in blocks])
    readings = readings[(status == Status.VALID).all(axis=1)]
    _, place = CentreSolver(nest)(readings)
    return nest, readings[place == CentreStatus.VALID]


def main() -> int:
    """Print the table; 1 where the ratio or the agreement is not reached."""
    nest, readings = recorded(Path(sys.argv[1]) if len(sys.argv) > 1 else _BAG)
    radius = nest.sphere_radius
    solver = CentreSolver(nest)
    few = readings[:: len(readings) // _SLOW][:_SLOW]

    def one_by_one(**how: object) -> np.ndarray:
        found = np.empty((len(few), 3))
        for row, reading in enumerate(few - nest.zero):
            spots = nest.spot + reading[:, None] * nest.direction

            def misfit(x: np.ndarray, spots: np.ndarray = spots) -> np.ndarray:
                return np.linalg.norm(spots - x, axis=1) - radius

            def slope(x: np.ndarray, spots: np.ndarray = spots) -> np.ndarray:
                ray = x - spots
                return ray / np.linalg.norm(ray, axis=1, keepdims=True)

            given = {'jac': slope} if how.get('analytic') else {}
            found[row] = least_squares(
                misfit, np.zeros(3), method=how['method'], xtol=1e-12, ftol=1e-12, gtol=1e-15,
                **given,
            ).x
        return found

    block = _median(lambda: solver.geometric(readings)) / len(readings)
    corrected = _median(lambda: solver(readings)) / len(readings)
    fast, solved = solver.geometric(few)
    print(f'{len(readings)} readings of three lasers, all solved: {bool(solved.all())}')
    print(f'{"":46}{"µs/reading":>12}{"ratio":>8}{"largest difference":>22}')
    print(f'{"blocks, Eq. 5-4":46}{block * 1e6:12.3f}{1.0:8.0f}')
    print(f'{"blocks, with correction and its border":46}{corrected * 1e6:12.3f}'
          f'{corrected / block:8.1f}')
    good = bool(solved.all())
    for name, how in (
        ('least_squares (trf), derivative by differences', {'method': 'trf'}),
        ('least_squares (lm), derivative given', {'method': 'lm', 'analytic': True}),
    ):
        begin = time.perf_counter()
        slow = one_by_one(**how)
        each = (time.perf_counter() - begin) / len(few)
        apart = float(np.linalg.norm(slow - fast, axis=1).max())
        good &= each / corrected >= _RATIO and apart <= _AGREEMENT
        print(f'{name:46}{each * 1e6:12.1f}{each / block:8.0f}{apart * 1e9:18.2g} nm')
    print(f'at least {_RATIO:.0f} times faster, correction included, and equal to '
          f'{_AGREEMENT * 1e9:.0f} nm: {"yes" if good else "NO"}')
    return 0 if good else 1


if __name__ == '__main__':
    sys.exit(main())
