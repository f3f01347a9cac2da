import numpy as np
import pytest
from independent import NMV, centre, static_cycle, turn
from warming import LEVELS, SPHERE, STATIONS, session

from rtest_identification.machine import parse_machine
from rtest_identification.thermal.poses import places, poses_of

MACHINE = parse_machine(NMV)
PLAN = session(lambda *_: {}, [0])[0].plan


def slopes(plan, axis, letter, size=1e-6):
    """(m, 3) change of the sphere centre per error, by the plain matrices."""
    return np.array([
        (centre(*row, {axis: {letter: size}}) - centre(*row, {axis: {letter: -size}})) / (2 * size)
        for row in plan.commands
    ])


@pytest.mark.parametrize('measured', [np.ones(27, bool), np.arange(27) % 5 != 2])
def test_gains_find_each_error_and_no_other(measured):
    poses = poses_of(MACHINE, PLAN)
    gains = poses.gains(measured)
    assert gains.determined.all()
    assert gains.rank == poses.full.rank
    effects = np.stack([slopes(PLAN, p.axis, p.letter) for p in poses.constants], axis=2)
    for gain in (gains.alone, gains.joint):
        np.testing.assert_allclose(
            np.einsum('pmi,miq->pq', gain, effects), np.eye(11), atol=1e-6
        )
        # An offset of the cycle is no error, and what was not measured takes no part.
        np.testing.assert_allclose(gain.sum(axis=1), 0.0, atol=1e-9)
        assert not gain[:, ~measured].any()
    np.testing.assert_allclose(np.einsum('qsmi,mip->qsp', gains.map, effects), 0.0, atol=1e-6)


def test_map_is_found_at_its_stations():
    poses = poses_of(MACHINE, PLAN)
    wave = np.array([1.0, -2.0, 0.0, 2.0, -1.0])
    b = PLAN.commands[:, 3]
    level = np.abs(b[:, None] - LEVELS).argmin(axis=1)
    change = 1e-6 * slopes(PLAN, 'B', 'Y') * wave[level][:, None]
    found = np.einsum('qsmi,mi->qs', poses.full.map, change)
    np.testing.assert_allclose(found[1], 1e-6 * wave, atol=1e-11)
    np.testing.assert_allclose(np.delete(found, 1, axis=0), 0.0, atol=1e-11)
    np.testing.assert_allclose(
        np.einsum('pmi,mi->p', poses.full.joint, change), 0.0, atol=1e-11
    )


def test_a_cycle_cut_short_determines_less():
    poses = poses_of(MACHINE, PLAN)
    part = poses.gains(np.arange(27) < 12)
    assert part.rank < poses.full.rank
    one_level = poses.gains(np.arange(27) < 6)
    assert not one_level.determined.all()


def test_places_by_command_and_visit():
    whole = places(PLAN, PLAN)
    assert whole.tolist() == list(range(27))
    # Backwards, both visits of the start and of the middle come in the other order.
    back = session(lambda *_: {}, [0])[0].plan
    back = type(back)(**{**vars(back), 'commands': back.commands[::-1]})
    assert sorted(places(PLAN, back).tolist()) == list(range(27))
    assert places(PLAN, back)[0] == 0
    other = static_cycle('1b', lambda b, c: {}).plan
    assert (places(PLAN, other) == -1).all()
    # Cut short, and with minus signs before zeros.
    commands = np.where(PLAN.commands[:9] == 0.0, -0.0, PLAN.commands[:9])
    cut = type(back)(**{**vars(PLAN), 'commands': commands})
    assert places(PLAN, cut).tolist() == list(range(9))


def test_the_bench_follows_the_thesis():
    # Section 4.5.1: 5 x 5 poses; the sphere stays in the nest.
    assert len(PLAN.commands) == 2 + len(LEVELS) * len(STATIONS)
    for x, y, z, b, c in PLAN.commands:
        at = turn('B', b) @ turn('C', c) @ [*SPHERE, 1.0]
        np.testing.assert_allclose([x, y, z], at[:3], atol=1e-12)
