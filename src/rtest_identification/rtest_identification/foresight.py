"""What a plan will determine, and how well, before anything is measured.

Everything follows from the Jacobian of the plan's poses with the conventions of `location.fit` and
`grid_map.fit_grid`: the standard deviations said here are those the fit will state when the noise
is as assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan
from rtest_identification.error_map import coupled, stations, zero_mean
from rtest_identification.grid_map import fit_grid
from rtest_identification.least_squares import solve
from rtest_identification.machine import Machine
from rtest_identification.moves import AxisPath
from rtest_identification.observations import Observations, turns
from rtest_identification.signatures import signatures
from rtest_identification.symbols import (
    ErrorParameter,
    location_parameters,
    map_parameters,
    parameter,
)
from rtest_identification.visibility import Outlook, basis, outlooks

# Noise of a pose per component that is assumed where none is given [m].
NOISE = 0.25e-6


@dataclass(frozen=True)
class Expected:
    """Errors and their predicted standard deviations.

    stddev : (p,) where only location errors and squareness are fitted [m] or [rad]
    stddev_with_map : (p,) where the map of the outer axis is fitted together with them
    determined : (p,) whether these poses tell each one from the others
    """

    parameters: tuple[ErrorParameter, ...]
    stddev: np.ndarray
    stddev_with_map: np.ndarray
    determined: np.ndarray


@dataclass(frozen=True)
class ExpectedMap:
    """A map's predicted standard deviations.

    outer : (s,) stations [rad]; inner : (c,) of the inner axis, None for the outer axis's map
    stddev : (6, s) or (6, s, c) in the order of `parameters`, NaN where not determined
    undetermined : symbols; left_open : groups of symbols with shapes that look like constants
    """

    axis: str
    parameters: tuple[ErrorParameter, ...]
    outer: np.ndarray
    inner: np.ndarray | None
    stddev: np.ndarray
    undetermined: tuple[str, ...]
    left_open: tuple[str, ...]


@dataclass(frozen=True)
class Foresight:
    """What a plan will determine at a noise of `noise` [m] per pose and component."""

    noise: float
    poses: int
    location: Expected
    outer_map: ExpectedMap | None
    inner_map: ExpectedMap | None
    outlooks: tuple[Outlook, ...]


def foresee(
    machine: Machine,
    plans: Sequence[CyclePlan],
    paths: Sequence[AxisPath],
    noise: float = NOISE,
) -> Foresight:
    """Predict what the static cycles among these plans determine.

    paths : of the same plans, for times and directions of approach

    Raises UserError where there is no static cycle.
    """
    observations = planned(machine, plans, paths)
    _, jacobian = observations.predict(jacobian=True)
    constants = location_parameters(machine)
    design = np.concatenate(
        [jacobian[:, :, [p.column for p in constants]], observations.offsets()], axis=2
    )
    design = design.reshape(3 * len(observations), -1)
    scale = np.r_[[p.scale for p in constants], np.ones(design.shape[1] - len(constants))]
    alone = solve(design, np.zeros(len(design)), scale)
    count = len(constants)
    stddev = noise * np.sqrt(np.diag(alone.cofactor))[:count]
    outer = _outer(observations, jacobian, design, scale, noise)
    with_map, explained = stddev, design
    if outer is not None:
        with_map = np.hypot(stddev, noise * outer.carried[:count])
        explained = np.hstack([design, outer.effect])
    inner = _inner(observations, jacobian, explained, noise)
    return Foresight(
        noise, len(observations),
        Expected(constants, stddev, with_map, alone.determined[:count]),
        outer.map if outer is not None else None, inner,
        outlooks(
            signatures(observations, jacobian), design, basis(explained), scale, constants
        ),
    )


def planned(
    machine: Machine, plans: Sequence[CyclePlan], paths: Sequence[AxisPath]
) -> Observations:
    """The poses of the static cycles as observations of an error-free machine.

    The stamp of the first pose of the first cycle is 0; cycles follow each other without a pause.
    """
    letters = len(machine.letters)
    start, chosen, stamps, signs = 0.0, [], [], []
    for plan, path in zip(plans, paths, strict=True):
        at_pose = start + path.arrival + np.arange(len(plan.commands)) * plan.dwell
        start = float(at_pose[-1]) + plan.dwell
        if turns(machine, plan):
            chosen.append(plan)
            stamps.append(np.rint(at_pose * 1e9).astype(np.int64))
            signs.append(path.signs()[:, :letters])
    if not chosen:
        raise UserError('no static cycle in this plan; give the session file setups and a cycle')
    poses = [len(plan.commands) for plan in chosen]
    total = sum(poses)
    return Observations(
        machine=machine,
        cycles=tuple(plan.cycle for plan in chosen),
        setups=tuple(plan.setup for plan in chosen),
        positions=np.vstack([plan.commands[:, :letters] for plan in chosen]),
        displacement=np.zeros((total, 3)),
        covariance=np.zeros((total, 3, 3)),
        sphere=np.repeat([plan.sphere for plan in chosen], poses, axis=0),
        cycle=np.repeat(np.arange(len(chosen)), poses),
        pose=np.concatenate([np.arange(n) for n in poses]),
        approach=np.vstack(signs).astype(np.int8),
        stamp=np.concatenate(stamps),
    )


@dataclass(frozen=True)
class _Outer:
    """The outer axis's map: its design (3 n, p), and what it adds to the constants' variance."""

    map: ExpectedMap
    effect: np.ndarray
    carried: np.ndarray


def _outer(
    observations: Observations,
    jacobian: np.ndarray,
    design: np.ndarray,
    scale: np.ndarray,
    noise: float,
) -> _Outer | None:
    """As `location.fit` does it: the map takes what the constants leave (Eq. 3-23)."""
    machine = observations.machine
    if not machine.rotary:
        return None
    axis = machine.rotary[0]
    places, station = stations(observations.axis(axis))
    if len(places) < 3:
        return None
    parameters = map_parameters(machine, axis)
    contrasts = zero_mean(len(places))
    columns = [parameter(machine, axis, p.letter).column for p in parameters]
    effect = np.einsum('nip,ns->nips', jacobian[:, :, columns], contrasts[station])
    effect = effect.reshape(len(design), -1)
    map_scale = np.repeat([p.scale for p in parameters], len(places) - 1)
    base = basis(design)
    free = solve(effect - base @ (base.T @ effect), np.zeros(len(design)), map_scale)
    turn = np.kron(np.eye(len(parameters)), contrasts)
    variance = np.diag(turn @ free.cofactor @ turn.T).reshape(len(parameters), -1)
    carry = solve(design, effect, scale).value
    carried = np.sqrt(np.maximum(np.diag(carry @ free.cofactor @ carry.T), 0.0))
    expected = ExpectedMap(
        axis, parameters, places, None, noise * np.sqrt(variance), (),
        coupled(parameters, turn @ (free.nullspace * map_scale[:, None])),
    )
    return _Outer(expected, effect, carried)


def _inner(
    observations: Observations, jacobian: np.ndarray, explained: np.ndarray, noise: float
) -> ExpectedMap | None:
    """As `grid_map.fit_grid` does it, on noise of a known size."""
    drawn = np.random.default_rng(0).normal(size=(len(observations), 3))
    taken = basis(explained)
    drawn -= (taken @ (taken.T @ drawn.reshape(-1))).reshape(-1, 3)
    grid = fit_grid(observations, jacobian, drawn, taken)
    if grid is None:
        return None
    return ExpectedMap(
        grid.axis, grid.parameters, grid.outer, grid.inner, grid.stddev * (noise / grid.rms),
        grid.undetermined, grid.left_open,
    )
