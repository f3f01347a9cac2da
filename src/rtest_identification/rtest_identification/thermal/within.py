"""What one cycle alone cannot tell: drift while it runs from dependence on the outer axis.

A cycle visits the stations of the outer axis one after the other, so that what changes with time
changes with the axis. How much of it can be told follows from the Jacobian at the poses and from
the times at which they were visited.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_identification.symbols import ErrorParameter
from rtest_identification.thermal.poses import Poses
from rtest_identification.thermal.series import Series, change_between

# A map, or a constant, that moves by more than this part of a drift is taken for it.
_NAMED = 0.2
# Where the map takes more than this part of what a drift does besides constants, they are one.
_HIDDEN = 0.5


@dataclass(frozen=True)
class Within:
    """A drift of one error while a cycle runs, as one cycle sees it.

    hidden : part of its effect (sum of squares, beyond constants) that the outer axis's map makes
        as well; NaN without a map
    as_map : symbols of the map that are taken for it, and how far they change over the stations
        per drift over the cycle [1], or [1/m], [m] between angles and lengths
    as_constants : the same of constants
    stddev : standard uncertainty of such a drift, over the cycle, from one cycle alone, everything
        else free [m] or [rad]
    drift : what it was over the reference cycle, by the cycles around it [m] or [rad]; 0 where the
        error does not drift
    """

    parameter: ErrorParameter
    hidden: float
    as_map: tuple[tuple[ErrorParameter, float], ...]
    as_constants: tuple[tuple[ErrorParameter, float], ...]
    stddev: float
    drift: float

    @property
    def inseparable(self) -> bool:
        """Whether most of it would be taken for a dependence on the outer axis."""
        return self.hidden > _HIDDEN


def within(
    poses: Poses,
    stamp: np.ndarray,
    measured: np.ndarray,
    noise: float,
    drifting: Sequence[Series] = (),
) -> list[Within]:
    """Every constant error drifting evenly over the reference cycle.

    stamp : (m,) when each pose was visited [ns]; measured : (m,) bool
    noise : of a displacement in one cycle, per component [m]
    drifting : errors that drift from cycle to cycle
    """
    time = np.zeros(len(poses))
    time[measured] = (stamp[measured] - stamp[measured].min()) * 1e-9
    span = float(np.ptp(time[measured]))
    if span <= 0.0:
        return []
    time = (time - time[measured].mean()) / span
    gains = poses.gains(measured)
    drift = {
        one.parameter: float(change_between(one, -0.5 * span, np.array([0.5 * span]))[0])
        for one in drifting
    }
    effects = poses.columns() * time[:, None, None]
    effects[~measured] = 0.0
    by_constants = np.einsum('pmi,mij->pj', gains.alone, effects)
    found = []
    for number, parameter in enumerate(poses.constants):
        effect = effects[measured][:, :, number].ravel()
        beyond = effect - gains.constant @ effect
        left = effect - gains.explained @ effect
        left_size, size = float(left @ left), float(beyond @ beyond)
        hidden = 1.0 - left_size / size if poses.parameters and size > 0.0 else float('nan')
        shapes = np.einsum('qsmi,mi->qs', gains.map, effects[:, :, number])
        found.append(Within(
            parameter, hidden,
            _taken(parameter, poses.parameters, np.ptp(shapes, axis=1) if shapes.size else ()),
            _taken(parameter, poses.constants, by_constants[:, number]),
            noise / float(np.sqrt(max(left_size, 1e-30))), drift.get(parameter, 0.0),
        ))
    return found


def _taken(
    drifting: ErrorParameter, others: Sequence[ErrorParameter], sizes: np.ndarray
) -> tuple[tuple[ErrorParameter, float], ...]:
    """Errors that move by a part of the drift worth naming, the largest first."""
    pairs = [
        (abs(size) * drifting.scale / other.scale, other, float(abs(size)))
        for other, size in zip(others, sizes, strict=True)
        if other != drifting
    ]
    pairs.sort(key=lambda pair: -pair[0])
    return tuple((other, size) for part, other, size in pairs if part > _NAMED)
