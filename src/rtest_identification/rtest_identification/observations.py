"""Finished cycles as one stack of observations over the machine's kinematics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtest_estimation.errors import UserError
from rtest_estimation.laser.correction import local_scatter
from rtest_estimation.records import Cycle, CyclePlan, Kind, NestCalibration, NestKind
from rtest_identification.kinematics import predict
from rtest_identification.machine import Machine


@dataclass(frozen=True)
class Observations:
    """Every measured pose of the static cycles of a session.

    positions : (n, axes) encoder positions in the order of ``machine.letters`` [m] or [rad]
    displacement : (n, 3) sphere centre relative to the nest, frame ``table`` [m]
    covariance : (n, 3, 3) of it, from the scatter of the readings [m2]
    sphere : (n, 3) nominal sphere centre, frame ``table`` [m]
    cycle : (n,) index into `cycles`; pose : (n,) row of its plan
    approach : (n, axes) sign of each axis's last motion before, in the order of the letters
    stamp : (n,) int64 middle of the readings [ns]
    """

    machine: Machine
    cycles: tuple[str, ...]
    setups: tuple[str, ...]
    positions: np.ndarray
    displacement: np.ndarray
    covariance: np.ndarray
    sphere: np.ndarray
    cycle: np.ndarray
    pose: np.ndarray
    approach: np.ndarray
    stamp: np.ndarray

    def __len__(self) -> int:
        return len(self.pose)

    def axis(self, name: str) -> np.ndarray:
        """(n,) position of one axis."""
        return self.positions[:, self.machine.letters.index(name)]

    def keep(self, rows: np.ndarray) -> Observations:
        """Only these rows (bool mask or indices)."""
        names = (
            'positions', 'displacement', 'covariance', 'sphere', 'cycle', 'pose', 'approach',
            'stamp',
        )
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def offsets(self) -> np.ndarray:
        """(n, 3, 3 cycles) design of the free offset that every cycle has (initial reset)."""
        one = np.eye(len(self.cycles))[self.cycle]
        return np.einsum('nc,ij->nicj', one, np.eye(3)).reshape(len(self), 3, -1)

    def predict(
        self, errors: np.ndarray | None = None, jacobian: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Displacement (n, 3) that a machine with these errors would show, but for the offsets.

        errors, jacobian : as in `kinematics.predict`.
        """
        result = predict(self.machine, self.positions, errors, jacobian)
        return result.centre - self.sphere, result.jacobian


def turns(machine: Machine, plan: CyclePlan) -> bool:
    """Whether a cycle is a static one in which a rotary axis moves.

    Otherwise it says nothing of them: it verifies the nest.
    """
    columns = [plan.axes.index(name) for name in machine.rotary if name in plan.axes]
    return plan.kind is Kind.STATIC and bool(np.ptp(plan.commands[:, columns], axis=0).any())


def stack(machine: Machine, cycles: Sequence[Cycle]) -> Observations:
    """Stack the points of all static cycles in which a rotary axis moves.

    Raises UserError where a cycle's axes are not the machine's, or nothing was measured.
    """
    static = [cycle for cycle in cycles if turns(machine, cycle.plan) and cycle.points]
    if not static and any(cycle.plan.kind is Kind.DYNAMIC for cycle in cycles):
        raise UserError(
            'no static cycle with a valid point in this session; `rtest dynamic` evaluates its '
            'dynamic cycles'
        )
    if not static:
        raise UserError(
            'no static cycle with a valid point in this session; '
            'see the missing poses and their reasons in `rtest info`'
        )
    positions, approach, rows = [], [], []
    for number, cycle in enumerate(static):
        axes = cycle.plan.axes
        absent = [name for name in machine.letters if name not in axes]
        if absent:
            raise UserError(
                f'{cycle.plan.cycle}: the plan has axes {" ".join(axes)}, the machine file '
                f'{machine.name!r} also has {" ".join(absent)}; give the right machine file'
            )
        order = [axes.index(name) for name in machine.letters]
        for point in cycle.points:
            positions.append(point.feedback[order])
            approach.append(point.approach[order])
            rows.append((number, cycle, point))
    return Observations(
        machine,
        tuple(cycle.plan.cycle for cycle in static),
        tuple(cycle.plan.setup for cycle in static),
        np.array(positions),
        np.array([point.displacement for _, _, point in rows]),
        np.array([point.covariance for _, _, point in rows]),
        np.array([cycle.plan.sphere for _, cycle, _ in rows]),
        np.array([number for number, _, _ in rows]),
        np.array([point.index for _, _, point in rows]),
        np.array(approach),
        np.array([point.stamp for _, _, point in rows], dtype=np.int64),
    )


def repeatability(
    cycles: Sequence[Cycle], nests: Sequence[NestCalibration] = ()
) -> tuple[float, int]:
    """What the same pose gives again: standard deviation per component [m], degrees of freedom.

    From the nest calibrations, in which the sphere moves by known steps at B = C = 0 with several
    visits to each position: scatter about the means of equal commands. It needs no model of the
    machine, so that a misfit of the model can be judged by it.

    A laser that comes back to a place reads the same speckle again, but not where the sphere has
    turned: of laser nests among `nests` it is the scatter of their corrections.
    """
    lasers = [nest for nest in nests if nest.kind is NestKind.LASER]
    if lasers:
        found = [local_scatter(n.correction_nodes, n.correction_values) for n in lasers]
        freedom = sum(number for _, number in found)
        squares = sum(one**2 * number for one, number in found if number)
        return (float(np.sqrt(squares / freedom)), freedom) if freedom else (float('nan'), 0)
    squares, freedom = 0.0, 0
    for cycle in cycles:
        if cycle.plan.kind is not Kind.NEST_CALIBRATION or not cycle.calibration:
            continue
        visits: dict[bytes, list[np.ndarray]] = {}
        for point in cycle.points:
            key = np.round(cycle.plan.commands[point.index], 9).tobytes()
            visits.setdefault(key, []).append(point.displacement - point.feedback[:3])
        for group in visits.values():
            values = np.array(group)
            squares += float(((values - values.mean(axis=0)) ** 2).sum())
            freedom += 3 * (len(values) - 1)
    return (float(np.sqrt(squares / freedom)), freedom) if freedom else (float('nan'), 0)
