"""Which error motions a plan shows, which it takes for others, and which it cannot show.

By projection on the Jacobian, nothing else: of a shape the part is left that the fitted errors and
the offsets of the cycles do not take; two of which the parts left are parallel are taken for each
other. There is no list of verdicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_identification.least_squares import solve
from rtest_identification.signatures import Signature
from rtest_identification.symbols import ErrorParameter

# A shape of which less is left is invisible; shapes with a larger cosine are taken for each other.
INVISIBLE, ALIKE = 0.02, 0.98
# Errors are named as taking a shape from this part of it on, so many at most.
_TAKES, _NAMED = 0.1, 4
# Takes the place of an error where a shape has no effect at all.
NO_MOTION = 'no motion at these poses'


@dataclass(frozen=True)
class Outlook:
    """How visible an error motion will be.

    shapes : how many there are; hidden : how many of them are invisible
    left : (least, most) fraction of its shapes that location errors, squareness and offsets of
        the cycles leave; left_by_map : the same where the map of the outer axis is fitted too
    taken_by : what takes the least visible shape, where that is invisible
    like : keys of error motions that its visible shapes cannot be told from
    """

    key: str
    name: str
    shapes: int
    hidden: int
    left: tuple[float, float]
    left_by_map: tuple[float, float]
    taken_by: tuple[str, ...]
    like: tuple[str, ...]

    @property
    def in_map(self) -> bool:
        """Whether the map of the outer axis takes all of it."""
        return self.left_by_map[1] < INVISIBLE

    @property
    def verdict(self) -> str:
        """In a word or two."""
        if self.hidden == self.shapes:
            return 'invisible'
        told = 'partly visible' if self.hidden else 'visible'
        if self.in_map:
            told += ', goes into the map'
        return f'{told}, looks like {", ".join(self.like)}' if self.like else told


def outlooks(
    found: Sequence[Signature],
    design: np.ndarray,
    with_map: np.ndarray,
    scale: np.ndarray,
    constants: tuple[ErrorParameter, ...],
) -> tuple[Outlook, ...]:
    """How visible each error motion is.

    Parameters
    ----------
    design : (3 n, p) of the constant errors, then the offsets of the cycles
    with_map : (3 n, q) orthonormal basis of that and of the design of the outer axis's map
    scale : (p,) as in `least_squares.solve`
    """
    base = basis(design)
    visible, told = [], []
    for signature in found:
        flat = signature.shapes.reshape(len(design), -1)
        # Shapes that move nothing but by rounding count as shapes of which nothing is left.
        moving = np.linalg.norm(flat, axis=0) > 1e-9 * np.sqrt(len(design))
        space = basis(flat[:, moving])
        nothing = np.zeros(flat.shape[1] - space.shape[1])
        u, s, vt = np.linalg.svd(space - base @ (base.T @ space), full_matrices=False)
        beside = np.linalg.svd(space - with_map @ (with_map.T @ space), compute_uv=False)
        takers: tuple[str, ...] = ()
        if nothing.size:
            takers = (NO_MOTION,)
        elif s[-1] < INVISIBLE:
            takers = _takers(space @ vt[-1], design, scale, constants)
        visible.append(u[:, s >= INVISIBLE])
        told.append((signature, np.r_[s, nothing], np.r_[beside, nothing], takers))
    return tuple(
        Outlook(
            signature.key, signature.name, len(left), int(np.sum(left < INVISIBLE)),
            (float(left.min()), float(left.max())), (float(beside.min()), float(beside.max())),
            takers, _alike(number, visible, found),
        )
        for number, (signature, left, beside, takers) in enumerate(told)
    )


def _takers(
    shape: np.ndarray,
    design: np.ndarray,
    scale: np.ndarray,
    constants: tuple[ErrorParameter, ...],
) -> tuple[str, ...]:
    """What the fit would take a unit shape for, largest part first."""
    value = solve(design, shape, scale).value
    count = len(constants)
    parts = {
        p.symbol: float(np.linalg.norm(design[:, k] * value[k])) for k, p in enumerate(constants)
    }
    parts['offsets of the cycles'] = float(np.linalg.norm(design[:, count:] @ value[count:]))
    ordered = sorted(parts, key=parts.__getitem__, reverse=True)
    takers = [name for name in ordered if parts[name] > _TAKES]
    more = ('others',) if len(takers) > _NAMED else ()
    return (*takers[:_NAMED], *more)


def _alike(
    number: int, visible: list[np.ndarray], found: tuple[Signature, ...]
) -> tuple[str, ...]:
    """Keys of the error motions that could pass for all visible shapes of one."""
    own = visible[number]
    keys = []
    for other, shapes in enumerate(visible):
        if other == number or not own.shape[1] or shapes.shape[1] < own.shape[1]:
            continue
        if np.linalg.svd(shapes.T @ own, compute_uv=False).min() > ALIKE:
            keys.append(found[other].key)
    return tuple(keys)


def basis(design: np.ndarray) -> np.ndarray:
    """Orthonormal basis of the columns."""
    if not design.shape[1]:
        return design
    size = np.linalg.norm(design, axis=0)
    u, s, _ = np.linalg.svd(design / np.where(size > 0.0, size, 1.0), full_matrices=False)
    return u[:, s > 1e-9 * s[0]]
