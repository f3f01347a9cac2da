"""Sessions of a machine with location errors, squareness and a map of B, and how to correct it."""

from dataclasses import replace
from functools import cache

import numpy as np

from rtest_drivers.config import config_path
from rtest_drivers.sim.cell import Cell
from rtest_drivers.sim.kinematics import follow
from rtest_drivers.sim.truth import load_truth
from rtest_estimation.pipeline import Estimator
from rtest_estimation.records import Kind
from rtest_identification.correction.known import of_field
from rtest_identification.error_field import ErrorField
from rtest_identification.gap.model_file import Model, ModelEffect, Value
from rtest_identification.machine import load_machine
from rtest_identification.pipeline import identify
from rtest_identification.session_file import load_session

MACHINE = load_machine(config_path('nmv1500dcg.yaml'))
TRUTH = load_truth(config_path('cell_demo.yaml'))
# Its sphere runs true, and C has no errors that change with it.
B_ONLY = replace(
    TRUTH, runout=np.zeros(2), errors=replace(
        TRUTH.errors, terms={s: t for s, t in TRUTH.errors.terms.items() if s.endswith('B')}
    ),
)
PLANS = load_session(config_path('demo.yaml')).plans
WITHOUT_RUNOUT = tuple(plan for plan in PLANS if plan.kind is not Kind.SPINDLE_RUNOUT)
EPOCH = 1_700_000_000_000_000_000
RIGHT = np.pi / 2
X, Y, Z, B, C = range(5)


def at_pose(place, b, c, machine=MACHINE):
    rows = np.zeros((1, 5))
    rows[0, B], rows[0, C] = b, c
    return follow(machine, rows, np.array(place))


def random_poses(machine, count, seed):
    """Away from poles: the axis of the tool is never near that of the first rotary axis."""
    rng = np.random.default_rng(seed)
    rows = np.zeros((count, len(machine.letters)))
    for name in machine.rotary:
        rows[:, machine.letters.index(name)] = rng.choice([-1, 1], count) * rng.uniform(
            0.3, 1.2, count
        )
    return follow(machine, rows, rng.uniform(-0.1, 0.1, (count, 3)))


def measure(truth, plans):
    """Finished cycles of plans that the simulated cell carries out."""
    cell, estimator = Cell(truth, EPOCH), Estimator()
    for plan in plans:
        started = replace(plan, stamp=cell.now, session='again')
        cell.queue(started)
        estimator.add_plan(started)
        while cell.busy:
            given = cell.advance(cell.now + 2_000_000_000)
            for sample in given.feedback:
                estimator.add_feedback(sample)
            for block in given.blocks:
                estimator.add_gauges(block)
    done = []
    while (ready := estimator.finished()) is not None:
        done.append(ready.cycle)
    return done + [ready.cycle for ready in estimator.finish()]


@cache
def identified():
    return identify(MACHINE, measure(B_ONLY, WITHOUT_RUNOUT))


@cache
def known_errors():
    return of_field(ErrorField.from_identification(identified()))


def model(*effects, **values):
    units = {letter: 'rad' if letter in 'ABC' else 'm' for letter in 'ABCXYZ'}
    return Model('m', MACHINE.name, {
        symbol: Value(value, 1e-7, units[symbol[2]]) for symbol, value in values.items()
    }, effects)


def effect(key, shape=(), **parameters):
    return ModelEffect(
        key, {name: Value(value, 0.0, unit) for name, (value, unit) in parameters.items()},
        {name: Value(value, 0.0, unit) for name, (value, unit) in shape},
    )


SCALE = effect('scale/X', e=(4e-5, 'm/m'))
ANGLE = effect('angular-cyclic/B.1', p=(1e-5, 'rad'), q=(-2e-5, 'rad'))
BACKLASH = effect('backlash/C', h=(3e-5, 'rad'))
VALUES = {'E_X(0Y)B': 1e-5, 'E_A(0B)C': 2e-5, 'E_C(0Y)X': 1.4e-5}
