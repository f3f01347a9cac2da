"""Map of a rotary axis's position-dependent errors over its stations, and its parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from rtest_identification.symbols import ErrorParameter

# Stations closer than this are one station [rad].
STATION = 1e-3


@dataclass(frozen=True)
class AxisMap:
    """Position-dependent errors of one rotary axis at its stations.

    stations : (s,) [rad]; value, stddev : (6, s) in the order of `parameters` [m] or [rad]
    covariance : (6 s, 6 s), parameters first
    left_open : names of shapes that these data do not tell from constant errors
    significance : probability of a map this large where there is none
    gain : (6 s, n, 3) change of each value per displacement of each observation
    """

    axis: str
    parameters: tuple[ErrorParameter, ...]
    stations: np.ndarray
    value: np.ndarray
    covariance: np.ndarray
    rank: int
    condition: float
    left_open: tuple[str, ...]
    significance: float
    gain: np.ndarray

    @property
    def stddev(self) -> np.ndarray:
        """(6, s) standard uncertainties."""
        return np.sqrt(np.diag(self.covariance)).reshape(self.value.shape)


def zero_mean(count: int) -> np.ndarray:
    """(count, count - 1) orthonormal basis of the sequences of mean zero (Helmert contrasts)."""
    basis = np.zeros((count, count - 1))
    for k in range(1, count):
        basis[:k, k - 1] = 1.0
        basis[k, k - 1] = -k
        basis[:, k - 1] /= np.sqrt(k * (k + 1))
    return basis


def stations(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stations of an axis and, for every row, which one it is at."""
    order = np.argsort(positions)
    group = np.concatenate([[0], np.cumsum(np.diff(positions[order]) > STATION)])
    station = np.empty(len(positions), dtype=int)
    station[order] = group
    return np.array([positions[station == g].mean() for g in range(group[-1] + 1)]), station


def coupled(parameters: tuple[ErrorParameter, ...], nullspace: np.ndarray) -> tuple[str, ...]:
    """Groups of symbols whose shapes over the stations the data do not tell from constants.

    The projector on what is left open couples the symbols that make up one shape; symbols it does
    not couple are named apart.
    """
    if not nullspace.shape[1]:
        return ()
    scale = np.repeat([p.scale for p in parameters], len(nullspace) // len(parameters))
    basis = np.linalg.qr(nullspace / scale[:, None])[0]
    parts = basis.reshape(len(parameters), -1, basis.shape[1])
    coupling = np.einsum('ask,btk->asbt', parts, parts)
    linked = np.sqrt((coupling**2).sum(axis=(1, 3))) > 0.05
    count, label = connected_components(linked, directed=False)
    groups = []
    for group in range(count):
        members = [i for i in range(len(parameters)) if label[i] == group and linked[i, i]]
        if members:
            names = ', '.join(parameters[i].symbol for i in members)
            shapes = round(sum(float((parts[i] ** 2).sum()) for i in members))
            groups.append(f'{names} ({shapes} shape{"s" if shapes != 1 else ""})')
    return tuple(groups)
