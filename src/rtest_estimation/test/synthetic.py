"""A little session made by hand: feedback and readings of a machine that visits its poses."""

import numpy as np

from rtest_estimation.records import CyclePlan, Feedback, GaugeBlock, Kind

T0 = 1_700_000_000_000_000_000
AXES = ('X', 'Y', 'Z', 'B', 'C')
V = np.array([[0.7, 0.0, 0.714], [-0.35, 0.61, 0.711], [-0.35, -0.61, 0.711]])
V /= np.linalg.norm(V, axis=1)[:, None]
SPHERE = np.array([0.0, -0.09, 0.04])


def nest_plan(stamp=T0, setup='1a', size=1e-3):
    start = np.array([*SPHERE, 0, 0])
    rows = []
    for _ in range(3):
        for axis in range(3):
            step = size * np.eye(5)[axis]
            rows += [start, start + step, start - step]
    return CyclePlan(stamp, 's', f'{setup}-nest', Kind.NEST_CALIBRATION, setup, SPHERE, AXES,
                     np.array([*rows, start]), 0.3)


def static_plan(stamp, setup='1a'):
    start = np.array([*SPHERE, 0, 0])
    rows = [start + [0.01 * k, 0, 0, 0.1 * k, 0.5 * k] for k in (0, 1, 2, 3, 2, 0)]
    return CyclePlan(stamp, 's', f'{setup}-static', Kind.STATIC, setup, SPHERE, AXES,
                     np.array(rows), 0.3)


def displacement(plan, row):
    """(3,) of the sphere at a pose: the step itself in a nest calibration, else made up [m]."""
    if plan.kind is Kind.NEST_CALIBRATION:
        return (plan.commands[row] - plan.commands[0])[:3]
    return 1e-6 * np.array([row, -2.0 * row, 0.5 * row * row])


def run(plans, seed=0, noise=1e-7, hz=50, batch=10, move=0.3, wait=1.0, channels=3):
    """Feedback samples and gauge blocks of the plans, each starting at its stamp."""
    rng = np.random.default_rng(seed)
    directions = V if channels == 3 else np.vstack([V, [0, 0, 1]])
    stamps, positions, readings = [], [], []
    for plan in plans:
        clock = plan.stamp
        for row, command in enumerate(plan.commands):
            before = plan.commands[row - 1] if row else command
            shift = displacement(plan, row)
            old = displacement(plan, row - 1) if row else shift
            moving = int(move * hz) if row else 0
            last = row == len(plan.commands) - 1
            still = int((wait if last else plan.dwell) * hz)
            for step in range(moving + still):
                part = min((step + 1) / (moving + 1), 1.0) if step < moving else 1.0
                stamps.append(clock)
                positions.append(before + part * (command - before))
                readings.append(directions @ (old + part * (shift - old)) + 2e-5)
                clock += 1_000_000_000 // hz
    positions = np.array(positions) + 3e-8 * rng.normal(size=(len(positions), 5))
    readings = np.array(readings) + noise * rng.normal(size=(len(readings), len(directions)))
    feedback = [Feedback(t, AXES, p) for t, p in zip(stamps, positions, strict=True)]
    blocks = [
        GaugeBlock(stamps[n], n, 1.0 / hz, readings[n : n + batch],
                   np.zeros(readings[n : n + batch].shape, np.uint8))
        for n in range(0, len(stamps), batch)
    ]
    return feedback, blocks


def session(setups=('1a',)):
    plans, stamp = [], T0
    for setup in setups:
        plans.append(nest_plan(stamp, setup))
        plans.append(static_plan(stamp + 20_000_000_000, setup))
        stamp += 30_000_000_000
    return plans
