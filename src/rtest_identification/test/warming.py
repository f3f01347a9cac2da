"""A machine that warms up, for the tests: the plain matrices of `independent` and a clock."""

from dataclasses import replace

import numpy as np
from independent import LETTERS, centre, turn

from rtest_estimation.records import Cycle, CyclePlan, CyclePoint, Kind, Missing

# Where the nest stands in section 4.5.1, and its cycle of 25 poses.
SPHERE = (-0.448e-3, -91.187e-3, 40.567e-3)
LEVELS = np.radians([-60, -30, 0, 30, 60])
STATIONS = np.radians([0, 72, 144, 216, 288])
MINUTE = 60.0
START = 1_700_000_000_000_000_000


def settling(time, tau):
    """0 at the start, 1 when settled."""
    return 1.0 - np.exp(-time / tau)


def session(
    errors_at, minutes, noise=0.0, seed=0, pose_seconds=4.0, keep=lambda cycle, pose: True
):
    """Cycles that begin at these minutes, of a machine with errors_at(seconds, b, c).

    keep : which poses are measured
    """
    rng = np.random.default_rng(seed)
    poses = [(0.0, 0.0)]
    for row, level in enumerate(LEVELS):
        poses += [(level, s) for s in (STATIONS if row % 2 == 0 else STATIONS[::-1])]
    poses.append((0.0, 0.0))
    sphere = np.array(SPHERE)
    rows = np.array(
        [[*(turn('B', b) @ turn('C', c) @ [*sphere, 1])[:3], b, c] for b, c in poses]
    )
    cycles = []
    for number, minute in enumerate(minutes):
        points, missing = [], []
        begin = MINUTE * minute
        for pose, row in enumerate(rows):
            at = begin + pose_seconds * (pose + 0.5)
            x = centre(*row, errors_at(at, row[3], row[4])) - sphere + noise * rng.normal(size=3)
            if keep(number, pose):
                points.append(CyclePoint(
                    pose, START + round(1e9 * at), row, np.zeros(5, np.int8), x,
                    (3e-8) ** 2 * np.eye(3), 10,
                ))
            else:
                missing.append(Missing(pose, 'not reached'))
        if points:
            reset = points[0].displacement
            points = [replace(p, displacement=p.displacement - reset) for p in points]
        plan = CyclePlan(
            START + round(1e9 * begin), 'warming', f'thermal-{number:02d}', Kind.STATIC, 't',
            sphere, LETTERS, rows, 0.3,
        )
        cycles.append(Cycle(
            plan, tuple(points), tuple(missing), 'cal',
            plan.stamp + round(1e9 * pose_seconds * len(rows)),
        ))
    return cycles


def readings(celsius_at, minutes, every=10.0, noise=0.0, seed=0):
    """(stamps [ns], degrees Celsius) of a thermometer from minute 0 to the last of `minutes`."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(0.0, MINUTE * minutes + every / 2, every)
    celsius = np.array([celsius_at(s) for s in seconds]) + noise * rng.normal(size=len(seconds))
    return START + np.rint(1e9 * seconds).astype(np.int64), celsius
