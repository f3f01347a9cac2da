"""Error motions that an R-test may meet, as displacements at the poses of a plan.

Each is a family of a few shapes: its amplitudes are what a fit would find. They come from the
machine's chain alone, so that any five-axis machine has its own; keys are `family/axis`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rtest_identification.error_map import stations
from rtest_identification.kinematics import ERROR_LETTERS
from rtest_identification.machine import Machine
from rtest_identification.observations import Observations
from rtest_identification.symbols import location_parameters, parameter

# Harmonics are looked at up to this order on a full turn, and to the second on less of one.
_HIGHEST, _PART = 11, 2
_UNIT = np.eye(3)
TURN, SHIFT = 'ABC', 'XYZ'


@dataclass(frozen=True)
class Signature:
    """One error motion.

    name : in words; shapes : (n, 3, m) displacement per amplitude, any scale
    """

    key: str
    name: str
    shapes: np.ndarray


def signatures(observations: Observations, jacobian: np.ndarray) -> tuple[Signature, ...]:
    """The error motions that apply to a machine.

    jacobian : (n, 3, 6 k) of `kinematics.predict` at the observations
    """
    machine = observations.machine
    found: list[Signature] = []
    for name in machine.rotary:
        found += _rotary(observations, jacobian, name)
    for name in machine.linear:
        found += _linear(observations, jacobian, name)
    found += _constants(machine, jacobian)
    for column, name in enumerate(machine.letters):
        axis = machine.axes[name]
        along = _effect(machine, jacobian, name, TURN if axis.rotary else SHIFT, axis.direction)
        side = observations.approach[:, column, None, None]
        found.append(_family(f'backlash/{name}', f'backlash of {name}', along * side))
    first = (machine.rotary or machine.linear)[0]
    shift = np.concatenate([_effect(machine, jacobian, first, SHIFT, u) for u in _UNIT], axis=2)
    whole, own = _courses(observations)
    for key, course, words in (
        ('drift', whole, 'drift, steady over the session'),
        ('drift-settling', 1.0 - np.exp(-4.0 * whole), 'drift that settles in a quarter of it'),
        ('drift-cycle', own, 'drift, steady and alike in every cycle'),
    ):
        found.append(_family(key, words, shift * course[:, None, None]))
    # A gain acts in proportion to what there is to see: the sum of the constant errors' effects.
    constant = [p.column for p in location_parameters(machine)]
    scale = np.array([p.scale for p in location_parameters(machine)])
    seen = (jacobian[:, :, constant] * scale).sum(axis=2, keepdims=True)
    found.append(_family('gauge-gain', 'equal gain of all gauges', seen))
    return tuple(found)


def _family(key: str, name: str, *shapes: np.ndarray) -> Signature:
    return Signature(key, name, np.concatenate(shapes, axis=2))


def _effect(
    machine: Machine, jacobian: np.ndarray, name: str, letters: str, vector: np.ndarray
) -> np.ndarray:
    """(n, 3, 1) effect of an error of an axis: a turn about ('ABC') or a shift along a vector."""
    start = 6 * machine.letters.index(name)
    columns = [start + ERROR_LETTERS.index(letter) for letter in letters]
    return (jacobian[:, :, columns] @ vector)[:, :, None]


def _rotary(
    observations: Observations, jacobian: np.ndarray, name: str
) -> list[Signature]:
    machine = observations.machine
    axis = machine.axes[name]
    u, v = across(axis.direction)
    angle = axis.sense * observations.axis(name)

    def of(letters: str, vector: np.ndarray) -> np.ndarray:
        return _effect(machine, jacobian, name, letters, vector)

    def with_harmonic(effect: np.ndarray, order: int) -> list[np.ndarray]:
        return [
            effect * f(order * angle)[:, None, None] for f in (np.cos, np.sin)
        ]

    def turning(letters: str) -> list[np.ndarray]:
        """Constant as seen from what the axis carries: turned by its angle."""
        c, s = np.cos(angle)[:, None, None], np.sin(angle)[:, None, None]
        first, second = of(letters, u), of(letters, v)
        return [c * first + s * second, -s * first + c * second]

    found = [
        _family(f'radial-turning/{name}', f'radial run-out that turns with {name}',
                *turning(SHIFT)),
        _family(f'coning-turning/{name}', f'coning that turns with {name}', *turning(TURN)),
        _family(f'angular-scale/{name}', f'angular error in proportion to {name}',
                of(TURN, axis.direction) * angle[:, None, None]),
    ]
    outer = machine.rotary[0]
    if name == outer:
        found.append(_family(
            f'torque-twist/{name}', f'twist of {name} under an unbalanced load, k sin {name}',
            of(TURN, axis.direction) * np.sin(angle)[:, None, None],
        ))
    else:
        grows = np.abs(observations.axis(outer))[:, None, None]
        for letters, key, words in (
            (SHIFT, 'runout-grows', 'run-out'), (TURN, 'coning-grows', 'coning')
        ):
            found.append(_family(
                f'{key}/{name}', f'{words} of {name} that grows with {outer}',
                *(shape * grows for shape in turning(letters)),
            ))
    for order in range(1, highest_order(observations.axis(name)) + 1):
        for family, letters, vectors, words in (
            ('radial', SHIFT, (u, v), 'radial'),
            ('axial', SHIFT, (axis.direction,), 'axial'),
            ('coning', TURN, (u, v), 'coning'),
            ('angular-cyclic', TURN, (axis.direction,), 'angular'),
        ):
            shapes = [s for w in vectors for s in with_harmonic(of(letters, w), order)]
            found.append(_family(
                f'{family}/{name}.{order}', f'{words} error of {name}, {order} a turn', *shapes
            ))
    return found


def _linear(observations: Observations, jacobian: np.ndarray, name: str) -> list[Signature]:
    machine = observations.machine
    axis = machine.axes[name]
    place = observations.axis(name)[:, None, None]
    found = [
        _family(f'scale/{name}', f'scale of {name}',
                _effect(machine, jacobian, name, SHIFT, axis.direction) * place)
    ]
    for vector in across(axis.direction):
        letter = 'XYZ'[int(np.argmax(np.abs(vector)))]
        found.append(_family(
            f'straightness/{letter}{name}', f'straightness {letter} of {name}, bow',
            _effect(machine, jacobian, name, SHIFT, vector) * place**2,
        ))
    for letter in 'ABC':
        column = parameter(machine, name, letter).column
        found.append(_family(
            f'angle/{letter}{name}', f'angle {letter} of {name} in proportion to {name}',
            jacobian[:, :, [column]] * place,
        ))
    return found


def _constants(machine: Machine, jacobian: np.ndarray) -> list[Signature]:
    """Constant errors that are not among the location and squareness errors."""
    known = {(p.axis, p.letter) for p in location_parameters(machine)}
    found = []
    for name in (*machine.rotary, *machine.linear):
        letters = 'XYZABC' if machine.axes[name].rotary else 'ABC'
        for letter in letters:
            if (name, letter) not in known:
                one = parameter(machine, name, letter)
                found.append(_family(
                    f'location/{one.symbol}', f'constant {one.symbol}',
                    jacobian[:, :, [one.column]],
                ))
    return found


def _courses(observations: Observations) -> tuple[np.ndarray, np.ndarray]:
    """(n,) part of the session, and of its own cycle, that is over at each row."""
    time = (observations.stamp - observations.stamp.min()).astype(float)
    own = time.copy()
    for number in range(len(observations.cycles)):
        rows = observations.cycle == number
        own[rows] -= time[rows].min()
        own[rows] /= max(float(own[rows].max()), 1.0)
    return time / max(float(time.max()), 1.0), own


def across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors across a direction, right-handed with it; along X, Y, Z where they can."""
    first = _UNIT[int(np.argmin(np.add(np.abs(direction), [0.0, 1e-6, 2e-6])))]
    u = first - (first @ direction) * direction
    u /= np.linalg.norm(u)
    return u, np.cross(direction, u)


def highest_order(positions: np.ndarray) -> int:
    """Highest harmonic that is looked at: one less than the stations on a full turn."""
    places, _ = stations(positions)
    largest = np.diff(np.r_[places, places[0] + 2.0 * math.pi]).max()
    if largest > math.radians(90.0):
        return _PART
    return min(_HIGHEST, len(places) - 1)

