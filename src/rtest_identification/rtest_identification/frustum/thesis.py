"""What Tables 6-2 to 6-7 of the thesis are about: conditions, error profiles, printed numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rtest_identification.frustum.cone import Frustum

# Sizes that errors are given: 10 µm or 0.01 deg, standard deviation 3.3 µm or 0.0033 deg.
LENGTH, ANGLE = 10e-6, math.radians(0.01)
SPREAD = 0.33


def size(angular: bool) -> float:
    """The size that an error is given, [rad] or [m]."""
    return ANGLE if angular else LENGTH


def frustum(
    tilt_deg: float, centre_mm: tuple[float, float, float], half_apex_deg: float = 30.0,
    diameter_mm: float = 129.9,
) -> Frustum:
    """A frustum in a person's units."""
    x, y, z = (1e-3 * value for value in centre_mm)
    return Frustum(
        math.radians(tilt_deg), math.radians(half_apex_deg), 1e-3 * diameter_mm, (x, y, z)
    )


PRINTED_CENTRE = (-81.8, 0.0, 189.3)
# Table 6-1. Its centre is where the normals meet: with that case (a) of Table 6-2 comes out to
# 0.1 µm. The three angular rows of case (b) do with a centre that is printed nowhere; the other
# five do not depend on it.
CASES = {'a': frustum(15.0, PRINTED_CENTRE), 'b': frustum(75.0, (-209.1, 0.0, 51.9))}
CASE_B_AS_PRINTED = frustum(75.0, PRINTED_CENTRE)

# Table 6-2: the thesis's symbol, axis and letter of the error, circularity in both cases [m].
CONSTANTS = (
    ('α⁰_BY', 'B', 'A', 9.1e-6, 8.2e-6),
    ('β⁰_BY', 'B', 'B', 5.6e-6, 7.2e-6),
    ('γ⁰_BY', 'B', 'C', 0.0, 0.0),
    ('α⁰_CB', 'C', 'A', 11.8e-6, 22.4e-6),
    ('δx⁰_BY', 'B', 'X', 1.9e-6, 2.3e-6),
    ('δy⁰_BY', 'B', 'Y', 3.6e-6, 2.6e-6),
    ('δz⁰_BY', 'B', 'Z', 0.0, 0.0),
    ('δx⁰_CB', 'C', 'X', 1.7e-6, 6.3e-6),
)


@dataclass(frozen=True)
class Draw:
    """Random numbers of m simulations at n points.

    b, c : (n,) commanded positions [rad]
    phase : (m, 1) ζ, uniform over a turn [rad]; share : (m, 1) uniform, where a profile breaks
    """

    b: np.ndarray
    c: np.ndarray
    phase: np.ndarray
    share: np.ndarray


# From a draw to an error (m, n) or (n,), per size.
Profile = Callable[[Draw], np.ndarray]


@dataclass(frozen=True)
class Row:
    """A row of Tables 6-3 to 6-7.

    terms : axis, letter and profile of each error that the row is about
    printed : (mean, standard deviation) of the circularity in case (a), in case (b) [m]
    """

    table: str
    name: str
    terms: tuple[tuple[str, str, Profile], ...]
    printed: tuple[tuple[float, float], tuple[float, float]]

    @property
    def angular(self) -> bool:
        """Whether its errors are angles."""
        return self.terms[0][1] in 'ABC'


def _slope(draw: Draw) -> np.ndarray:
    """Eq. 6-1 over B: a straight line from -1/2 to 1/2."""
    return 0.5 + (draw.b - draw.b.max()) / np.ptp(draw.b)


def _two_slopes(position: str) -> Profile:
    """Eqs. 6-2 and 6-3 over B or C: from -1/2 to 1/2 at the break and back."""

    def profile(draw: Draw) -> np.ndarray:
        at = getattr(draw, position)
        low, high = at.min(), at.max()
        edge = low + draw.share * (high - low)
        rising = 0.5 + (at - edge) / (edge - low)
        return np.where(at < edge, rising, -0.5 - (at - high) / (high - edge))

    return profile


def _wave(position: str, function: Callable, growing: bool = False) -> Profile:
    """Eqs. 6-4 to 6-7, and 6-10: cos or sin of B + ζ or C + ζ, once a turn."""

    def profile(draw: Draw) -> np.ndarray:
        wave = function(getattr(draw, position) + draw.phase)
        return wave * _growth(draw) if growing else wave

    return profile


def _growing(function: Callable) -> Profile:
    """Eqs. 6-8 and 6-9: cos ζ or sin ζ, growing with |B|."""
    return lambda draw: function(draw.phase) * _growth(draw)


def _growth(draw: Draw) -> np.ndarray:
    size = np.abs(draw.b)
    return (size - size.min()) / np.ptp(size)


def _um(*values: float) -> tuple[tuple[float, float], tuple[float, float]]:
    a, a_std, b, b_std = (1e-6 * v for v in values)
    return (a, a_std), (b, b_std)


def _ramps(letter: str, name: str, first: tuple, second: tuple) -> tuple[Row, Row]:
    return (
        Row('6-3', f'{name}¹_BY(B)', (('B', letter, _slope),), _um(*first)),
        Row('6-3', f'{name}²_BY(B)', (('B', letter, _two_slopes('b')),), _um(*second)),
    )


def _pair(axis: str, letters: str, position: str, growing: bool = False) -> tuple:
    one, two = letters
    return (
        (axis, one, _wave(position, np.cos, growing)),
        (axis, two, _wave(position, np.sin, growing)),
    )


# Eq. 6-7 prints α and β for the coning of B, its table α and γ: a tilt of B's axis is about X and
# Z, and the printed numbers are nearer to those of α and γ.
ROWS = (
    *_ramps('B', 'β', (3.6, 1.3, 20, 6.7), (32, 11.5, 15, 11.1)),
    *_ramps('Y', 'δy', (3.5, 1.2, 6.0, 2.2), (4, 1.5, 7.5, 3.3)),
    *_ramps('Z', 'δz', (0, 0, 0, 0), (0, 0, 0, 0)),
    Row('6-4', 'γ²_CB(C)', (('C', 'C', _two_slopes('c')),), _um(4.6, 2.0, 16.5, 11.4)),
    Row('6-4', 'δz²_CB(C)', (('C', 'Z', _two_slopes('c')),), _um(2.0, 0.9, 6.6, 2.5)),
    Row('6-5', 'δx, δy_CB(C)', _pair('C', 'XY', 'c'), _um(0, 0, 0, 0)),
    Row('6-5', 'δx, δz_BY(B)', _pair('B', 'XZ', 'b'), _um(0.8, 0.6, 3, 2.5)),
    Row('6-5', 'α, β_CB(C)', _pair('C', 'AB', 'c'), _um(0, 0, 0, 0)),
    Row('6-5', 'α, γ_BY(B)', _pair('B', 'AC', 'b'), _um(4.6, 3.5, 12, 9.0)),
    Row('6-6', 'δx, δy_CB(B)', (('C', 'X', _growing(np.cos)), ('C', 'Y', _growing(np.sin))),
        _um(1.5, 0.6, 3.8, 1.6)),
    Row('6-6', 'α, β_CB(B)', (('C', 'A', _growing(np.cos)), ('C', 'B', _growing(np.sin))),
        _um(2.0, 1.1, 12.5, 5.4)),
    Row('6-7', 'δx, δy_CB(B, C)', _pair('C', 'XY', 'c', True), _um(5.0, 1.7, 3, 1.7)),
    Row('6-7', 'α, β_CB(B, C)', _pair('C', 'AB', 'c', True), _um(16.5, 6.1, 10, 7.3)),
)  # fmt: skip
