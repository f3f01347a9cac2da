"""Compensation of single axes: `COMP_FILE` of LinuxCNC.

The file maps the positions of one joint: nominal, and where the joint really is when it comes
there upwards and downwards (``COMP_FILE_TYPE = 0``). LinuxCNC adds nominal minus real to the
command and takes it off the feedback again, straight between the lines, and holds it beyond the
ends. It takes 256 lines at most, ascending, three numbers each, and stops reading at the first
line that is anything else: there are no comments. Source: LinuxCNC, INI configuration,
``[JOINT_n] COMP_FILE``; motion/usrmotintf.cc and motion/control.c.

An axis's own error moves it along (or turns it about) its own direction: the table of one axis
takes that away where it depends on nothing but this axis. Everything else moves other axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rtest_identification.correction.known import KnownErrors
from rtest_identification.kinematics import ERROR_LETTERS
from rtest_identification.machine import Axis, Machine

LINES = 241
# An error of one axis that changes with others by more than this share is none of that axis alone.
_SHARE = 0.1
# Smaller ones are none [m], [rad].
_NOTHING = 1e-9
# Poses of the other axes at which the error of one is looked at.
_POSES = 24
# How far an endless linear axis is taken to go each way [m].
_ENDLESS = 0.2


@dataclass(frozen=True)
class AxisTable:
    """An axis's own error over its position.

    nominal : (m,) increasing [m] or [rad]
    forward, backward : (m,) error when the axis came there upwards and downwards, positive where
        it stands too far in its positive direction [m] or [rad]
    """

    axis: Axis
    nominal: np.ndarray
    forward: np.ndarray
    backward: np.ndarray

    def change(self, positions: np.ndarray, approach: np.ndarray) -> np.ndarray:
        """(n,) what a controller with this table adds to commands (n,) [m] or [rad].

        approach : (n,) sign of the last motion; 0 for the mean of both
        """
        ends = [np.interp(positions, self.nominal, way) for way in (self.forward, self.backward)]
        weight = 0.5 * (1.0 + np.sign(approach))
        return -(weight * ends[0] + (1.0 - weight) * ends[1])

    def text(self) -> str:
        """The file: mm or degrees."""
        scale = 180.0 / math.pi if self.axis.rotary else 1e3
        rows = np.stack(
            [self.nominal, self.nominal + self.forward, self.nominal + self.backward], axis=1
        )
        return ''.join(
            ' '.join(f'{value + 0.0:.7f}' for value in row) + '\n'
            for row in np.round(rows * scale, 7)
        )


def axis_tables(known: KnownErrors) -> tuple[list[AxisTable], dict[str, str]]:
    """Tables of the axes whose own error one of them takes away; why there is none of the others.

    Returns tables, and for every other axis a reason in words.
    """
    tables, refused = [], {}
    for name in known.machine.letters:
        one = _table(known, name)
        if isinstance(one, str):
            refused[name] = one
        else:
            tables.append(one)
    return tables, refused


def changes(
    machine: Machine, tables: list[AxisTable], positions: np.ndarray, approach: np.ndarray
) -> np.ndarray:
    """(n, k) what controllers with these tables add to commands (n, k)."""
    change = np.zeros_like(positions)
    for one in tables:
        column = machine.letters.index(one.axis.name)
        change[:, column] = one.change(positions[:, column], approach[:, column])
    return change


def ini_text(tables: list[AxisTable]) -> str:
    """Lines for the INI file, joints by the letters of their axes."""
    lines = [
        '# Compensation of single axes, for the section [JOINT_n] of each. Not together with a',
        '# program that is corrected for the same errors. BACKLASH of these joints is then not',
        '# used: what is known of it is in the tables.',
    ]
    for one in tables:
        name = one.axis.name
        lines += [
            f'# [JOINT_n] of {name}', f'COMP_FILE = {name}.comp', 'COMP_FILE_TYPE = 0',
        ]
    return '\n'.join(lines) + '\n'


def elsewhere(known: KnownErrors) -> list[str]:
    """Errors, for example E_XB, that act across their axis: no table of one axis holds them."""
    machine = known.machine
    rng = np.random.default_rng(0)
    positions = np.stack([rng.uniform(*_range(known, n), _POSES) for n in machine.letters], axis=1)
    positions = positions[known.inside(positions)]
    errors = known.at(positions, np.ones_like(positions))
    found = []
    for number, name in enumerate(machine.letters):
        axis = machine.axes[name]
        along = np.abs(axis.direction) > _NOTHING
        own = np.r_[along & axis.rotary, along & (not axis.rotary)]
        large = (np.abs(errors[:, number]) > _NOTHING).any(axis=0)
        found += [
            f'E_{ERROR_LETTERS[k]}{name}' for k in np.flatnonzero(large & ~own)
        ]
    return found


def own_error(axis: Axis, errors: np.ndarray) -> np.ndarray:
    """(...) error of an axis in its own direction, from errors (..., 6) [m] or [rad].

    Positive where the axis stands too far in its positive direction.
    """
    if axis.rotary:
        return axis.sense * (errors[..., :3] @ axis.direction)
    return errors[..., 3:] @ axis.direction


def _table(known: KnownErrors, name: str) -> AxisTable | str:
    """The table of an axis, or why there is none."""
    machine = known.machine
    axis, column = machine.axes[name], machine.letters.index(name)
    if not math.isfinite(axis.upper - axis.lower):
        return 'its range is not in the machine file'
    nominal = np.linspace(*_range(known, name), LINES)
    rng = np.random.default_rng(0)
    positions = np.zeros((_POSES, LINES, len(machine.letters)))
    for number, other in enumerate(machine.letters):
        positions[:, :, number] = rng.uniform(*_range(known, other), _POSES)[:, None]
    positions[:, :, column] = nominal
    flat = positions.reshape(-1, len(machine.letters))
    good = known.inside(flat)
    ways = []
    for sign in (1.0, -1.0):
        approach = np.zeros_like(flat)
        approach[:, column] = sign
        own = np.full(len(flat), np.nan)
        own[good] = own_error(axis, known.at(flat[good], approach[good])[:, column])
        ways.append(own.reshape(_POSES, LINES))
    both = np.stack(ways)
    size = float(np.nanmax(np.abs(both)))
    if size < _NOTHING:
        return 'no error in its own direction is known of it'
    known_at = np.isfinite(both).any(axis=(0, 1))
    nominal, both = nominal[known_at], both[:, :, known_at]
    mean = np.nanmean(both, axis=1)
    changing = float(np.nanmax(np.abs(both - mean[:, None])))
    if changing > _SHARE * size:
        unit = 'µrad' if axis.rotary else 'µm'
        return (
            f'its own error, up to {size * 1e6:.2f} {unit}, changes by {changing * 1e6:.2f} '
            f'{unit} with other axes: no table of one axis holds it'
        )
    return AxisTable(axis, nominal, mean[0], mean[1])


def _range(known: KnownErrors, name: str) -> tuple[float, float]:
    """Where an axis goes and something is known of it; where it is endless, a part of that."""
    axis = known.machine.axes[name]
    reach = math.pi if axis.rotary else _ENDLESS
    lower, upper = max(axis.lower, -reach), min(axis.upper, reach)
    if math.isfinite(axis.upper - axis.lower):
        lower, upper = axis.lower, axis.upper
    ends = np.zeros((2, len(known.machine.letters)))
    ends[:, known.machine.letters.index(name)] = lower, upper
    if name not in known.stations or known.inside(ends).all():
        return lower, upper
    stations = known.stations[name]
    return max(lower, float(stations[0])), min(upper, float(stations[-1]))
