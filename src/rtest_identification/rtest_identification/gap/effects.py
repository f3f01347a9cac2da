"""The library of effects: error motions that a machine's model may lack, by key.

A key is ``family/axis``; harmonic families carry an order, ``radial/C.2``. Every family is generic
in the axis and is made for all axes of a machine's chain to which it applies. An effect is linear
in its parameters; what enters otherwise (a time constant, a break, a wavelength) is its shape, of
which the library offers a grid of values to choose from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from rtest_identification.gap.scene import Scene
from rtest_identification.machine import Machine
from rtest_identification.symbols import ErrorParameter

# Orders of harmonics offered, for an axis that turns fully and for one that swivels.
_ORDERS_FULL, _ORDERS_SWIVEL = (1, 2, 3, 4, 5, 6), (1, 2)
_RIGHT_ANGLE = math.pi / 2.0

Columns = Callable[[Scene, tuple[float, ...]], np.ndarray]


@dataclass(frozen=True)
class Parameter:
    """A value of an effect: name and SI unit."""

    name: str
    unit: str


@dataclass(frozen=True)
class Effect:
    """One effect of the library.

    key : as in model files; name and formula : for a person
    symbols : of the errors it moves; parameters : those it is linear in
    shape : names and units of those it is not linear in, with `grid` the values to try
    columns : (scene, shape) to (n, 3, p), displacement per parameter, frame ``table``
    """

    key: str
    name: str
    formula: str
    symbols: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    columns: Columns
    shape: tuple[Parameter, ...] = ()
    grid: tuple[tuple[float, ...], ...] = ((),)


def library(scene: Scene) -> list[Effect]:
    """Every effect that applies to the machine and the data of a scene."""
    machine = scene.machine
    found: list[Effect] = []
    for axis in machine.rotary:
        found += _rotary(machine, axis, scene)
    if len(machine.rotary) == 2:
        found += _growing(*machine.rotary)
    for axis in machine.linear:
        found += _linear(machine, axis, scene)
    found += [_backlash(machine, axis) for axis in machine.letters]
    found += _thermal(machine)
    found += _instrument(scene)
    return found


def location(parameter: ErrorParameter) -> Effect:
    """A location or squareness error that a model leaves out."""
    return Effect(
        f'location/{parameter.symbol}', f'{parameter.symbol}, which the model leaves out',
        f'{parameter.symbol} is not zero', (parameter.symbol,),
        (Parameter('value', parameter.unit),),
        _motion(parameter.axis, (parameter.letter, lambda scene: np.ones(len(scene.time)))),
    )


def _motion(axis: str, *terms: tuple[str, Callable[[Scene], np.ndarray]]) -> Columns:
    """Columns of error motions: each term is a letter of `axis` and its function of the scene."""

    def columns(scene: Scene, shape: tuple[float, ...]) -> np.ndarray:
        return np.stack(
            [scene.slope(axis, letter) * f(scene)[:, None] for letter, f in terms], axis=2
        )

    return columns


def _own(machine: Machine, axis: str) -> tuple[str, str]:
    """Letters of the rotation about and the shift along a rotary axis."""
    place = int(np.argmax(np.abs(machine.axes[axis].direction)))
    return 'ABC'[place], 'XYZ'[place]


def _across(machine: Machine, axis: str) -> tuple[str, str, str, str]:
    """Letters of the two shifts and the two tilts across a rotary axis."""
    turn, along = _own(machine, axis)
    shifts = [c for c in 'XYZ' if c != along]
    tilts = [c for c in 'ABC' if c != turn]
    return (*shifts, *tilts)


def _rotary(machine: Machine, axis: str, scene: Scene) -> Iterator[Effect]:
    turn, along = _own(machine, axis)
    x, y, a, b = _across(machine, axis)

    def angle(scene: Scene) -> np.ndarray:
        return scene.position(axis)

    def sine(order: int) -> Callable[[Scene], np.ndarray]:
        return lambda scene: np.sin(order * scene.position(axis))

    def cosine(order: int) -> Callable[[Scene], np.ndarray]:
        return lambda scene: np.cos(order * scene.position(axis))

    own = f'E_{turn}{axis}'
    yield Effect(
        f'angular-scale/{axis}', f'scale of the angle of {axis}', f'{own} = s {axis}', (own,),
        (Parameter('s', 'rad/rad'),), _motion(axis, (turn, angle)),
    )
    low, high = scene.span(axis)
    breaks = tuple((float(v),) for v in np.linspace(low, high, 9)[1:-1]) or ((0.0,),)
    yield Effect(
        f'angular-two-slope/{axis}', f'angle of {axis} with two slopes',
        f'{own} = triangle over the range of {axis} with one break (Eqs. 6-2, 6-3)', (own,),
        (Parameter('amplitude', 'rad'),), _two_slope(axis, turn, low, high),
        (Parameter('break', 'rad'),), breaks,
    )
    full = high - low > 1.5 * math.pi
    for n in _ORDERS_FULL if full else _ORDERS_SWIVEL:
        wave = f'cos {n}{axis} + q sin {n}{axis}'
        pair = (Parameter('p', 'rad'), Parameter('q', 'rad'))
        yield Effect(
            f'angular-cyclic/{axis}.{n}', f'angle of {axis}, {n} a turn', f'{own} = p {wave}',
            (own,), pair, _motion(axis, (turn, cosine(n)), (turn, sine(n))),
        )
        shift = f'E_{along}{axis}'
        yield Effect(
            f'axial/{axis}.{n}', f'axial motion of {axis}, {n} a turn', f'{shift} = p {wave}',
            (shift,), (Parameter('p', 'm'), Parameter('q', 'm')),
            _motion(axis, (along, cosine(n)), (along, sine(n))),
        )
        for family, word, first, second, unit in (
            ('radial', 'radial motion', x, y, 'm'), ('coning', 'tilt motion', a, b, 'rad'),
        ):
            pieces = [(first, cosine(n)), (first, sine(n)), (second, cosine(n)), (second, sine(n))]
            yield Effect(
                f'{family}/{axis}.{n}', f'{word} of {axis}, {n} a turn',
                f'E_{first}{axis}, E_{second}{axis} = a cos {n}{axis} + b sin {n}{axis} each',
                (f'E_{first}{axis}', f'E_{second}{axis}'),
                tuple(Parameter(f'{k}_{c}', unit) for c in (first, second) for k in 'ab'),
                _motion(axis, *pieces),
            )
    if not full:
        yield Effect(
            f'torque-twist/{axis}', f'twist of {axis} under an unbalanced table',
            f'{own} = k sin {axis}', (own,), (Parameter('k', 'rad'),),
            _motion(axis, (turn, sine(1))),
        )
        yield Effect(
            f'sag/{axis}', f'sag with {axis}', f'E_Z{axis} = -g (1 - cos {axis})',
            (f'E_Z{axis}',), (Parameter('g', 'm'),),
            _motion(axis, ('Z', lambda scene: np.cos(scene.position(axis)) - 1.0)),
        )


def _two_slope(axis: str, turn: str, low: float, high: float) -> Columns:
    def columns(scene: Scene, shape: tuple[float, ...]) -> np.ndarray:
        (at,), angle = shape, scene.position(axis)
        rising = 0.5 + (angle - at) / max(at - low, 1e-9)
        falling = -(0.5 + (angle - high) / max(high - at, 1e-9))
        triangle = np.where(angle < at, rising, falling)
        return (scene.slope(axis, turn) * triangle[:, None])[:, :, None]

    return columns


def _growing(outer: str, inner: str) -> Iterator[Effect]:
    """What the inner axis does more of the farther the outer one swivels (Eqs. 6-8 to 6-10)."""

    def share(scene: Scene) -> np.ndarray:
        return np.abs(scene.position(outer)) / _RIGHT_ANGLE

    def turning(function: Callable) -> Callable[[Scene], np.ndarray]:
        return lambda scene: function(scene.position(inner)) * share(scene)

    cosine, sine = turning(np.cos), turning(np.sin)

    def negative(scene: Scene) -> np.ndarray:
        return -sine(scene)

    def rotating(first: str, second: str) -> Columns:
        def columns(scene: Scene, shape: tuple[float, ...]) -> np.ndarray:
            one, two = scene.slope(inner, first), scene.slope(inner, second)
            c, s = cosine(scene)[:, None], sine(scene)[:, None]
            # A (cos(C + z), sin(C + z)) in the parameters A cos z, A sin z.
            return np.stack([one * c + two * s, two * c - one * s], axis=2)

        return columns

    for family, word, first, second, unit in (
        ('runout-grows', 'run-out', 'X', 'Y', 'm'), ('coning-grows', 'coning', 'A', 'B', 'rad'),
    ):
        symbols = (f'E_{first}{inner}', f'E_{second}{inner}')
        yield Effect(
            f'{family}/{inner}', f'{word} of {inner} that grows with |{outer}|',
            f'({symbols[0]}, {symbols[1]}) = A (cos({inner} + z), sin({inner} + z)) '
            f'|{outer}|/90 deg (Eq. 6-10)',
            symbols, (Parameter('A cos z', unit), Parameter('A sin z', unit)),
            rotating(first, second),
        )
    for family, word, first, second, unit in (
        ('line-shift-grows', 'shift', 'X', 'Y', 'm'), ('line-tilt-grows', 'tilt', 'A', 'B', 'rad'),
    ):
        symbols = (f'E_{first}{inner}', f'E_{second}{inner}')
        yield Effect(
            f'{family}/{inner}',
            f'{word} of the average line of {inner} that grows with |{outer}|',
            f'({symbols[0]}, {symbols[1]}) = A (cos z, sin z) |{outer}|/90 deg (Eqs. 6-8, 6-9)',
            symbols, (Parameter('A cos z', unit), Parameter('A sin z', unit)),
            _motion(inner, (first, share), (second, share)),
        )


def _linear(machine: Machine, axis: str, scene: Scene) -> Iterator[Effect]:
    along = 'XYZ'[int(np.argmax(np.abs(machine.axes[axis].direction)))]

    def place(scene: Scene) -> np.ndarray:
        return scene.position(axis)

    own = f'E_{along}{axis}'
    yield Effect(
        f'scale/{axis}', f'scale of {axis}', f'{own} = e {axis.lower()}', (own,),
        (Parameter('e', 'm/m'),), _motion(axis, (along, place)),
    )
    for letter in 'XYZ':
        if letter != along:
            yield Effect(
                f'straightness/{letter}{axis}', f'straightness {letter} of {axis}',
                f'E_{letter}{axis} = c {axis.lower()}^2', (f'E_{letter}{axis}',),
                (Parameter('c', '1/m'),), _motion(axis, (letter, lambda s: place(s) ** 2)),
            )
    for letter in 'ABC':
        yield Effect(
            f'angle/{letter}{axis}', f'{letter} rotation of {axis} with {axis}',
            f'E_{letter}{axis} = k {axis.lower()}', (f'E_{letter}{axis}',),
            (Parameter('k', 'rad/m'),), _motion(axis, (letter, place)),
        )
    low, high = scene.span(axis)
    if high - low > 0.02:
        # A quarter of a wave more each: half of what the range can tell apart, so that the best
        # length lies in the valley of one of them.
        lengths = tuple((4.0 * (high - low) / k,) for k in range(4, 33))
        yield Effect(
            f'linear-cyclic/{axis}', f'cyclic error of {axis}',
            f'{own} = p cos(2 pi {axis.lower()}/L) + q sin(2 pi {axis.lower()}/L)', (own,),
            (Parameter('p', 'm'), Parameter('q', 'm')), _linear_cyclic(axis, along),
            (Parameter('L', 'm'),), lengths,
        )


def _linear_cyclic(axis: str, along: str) -> Columns:
    def columns(scene: Scene, shape: tuple[float, ...]) -> np.ndarray:
        phase = 2.0 * math.pi * scene.position(axis) / shape[0]
        slope = scene.slope(axis, along)
        return np.stack([slope * np.cos(phase)[:, None], slope * np.sin(phase)[:, None]], axis=2)

    return columns


def _backlash(machine: Machine, axis: str) -> Effect:
    one = machine.axes[axis]
    place = int(np.argmax(np.abs(one.direction)))
    letter, unit = ('ABC'[place], 'rad') if one.rotary else ('XYZ'[place], 'm')
    return Effect(
        f'backlash/{axis}', f'backlash of {axis}',
        f'E_{letter}{axis} = h/2 times the sign of the last motion of {axis}',
        (f'E_{letter}{axis}',), (Parameter('h', unit),),
        _motion(axis, (letter, lambda scene: 0.5 * scene.direction(axis))),
    )


def _thermal(machine: Machine) -> Iterator[Effect]:
    carrier = machine.rotary[0] if machine.rotary else None
    if carrier is None:
        return

    def columns(scene: Scene, shape: tuple[float, ...]) -> np.ndarray:
        grown = -np.expm1(-scene.time / shape[0])
        slopes = [scene.slope(carrier, letter) for letter in 'XYZ']
        return np.stack([slope * grown[:, None] for slope in slopes], axis=2)

    yield Effect(
        'drift', 'drift with time',
        f'(E_X{carrier}, E_Y{carrier}, E_Z{carrier}) = d (1 - exp(-t/tau))',
        tuple(f'E_{c}{carrier}' for c in 'XYZ'),
        tuple(Parameter(f'd_{c}', 'm') for c in 'XYZ'), columns,
        (Parameter('tau', 's'),), tuple((t,) for t in (20.0, 40.0, 80.0, 160.0, 320.0, 1e4)),
    )


def _instrument(scene: Scene) -> Iterator[Effect]:
    def slip(scene: Scene, shape: tuple[float, ...]) -> np.ndarray:
        after = (scene.time >= shape[0]).astype(float)
        return after[:, None, None] * np.eye(3)

    yield Effect(
        'nest-slip', 'the nest slipped on the table', 'a step of the reading at t0, table frame',
        (), tuple(Parameter(f'd_{c}', 'm') for c in 'XYZ'), slip,
        (Parameter('t0', 's'),), tuple((t,) for t in scene.slip_times()),
    )
    for gauge in range(scene.gauges):

        def gain(scene: Scene, shape: tuple[float, ...], gauge: int = gauge) -> np.ndarray:
            return scene.gauge_gain(gauge)[:, :, None]

        def turned(scene: Scene, shape: tuple[float, ...], gauge: int = gauge) -> np.ndarray:
            return scene.gauge_turn(gauge)

        yield Effect(
            f'gauge-gain/{gauge + 1}', f'gain of gauge {gauge + 1}',
            f'd_{gauge + 1} (1 + k)', (), (Parameter('k', '1'),), gain,
        )
        yield Effect(
            f'gauge-direction/{gauge + 1}', f'direction of gauge {gauge + 1}',
            f'V_{gauge + 1} off by a small rotation', (),
            (Parameter('u', 'rad'), Parameter('v', 'rad')), turned,
        )
