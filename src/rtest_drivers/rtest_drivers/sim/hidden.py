"""Effects to hide in the simulated machine: what a model may lack, as the machine would do it.

Formulas of their own, of the poses' positions, directions of motion and times; nothing is taken
from the library of effects that looks for them. Every effect is drawn at amplitude 1 (metre or
radian, whatever its unit is) and scaled by whoever hides it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rtest_drivers.sim.errors import COMPONENTS, GeometricErrors
from rtest_drivers.sim.kinematics import follow
from rtest_identification.machine import Machine

# Letters of the machine's axes as the formulas name them: swivel, table, linear.
_SWIVEL, _TABLE = 'B', 'C'
_ORDERS = {_SWIVEL: (1, 2), _TABLE: (1, 2, 3, 4, 5, 6)}
_TURN = {_SWIVEL: 'B', _TABLE: 'C'}
_ALONG = {_SWIVEL: 'Y', _TABLE: 'Z'}
_QUARTER = math.pi / 2.0


@dataclass(frozen=True)
class Poses:
    """Poses in the order they are visited.

    positions, direction : (n, k) in the order of ``machine.letters``; sign of the last motion
        of each axis on arrival, 0 before its first within a cycle
    time : (n,) since the start of the session [s]
    cycle : (n,) number of the cycle a pose belongs to
    """

    machine: Machine
    positions: np.ndarray
    direction: np.ndarray
    time: np.ndarray
    cycle: np.ndarray

    def at(self, axis: str) -> np.ndarray:
        """(n,) positions of an axis [m] or [rad]."""
        return self.positions[:, self.machine.letters.index(axis)]

    def sign(self, axis: str) -> np.ndarray:
        """(n,) direction of its last motion."""
        return self.direction[:, self.machine.letters.index(axis)]

    def __len__(self) -> int:
        return len(self.time)


Errors = dict[str, np.ndarray]


@dataclass(frozen=True)
class Hidden:
    """An effect at amplitude 1.

    key : its name in the library; empty where the library has none
    errors : error by symbol such as E_XC, (n,) [m] or [rad]
    gauge : index of the gauge that is to blame, or -1
    gain, turn : relative error of its gain; (3,) change of its direction, after the calibration
    slip : (n, 3) of the nest, frame ``table`` [m]
    parameters : by name, as the library calls them, at amplitude 1; those of its shape as they are
    shape : names of those that no amplitude scales
    """

    key: str
    errors: Errors = field(default_factory=dict)
    gauge: int = -1
    gain: float = 0.0
    turn: np.ndarray = field(default_factory=lambda: np.zeros(3))
    slip: np.ndarray | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    shape: tuple[str, ...] = ()


@dataclass(frozen=True)
class HiddenErrors:
    """Errors of a machine with hidden effects at fixed poses; for `sphere_in_table`."""

    base: GeometricErrors
    hidden: tuple[tuple[Hidden, float], ...]

    @property
    def axes(self) -> frozenset[str]:
        """Axes that have any error."""
        return self.base.axes | {s[-1] for effect, _ in self.hidden for s in effect.errors}

    def of_axis(self, axis: str, positions: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, 6) errors A B C X Y Z of one axis [rad] and [m]."""
        values = self.base.of_axis(axis, positions)
        for effect, amplitude in self.hidden:
            for symbol, error in effect.errors.items():
                if symbol[-1] == axis:
                    values[:, COMPONENTS.index(symbol[2])] += amplitude * error
        return values


def directions(machine: Machine, commands: np.ndarray, sphere: np.ndarray) -> np.ndarray:
    """(n, k) sign of the last motion of each axis on arrival at commands (n, k) of one cycle.

    Between poses the rotary axes run in proportion and the linear ones follow the sphere: what
    counts is the last hundredth of the way.
    """
    signs = np.zeros_like(commands)
    for row in range(1, len(commands)):
        near = commands[row - 1] + 0.99 * (commands[row] - commands[row - 1])
        step = commands[row] - follow(machine, near, sphere)[0]
        moved = np.abs(step) > 1e-9
        signs[row] = np.where(moved, np.sign(step), signs[row - 1])
    return signs


Draw = Callable[[np.random.Generator, Poses], Hidden]


def families(machine: Machine) -> dict[str, Draw]:
    """How to draw each effect of a machine with B and C, by key."""
    found: dict[str, Draw] = {}
    for axis in (_SWIVEL, _TABLE):
        own = f'E_{_TURN[axis]}{axis}'
        found[f'angular-scale/{axis}'] = _one(own, 's', lambda p, a=axis: p.at(a))
        found[f'angular-two-slope/{axis}'] = _two_slope(axis)
        for n in _ORDERS[axis]:
            found[f'angular-cyclic/{axis}.{n}'] = _cyclic(own, axis, n)
            found[f'axial/{axis}.{n}'] = _cyclic(f'E_{_ALONG[axis]}{axis}', axis, n)
            found[f'radial/{axis}.{n}'] = _pair(axis, n, 'XYZ', _ALONG[axis])
            found[f'coning/{axis}.{n}'] = _pair(axis, n, 'ABC', _TURN[axis])
    found['torque-twist/B'] = _one('E_BB', 'k', lambda p: np.sin(p.at('B')))
    found['sag/B'] = _one('E_ZB', 'g', lambda p: -(1.0 - np.cos(p.at('B'))))
    for kind, first, second in (('runout', 'X', 'Y'), ('coning', 'A', 'B')):
        found[f'{kind}-grows/C'] = _grows(f'{kind}-grows/C', first, second, turning=True)
    for kind, first, second in (('line-shift', 'X', 'Y'), ('line-tilt', 'A', 'B')):
        found[f'{kind}-grows/C'] = _grows(f'{kind}-grows/C', first, second, turning=False)
    for axis in machine.letters:
        own = f'E_{_TURN[axis]}{axis}' if machine.axes[axis].rotary else f'E_{axis}{axis}'
        found[f'backlash/{axis}'] = _one(own, 'h', lambda p, a=axis: 0.5 * p.sign(a))
    for axis in machine.linear:
        found[f'scale/{axis}'] = _one(f'E_{axis}{axis}', 'e', lambda p, a=axis: p.at(a))
        found[f'linear-cyclic/{axis}'] = _wave(axis)
        for other in 'XYZ':
            if other != axis:
                found[f'straightness/{other}{axis}'] = _one(
                    f'E_{other}{axis}', 'c', lambda p, a=axis: p.at(a) ** 2
                )
        for turn in 'ABC':
            found[f'angle/{turn}{axis}'] = _one(
                f'E_{turn}{axis}', 'k', lambda p, a=axis: p.at(a)
            )
    found['drift'] = _drift
    found['nest-slip'] = _slip
    for gauge in range(3):
        found[f'gauge-gain/{gauge + 1}'] = _gain(gauge)
        found[f'gauge-direction/{gauge + 1}'] = _direction(gauge)
    # The key of a family is the key of what it draws.
    return {key: _named(key, draw) for key, draw in found.items()}


def _named(key: str, draw: Draw) -> Draw:
    def named(rng: np.random.Generator, poses: Poses) -> Hidden:
        hidden = draw(rng, poses)
        return Hidden(**{**vars(hidden), 'key': key})

    return named


def _one(symbol: str, name: str, shape: Callable[[Poses], np.ndarray]) -> Draw:
    def draw(rng: np.random.Generator, poses: Poses) -> Hidden:
        sign = rng.choice([-1.0, 1.0])
        return Hidden('', {symbol: sign * shape(poses)}, parameters={name: sign})

    return draw


def _cyclic(symbol: str, axis: str, order: int) -> Draw:
    def draw(rng: np.random.Generator, poses: Poses) -> Hidden:
        phase = rng.uniform(0.0, 2.0 * math.pi)
        p, q = math.cos(phase), math.sin(phase)
        angle = order * poses.at(axis)
        return Hidden(
            '', {symbol: p * np.cos(angle) + q * np.sin(angle)}, parameters={'p': p, 'q': q}
        )

    return draw


def _pair(axis: str, order: int, letters: str, without: str) -> Draw:
    def draw(rng: np.random.Generator, poses: Poses) -> Hidden:
        angle, size = order * poses.at(axis), rng.normal(size=(2, 2))
        size /= np.linalg.norm(size)
        errors, parameters = {}, {}
        for letter, (a, b) in zip((c for c in letters if c != without), size, strict=True):
            errors[f'E_{letter}{axis}'] = a * np.cos(angle) + b * np.sin(angle)
            parameters |= {f'a_{letter}': a, f'b_{letter}': b}
        return Hidden('', errors, parameters=parameters)

    return draw


def _grows(key: str, first: str, second: str, turning: bool) -> Draw:
    def draw(rng: np.random.Generator, poses: Poses) -> Hidden:
        zeta = rng.uniform(0.0, 2.0 * math.pi)
        angle = (poses.at(_TABLE) if turning else 0.0) + zeta
        share = np.abs(poses.at(_SWIVEL)) / _QUARTER
        errors = {f'E_{first}C': np.cos(angle) * share, f'E_{second}C': np.sin(angle) * share}
        return Hidden(
            key, errors, parameters={'A cos z': math.cos(zeta), 'A sin z': math.sin(zeta)}
        )

    return draw


def _two_slope(axis: str) -> Draw:
    def draw(rng: np.random.Generator, poses: Poses) -> Hidden:
        angle = poses.at(axis)
        low, high = angle.min(), angle.max()
        at = rng.uniform(low + 0.25 * (high - low), high - 0.25 * (high - low))
        rise = np.interp(angle, [low, at, high], [-0.5, 0.5, -0.5])
        return Hidden(
            '', {f'E_{_TURN[axis]}{axis}': rise}, parameters={'amplitude': 1.0, 'break': at},
            shape=('break',),
        )

    return draw


def _wave(axis: str) -> Draw:
    def draw(rng: np.random.Generator, poses: Poses) -> Hidden:
        place = poses.at(axis)
        length = (place.max() - place.min()) * rng.uniform(0.15, 0.8)
        phase = rng.uniform(0.0, 2.0 * math.pi)
        p, q = math.cos(phase), math.sin(phase)
        angle = 2.0 * math.pi * place / length
        return Hidden(
            '', {f'E_{axis}{axis}': p * np.cos(angle) + q * np.sin(angle)},
            parameters={'p': p, 'q': q, 'L': length}, shape=('L',),
        )

    return draw


def _drift(rng: np.random.Generator, poses: Poses) -> Hidden:
    size = rng.normal(size=3)
    size /= np.linalg.norm(size)
    # A constant near the length of the session looks like a slow drift of any constant.
    tau = poses.time.max() * rng.uniform(0.1, 0.8)
    grown = 1.0 - np.exp(-poses.time / tau)
    return Hidden(
        '', {f'E_{c}B': d * grown for c, d in zip('XYZ', size, strict=True)},
        parameters={**{f'd_{c}': d for c, d in zip('XYZ', size, strict=True)}, 'tau': tau},
        shape=('tau',),
    )


def _slip(rng: np.random.Generator, poses: Poses) -> Hidden:
    size = rng.normal(size=3)
    size /= np.linalg.norm(size)
    # Within a cycle: between two, nothing of it would be left beside their offsets.
    rows = np.flatnonzero(poses.cycle == rng.choice(np.unique(poses.cycle)))
    k = rng.integers(len(rows) // 6, len(rows) - len(rows) // 6)
    before, after = poses.time[rows[k - 1]], poses.time[rows[k]]
    at = 0.5 * (before + after)
    return Hidden(
        '', slip=(poses.time >= at)[:, None] * size,
        parameters={**{f'd_{c}': d for c, d in zip('XYZ', size, strict=True)}, 't0': at},
        shape=('t0',),
    )


def _gain(gauge: int) -> Draw:
    def draw(rng: np.random.Generator, poses: Poses) -> Hidden:
        sign = rng.choice([-1.0, 1.0])
        return Hidden('', gauge=gauge, gain=sign, parameters={'k': sign})

    return draw


def _direction(gauge: int) -> Draw:
    def draw(rng: np.random.Generator, poses: Poses) -> Hidden:
        turn = rng.normal(size=3)
        return Hidden('', gauge=gauge, turn=turn / np.linalg.norm(turn))

    return draw


def outside(kind: str, rng: np.random.Generator, poses: Poses) -> Hidden:
    """An effect that no library describes.

    kind : 'random' (every pose of B and C on its own), 'product' (odd waves of B times waves of
        C), 'dent' (near one pose of B and C, falling off to the other side), 'switch' (changes
        its sign at one B and as C turns)
    """
    b, c = poses.at(_SWIVEL), poses.at(_TABLE)
    letter, phase = rng.choice(list('XYZ')), rng.uniform(0.0, 2.0 * math.pi)
    if kind == 'random':
        key = np.round(np.column_stack([b, c]) / math.radians(0.5)).astype(int)
        _, cell = np.unique(key, axis=0, return_inverse=True)
        values = rng.normal(size=(cell.max() + 1, 3))[cell.ravel()]
        return Hidden('', {f'E_{d}C': values[:, k] for k, d in enumerate('XYZ')})
    if kind == 'product':
        wave = np.sin(rng.uniform(2.0, 3.0) * b) * np.cos(rng.integers(2, 5) * c + phase)
    elif kind == 'dent':
        along = (b - rng.uniform(-0.8, 0.8)) / 0.3
        around = np.angle(np.exp(1j * (c - phase))) / 0.5
        wave = (along + 0.5) * np.exp(-0.5 * (along**2 + around**2))
    else:
        wave = np.sign(b - rng.uniform(-0.6, 0.6)) * np.sign(np.sin(2.0 * c + phase))
    return Hidden('', {f'E_{letter}C': wave})
