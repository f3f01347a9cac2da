"""Squareness of the linear axes from average circles and centre lines (3.5, Eqs. 3-7 to 3-10).

At each level of the stepping axis (B) two things tell where the turning axis (C) points: the
normal of the circle of a sphere off the axis, against the motions across it (X and Y), and the
line through the centres of spheres on the axis at two heights, against the motion along it (Z).
Whatever the rotary axes do tilts both alike, so that the difference is the squareness of the
linear axes in the frame of B. No model of the rotary axes' errors is needed for it, unlike for the
joint fit.

A tilt is counted as the rotation from the nominal direction, about X and Y of the B frame, of the
turning axis as the nest shows it. If the linear axes move the sphere by S r besides r, the normal
n turns to n + S'n and the line to n - S n (the parts across n): the difference is the shear (S +
S') n. For the machine of the thesis with the table turning by +B that is

    beta_CX - beta_CZ   =  E_B(0X)Z cos 2B
    alpha_CY - alpha_CZ =  E_A(0Y)Z cos B - E_C(0Y)X sin B

Against the printed equations, found so in simulated data: Eq. 3-9 stands as it is. Eq. 3-10 has
the opposite sign; it holds if alpha is counted as a lean towards +Y, which is a negative rotation
about X. With the table turning by -B (Eq. 3-1) the two terms of alpha have equal signs. The thesis
takes alpha_ZY from B = 0 alone and then gamma from the rest; here both follow from all levels.

Where the differences do not follow the shear of constants, the squareness is not one number: the
thesis's own finding about X and Z (3.7.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, stats

from rtest_identification.axis_lines import AxisLines, Tilts, axis_lines, tilt_gain
from rtest_identification.kinematics import predict
from rtest_identification.least_squares import Solution, solve
from rtest_identification.machine import Machine
from rtest_identification.pipeline import Identification
from rtest_identification.presentation import Presentation
from rtest_identification.symbols import carrier

# Constant squareness is held to fail where chance would make as much of it this rarely, per tilt.
SIGNIFICANCE = 0.005
_GREEK = {'A': 'alpha', 'B': 'beta', 'C': 'gamma'}


@dataclass(frozen=True)
class Agreement:
    """Whether one tilt follows constant squareness errors over the levels.

    name : of the difference, for example beta_ZX; letter : its rotation
    symbols : of the squareness errors that drive it
    ratio : mean square of what they leave over the variance (F); probability : of a larger one
    curve : (s,) what they make at each level [rad]; law : the same in words
    sentence : what it means that it does not
    """

    name: str
    letter: str
    symbols: tuple[str, ...]
    ratio: float
    freedom: int
    probability: float
    curve: np.ndarray
    law: str
    sentence: str

    @property
    def ok(self) -> bool:
        """Whether the assumption of constants holds."""
        return not self.probability < SIGNIFICANCE


@dataclass(frozen=True)
class Separation:
    """Squareness errors by the way of section 3.5, with all that led to them.

    differences : circle minus line of each outer set-up (Eqs. 3-7 and 3-8); empty without a line
    symbols, value, covariance, determined : squareness errors (p,) [rad]
    joint, joint_stddev : (p,) the same from the least-squares fit of everything; NaN where that
        does not determine them
    agreements : of the tilts that have levels enough to be judged
    """

    stepping: str
    levels: np.ndarray
    lines: AxisLines
    differences: tuple[Tilts, ...]
    symbols: tuple[str, ...]
    value: np.ndarray
    covariance: np.ndarray
    determined: np.ndarray
    joint: np.ndarray
    joint_stddev: np.ndarray
    agreements: tuple[Agreement, ...]

    @property
    def stddev(self) -> np.ndarray:
        """(p,) standard uncertainties."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def failures(self) -> tuple[str, ...]:
        """A sentence for each tilt that constant squareness errors do not explain."""
        return tuple(a.sentence for a in self.agreements if not a.ok)


def separate(result: Identification, view: Presentation) -> Separation | None:
    """Separate the squareness of the linear axes (3.5).

    None where the table does not turn or no sphere is off its axis: nothing makes circles then.
    """
    if view.seen == 'sphere' or not any(s.outer for s in view.setups):
        return None
    lines = axis_lines(view, view.error())
    if not lines.circles or not lines.freedom:
        return None
    machine, location = result.machine, result.location
    chosen = [i for i, p in enumerate(location.parameters) if not machine.axes[p.axis].rotary]
    parameters = [location.parameters[i] for i in chosen]
    symbols = tuple(p.symbol for p in parameters)
    levels = range(len(view.levels))
    design = np.zeros((len(levels), 2, len(parameters)))
    for k, p in enumerate(parameters):
        s = strain(machine, p.column)
        design[:, :, k] = [tilt_gain(view, n) @ (s + s.T) @ view.normal(n) for n in levels]
    count = len(parameters)
    differences: tuple[Tilts, ...] = ()
    agreements: tuple[Agreement, ...] = ()
    value, covariance = np.zeros(count), np.zeros((count, count))
    determined = np.zeros(count, dtype=bool)
    if lines.along is not None:
        along = lines.along
        differences = tuple(
            Tilts(c.name, c.value - along.value, c.cofactor + along.cofactor)
            for c in lines.across
        )
        found, *_ = _solve(differences, along, design, (0, 1))
        if found is not None:
            value, determined = found.value, found.determined
            covariance = lines.variance * found.cofactor
        judged = (
            _judge(machine, view, lines, differences, design, symbols, k) for k in (0, 1)
        )
        agreements = tuple(a for a in judged if a is not None)
    known = location.determined[chosen]
    return Separation(
        view.stepping, view.levels, lines, differences, symbols, value, covariance, determined,
        np.where(known, location.value[chosen], np.nan),
        np.where(known, location.stddev[chosen], np.nan), agreements,
    )


def strain(machine: Machine, column: int) -> np.ndarray:
    """(3, 3) S of a constant error of a linear axis: it moves the sphere by S r besides r.

    r is the sphere relative to the table as the linear axes move it, in the machine frame with the
    rotary axes at zero; `column` is the error's in the Jacobian of `kinematics.predict`.
    """
    columns = [machine.letters.index(name) for name in machine.linear]
    positions = np.zeros((4, len(machine.letters)))
    positions[[1, 2, 3], columns] = 1.0
    moved = predict(machine, positions, jacobian=True)
    slopes = (moved.centre[1:] - moved.centre[0]).T
    effect = moved.jacobian[:, :, column]
    return (effect[1:] - effect[0]).T @ np.linalg.inv(slopes)


def _solve(
    differences: tuple[Tilts, ...], along: Tilts, design: np.ndarray, tilts: tuple[int, ...]
) -> tuple[Solution | None, float, int]:
    """Fit constants to these tilts; also the whitened squares they leave and the freedom.

    At a level all set-ups share the line, so that their differences are correlated by it.
    """
    at = np.ix_(tilts, tilts)
    rows, white, seen = [], [], []
    for level in range(len(along.value)):
        y = [d.value[level, tilts] for d in differences]
        use = [k for k, one in enumerate(y) if np.isfinite(one).all()]
        if not use:
            continue
        shared = np.kron(np.ones((len(use), len(use))), along.cofactor[level][at])
        own = [(differences[k].cofactor[level] - along.cofactor[level])[at] for k in use]
        factor = np.linalg.inv(np.linalg.cholesky(shared + linalg.block_diag(*own)))
        rows.append(factor @ np.tile(design[level][list(tilts)], (len(use), 1)))
        white.append(factor @ np.concatenate([y[k] for k in use]))
        seen.append(level)
    if not rows or not design.shape[2]:
        return None, float('nan'), 0
    a, y = np.vstack(rows), np.concatenate(white)
    found = solve(a, y, np.ones(design.shape[2]))
    left = y - a @ found.value
    return found, float(left @ left), len(y) - found.rank


def _judge(
    machine: Machine,
    view: Presentation,
    lines: AxisLines,
    differences: tuple[Tilts, ...],
    design: np.ndarray,
    symbols: tuple[str, ...],
    tilt: int,
) -> Agreement | None:
    found, squares, freedom = _solve(differences, lines.along, design, (tilt,))
    if found is None or freedom < 1:
        return None
    ratio = squares / freedom / lines.variance
    probability = float(stats.f.sf(ratio, freedom, lines.freedom))
    driven = [k for k in range(len(symbols)) if np.abs(design[:, tilt, k]).max() > 1e-6]
    pairs = [f'{symbols[k][-1]}{symbols[k][5:-2]}' for k in driven]
    letter = lines.letters[tilt]
    name = f'{_GREEK[letter]}_{pairs[0] if pairs else ""}'
    law = _law(design[:, tilt, driven], view)
    one = ' and '.join('-'.join(pair) for pair in pairs)
    cause = ''
    if driven:
        mover = carrier(machine, symbols[driven[0]][-1])
        if mover in machine.linear:
            along = np.abs(machine.axes[mover].direction['ABC'.index(letter)]) > 0.7
            cause = f', e.g. {"roll" if along else "pitch"} of {mover}'
    sentence = (
        f'{name} does not follow {law} (F = {ratio:.1f}, p = {probability:.1g}): {one} squareness '
        f'is not one number{cause}'
    )
    return Agreement(
        name, letter, tuple(symbols[k] for k in driven), ratio, freedom, probability,
        design[:, tilt] @ found.value, law, sentence,
    )


def _law(forms: np.ndarray, view: Presentation) -> str:
    """What constants make of a tilt over the levels, in words; `forms` (s, k)."""
    b, step = view.levels, view.stepping
    if not step:
        return 'a constant'
    laws = {
        f'cos 2{step}': [np.cos(2.0 * b)],
        f'cos {step} and sin {step}': [np.cos(b), np.sin(b)],
        'a constant': [np.ones_like(b)],
    }
    for law, shapes in laws.items():
        shapes = np.column_stack(shapes)
        fitted = shapes @ np.linalg.lstsq(shapes, forms, rcond=None)[0]
        if np.allclose(fitted, forms, atol=1e-6):
            return law
    return 'constant squareness errors'
