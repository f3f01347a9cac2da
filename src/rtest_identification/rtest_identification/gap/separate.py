"""The next measurement that would tell an effect from its rivals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from rtest_estimation.records import CyclePlan
from rtest_identification.gap.effects import Effect, library, location
from rtest_identification.gap.rows import Rows
from rtest_identification.gap.scene import Scene
from rtest_identification.observations import Observations
from rtest_identification.plans import static
from rtest_identification.symbols import location_parameters

# Two signatures less than this apart (sine of their angle) are alike in these data.
_APART = 0.2
# And these are the same but for rounding.
_SAME = 1e-6


def separate(
    rows: Rows, effect: Effect, rivals: Sequence[str], more: Sequence[Effect] = ()
) -> str:
    """What to measure besides, so that `effect` no longer looks like its rivals.

    Each option's poses are added to those of the session and the two signatures compared beside
    the base model, as they would be identified. more : effects of the user's own.
    """
    if not rivals:
        return ''
    options = {'': (), **_options(rows)}
    told: dict[str, list[str]] = {}
    for rival in rivals:
        apart = {
            name: _angle(rows, plans, effect.key, rival, more) for name, plans in options.items()
        }
        now = apart.pop('')
        if now < _SAME and _same(rows, options.values(), effect.key, rival, more):
            told.setdefault('the same effect', []).append(rival)
            continue
        best = max(apart, key=apart.__getitem__, default=None)
        if best is None or apart[best] < max(_APART, 1.5 * now):
            word = 'no further R-test pose; measure one of the two directly (laser, straightedge)'
            if now >= _APART:
                word = 'more poses of the same kind: they differ, but less than the noise'
        else:
            word = best
        told.setdefault(word, []).append(rival)
    return '; '.join(f'{", ".join(keys)}: {word}' for word, keys in told.items())


def _options(rows: Rows) -> dict[str, tuple[CyclePlan, ...]]:
    """Measurements that could be made next, as plans."""
    scene = rows.scene
    machine, observations = scene.machine, scene.observations
    outer, inner = (np.unique(np.round(scene.position(axis), 3)) for axis in machine.rotary)
    spheres = np.unique(observations.sphere, axis=0)
    last = spheres[-1]
    height = 0.1 if np.ptp(spheres[:, 2]) < 0.05 else -0.05

    def plan(sphere: np.ndarray, b: np.ndarray, c: np.ndarray) -> CyclePlan:
        return static(machine, 'next', sphere, b, c)

    turned = spheres[0] * [-1, -1, 1] if np.abs(spheres[:, :2]).max() > 0 else spheres[0]
    step = np.diff(inner).min() if len(inner) > 1 else 0.5
    return {
        'another sphere height': (plan(last + np.array([0.0, 0.0, height]), outer, inner),),
        'another sphere radius': (plan(last + np.array([0.05, 0.03, 0.0]), outer, inner),),
        'a sphere on the other side of the table': (plan(turned, outer, inner),),
        'uneven stations of the inner axis': (plan(last, outer, inner + 0.37 * step),),
        'the levels of the outer axis in reverse order': (plan(last, outer[::-1], inner),),
    }


def _angle(
    rows: Rows, plans: Sequence[CyclePlan], key: str, rival: str, more: Sequence[Effect]
) -> float:
    """Sine of the angle between two signatures beside the base model."""
    scene = _extended(rows, plans) if plans else rows.scene
    effects = {e.key: e for e in (*library(scene), *_locations(scene), *more)}
    if key not in effects or rival not in effects:
        return 0.0
    columns = [p.column for p in location_parameters(scene.machine)]
    base = np.concatenate([scene.jacobian[:, :, columns], scene.observations.offsets()], axis=2)
    u, s, _ = np.linalg.svd(_flat(base), full_matrices=False)
    u = u[:, s > 1e-6 * s[0]]

    def left(effect: Effect, shape: tuple[float, ...]) -> np.ndarray:
        flat = _flat(effect.columns(scene, shape))
        flat = flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
        q, size, _ = np.linalg.svd(flat - u @ (u.T @ flat), full_matrices=False)
        return q[:, size > 0.02]

    mine = left(effects[key], effects[key].grid[0])
    if not mine.shape[1]:
        return 0.0
    smallest = 1.0
    for shape in effects[rival].grid[::3] or ((),):
        other = left(effects[rival], shape)
        rest = mine - other @ (other.T @ mine)
        smallest = min(smallest, float(np.linalg.norm(rest) / np.sqrt(mine.shape[1])))
    return smallest


def _same(
    rows: Rows,
    options: Iterable[Sequence[CyclePlan]],
    key: str,
    rival: str,
    more: Sequence[Effect],
) -> bool:
    """Whether two effects are the same error motions, not only the same displacements.

    Twins move the sphere alike because of the chain; with a response drawn at random for every
    pose and error they do not.
    """
    scene = _extended(rows, [plan for plans in options for plan in plans])
    response = np.random.default_rng(0).standard_normal(scene.jacobian.shape)
    effects = {e.key: e for e in (*library(scene), *_locations(scene), *more)}
    scene = replace(scene, jacobian=response)
    one, other = effects[key], effects[rival]
    if len(one.parameters) != len(other.parameters):
        return False
    mine, theirs = (
        [np.linalg.qr(_flat(e.columns(scene, shape)))[0] for shape in e.grid] for e in (one, other)
    )
    return all(min(np.linalg.norm(a - b @ (b.T @ a)) for b in theirs) < _SAME for a in mine)


def _flat(columns: np.ndarray) -> np.ndarray:
    return columns.reshape(-1, columns.shape[2])


def _extended(rows: Rows, plans: Sequence[CyclePlan]) -> Scene:
    """The session's poses and those of the plans, as if they had been measured."""
    old = rows.scene.observations
    machine = old.machine
    parts = {name: [getattr(old, name)] for name in (
        'positions', 'displacement', 'covariance', 'sphere', 'cycle', 'pose', 'approach', 'stamp'
    )}
    names, setups = list(old.cycles), list(old.setups)
    clock = int(old.stamp.max())
    for plan in plans:
        count = len(plan.commands)
        steps = np.sign(np.diff(plan.commands, axis=0, prepend=plan.commands[:1]))
        parts['positions'].append(plan.commands)
        parts['displacement'].append(np.zeros((count, 3)))
        parts['covariance'].append(np.zeros((count, 3, 3)))
        parts['sphere'].append(np.tile(plan.sphere, (count, 1)))
        parts['cycle'].append(np.full(count, len(names)))
        parts['pose'].append(np.arange(count))
        parts['approach'].append(_held(steps).astype(np.int8))
        parts['stamp'].append(clock + np.arange(1, count + 1) * 600_000_000)
        names.append(f'next {len(names)}')
        setups.append(old.setups[-1])
    whole = Observations(
        machine, tuple(names), tuple(setups), **{k: np.concatenate(v) for k, v in parts.items()}
    )
    _, jacobian = whole.predict(None, jacobian=True)
    fitted = np.concatenate([rows.scene.fitted, np.zeros((len(whole) - len(old), 3))])
    return replace(rows.scene, observations=whole, jacobian=jacobian, fitted=fitted)


def _held(steps: np.ndarray) -> np.ndarray:
    """Sign of the last motion: where an axis rests it keeps its direction."""
    held = steps.copy()
    for row in range(1, len(held)):
        held[row] = np.where(held[row] == 0, held[row - 1], held[row])
    return held


def _locations(scene: Scene) -> list[Effect]:
    """Constants, which are candidates where a model leaves them out."""
    return [location(parameter) for parameter in location_parameters(scene.machine)]
