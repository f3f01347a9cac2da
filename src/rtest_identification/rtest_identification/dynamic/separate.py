"""What to measure next so that effects that look alike can be told apart."""

from __future__ import annotations

from collections.abc import Sequence

from rtest_identification.dynamic.blocks import Scene
from rtest_identification.dynamic.effects import CLOCK, LAG, SHRINK


def separate_by(scene: Scene, key: str, rivals: Sequence[str]) -> str:
    """For a person: the measurement that tells `key` from each of its rivals."""
    told: dict[str, list[str]] = {}
    for rival in rivals:
        told.setdefault(_how(scene, {key, rival}), []).append(rival)
    words = [f'{", ".join(keys)}: {how}' for how, keys in told.items()]
    if key == LAG and len(scene.motion.feeds) == 2:
        words.append(
            'its law: a third feed (with two, a constant lag together with a shift in proportion '
            'to speed shows the same)'
        )
    return '; '.join(words)


def _how(scene: Scene, pair: set[str]) -> str:
    families = {key.partition('/')[0] for key in pair}
    if len(scene.motion.feeds) == 1 and families & {CLOCK, LAG, SHRINK, 'servo-mismatch'}:
        return 'the same motion at another feed, ten times as fast or slow'
    if families == {LAG, 'backlash'}:
        return 'the same motion with lasers, which do not touch the sphere'
    if families == {LAG, CLOCK}:
        return 'a third feed, and starts and stops with more acceleration'
    if families == {'reversal-spike', 'backlash'}:
        return 'a slower feed, at which a spike dies away long before the next reversal'
    return 'a third feed in both directions, over several turns'
