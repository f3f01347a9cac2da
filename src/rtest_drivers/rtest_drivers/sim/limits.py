"""What the simulated machine cannot do."""

from __future__ import annotations

import numpy as np

from rtest_drivers.sim.motion import SPINDLE
from rtest_drivers.sim.truth import Truth
from rtest_estimation.dwell import turns
from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, Kind


def check(plan: CyclePlan, truth: Truth) -> None:
    """Refuse a plan the simulated machine cannot do.

    Raises UserError naming cycle, axis, pose and what is expected.
    """
    where = f'plan {plan.cycle!r}'
    axes = truth.machine.axes
    if turns(plan):
        turned = [k for k, name in enumerate(plan.axes) if name in axes and axes[name].rotary]
        steps = np.abs(np.diff(plan.commands[:, turned], axis=0))
        if not plan.feed > 0.0 or steps.max(axis=1).min() < 1e-9:
            raise UserError(
                f'{where}: a dynamic cycle turns a rotary axis between all of its poses, with a '
                'feed, or none between any'
            )
    elif plan.kind is Kind.DYNAMIC and not plan.feed > 0.0:
        raise UserError(f'{where}: a dynamic cycle has a feed')
    for column, name in enumerate(plan.axes):
        if name == SPINDLE:
            continue
        if name not in axes:
            raise UserError(
                f'{where}: no axis {name} in the machine, expected {sorted(axes)} or {SPINDLE}'
            )
        values, slack = plan.commands[:, column], 1e-9
        axis = axes[name]
        outside = np.flatnonzero((values < axis.lower - slack) | (values > axis.upper + slack))
        if outside.size:
            raise UserError(
                f'{where}: pose {outside[0]}: {name} = {values[outside[0]]:.6g} is outside '
                f'{axis.lower:.6g} to {axis.upper:.6g} (m or rad)'
            )
