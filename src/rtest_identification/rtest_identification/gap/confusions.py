"""What an effect of the user's own looks like in the data at hand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtest_identification.gap.effects import Effect
from rtest_identification.gap.projection import Projection
from rtest_identification.gap.rows import Rows

# An effect that looks more than this like one of the library is not told from it for certain.
CONFUSABLE = 0.98
# Stands for the base model.
INVISIBLE = 'invisible'


def described(effect: Effect, rows: Rows, library: Sequence[Effect]) -> str | None:
    """One line on what a new effect looks like in these rows; None where like nothing else."""
    found = confusions(effect, rows, library)
    if not found:
        return None
    if found[0][0] != INVISIBLE:
        names = ', '.join(f'{key} ({cosine:.3f})' for key, cosine in found)
        return f'{effect.key} looks like {names} in these data (cosine)'
    without = len(rows.constants) + rows.scene.observations.offsets().shape[2]
    if rows.base.shape[2] > without:
        # Whether it is the model's effects that do the same.
        plain = replace(rows, base=rows.base[:, :, :without])
        if INVISIBLE not in dict(confusions(effect, plain, library)):
            return f'{effect.key} is already in the model, or what its effects do is the same'
    return (
        f'these data cannot show {effect.key}: location errors, squareness and the start of each '
        'cycle do the same'
    )


def confusions(
    effect: Effect, rows: Rows, library: Sequence[Effect]
) -> list[tuple[str, float]]:
    """Which effects a new one looks like in these rows, beside the base model.

    The cosine of the smallest principal angle between what is left of both, over their shapes: for
    some values of its parameters the new effect cannot be told from that one. Those above
    CONFUSABLE, the most alike first; INVISIBLE alone, with the cosine to the base model, where
    less than 2 % of the new effect is left.
    """
    projection = Projection(rows, library)
    own = [projection.project(effect, shape) for shape in effect.grid]
    bases = [candidate.basis for candidate in own if candidate is not None]
    if not bases:
        columns = rows.white(np.concatenate(
            [effect.columns(rows.scene, shape) for shape in effect.grid], axis=2
        ))
        left = columns - projection.base @ (projection.base.T @ columns)
        size = np.linalg.norm(columns, axis=0)
        share = float(np.max(np.linalg.norm(left, axis=0) / np.maximum(size, 1e-300)))
        return [(INVISIBLE, math.sqrt(max(1.0 - share**2, 0.0)))]
    cosines: dict[str, float] = {}
    for candidate in projection.candidates:
        key = candidate.effect.key
        for basis in bases:
            cosine = float(np.linalg.norm(basis.T @ candidate.basis, 2))
            cosines[key] = max(cosines.get(key, 0.0), min(cosine, 1.0))
    found = [(k, c) for k, c in cosines.items() if c > CONFUSABLE and k != effect.key]
    return sorted(found, key=lambda pair: -pair[1])
