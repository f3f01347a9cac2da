"""Ranges along the moves, bodies that come near each other, duration."""

import numpy as np
import pytest
from independent import NMV, SETUPS, B, C

from rtest_estimation.errors import UserError
from rtest_identification.machine import parse_machine
from rtest_identification.moves import Approach, Speeds, clear_of_nest, synchronous_path
from rtest_identification.plan_check import Spindle, Table, check_plan, duration, swing
from rtest_identification.plans import check_ranges, nest_calibration, static

MACHINE = parse_machine(NMV)
SPHERE = np.array(SETUPS['1a'])


def checked(plan, machine=MACHINE, **bodies):
    return check_plan(machine, plan, synchronous_path(machine, plan), Approach(), **bodies)


def test_an_axis_may_leave_its_range_between_poses_that_are_within():
    # C from 10 to 170 deg at a radius of 90 mm: X goes through 90 mm, its poses are at 15.6 mm.
    narrow = parse_machine(NMV.replace('range_mm: [-210, 210]', 'range_mm: [-60, 60]'))
    plan = static(narrow, '1a', SPHERE, np.radians([0.0]), np.radians([10.0, 170.0]))
    check_ranges(narrow, plan)
    with pytest.raises(UserError, match='on the way from pose 1 to the next X'):
        checked(plan, narrow)
    assert checked(plan).extent['X'][1] == pytest.approx(0.09, abs=1e-4)


def test_time_is_that_of_the_slowest_axis_dwells_and_the_way_in_and_out():
    plan = static(MACHINE, '2a', np.array(SETUPS['2a']), np.radians([0.0]), np.radians([0, 90.0]))
    path = synchronous_path(MACHINE, plan, Speeds(0.05, np.radians(10.0)))
    # 0, 0, 90, 0 deg of C with the sphere on its axis: 18 s, and a block that does not move.
    seconds = duration(plan, path, Approach(0.05, 0.01))
    assert seconds == pytest.approx(18.0 + 0.02 + 4 * 0.3 + 10.0)


def test_a_nest_calibration_goes_straight():
    plan = nest_calibration(MACHINE, '1a', SPHERE)
    assert len(synchronous_path(MACHINE, plan).positions) == len(plan.commands)


def table(**changes):
    return Table(**{'radius': 0.15, 'surface': -0.05, **changes})


def test_the_distance_of_spindle_and_table_is_that_of_plane_geometry():
    # Sphere on the axis 40.6 mm up, the table 50 mm below zero: upright spindle, nose 100 mm up.
    plan = static(MACHINE, '2a', np.array(SETUPS['2a']), np.radians([0.0]), C)
    found = checked(plan, table=table(), spindle=Spindle(0.05, 0.1))
    assert found.distance == pytest.approx(0.0406 + 0.1 + 0.05, abs=1e-6)
    # Tilted by 60 deg: the nose's centre at 90.6 + 100 cos 60, its rim lower by 50 sin 60.
    tilted = static(MACHINE, '2a', np.array(SETUPS['2a']), np.radians([60.0]), C)
    found = checked(tilted, table=table(radius=0.5), spindle=Spindle(0.05, 0.1))
    assert found.distance == pytest.approx(0.0906 + 0.05 - 0.05 * np.sqrt(0.75), abs=2e-5)


def test_a_spindle_that_meets_the_nest_or_the_table_is_refused_with_the_pose():
    plan = static(MACHINE, '2a', np.array(SETUPS['2a']), np.radians([-90.0, 0, 90.0]), C)
    with pytest.raises(UserError, match='the spindle meets the table after pose'):
        checked(plan, table=table(radius=0.3), spindle=Spindle(0.1, 0.1))
    with pytest.raises(UserError, match='meets the nest'):
        checked(static(MACHINE, '2a', np.array(SETUPS['2a']), np.radians([0.0]), C),
                table=table(nest_radius=0.05, nest_height=0.2), spindle=Spindle(0.05, 0.1))


def test_bodies_that_come_near_are_warned_of():
    plan = static(MACHINE, '2a', np.array(SETUPS['2a']), np.radians([0.0]), C)
    found = checked(plan, table=table(nest_radius=0.05, nest_height=0.1856),
                    spindle=Spindle(0.05, 0.1))
    assert found.distance == pytest.approx(0.005, abs=1e-6)
    assert 'within 5.0 mm of the nest' in found.warnings[0]


def test_the_swing_is_that_of_the_farthest_edge():
    plain = table(radius=0.3, surface=-0.02)
    # Lower edge of a table 100 mm thick.
    assert swing(MACHINE, SPHERE, plain) == pytest.approx(np.hypot(0.3, 0.12), rel=1e-3)
    plan = static(MACHINE, '1a', SPHERE, B, C)
    found = checked(plan, table=table(radius=0.3, swing=0.25))
    assert any('sweep a radius' in text for text in found.warnings) and found.distance is None


def test_a_short_way_out_of_the_nest_is_told():
    short = parse_machine(NMV.replace('[-200, 200]', '[-200, 170]'))
    plan = static(short, '1b', np.array(SETUPS['1b']), np.radians([0.0]), C)
    _, reach = clear_of_nest(short, plan.commands[0], Approach())
    assert reach == pytest.approx(0.17 - 0.1406)
    assert '29.4 mm of 50.0 mm' in checked(plan, short).warnings[0]
