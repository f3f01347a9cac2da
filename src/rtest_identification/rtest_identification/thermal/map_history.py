"""Errors of the outer rotary axis at its stations, cycle by cycle (Fig. 4-7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_identification.symbols import ErrorParameter
from rtest_identification.thermal.changes import Changes
from rtest_identification.thermal.series import holm, variation


@dataclass(frozen=True)
class MapHistory:
    """How the errors of the outer rotary axis change since the reference.

    levels : (s,) stations [rad]
    value, stddev : (k, 6, s) change of the map, mean zero over the stations [m] or [rad]; NaN in
        cycles that do not determine it
    total, total_stddev : (k, 6, s) the same with the change of the constant error of the same
        letter: what the axis does at each station
    probability : (6,) of changes of the map this large by noise alone, adjusted for asking of six
    """

    axis: str
    parameters: tuple[ErrorParameter, ...]
    levels: np.ndarray
    value: np.ndarray
    stddev: np.ndarray
    total: np.ndarray
    total_stddev: np.ndarray
    probability: np.ndarray


def complete(found: Changes) -> np.ndarray:
    """(k,) cycles that determine all that the plan does."""
    return np.array([gain.rank == found.poses.full.rank for gain in found.gains])


def any_change(found: Changes) -> float:
    """Probability of a map that changes this much by noise alone, over all six errors."""
    if not found.poses.parameters:
        return 1.0
    return _probability(found, [_flat(gain.map) for gain in found.gains])


def map_history(found: Changes) -> MapHistory | None:
    """None where the outer axis has too few stations."""
    poses = found.poses
    if not poses.parameters:
        return None
    constant = {(p.axis, p.letter): n for n, p in enumerate(poses.constants)}
    alone, total = [], []
    for gain in found.gains:
        both = gain.map.copy()
        for n, p in enumerate(poses.parameters):
            if (p.axis, p.letter) in constant:
                both[n] += gain.joint[constant[p.axis, p.letter]]
        alone.append(_flat(gain.map))
        total.append(_flat(both))
    whole = complete(found)[:, None, None]

    def shown(values: np.ndarray) -> np.ndarray:
        shape = (len(values), len(poses.parameters), len(poses.levels))
        return np.where(whole, values.reshape(shape), np.nan)

    return MapHistory(
        poses.parameters[0].axis, poses.parameters, poses.levels,
        shown(found.values(alone)), shown(found.stddev(alone)),
        shown(found.values(total)), shown(found.stddev(total)),
        holm([
            _probability(found, [gain.map[n] for gain in found.gains])
            for n in range(len(poses.parameters))
        ]),
    )


def _probability(found: Changes, gain: list[np.ndarray]) -> float:
    rows = np.flatnonzero(complete(found))
    values, scatter = found.values(gain), found.scatter(gain)
    return variation([values[k] for k in rows], [scatter[k] for k in rows], found.freedom)


def _flat(gain: np.ndarray) -> np.ndarray:
    """(6, s, m, 3) to (6 s, m, 3)."""
    return gain.reshape(-1, *gain.shape[2:])
