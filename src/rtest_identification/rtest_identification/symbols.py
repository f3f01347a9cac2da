"""Names of geometric errors, and which of them a machine's chain lets anybody tell apart.

ISO 230-1 style in ASCII with the thesis's relative frame (Tables 2-3 and 2-4): ``E_A(0Y)B`` is the
constant rotation about X of axis B in the frame of Y, ``E_A(Y)B`` its change with B.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rtest_identification.kinematics import ERROR_LETTERS, linear_positions, predict
from rtest_identification.machine import BED, Machine

# Angles and lengths are compared at this lever arm, the size of an R-test's workspace [m].
LEVER = 0.1
# Singular values below this part of the largest mean: not determined by these data. What the
# chain cannot show at all lies at 1e-5, where the noise of the encoders lifts it from zero; a
# combination that a plan does show lies above 1e-2.
RANK_TOLERANCE = 1e-3


@dataclass(frozen=True)
class ErrorParameter:
    """One constant error of one axis.

    symbol : for example E_X(0Y)B
    column : in the Jacobian of `kinematics.predict`
    angular : whether it is an angle [rad] and not a length [m]
    """

    symbol: str
    axis: str
    letter: str
    column: int

    @property
    def angular(self) -> bool:
        """Whether it is an angle."""
        return self.letter in 'ABC'

    @property
    def unit(self) -> str:
        """SI unit."""
        return 'rad' if self.angular else 'm'

    @property
    def scale(self) -> float:
        """Value whose effect in the workspace is about a metre."""
        return 1.0 / LEVER if self.angular else 1.0


def carrier(machine: Machine, axis: str) -> str:
    """The axis in whose frame the errors of `axis` are counted.

    It is the axis that carries it; for an axis on the bed, the first axis of the other side.
    """
    for side, other in (
        (machine.table_side, machine.tool_side),
        (machine.tool_side, machine.table_side),
    ):
        if axis in side:
            place = side.index(axis)
            return side[place - 1] if place else (other[0] if other else BED)
    raise KeyError(axis)


def symbol(machine: Machine, axis: str, letter: str, constant: bool) -> str:
    """Symbol of an error: ``E_X(0Y)B`` (constant) or ``E_X(Y)B`` (position-dependent).

    A squareness of a linear axis is counted against the linear axis that it opens or closes the
    angle to (Table 2-3: E_A(0Y)Z, E_B(0X)Z, E_C(0Y)X).
    """
    reference = carrier(machine, axis)
    if constant and not machine.axes[axis].rotary and letter in 'ABC':
        turn = np.eye(3)['ABC'.index(letter)]
        partner = np.cross(turn, machine.axes[axis].direction)
        along = {n: abs(machine.axes[n].direction @ partner) for n in machine.linear if n != axis}
        reference = max(along, key=along.__getitem__)
    return f'E_{letter}({"0" if constant else ""}{reference}){axis}'


def parameter(machine: Machine, axis: str, letter: str, constant: bool = True) -> ErrorParameter:
    """The error `letter` of `axis` with its symbol and its column in the Jacobian."""
    column = 6 * machine.letters.index(axis) + ERROR_LETTERS.index(letter)
    return ErrorParameter(symbol(machine, axis, letter, constant), axis, letter, column)


@lru_cache(maxsize=16)
def _independent(key: _ByText) -> tuple[tuple[str, str], ...]:
    """Constant errors that a cycle of every pose and several spheres can tell apart, greedily."""
    machine = key.machine
    rng = np.random.default_rng(0)
    columns, offsets = [], []
    spheres = np.array([[0.0, -0.09, 0.04], [0.0, -0.09, 0.14], [0.0, 0, 0.04], [0.05, 0, 0.14]])
    for number, sphere in enumerate(spheres):
        positions = np.zeros((40, len(machine.letters)))
        for name in machine.rotary:
            positions[:, machine.letters.index(name)] = rng.uniform(-1.3, 1.3, 40)
        positions = linear_positions(machine, sphere, positions)
        jacobian = predict(machine, positions, jacobian=True).jacobian
        columns.append(jacobian.reshape(120, -1))
        offset = np.zeros((40, 3, 3 * len(spheres)))
        offset[:, :, 3 * number : 3 * number + 3] = np.eye(3)
        offsets.append(offset.reshape(120, -1))
    everything, basis = np.vstack(columns), np.vstack(offsets)
    basis = np.linalg.qr(basis)[0]
    chosen = []
    candidates = [(axis, letter) for axis in machine.rotary for letter in 'XYZABC']
    outer_first = [n for n in machine.table_side + machine.tool_side if not machine.axes[n].rotary]
    candidates += [(axis, letter) for axis in reversed(outer_first) for letter in 'ABC']
    for axis, letter in candidates:
        one = parameter(machine, axis, letter)
        column = everything[:, one.column] * one.scale
        left = column - basis @ (basis.T @ column)
        left -= basis @ (basis.T @ left)
        size = np.linalg.norm(left)
        if size > 1e-6 * np.sqrt(len(column)):
            chosen.append((axis, letter))
            basis = np.column_stack([basis, left / size])
    return tuple(chosen)


@dataclass(frozen=True)
class _ByText:
    """A machine hashed by its text, for the cache."""

    machine: Machine

    def __hash__(self) -> int:
        return hash(self.machine.text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByText) and self.machine.text == other.machine.text


def location_parameters(machine: Machine) -> tuple[ErrorParameter, ...]:
    """Location errors of the rotary axes, then squareness errors of the linear ones.

    Found from the Jacobian: going outwards from the bed, an error joins when an R-test of any
    poses could tell it from those before it and from the offset of each cycle. For the machine of
    the thesis these are the eight and the three of Table 2-3.
    """
    chosen = _independent(_ByText(machine))
    return tuple(parameter(machine, axis, letter) for axis, letter in chosen)


def map_parameters(machine: Machine, axis: str) -> tuple[ErrorParameter, ...]:
    """The six position-dependent errors of one axis (Table 2-4), in the order X Y Z A B C."""
    return tuple(parameter(machine, axis, letter, constant=False) for letter in 'XYZABC')
