"""Faults of the simulated cell: what goes wrong, and when."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from rtest_drivers.sim.fields import Fields
from rtest_estimation.errors import UserError

KINDS = {
    'gauge_silent': 'the gauges take no readings',
    'gauge_out_of_range': 'readings at the end of the range, status 1',
    'gauge_nan': 'readings that are not numbers, status 0',
    'gauge_error': 'device error, status 3',
    'lost_block': 'readings are taken but do not arrive: the sequence jumps',
    'feedback_stale': 'feedback freezes: the last message again and again',
    'feedback_silent': 'feedback stops',
    'pose_skipped': 'the machine goes straight to the next pose',
}
_NEEDS_POSE = {'pose_skipped'}


@dataclass(frozen=True)
class Fault:
    """One fault.

    cycle, pose : the dwell at this pose, or the whole cycle where pose is None
    start : instead of a cycle, seconds after the start of the simulation [s]
    duration : how long; None for the dwell or the cycle [s]
    gauge : which one, None for all
    """

    kind: str
    cycle: str | None = None
    pose: int | None = None
    start: float | None = None
    duration: float | None = None
    gauge: int | None = None


@dataclass(frozen=True)
class Window:
    """A fault in simulated time: from start up to, not including, end [ns]."""

    fault: Fault
    start: int
    end: int


def parse_faults(fields: Fields, gauges: int) -> tuple[Fault, ...]:
    """Read the list `faults` of a truth file.

    Raises UserError naming file, key and what is expected.
    """
    faults = []
    for entry in fields.entries('faults'):
        kind = entry.choice('kind', KINDS)
        cycle = entry.raw('cycle', None)
        pose = entry.integer('pose', None)
        start = entry.number('at_s', None, lower=0.0)
        duration = entry.number('for_s', None, lower=0.0)
        gauge = entry.integer('gauge', None)
        entry.done()
        if (cycle is None) == (start is None) or (cycle is None and pose is not None):
            raise UserError(f'{entry.where}: expected either cycle (with pose) or at_s')
        if start is not None and duration is None:
            raise UserError(f'{entry.where}: for_s: missing, a fault at_s needs a duration')
        if kind in _NEEDS_POSE and pose is None:
            raise UserError(f'{entry.where}: {kind} needs cycle and pose')
        if gauge is not None and gauge >= gauges:
            raise UserError(f'{entry.where}: gauge: expected below {gauges}, got {gauge}')
        cycle = None if cycle is None else str(cycle)
        faults.append(Fault(kind, cycle, pose, start, duration, gauge))
    return tuple(faults)


def timed(faults: Iterable[Fault], epoch: int) -> list[Window]:
    """The faults given by seconds since `epoch` [ns]."""
    return [
        _window(fault, epoch + round(fault.start * 1e9), 0)
        for fault in faults
        if fault.start is not None
    ]


def of_cycle(
    faults: Iterable[Fault],
    cycle: str,
    poses: Mapping[int, tuple[int, int]],
    whole: tuple[int, int],
) -> list[Window]:
    """The faults of a cycle. poses : begin and end of their dwells; whole : of the cycle [ns]."""
    return [
        _window(fault, *(poses[fault.pose] if fault.pose is not None else whole))
        for fault in faults
        if fault.cycle == cycle and (fault.pose is None or fault.pose in poses)
    ]


def skipped_poses(faults: Iterable[Fault], cycle: str) -> set[int]:
    """Poses of a cycle to which the machine does not go."""
    return {
        fault.pose for fault in faults if fault.kind == 'pose_skipped' and fault.cycle == cycle
    }


def _window(fault: Fault, start: int, end: int) -> Window:
    """From `start` for the fault's own duration, or up to `end` where it has none [ns]."""
    if fault.duration is not None:
        end = start + round(fault.duration * 1e9)
    return Window(fault, start, end)


def active(windows: Iterable[Window], kind: str, times: np.ndarray) -> np.ndarray:
    """Whether a fault of this kind is on at `times` (n,) [ns]."""
    on = np.zeros(len(times), dtype=bool)
    for item in windows:
        if item.fault.kind == kind:
            on |= (times >= item.start) & (times < item.end)
    return on
