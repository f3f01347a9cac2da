"""From continuous readings and encoder feedback to the dynamic errors of one measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.dynamic.blocks import Scene
from rtest_identification.dynamic.clocks import TimeOffset, align
from rtest_identification.dynamic.error_motion import (
    Lag,
    Parts,
    Transient,
    TurnMotion,
    lags,
    split,
    transients,
    turn_motions,
)
from rtest_identification.dynamic.motion import Readings, describe
from rtest_identification.dynamic.naming import Naming, name_effects
from rtest_identification.dynamic.rows import encoder_rows, gauge_rows
from rtest_identification.machine import Machine

# Encoders that agree with the command better than this are not encoders [m].
_PERFECT = 1e-10


@dataclass(frozen=True)
class DynamicResult:
    """One measurement: all dynamic cycles of a set-up.

    scene : blocks of readings, by a common clock
    measured, rest : error motions of the whole, and of its dynamic rest, pass by pass
    """

    setup: str
    cycles: tuple[str, ...]
    scene: Scene
    offset: TimeOffset
    naming: Naming
    parts: Parts
    lags: tuple[Lag, ...]
    measured: tuple[TurnMotion, ...]
    servo: tuple[TurnMotion, ...]
    rest: tuple[TurnMotion, ...]
    transients: tuple[Transient, ...]
    warnings: tuple[str, ...]


def analyse(machine: Machine, cycles: list[Readings]) -> DynamicResult:
    """Evaluate the dynamic cycles of one set-up together.

    cycles : at one sphere position, with one calibration of the nest, in time, times with a
        common zero

    Raises UserError where they are no dynamic measurement, and says why.
    """
    spheres = np.array([one.sphere for one in cycles])
    if np.ptp(spheres, axis=0).max() > 1e-6:
        raise UserError(
            f'{", ".join(c.cycle for c in cycles)}: one set-up with several sphere positions; '
            'name each position a set-up of its own'
        )
    motion = describe(machine, cycles)
    scene, offset = align(motion, cycles)
    gauges, encoders = gauge_rows(scene), encoder_rows(scene)
    naming = name_effects(encoders, gauges, offset)
    gauges = naming.gauges.rows
    parts = split(
        gauge_rows(scene, naming.gauges.chosen, gauges.noise),
        encoder_rows(scene, naming.encoders.chosen, encoders.noise),
        sum(len(effect.parameters) for effect, _ in naming.gauges.chosen),
    )
    found = lags(gauges, encoders)
    return DynamicResult(
        cycles[0].setup, tuple(one.cycle for one in cycles), scene, naming.offset, naming, parts,
        found, turn_motions(scene, parts.measured), turn_motions(scene, parts.servo),
        turn_motions(scene, parts.dynamic), transients(scene, parts),
        tuple(_warnings(scene, naming)),
    )


def _warnings(scene: Scene, naming: Naming) -> list[str]:
    """What limits the result, for a person."""
    told = list(naming.notes)
    if np.abs(scene.servo - scene.servo.mean(axis=0)).max() < _PERFECT:
        told.append(
            'the feedback follows the command exactly: these look like commands, not encoder '
            'positions, and what the drives do is then counted as dynamic rest'
        )
    if not naming.offset.determined:
        told.append(f'time between gauges and CNC not determined: {naming.offset.why}')
    signs = {one.sign for one in scene.motion.passes}
    if len(signs) == 1:
        told.append('one direction only: a constant lag is told from an offset by the start alone')
    if len(scene.motion.feeds) == 1:
        told.append('one feed only: what depends on the speed cannot be told from what does not')
    return told
