"""Positions of the nest in some cycles, for drawing (Figs. 4-5 and 4-6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rtest_identification.kinematics import rotation
from rtest_identification.machine import Machine
from rtest_identification.presentation import Presentation, present
from rtest_identification.thermal.pipeline import Thermal
from rtest_identification.thermal.poses import places
from rtest_identification.thermal.words import moment


def shown_cycles(result: Thermal) -> list[int]:
    """The reference, the last cycle, and one between: the farthest away where errors turn back.

    Cycles that are cut short are not shown.
    """
    full = result.changes.poses.full.rank
    able = [n for n, gain in enumerate(result.changes.gains) if gain.rank == full]
    able = [n for n in able if n >= result.place] or [result.place]
    middle = 0.5 * (result.time[able[0]] + result.time[able[-1]])
    between = min(able, key=lambda n: abs(result.time[n] - middle))
    if len(result.phases) > 1:
        values = np.nan_to_num(np.abs(result.drifting[0].series.value))
        between = max(able, key=lambda n: values[n])
    return sorted({able[0], between, able[-1]})


def present_cycles(result: Thermal, chosen: Sequence[int]) -> Presentation | None:
    """The reference and what changed since, every cycle as a set-up named by its time.

    The offsets of the rotary axes in the reference are those of all cycles, so that removing them
    leaves their change. Each cycle's own reset is out of it. None without a rotary axis.
    """
    view = present(result.reference)
    if view is None:
        return None
    data = result.reference.observations
    keep = np.setdiff1d(np.arange(len(data)), result.reference.fit.outliers)
    turn = _table(result.machine, data.positions[keep])
    towards = turn if view.seen == 'sphere' else -turn
    place = places(result.changes.poses.plan, result.cycles[result.place].plan)[view.pose]
    rows, cycle, moved = [], [], []
    for number, one in enumerate(chosen):
        there = np.flatnonzero(result.changes.used[one][place] & (place >= 0))
        change = result.changes.difference[one][place[there]]
        rows.append(there)
        cycle.append(np.full(len(there), number))
        moved.append(np.einsum('nij,nj->ni', towards[there], change - _reset(result, one)))
    taken = np.concatenate(rows)
    span = float(result.time[-1] - result.time[0])
    names = (
        'level', 'turned', 'angle', 'pose', 'nominal', 'carrier', 'measured', 'reset', 'offsets',
        'squareness',
    )
    view = replace(
        view, **{name: getattr(view, name)[taken] for name in names},
        cycle=np.concatenate(cycle),
        setups=tuple(
            replace(view.setups[0], name=moment(float(result.time[one]), span)) for one in chosen
        ),
    )
    return replace(view, measured=view.measured + np.concatenate(moved))


def _reset(result: Thermal, number: int) -> np.ndarray:
    """(3,) change of a cycle's offset, frame ``table`` [m]."""
    found = result.changes
    used, gain = found.used[number], found.gains[number]
    change = np.einsum('pmi,mi->p', gain.joint, np.nan_to_num(found.difference[number]))
    model = found.poses.columns() @ change
    return (found.difference[number] - model)[used].mean(axis=0)


def _table(machine: Machine, positions: np.ndarray) -> np.ndarray:
    """(n, 3, 3) nominal turn of the table."""
    turn = np.broadcast_to(np.eye(3), (len(positions), 3, 3))
    for name in machine.table_side:
        axis = machine.axes[name]
        if axis.rotary:
            angle = axis.sense * positions[:, machine.letters.index(name)]
            turn = turn @ rotation(axis.direction, angle)
    return turn
