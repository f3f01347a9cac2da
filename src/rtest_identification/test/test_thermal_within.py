"""What one cycle alone cannot tell, against least squares on plain matrices."""

import numpy as np
import pytest
from independent import NMV, centre
from warming import LEVELS, START, session

from rtest_identification.machine import parse_machine
from rtest_identification.thermal.pipeline import identify_thermal
from rtest_identification.thermal.poses import poses_of
from rtest_identification.thermal.within import within

MACHINE = parse_machine(NMV)
PLAN = session(lambda *_: {}, [0])[0].plan
CONSTANTS = [
    ('B', 'X'), ('B', 'Y'), ('B', 'Z'), ('B', 'A'), ('B', 'B'), ('B', 'C'), ('C', 'X'), ('C', 'A'),
    ('Z', 'A'), ('Z', 'B'), ('X', 'C'),
]


def slope(axis, letter, size=1e-6):
    """(m, 3) change of the sphere centre per error; angles at a lever arm of 0.1 m."""
    error = (10.0 if letter in 'ABC' else 1.0) * size
    moved = [
        centre(*row, {axis: {letter: error}}) - centre(*row, {axis: {letter: -error}})
        for row in PLAN.commands
    ]
    return np.array(moved) / (2 * size)


def left(target, columns):
    """Sum of squares that columns leave of a target."""
    design = np.column_stack([np.asarray(c).reshape(81) for c in columns])
    fit, *_ = np.linalg.lstsq(design, target.ravel(), rcond=1e-8)
    return float(((target.ravel() - design @ fit) ** 2).sum())


def by_hand(axis, letter, seconds):
    time = (seconds - seconds.mean()) / np.ptp(seconds)
    drift = slope(axis, letter) * time[:, None]
    constants = [slope(*c) for c in CONSTANTS] + [np.tile(e, (27, 1)) for e in np.eye(3)]
    level = np.abs(PLAN.commands[:, 3, None] - LEVELS).argmin(axis=1)
    on_map = [slope('B', k) * (level == n)[:, None] for k in 'XYZABC' for n in range(5)]
    return 1.0 - left(drift, constants + on_map) / left(drift, constants)


@pytest.mark.parametrize('order', ['as planned', 'at random'])
def test_hidden_part_by_plain_matrices(order):
    seconds = 4.0 * np.arange(27.0)
    if order == 'at random':
        seconds = np.random.default_rng(0).permutation(seconds)
    stamp = START + np.rint(1e9 * seconds).astype(np.int64)
    found = within(poses_of(MACHINE, PLAN), stamp, np.ones(27, bool), 0.25e-6)
    for one in found:
        expected = by_hand(one.parameter.axis, one.parameter.letter, seconds)
        assert one.hidden == pytest.approx(expected, abs=1e-4), one.parameter.symbol
    told = {one.parameter.symbol for one in found if one.inseparable}
    if order == 'as planned':
        # B goes from level to level, C to and fro: what C shows is told, what B alone is not.
        assert {'E_Y(0Y)B', 'E_B(0Y)B'} <= told and 'E_X(0Y)B' not in told
    else:
        assert not {'E_Y(0Y)B', 'E_B(0Y)B'} & told


def test_what_it_is_taken_for():
    stamp = START + 4_000_000_000 * np.arange(27)
    found = within(poses_of(MACHINE, PLAN), stamp, np.ones(27, bool), 0.25e-6)
    y = next(one for one in found if one.parameter.symbol == 'E_Y(0Y)B')
    (name, size), *_ = y.as_map
    # Five levels, one after the other, cover four fifths of the time between their middles.
    assert name.symbol == 'E_Y(Y)B' and size == pytest.approx(0.8, abs=0.05)
    # A drift of Y within a cycle of this noise is seen from 0.6 um on.
    assert 2.0 * y.stddev == pytest.approx(0.65e-6, rel=0.1)


def test_drift_of_the_reference_cycle_is_told():
    def errors(time, b, c):
        return {'B': {'Y': -1e-9 * time}}

    result = identify_thermal(MACHINE, session(errors, [0, 15, 30, 45], noise=0.1e-6, seed=1))
    y = next(one for one in result.within if one.parameter.symbol == 'E_Y(0Y)B')
    assert y.drift == pytest.approx(-1e-9 * 104.0, rel=0.2)
    assert all(one.drift == 0.0 for one in result.within if one.parameter.symbol == 'E_A(0Y)B')
