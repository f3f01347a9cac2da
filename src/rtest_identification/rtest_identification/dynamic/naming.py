"""Which dynamic effects are in a measurement, by name, size and uncertainty.

The same search as for static cycles (`gap.search`) on two channels: what the encoders show of
themselves, and what the gauges show beyond the encoders.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtest_identification.dynamic.blocks import Scene
from rtest_identification.dynamic.clocks import TimeOffset
from rtest_identification.dynamic.effects import (
    CLOCK,
    LAG,
    SHRINK,
    encoder_library,
    gauge_library,
)
from rtest_identification.dynamic.noise import Noise, estimate
from rtest_identification.dynamic.rest import Rest, judge_rest
from rtest_identification.dynamic.rows import (
    Chosen,
    Rows,
    encoder_rows,
    gauge_rows,
)
from rtest_identification.dynamic.separate import separate_by
from rtest_identification.gap.effects import Effect
from rtest_identification.gap.projection import VISIBLE, Projection
from rtest_identification.gap.search import Named, Search, search
from rtest_identification.gap.size import Found, sizes
from rtest_identification.gap.workflow import REST_ALARM

# Time offsets that agree within so many standard deviations are one.
AGREE = 4.0
# ... or within this part of a shift: where an acceleration begins and ends is not known better.
_CORNERS = 0.1
# Features that are late by so many standard deviations are late.
LATE = 5.0
# The search is free of scale: what is found in encoders far better than the gauges must be at
# least so many of the rows' standard deviations.
_LEAST = 6.0


@dataclass(frozen=True)
class NamedEffect:
    """An effect that was found.

    channel : 'encoders', or 'gauges' for what the encoders do not show
    values : (name, value, stddev, unit) of its parameters, SI
    strength : signal to noise; seen : rms of what it moves the sphere by [m]
    """

    key: str
    name: str
    formula: str
    channel: str
    values: tuple[tuple[str, float, float, str], ...]
    strength: float
    seen: float
    confidence: float
    rivals: tuple[str, ...]
    separate_by: str


@dataclass(frozen=True)
class Channel:
    """One channel with what was named in it.

    before, after : rms that the base model leaves, without and with the effects [m]
    noise : rms standard deviation of the rows [m]
    chosen : the effects with their shapes, as `rows` takes them
    """

    rows: Rows
    effects: tuple[NamedEffect, ...]
    chosen: tuple[Chosen, ...]
    invisible: tuple[str, ...]
    before: float
    after: float
    noise: float


@dataclass(frozen=True)
class Naming:
    """Verdict on both channels together; whether something is left is judged on the gauges."""

    verdict: str
    encoders: Channel
    gauges: Channel
    rest: Rest
    offset: TimeOffset
    notes: tuple[str, ...]

    @property
    def effects(self) -> tuple[NamedEffect, ...]:
        """Of both channels."""
        return self.encoders.effects + self.gauges.effects


def name_effects(encoders: Rows, gauges: Rows, offset: TimeOffset) -> Naming:
    """Search both channels.

    offset : from `clocks.align`, to which the gauges' rows are aligned
    """
    scene = gauges.scene
    servo = _channel('encoders', encoders, encoder_library(scene), encoder_rows)
    gauges = _sober(gauges)
    shown = _channel('gauges', gauges, gauge_library(scene), gauge_rows)
    offset = _joint_offset(shown, offset)
    shown, notes = _clocks(shown, offset)
    rest = judge_rest(gauge_rows(scene, shown.chosen, gauges.noise))
    found = servo.effects or shown.effects
    verdict = 'explained' if found else 'no gap'
    if rest.probability < REST_ALARM or notes:
        verdict = 'partly explained' if found else 'unknown effect'
    return Naming(verdict, servo, shown, rest, offset, notes)


def _channel(
    channel: str, rows: Rows, library: Sequence[Effect],
    make: Callable[[Scene, Sequence[Chosen], Noise], Rows],
) -> Channel:
    visible = [effect for effect in library if _shows(rows, effect)]
    result = search(Projection(rows, visible)) if visible else None
    invisible = tuple(effect.key for effect in library if effect not in visible)
    named = _prefer_friction(result, rows) if result else ()
    found, chosen = _sizes(rows, named)
    strong = [one.strength >= _LEAST for one in found]
    if not all(strong):
        named = tuple(n for n, good in zip(named, strong, strict=True) if good)
        found, chosen = _sizes(rows, named)
    effects = tuple(
        _named(channel, one, n.rivals, separate_by(rows.scene, one.effect.key, n.rivals))
        for one, n in zip(found, named, strict=True)
    )
    after = make(rows.scene, chosen, rows.noise) if chosen else rows
    noise = float(np.sqrt(np.mean(rows.sigma**2)))
    return Channel(rows, effects, chosen, invisible, _rms(rows), _rms(after), noise)


def _sober(rows: Rows) -> Rows:
    """The gauges' rows with their noise judged beside what effects may be in them.

    Large effects that no pass repeats look like drift, and drift looks like effects: a search
    that knows of no drift finds all that could be one, and what is left tells how much drifts.
    """
    scene, still = rows.scene, replace(rows.noise, drift=0.0)
    if not rows.noise.drift:
        return rows
    plain = gauge_rows(scene, (), still)
    visible = [effect for effect in gauge_library(scene) if _shows(plain, effect)]
    if not visible:
        return rows
    named = search(Projection(plain, visible)).named
    chosen = tuple((n.candidate.effect, n.candidate.shape) for n in named)
    free = gauge_rows(scene, chosen, still)
    width = sum(len(effect.parameters) for effect, _ in chosen)
    effects = free.base[:, :, free.base.shape[2] - width :] @ free.fit()[len(free.fit()) - width :]
    return gauge_rows(scene, (), estimate(scene, rows.value - effects))


def _sizes(rows: Rows, named: Sequence[Named]) -> tuple[tuple[Found, ...], tuple[Chosen, ...]]:
    chosen = tuple((n.candidate.effect, n.candidate.shape) for n in named)
    # Rivals are told apart by other means than the poses of a static cycle.
    return sizes(rows, [replace(n, rivals=()) for n in named], chosen, ()), chosen


def _prefer_friction(result: Search, rows: Rows) -> tuple[Named, ...]:
    """The names; of a lag that is equal at all speeds friction is the first to be suspected.

    With probes that touch the sphere, backlash of the turning axis is its rival.
    """
    named = []
    axis = rows.scene.motion.axis
    for one in result.named:
        if one.candidate.effect.key == f'backlash/{axis}' and LAG in one.rivals:
            lag = next(e for e in gauge_library(rows.scene) if e.key == LAG)
            candidate = Projection(rows, [lag]).project(lag, (0.0,))
            rivals = (f'backlash/{axis}', *(r for r in one.rivals if r != LAG))
            one = replace(one, candidate=candidate, rivals=rivals)
        named.append(one)
    return tuple(named)


def _shows(rows: Rows, effect: Effect) -> bool:
    """Whether anything of an effect is left beside the base model."""
    for shape in effect.grid:
        columns = rows.white(effect.columns(rows.scene, shape))
        norm = np.linalg.norm(columns, axis=0)
        columns = columns[:, norm > 0.0] / norm[norm > 0.0]
        left = columns - rows.basis @ (rows.basis.T @ columns)
        if columns.size and np.linalg.norm(left, axis=0).max() > VISIBLE:
            return True
    return False


def _named(channel: str, found: Found, rivals: tuple[str, ...], how: str) -> NamedEffect:
    names = (*found.effect.parameters, *found.effect.shape)
    values = [
        (p.name, float(v), float(s), p.unit)
        for p, v, s in zip(names, found.value, found.stddev, strict=True)
    ]
    if found.effect.key == SHRINK:
        # Linear in T^2; a circle that grows has a negative T.
        (_, square, spread, _) = values[0]
        time = np.sign(square) * np.sqrt(abs(square))
        values = [('T', float(time), spread / (2.0 * abs(time)), 's')]
    return NamedEffect(
        found.effect.key, found.effect.name, found.effect.formula, channel, tuple(values),
        found.strength, found.seen, found.confidence, rivals, how,
    )


def _joint_offset(channel: Channel, offset: TimeOffset) -> TimeOffset:
    """The offset together with the effects that were named."""
    if not offset.determined:
        return offset
    rows = gauge_rows(channel.rows.scene, channel.chosen, channel.rows.noise)
    white = rows.white(rows.base)
    own, others = white[:, 0], white[:, 1:]
    basis = np.linalg.qr(others / np.maximum(np.linalg.norm(others, axis=0), 1e-300))[0]
    left = own - basis @ (basis.T @ own)
    square = float(left @ left)
    more = float(left @ rows.white(rows.value)) / square
    return replace(offset, value=offset.value + more, stddev=square**-0.5)


def _clocks(channel: Channel, offset: TimeOffset) -> tuple[Channel, tuple[str, ...]]:
    """A clock offset needs late features too; late features alone are one."""
    named = next((e for e in channel.effects if e.key == CLOCK), None)
    if named is None:
        if not offset.determined or abs(offset.value) < LATE * offset.stddev:
            return channel, ()
        late = channel.rows.base[:, :, 0] * offset.value
        white = channel.rows.white(late)
        effect = NamedEffect(
            CLOCK, 'clocks of gauges and CNC differ', 'every feature late by t0', 'gauges',
            (('t0', offset.value, offset.stddev, 's'),), float(np.linalg.norm(white)),
            float(np.sqrt(np.mean(late**2))), 1.0, (), '',
        )
        return replace(channel, effects=(*channel.effects, effect)), ()
    _, value, spread, _ = named.values[0]
    if not offset.determined:
        return channel, ()
    # Which of the two clocks is late decides the sign of the shift, not its size.
    apart = abs(abs(offset.value) - abs(value)) / np.hypot(
        np.hypot(offset.stddev, spread), _CORNERS * value
    )
    if apart < AGREE:
        if abs(value) > AGREE * offset.stddev:
            return channel, ()
        how = (
            f'features show {1e3 * offset.value:.3f} ± {2e3 * offset.stddev:.3f} ms, which does '
            'not tell it from a lag in proportion to speed outside the position loops: more '
            'starts and stops, with more acceleration'
        )
        how = '; '.join(filter(None, (named.separate_by, how)))
        effects = [replace(e, separate_by=how) if e is named else e for e in channel.effects]
        return replace(channel, effects=tuple(effects)), ()
    note = (
        f'a tangential shift in proportion to speed ({value * 1e3:.3f} ms) that the encoders do '
        f'not show, while features are late by {offset.value * 1e3:.3f} ± '
        f'{2e3 * offset.stddev:.3f} ms: no clock offset; axes latched at different times, or a '
        'lag outside the position loops'
    )
    effects = tuple(e for e in channel.effects if e.key != CLOCK)
    return replace(channel, effects=effects), (note,)


def _rms(rows: Rows) -> float:
    free = max(rows.residual.size - rows.base.shape[2], 1)
    return float(np.sqrt((rows.residual**2).sum() / free))
