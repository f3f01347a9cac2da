"""A machine of its own for the tests: plain 4x4 matrices, sharing no code with the package."""

from dataclasses import replace

import numpy as np

from rtest_estimation.records import Cycle, CyclePlan, CyclePoint, Kind

NMV = """
name: NMV
chain: [C, B, bed, Y, X, Z]
axes:
  X: {type: linear, direction: [1, 0, 0], range_mm: [-210, 210]}
  Y: {type: linear, direction: [0, 1, 0], range_mm: [-105, 105]}
  Z: {type: linear, direction: [0, 0, 1], range_mm: [-200, 200]}
  B: {type: rotary, direction: [0, 1, 0], sense: 1, range_deg: [-180, 160]}
  C: {type: rotary, direction: [0, 0, 1], sense: 1, range_deg: [-360, 360]}
"""
SETUPS = {
    '1a': (0.0, -0.09, 0.0406),
    '1b': (0.0, -0.09, 0.1406),
    '2a': (0.0, 0.0, 0.0406),
    '2b': (0.0, 0.0, 0.1406),
}
B = np.radians([-75, -50, -25, 0, 25, 50, 75])
C = np.radians(np.arange(12) * 30)
LETTERS = ('X', 'Y', 'Z', 'B', 'C')


def turn(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    i, j = {'A': (1, 2), 'B': (2, 0), 'C': (0, 1)}[axis]
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def shift(x=0.0, y=0.0, z=0.0):
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def defect(e):
    """Da Db Dc Dx Dy Dz of a dict of errors (Eq. 2-13)."""
    g = e.get
    rotations = turn('A', g('A', 0)) @ turn('B', g('B', 0)) @ turn('C', g('C', 0))
    return rotations @ shift(g('X', 0), g('Y', 0), g('Z', 0))


def centre(x, y, z, b, c, errors):
    """Sphere in the table frame for errors {'B': {'X': ..}, ..}."""
    e = {axis: errors.get(axis, {}) for axis in 'XYZBC'}
    table = defect(e['B']) @ turn('B', b) @ defect(e['C']) @ turn('C', c)
    tool = defect(e['Y']) @ shift(0, y, 0) @ defect(e['X']) @ shift(x, 0, 0)
    tool = tool @ defect(e['Z']) @ shift(0, 0, z)
    return (np.linalg.inv(table) @ tool @ [0, 0, 0, 1])[:3]


def noisy(cycle, noise, rng):
    """The same cycle with white noise on every component of every point."""
    points = tuple(
        replace(p, displacement=p.displacement + noise * rng.normal(size=3)) for p in cycle.points
    )
    return replace(cycle, points=points)


def static_cycle(setup, errors_at, b=B, c=C):
    """A finished cycle of a machine whose errors at (B, C) are errors_at(b, c)."""
    sphere = np.array(SETUPS[setup])
    poses = [(0.0, 0.0)]
    for row, level in enumerate(b):
        poses += [(level, station) for station in (c if row % 2 == 0 else c[::-1])]
    poses.append((0.0, 0.0))
    rows, points = [], []
    for level, station in poses:
        r = (turn('B', level) @ turn('C', station) @ [*sphere, 1])[:3]
        row = np.array([*r, level, station])
        rows.append(row)
        points.append(centre(*row, errors_at(level, station)) - sphere)
    points = np.array(points) - points[0]
    made = tuple(
        CyclePoint(n, 10**9 * n, row, np.zeros(5, np.int8), x, (3e-8) ** 2 * np.eye(3), 10)
        for n, (row, x) in enumerate(zip(rows, points, strict=True))
    )
    plan = CyclePlan(
        10**12 * list(SETUPS).index(setup), 'made', f'{setup}-static', Kind.STATIC, setup, sphere,
        LETTERS, np.array(rows), 0.3,
    )
    return Cycle(plan, made, (), 'cal', plan.stamp + 10**11)


def nest_cycle(setup, step=1e-3):
    """A finished nest calibration of 28 positions (section 2.2.2), without noise."""
    sphere = np.array(SETUPS[setup])
    start = np.array([*sphere, 0.0, 0.0])
    rows = []
    for _ in range(3):
        for axis in range(3):
            rows += [start, start + step * np.eye(5)[axis], start - step * np.eye(5)[axis]]
    rows = np.array([*rows, start])
    points = tuple(
        CyclePoint(n, n, row, np.zeros(5, np.int8), row[:3] - sphere, 1e-16 * np.eye(3), 10)
        for n, row in enumerate(rows)
    )
    plan = CyclePlan(
        1, 'made', f'{setup}-nest', Kind.NEST_CALIBRATION, setup, sphere, LETTERS, rows, 0.3
    )
    return Cycle(plan, points, (), 'cal', 2)


def chain_centre(chain, positions, errors, tool=(0.0, 0.0, 0.0)):
    """Sphere in the table frame of any chain from table to tool; linear X Y Z, rotary A B C.

    positions : axis to m or rad; errors : as for `centre`.
    """
    bed = chain.index('bed')

    def side(names):
        matrix = np.eye(4)
        for name in names:
            matrix = matrix @ defect(errors.get(name, {}))
            q = positions[name]
            matrix = matrix @ (turn(name, q) if name in 'ABC' else shift(**{name.lower(): q}))
        return matrix

    table, tool_side = side(chain[:bed][::-1]), side(chain[bed + 1 :])
    return (np.linalg.inv(table) @ tool_side @ [*tool, 1])[:3]
