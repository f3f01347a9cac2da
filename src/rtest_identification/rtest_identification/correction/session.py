"""Corrected commands of measurement cycles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rtest_estimation.records import CyclePlan
from rtest_identification.correction.known import KnownErrors
from rtest_identification.correction.step import Correction, correct
from rtest_identification.moves import synchronous_path
from rtest_identification.nc_program import NcSettings, nc_program
from rtest_identification.session_file import SessionConfig


def correct_plan(known: KnownErrors, plan: CyclePlan) -> tuple[CyclePlan, Correction]:
    """A plan with corrected commands, `-corrected` in its name.

    Nothing moves between sphere and nest any more where the errors are those of the machine: the
    gauges read noise, run-out of the sphere, and an offset of the cycle. Encoders read the
    corrected positions; where those are what the measurement is identified with, the errors of
    the machine come out again, which are what they were. With the nominal ones in their place, as
    a controller that corrects by itself shows them, what comes out is what the correction leaves.

    Raises UserError where the cycle leaves the measured stations.
    """
    count = len(known.machine.letters)
    nominal = plan.commands[:, :count]
    path = synchronous_path(known.machine, plan)
    errors = known.named(
        nominal, path.signs()[:, :count], lambda row: f'{plan.cycle}: pose {row}'
    )
    correction = correct(known.machine, nominal, errors)
    commands = np.column_stack([correction.positions, plan.commands[:, count:]])
    return replace(plan, cycle=f'{plan.cycle}-corrected', commands=commands), correction


def plan_program(
    config: SessionConfig, plan: CyclePlan, settings: NcSettings, number: int = 1
) -> str:
    """The NC program of a corrected plan of a session."""
    path = synchronous_path(config.machine, plan, config.speeds, settings.chord)
    return nc_program(
        config.machine, plan, path, config.approach, settings,
        sphere_radius=config.sphere_radius, number=number,
    )
