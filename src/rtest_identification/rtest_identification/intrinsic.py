"""What no cycle at all would add to the maps at given stations, found from the Jacobian."""

from __future__ import annotations

import numpy as np

from rtest_identification.kinematics import linear_positions
from rtest_identification.location import fit
from rtest_identification.observations import Observations
from rtest_identification.pipeline import Identification

# Enough spheres for everything that R-tests can see (three heights and radii, not in a plane).
_SPHERES = np.array([[0.0, -0.09, 0.04], [0.0, -0.09, 0.14], [0.0, 0.0, 0.04], [0.05, 0.0, 0.14]])


def left_open_by_any(result: Identification) -> frozenset[str]:
    """Groups of shapes that stay open at the stations of this session with any spheres.

    They are the same machine under another name: a run-out of B that follows the pitch circle of
    C's axis is a location error of C, one that turns with the table is where the table's zero is.
    By convention they are in the constants; the map is determined without them.
    """
    machine, data = result.machine, result.observations
    used = data.keep(np.setdiff1d(np.arange(len(data)), result.fit.outliers))
    columns = [machine.letters.index(name) for name in machine.rotary]
    rotary = np.unique(np.round(used.positions[:, columns], 4), axis=0)
    start = np.zeros((len(rotary), len(machine.letters)))
    start[:, columns] = rotary
    count, spheres = len(rotary), len(_SPHERES)
    positions = np.concatenate([linear_positions(machine, s, start) for s in _SPHERES])
    # Any displacements will do: only the design is asked for.
    noise = 1e-7 * np.random.default_rng(0).standard_normal((count * spheres, 3))
    full = fit(Observations(
        machine, tuple(map(str, range(spheres))), tuple(map(str, range(spheres))), positions,
        noise, np.tile(1e-16 * np.eye(3), (count * spheres, 1, 1)),
        np.repeat(_SPHERES, count, axis=0), np.repeat(np.arange(spheres), count),
        np.tile(np.arange(count), spheres), np.zeros_like(positions),
        np.arange(len(positions)),
    ))
    maps = (full.error_map, full.inner_map)
    return frozenset(group for fitted in maps if fitted for group in fitted.left_open)
