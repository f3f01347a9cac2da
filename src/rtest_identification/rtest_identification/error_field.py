"""What the identified errors do anywhere in the work volume, with uncertainty.

Location errors, squareness and the interpolated maps of the rotary axes are put into the exact
kinematics of the machine. The covariance is carried through the analytic Jacobian (GUM, linear):
location errors with their correlations, the outer axis's map with its covariance over stations
and with the location errors, the inner axis's map with that of its six errors at each station
(different stations are independent), and what the interpolation between stations may be wrong by.

An R-test sees how the sphere moves against the table from pose to pose, never what stays the same
at all of them: give a `reference` pose to get what is free of that, the error against the one
that the same point of the table has there (a workpiece zeroed at B = C = 0).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.field_maps import AxisNodes, GridNodes, Reading
from rtest_identification.field_sources import Sources, from_file, from_result
from rtest_identification.kinematics import linear_positions, predict
from rtest_identification.machine import Machine
from rtest_identification.pipeline import Identification
from rtest_identification.symbols import ErrorParameter

# An error that is not determined matters where it moves the point by more than this part of it,
# [m/rad] or [m/m]: 0.1 nm for 100 µrad.
_MATTERS = 1e-6


@dataclass(frozen=True)
class AxisErrors:
    """The six errors of every axis.

    value, stddev : (n, k, 6) errors A B C X Y Z of every axis in the order of ``Machine.letters``,
        each in the frame of the axis that carries it, before its own motion, as
        `kinematics.predict` takes them [rad], [m]; the stddev is a standard uncertainty. What is
        not known is NaN
    inside : (n,) bool, False outside the measured stations, where everything is NaN
    """

    value: np.ndarray
    stddev: np.ndarray
    inside: np.ndarray


@dataclass(frozen=True)
class PointErrors:
    """Errors of the tool point, frame ``table``.

    error : (n, 3) where the tool point is, minus where it should be [m]; NaN where not known
    covariance : (n, 3, 3) of it, k = 1 [m2]
    inside : (n,) bool, False outside the measured stations
    """

    error: np.ndarray
    covariance: np.ndarray
    inside: np.ndarray

    @property
    def stddev(self) -> np.ndarray:
        """(n, 3) standard uncertainties [m]."""
        return np.sqrt(np.einsum('nii->ni', self.covariance))


@dataclass(frozen=True)
class ErrorField:
    """Errors of a machine at any pose, and what they do to the tool point.

    Made by `from_identification` or `from_json`. Example: the error at two points of a workpiece,
    against the one that they have at B = C = 0 (rotary axes in the order of `rotary`):

    >>> field = ErrorField.from_json('identification/identification.json', machine)
    >>> points = [[0.0, -0.05, 0.1], [0.05, 0.0, 0.1]]           # table frame [m]
    >>> found = field.at_points(points, np.radians([[30, 45], [-60, 200]]), reference=[0, 0])
    >>> found.error, 2 * found.stddev                            # table frame [m], U (k = 2)

    parameters, value : location errors and squareness (p,) [m] or [rad]
    outer, inner : maps of the rotary axes; None where there is none
    covariance : (p + 6 s, p + 6 s) of `value` and of the outer map's values at its s stations
    undetermined : symbols that the data do not determine; where they matter, results are NaN
    """

    machine: Machine
    parameters: tuple[ErrorParameter, ...]
    value: np.ndarray
    outer: AxisNodes | None
    inner: GridNodes | None
    covariance: np.ndarray
    undetermined: tuple[str, ...]

    @classmethod
    def from_identification(
        cls, result: Identification, every_map: bool = False
    ) -> ErrorField:
        """With what was identified in a session.

        every_map : also maps that do not stand out from the noise (significance 0.01). They add
            little but their uncertainty; without them the errors are those of the constants.
        """
        return cls.of(result.machine, from_result(result, every_map))

    @classmethod
    def from_json(
        cls, path: Path | str, machine: Machine, every_map: bool = False
    ) -> ErrorField:
        """From identification.json; `machine` is the one that was measured.

        Raises UserError naming the file where it is not one, or of another machine.
        """
        return cls.of(machine, from_file(path, machine, every_map))

    @classmethod
    def of(cls, machine: Machine, data: Sources) -> ErrorField:
        """From values and covariance wherever they come from."""
        letters = machine.letters
        outer = data.outer and AxisNodes.of(data.outer, letters.index(data.outer.axis))
        inner = None
        if data.inner:
            inner = GridNodes.of(data.inner, [letters.index(name) for name in machine.rotary])
        lost = data.undetermined + (inner.undetermined if inner else ())
        return cls(
            machine, data.parameters, data.value, outer, inner, data.covariance, lost
        )

    @property
    def rotary(self) -> tuple[str, ...]:
        """Order of the rotary axes in `at_points`: from the bed outwards, table side first."""
        return self.machine.rotary

    def with_tool(self, tool: np.ndarray) -> ErrorField:
        """The same machine with another tool point (3,), in the frame of the last axis [m]."""
        return replace(self, machine=replace(self.machine, tool=np.asarray(tool, dtype=float)))

    def errors(self, positions: np.ndarray, outside: str = 'raise') -> AxisErrors:
        """The six errors of every axis: constant and position-dependent part added.

        positions : (n, k) in the order of ``machine.letters`` [m] or [rad]
        outside : 'raise' (UserError naming axis and range) or 'nan' where a rotary axis is outside
            its measured stations
        """
        positions = np.atleast_2d(np.asarray(positions, dtype=float))
        inside, readings = self._read(positions, outside)
        value = self._values(len(positions), readings)
        variance = np.zeros_like(value)
        size = len(self.value)
        columns = [p.column for p in self.parameters]
        variance[:, columns] = np.diag(self.covariance)[:size]
        if self.outer:
            read = readings[0]
            stations = read.weights.shape[1]
            blocks = self.covariance[size:, size:].reshape(6, stations, 6, stations)
            across = self.covariance[:size, size:].reshape(size, 6, stations)
            for row, column in enumerate(self.outer.columns):
                within = read.weights @ blocks[row, :, row]
                variance[:, column] += (within * read.weights).sum(axis=1)
                variance[:, column] += read.doubt[:, row] ** 2
                if column in columns:
                    both = read.weights @ across[columns.index(column), row]
                    variance[:, column] += 2.0 * both
        if self.inner:
            read = readings[-1]
            own = self.inner.variance(read.weights)
            variance[:, self.inner.columns] += np.einsum('nii->ni', own) + read.doubt**2
        variance[:, self._lost()] = np.nan
        variance[~inside] = np.nan
        value = np.where(np.isnan(variance), np.nan, value)
        shape = (len(positions), len(self.machine.letters), 6)
        return AxisErrors(
            value.reshape(shape), np.sqrt(np.maximum(variance, 0.0)).reshape(shape), inside
        )

    def at(
        self, positions: np.ndarray, reference: np.ndarray | None = None, outside: str = 'raise'
    ) -> PointErrors:
        """Error of the tool point at poses of the machine.

        Parameters
        ----------
        positions : (n, k) in the order of ``machine.letters`` [m] or [rad]
        reference : positions of the rotary axes (2,) [rad] in the order of `rotary`; the error
            there of the same nominal point of the table is subtracted
        outside : 'raise' or 'nan', as in `errors`

        Positive errors: the tool is too far along +X, +Y, +Z of frame ``table``.
        """
        positions = np.atleast_2d(np.asarray(positions, dtype=float))
        nominal = predict(self.machine, positions).centre
        inside, readings = self._read(positions, outside)
        error, jacobian = self._kinematics(positions, nominal, readings)
        parts = [(jacobian, readings)]
        if reference is not None:
            zero = self._positions(nominal, np.broadcast_to(reference, (len(nominal), 2)))
            known, there = self._read(zero, outside)
            offset, slope = self._kinematics(zero, nominal, there)
            error, inside = error - offset, inside & known
            parts.append((-slope, there))
        covariance = self._propagate(parts)
        total = sum(slope for slope, _ in parts)
        lost = (np.abs(total[:, :, self._lost()]) > _MATTERS).any(axis=(1, 2)) | ~inside
        error[lost], covariance[lost] = np.nan, np.nan
        return PointErrors(error, covariance, inside)

    def at_points(
        self,
        points: np.ndarray,
        rotary: np.ndarray,
        reference: np.ndarray | None = None,
        outside: str = 'raise',
    ) -> PointErrors:
        """Error of the tool point at points of the table, the linear axes being where they must.

        Parameters
        ----------
        points : (n, 3) or (3,) nominal tool points, frame ``table`` [m]
        rotary : (n, 2) or (2,) positions of the rotary axes [rad] in the order of `rotary`
        reference, outside : as in `at`
        """
        points, rotary = np.atleast_2d(points), np.atleast_2d(rotary)
        count = max(len(points), len(rotary))
        positions = self._positions(
            np.broadcast_to(points, (count, 3)), np.broadcast_to(rotary, (count, rotary.shape[1]))
        )
        return self.at(positions, reference, outside)

    def _positions(self, points: np.ndarray, rotary: np.ndarray) -> np.ndarray:
        positions = np.zeros((len(points), len(self.machine.letters)))
        positions[:, [self.machine.letters.index(name) for name in self.rotary]] = rotary
        return linear_positions(self.machine, points, positions)

    def _read(self, positions: np.ndarray, outside: str) -> tuple[np.ndarray, list[Reading]]:
        """Interpolate the maps, outer first."""
        if outside not in ('raise', 'nan'):
            raise ValueError(f"outside: expected 'raise' or 'nan', got {outside!r}")
        readings = [nodes.read(positions) for nodes in (self.outer, self.inner) if nodes]
        inside = np.ones(len(positions), dtype=bool)
        for read in readings:
            inside &= read.inside
        if outside == 'raise' and not inside.all():
            row = int(np.argmin(inside))
            angles = ', '.join(
                f'{name} = {np.degrees(positions[row, self.machine.letters.index(name)]):.6g}'
                for name in self.rotary
            )
            here = positions[row : row + 1]
            ranges = {text: None for nodes in (self.outer, self.inner) if nodes
                      for text in nodes.left(self.machine.letters, here)}
            pose = f'pose {row} ({angles} deg)' if len(positions) > 1 else f'{angles} deg'
            raise UserError(
                f'{pose} is outside the measured stations of {", ".join(ranges)}: measure there '
                'too'
            )
        return inside, readings

    def _values(self, count: int, readings: list[Reading]) -> np.ndarray:
        """(n, 6 k) errors of all axes."""
        value = np.zeros((count, 6 * len(self.machine.letters)))
        value[:, [p.column for p in self.parameters]] = self.value
        for nodes, read in zip(filter(None, (self.outer, self.inner)), readings, strict=True):
            value[:, nodes.columns] += read.weights @ nodes.value.T
        return value

    def _lost(self) -> list[int]:
        """Columns of the errors that are not determined."""
        known = {p.symbol: p.column for p in self.parameters}
        if self.inner:
            known |= dict(zip(self.inner.symbols, self.inner.columns, strict=True))
        return sorted({known[name] for name in self.undetermined})

    def _kinematics(
        self, positions: np.ndarray, nominal: np.ndarray, readings: list[Reading]
    ) -> tuple[np.ndarray, np.ndarray]:
        values = self._values(len(positions), readings).reshape(len(positions), -1, 6)
        result = predict(self.machine, positions, values, jacobian=True)
        return result.centre - nominal, result.jacobian

    def _propagate(self, parts: list[tuple[np.ndarray, list[Reading]]]) -> np.ndarray:
        """(n, 3, 3) covariance of the sum of parts (n, 3, 6 k) with the maps read for each."""
        count = len(parts[0][0])
        columns = [p.column for p in self.parameters]
        design = sum(slope for slope, _ in parts)[:, :, columns]
        if self.outer:
            spread = sum(
                slope[:, :, self.outer.columns, None] * read[0].weights[:, None, None, :]
                for slope, read in parts
            )
            design = np.concatenate([design, spread.reshape(count, 3, -1)], axis=2)
        covariance = (design @ self.covariance) @ design.transpose(0, 2, 1)
        for nodes, place in ((self.outer, 0), (self.inner, -1)):
            for slope, read in parts if nodes else ():
                doubt = slope[:, :, nodes.columns] * read[place].doubt[:, None, :]
                covariance += doubt @ doubt.transpose(0, 2, 1)
        if self.inner:
            for left, one in parts:
                for right, other in parts:
                    shared = self.inner.variance(one[-1].weights, other[-1].weights)
                    covariance += (
                        left[:, :, self.inner.columns]
                        @ shared
                        @ right[:, :, self.inner.columns].transpose(0, 2, 1)
                    )
        return covariance
