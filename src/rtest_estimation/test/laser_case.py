"""A laser nest made by hand; readings by bisection along the beam, which shares no code."""

import numpy as np

from rtest_estimation.records import NestCalibration, NestKind

RADIUS = 25e-3


def directions(count=3, tilt=np.pi / 4, turn=0.2):
    azimuth = turn + 2 * np.pi * np.arange(count) / count
    level = np.cos(tilt)
    return np.column_stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.full(count, -np.sin(tilt))]
    )


def spots(count=3, aside=2e-4):
    """Where beams meet the sphere that pass its centre at about this distance."""
    normal = directions(count) + aside / RADIUS * np.array([[1, 0, 0.5], [0, -1, 0], [1, 1, 0],
                                                            [-1, 0, 1]])[:count]
    return RADIUS * normal / np.linalg.norm(normal, axis=1, keepdims=True)


def cube(half=5e-4, levels=3):
    side = np.linspace(-half, half, levels)
    grid = np.stack(np.meshgrid(side, side, side, indexing='ij'), axis=-1).reshape(-1, 3)
    return np.vstack([np.zeros(3), grid])


def bisect(spot, direction, centres, radius=RADIUS):
    """(n, lasers) d with |P + d V - x| = R on the side of V, by bisection."""
    near = np.zeros((len(centres), len(spot)))
    far = np.full_like(near, 1.5 * radius)
    # From the foot of the perpendicular outwards: inside the sphere first, outside in the end.
    foot = np.einsum('nij,ij->ni', centres[:, None] - spot, direction)
    for _ in range(80):
        middle = (near + far) / 2
        point = spot + (foot + middle)[..., None] * direction
        outside = np.linalg.norm(point - centres[:, None], axis=2) > radius
        near, far = np.where(outside, near, middle), np.where(outside, middle, far)
    return foot + (near + far) / 2


def nest(count=3, nodes=None, values=None, zero=0.0):
    """A calibrated nest whose correction is zero unless given."""
    nodes = cube() if nodes is None else nodes
    values = np.zeros_like(nodes) if values is None else values
    return NestCalibration(
        'id', '1a', 0, directions(count), 0.0, RADIUS, NestKind.LASER,
        zero=np.full(count, zero), spot=spots(count), correction_nodes=nodes,
        correction_values=values,
    )
