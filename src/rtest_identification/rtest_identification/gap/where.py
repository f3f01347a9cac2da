"""Where the gap sits: the same test by set-up, level, direction, time and component."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtest_identification.error_map import stations
from rtest_identification.gap.rows import Rows
from rtest_identification.kinematics import rotation

# A place is told when it is this improbable, over all places looked at.
NOTABLE = 0.01
_BLOCKS = 6


@dataclass(frozen=True)
class Place:
    """A part of the poses in which more is left than noise.

    by : what the poses are sorted by; value : which of them; rms : of what is left there [m]
    p : probability of as much where there is noise alone
    """

    by: str
    value: str | float
    rms: float
    p: float


def locate(rows: Rows) -> tuple[Place, ...]:
    """Places where the base model leaves more than noise, the most improbable first."""
    base = rows.white(rows.base)
    u, s, _ = np.linalg.svd(
        base / np.maximum(np.linalg.norm(base, axis=0), 1e-300), full_matrices=False
    )
    u = u[:, s > 1e-6 * s[0]]
    y = rows.white(rows.residual)
    y = (y - u @ (u.T @ y)).reshape(-1, 3)
    free = 1.0 - (u**2).sum(axis=1).reshape(-1, 3)
    found = []
    groups = _groups(rows)
    for by, value, chosen in groups:
        count = float(free[chosen].sum())
        if count < 3:
            continue
        p = float(stats.f.sf((y[chosen] ** 2).sum() / count, count, rows.freedom))
        rms = float(np.sqrt(np.mean(rows.residual[chosen] ** 2)))
        found.append(Place(by, value, rms, p))
    for by, value, component in _components(rows, y):
        count = len(component) * float(free.mean())
        p = float(stats.f.sf((component**2).sum() / count, count, rows.freedom))
        rms = float(np.sqrt(np.mean((component * rows.sigma) ** 2)))
        found.append(Place(by, value, rms, p))
    notable = [place for place in found if place.p < NOTABLE / len(found)]
    return tuple(sorted(notable, key=lambda place: place.p))


def _groups(rows: Rows) -> list[tuple[str, str | float, np.ndarray]]:
    scene, observations = rows.scene, rows.scene.observations
    groups: list[tuple[str, str | float, np.ndarray]] = []
    for number, setup in enumerate(observations.setups):
        groups.append(('setup', setup, observations.cycle == number))
    for axis in scene.machine.rotary:
        places, at = stations(scene.position(axis))
        groups += [(axis, float(place), at == k) for k, place in enumerate(places)]
    for axis in scene.machine.letters:
        for sign in (-1.0, 1.0):
            groups.append((f'direction of {axis}', sign, scene.direction(axis) == sign))
    edges = np.linspace(scene.time.min(), scene.time.max() + 1e-6, _BLOCKS + 1)
    for low, high in itertools.pairwise(edges):
        groups.append(('time', float(low), (scene.time >= low) & (scene.time < high)))
    return groups


def _components(rows: Rows, y: np.ndarray) -> list[tuple[str, str, np.ndarray]]:
    """Residual components in the table's frame, the outer axis's and the machine's."""
    scene, machine = rows.scene, rows.scene.machine
    found = [('component, table frame', c, y[:, k]) for k, c in enumerate('XYZ')]
    turned = y
    side = machine.table_side
    for axis in reversed([name for name in side if machine.axes[name].rotary]):
        one = machine.axes[axis]
        turn = rotation(one.direction, one.sense * scene.position(axis))
        turned = np.einsum('nij,nj->ni', turn, turned)
        frame = f'component, frame that carries {axis}'
        found += [(frame, c, turned[:, k]) for k, c in enumerate('XYZ')]
    return found
