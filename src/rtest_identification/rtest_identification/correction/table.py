"""The correction of every axis over stations of the rotary axes, at places of the work volume."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.correction.known import KnownErrors
from rtest_identification.correction.step import Correction, correct
from rtest_identification.kinematics import linear_positions
from rtest_identification.machine import Machine

# Places where none are given: a cube of the table frame [m].
CUBE = tuple(itertools.product((-0.1, 0.0, 0.1), (-0.1, 0.0, 0.1), (0.0, 0.1, 0.2)))
# Stations where nothing was measured over them.
_SWIVEL = np.radians(np.linspace(-90.0, 90.0, 7))
_TURN = np.radians(np.arange(0.0, 360.0, 30.0))
# Measured stations are means of what encoders read [rad].
_DIGIT = math.radians(1e-3)


@dataclass(frozen=True)
class Table:
    """Corrections at places and stations.

    place : (n, 3) nominal tool points, frame ``table`` [m]
    left_out : how many more the machine does not reach, or nothing is known of
    """

    place: np.ndarray
    correction: Correction
    left_out: int


def table(known: KnownErrors, places: Sequence[Sequence[float]] = CUBE) -> Table:
    """Corrections at every place, at every station of the rotary axes.

    Raises UserError where the machine reaches none of them.
    """
    machine = known.machine
    stations = [
        np.round(known.stations[name] / _DIGIT) * _DIGIT if name in known.stations
        else _default(machine, name)
        for name in machine.rotary
    ]
    combined = list(itertools.product(places, *stations))
    place = np.array([row[0] for row in combined], dtype=float)
    positions = np.zeros((len(combined), len(machine.letters)))
    columns = [machine.letters.index(name) for name in machine.rotary]
    positions[:, columns] = [row[1:] for row in combined]
    positions = linear_positions(machine, place, positions)
    good = reachable(machine, positions) & known.inside(positions)
    if not good.any():
        raise UserError(
            f'machine {machine.name!r}: reaches none of these places; give others with --at'
        )
    place, positions = place[good], positions[good]
    errors = known.at(positions, np.zeros_like(positions))
    return Table(place, correct(machine, positions, errors), int((~good).sum()))


def reachable(machine: Machine, positions: np.ndarray) -> np.ndarray:
    """(n,) whether positions (n, k) are in the ranges of all axes."""
    lower, upper = (
        np.array([getattr(machine.axes[name], end) for name in machine.letters])
        for end in ('lower', 'upper')
    )
    return ((positions >= lower - 1e-9) & (positions <= upper + 1e-9)).all(axis=1)


def _default(machine: Machine, name: str) -> np.ndarray:
    axis = machine.axes[name]
    full = axis.upper - axis.lower >= 2.0 * math.pi
    stations = _TURN if full else _SWIVEL
    return stations[(stations >= axis.lower) & (stations <= axis.upper)]
