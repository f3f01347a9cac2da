"""Error maps as nodes with weights: their values and covariance at any position of the axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_identification.interpolation import Stations
from rtest_identification.symbols import ErrorParameter

# The interpolation may be wrong by up to the difference of two interpolants, anything within
# being as likely: rectangular (GUM 4.3.7).
_RECTANGULAR = 1.0 / np.sqrt(3.0)


@dataclass(frozen=True)
class OuterMap:
    """Map over one axis: stations (s,) [rad], value (6, s) [m] or [rad]."""

    axis: str
    parameters: tuple[ErrorParameter, ...]
    stations: np.ndarray
    value: np.ndarray


@dataclass(frozen=True)
class InnerMap:
    """Map over both axes: outer (b,), inner (c,) [rad], value (6, b, c), NaN where not known.

    covariance : (b, c, 6, 6) of the six values at each station
    """

    axis: str
    parameters: tuple[ErrorParameter, ...]
    outer: np.ndarray
    inner: np.ndarray
    value: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Reading:
    """A map interpolated at n poses.

    weights : (n, m) of the values at the m nodes
    doubt : (n, 6) standard uncertainty of the interpolation
    inside : (n,) bool, False outside the measured stations
    """

    weights: np.ndarray
    doubt: np.ndarray
    inside: np.ndarray


@dataclass(frozen=True)
class AxisNodes:
    """A map over one axis.

    columns : (6,) of the errors in the Jacobian; value : (6, m); place : column of the axis in
    the positions
    """

    axis: str
    columns: np.ndarray
    value: np.ndarray
    stations: Stations
    place: int

    @classmethod
    def of(cls, data: OuterMap, place: int) -> AxisNodes:
        """From a map."""
        columns = np.array([p.column for p in data.parameters])
        return cls(data.axis, columns, data.value, Stations.of(data.stations), place)

    def left(self, letters: Sequence[str], position: np.ndarray) -> list[str]:
        """Axes whose stations a position (1, k) leaves, for example `B (-75 to 75 deg)`."""
        inside = self.stations.place(position[:, self.place])[1].all()
        return [] if inside else [_span(letters[self.place], self.stations)]

    def read(self, positions: np.ndarray) -> Reading:
        """Interpolate at positions (n, k) [rad]."""
        angle = positions[:, self.place]
        doubt = _RECTANGULAR * self.stations.doubt(self.value.T, angle)
        return Reading(self.stations.weights(angle), doubt, self.stations.place(angle)[1])


@dataclass(frozen=True)
class GridNodes:
    """A map over both rotary axes; stations of the inner axis may differ from level to level.

    columns : (6,); value : (6, m), covariance : (m, 6, 6) at the m measured nodes, level by level
    levels : of the outer axis; rows : for each of them the inner axis's stations and its nodes
    grid, filled : all stations of the inner axis, and the map on all of them (levels, c, 6)
    """

    axis: str
    symbols: tuple[str, ...]
    columns: np.ndarray
    value: np.ndarray
    covariance: np.ndarray
    levels: Stations
    rows: tuple[tuple[Stations, slice], ...]
    grid: Stations
    filled: np.ndarray
    undetermined: tuple[str, ...]
    places: tuple[int, int]

    @classmethod
    def of(cls, data: InnerMap, places: list[int]) -> GridNodes:
        """From a map; places: columns of outer and inner axis in the positions."""
        known = np.isfinite(data.value)
        measured = known.any(axis=0)
        # An error unknown at most of the nodes is undetermined; a node where another one is
        # unknown (a pose is missing in a set-up) is left out.
        good = known[:, measured].mean(axis=1) > 0.5
        used = measured & known[good].all(axis=0)
        keep = used.sum(axis=1) >= min(3, used.sum(axis=1).max())
        value = np.where(good[:, None, None], data.value, 0.0)
        both = good[:, None] & good
        covariance = np.where(both, data.covariance, 0.0)
        rows, nodes, start = [], [], 0
        for level in np.flatnonzero(keep):
            columns = np.flatnonzero(used[level])
            rows.append((Stations.of(data.inner[columns]), slice(start, start + len(columns))))
            nodes += [(level, column) for column in columns]
            start += len(columns)
        b, c = np.array(nodes).T
        at_nodes = value[:, b, c]
        return cls(
            data.axis,
            tuple(p.symbol for p in data.parameters),
            np.array([p.column for p in data.parameters]),
            at_nodes,
            covariance[b, c],
            Stations.of(data.outer[keep]),
            tuple(rows),
            Stations.of(data.inner),
            np.array([s.weights(data.inner) @ at_nodes[:, part].T for s, part in rows]),
            tuple(p.symbol for p, g in zip(data.parameters, good, strict=True) if not g),
            (places[0], places[1]),
        )

    def left(self, letters: Sequence[str], position: np.ndarray) -> list[str]:
        """Axes whose stations a position (1, k) leaves, for example `B (-75 to 75 deg)`."""
        outer, inner = self.places
        # Any level whose stations of the inner axis do not hold it narrows that axis.
        every = [(outer, self.levels), *((inner, stations) for stations, _ in self.rows)]
        found = [_span(letters[place], stations) for place, stations in every
                 if not stations.place(position[:, place])[1].all()]
        return list(dict.fromkeys(found))

    def read(self, positions: np.ndarray) -> Reading:
        """Interpolate at positions (n, k) [rad]: along the inner axis, then along the outer."""
        outer, inner = (positions[:, place] for place in self.places)
        of_level = self.levels.weights(outer)
        inside = self.levels.place(outer)[1]
        weights = np.empty((len(positions), self.value.shape[1]))
        along = np.zeros((len(positions), 6))
        for level, (stations, part) in enumerate(self.rows):
            share = of_level[:, level, None]
            weights[:, part] = share * stations.weights(inner)
            along += np.abs(share) * stations.doubt(self.value[:, part].T, inner)
            inside = inside & stations.place(inner)[1]
        across = self.levels.doubt(self.filled, outer)
        across = np.einsum('nc,nci->ni', np.abs(self.grid.weights(inner)), across)
        return Reading(weights, _RECTANGULAR * np.hypot(along, across), inside)

    def variance(self, weights: np.ndarray, other: np.ndarray | None = None) -> np.ndarray:
        """(n, 6, 6) covariance of the values read with `weights` with those of `other`."""
        both = weights * (weights if other is None else other)
        return (both @ self.covariance.reshape(-1, 36)).reshape(-1, 6, 6)


def _span(axis: str, stations: Stations) -> str:
    if stations.periodic:
        return f'{axis} (the whole turn)'
    lower, upper = np.degrees(stations.knots[[0, -1]])
    return f'{axis} ({lower:.6g} to {upper:.6g} deg)'
