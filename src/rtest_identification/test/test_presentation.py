"""Positions of the nest against hand cases (Fig. 3-3 and the like)."""

from dataclasses import replace

import numpy as np
import pytest
from independent import NMV, SETUPS, noisy, static_cycle, turn

from rtest_identification.axis_lines import axis_lines
from rtest_identification.machine import parse_machine
from rtest_identification.pipeline import identify
from rtest_identification.presentation import present

MACHINE = parse_machine(NMV)


def view_of(errors, setups=tuple(SETUPS), machine=MACHINE, mirrored=False):
    cycles = [static_cycle(setup, lambda b, c: errors) for setup in setups]
    if mirrored:
        for cycle in cycles:
            cycle.plan.commands[:, 3:] *= -1
            for point in cycle.points:
                point.feedback[3:] *= -1
    return present(identify(machine, cycles))


def at(view, setup, degrees):
    """Rows of one turn."""
    names = [s.name for s in view.setups]
    level = int(np.abs(np.degrees(view.levels) - degrees).argmin())
    return view.rows(names.index(setup), level)


def test_setups_are_told_by_their_geometry():
    view = view_of({'B': {'X': 1e-6}})
    assert (view.turning, view.stepping, view.seen) == ('C', 'B', 'sensors nest')
    assert [s.outer for s in view.setups] == [True, True, False, False]
    assert [s.height for s in view.setups] == pytest.approx([0.0406, 0.1406, 0.0406, 0.1406])
    rows = at(view, '1a', 0)
    # Ry(B) Rz(C) w: at B = C = 0 the sphere, a quarter turn on at +X.
    quarter = rows[np.abs(view.turned[rows] - np.pi / 2).argmin()]
    np.testing.assert_allclose(view.nominal[quarter], [0.09, 0.0, 0.0406], atol=1e-9)
    tilted = at(view, '2b', 75)
    leaning = 0.1406 * np.array([np.sin(np.radians(75)), 0.0, np.cos(np.radians(75))])
    np.testing.assert_allclose(view.nominal[tilted[0]], leaning, atol=1e-9)


def test_an_offset_of_c_expands_the_circle_and_shifts_it_once_the_reset_is_compensated():
    """Fig. 3-3: (a) with the reset at the first pose, (b) without."""
    view = view_of({'B': {'X': 10e-6}})
    rows = at(view, '1a', 0)
    measured = view.measured[rows]
    # (a) nothing at C = 0; half a turn on the nest seems 20 um off, on average 10.
    first = np.abs(view.turned[rows]).argmin()
    np.testing.assert_allclose(measured[first], 0.0, atol=1e-9)
    half = np.abs(view.turned[rows] - np.pi).argmin()
    np.testing.assert_allclose(measured[half], [20e-6, 0.0, 0.0], atol=1e-9)
    # (b) the circle as a whole is 10 um off in +X, at every pose.
    np.testing.assert_allclose(
        view.error(offsets=True)[rows], np.tile([10e-6, 0.0, 0.0], (len(rows), 1)), atol=2e-9
    )
    # (3-6) and with the offset removed nothing is left, at every level of B.
    np.testing.assert_allclose(view.error(), 0.0, atol=2e-9)


def test_an_offset_of_c_against_b_turns_with_b():
    """Eq. 3-6 takes a vector fixed in the machine off; at B = 75 deg that leaves 12 of 10 um."""
    view = view_of({'C': {'X': 10e-6}})
    rows = at(view, '1a', 75)
    angle = np.radians(75)
    turned = 10e-6 * np.array([np.cos(angle), 0.0, -np.sin(angle)])
    np.testing.assert_allclose(
        view.error(offsets=True)[rows], np.tile(turned, (len(rows), 1)), atol=2e-9
    )
    np.testing.assert_allclose(view.error(), 0.0, atol=2e-9)
    assert np.linalg.norm(turned - [10e-6, 0.0, 0.0]) > 12e-6
    # In the B frame it stands still (6.6.4).
    in_b = view.in_level_frame(view.error(offsets=True))
    np.testing.assert_allclose(in_b, np.tile([10e-6, 0.0, 0.0], (len(in_b), 1)), atol=2e-9)


@pytest.mark.parametrize('letter', 'AB')
def test_a_tilt_of_c_tilts_its_average_circle_by_that_angle(letter):
    tilt = 30e-6
    view = view_of({'C': {letter: tilt}} if letter == 'A' else {'B': {letter: tilt}})
    lines = axis_lines(view, view.error())
    expected = [tilt, 0.0] if letter == 'A' else [0.0, tilt]
    assert lines.letters == ('A', 'B')
    for tilts in lines.across:
        np.testing.assert_allclose(tilts.value, np.tile(expected, (7, 1)), atol=1e-8)
    np.testing.assert_allclose(lines.along.value, np.tile(expected, (7, 1)), atol=1e-8)


def test_a_table_that_turns_the_other_way_shows_the_same():
    errors = {'B': {'X': 10e-6, 'Z': -7e-6, 'B': 20e-6}, 'C': {'A': 30e-6}}
    plain = view_of(errors)
    other = view_of(
        errors, machine=parse_machine(NMV.replace('sense: 1', 'sense: -1')), mirrored=True
    )
    np.testing.assert_allclose(other.nominal, plain.nominal, atol=1e-12)
    for offsets in (True, False):
        np.testing.assert_allclose(
            other.error(offsets=offsets), plain.error(offsets=offsets), atol=1e-12
        )
    np.testing.assert_allclose(other.levels[::-1], -plain.levels, atol=1e-12)


def test_squareness_can_be_taken_out():
    errors = {'B': {'Y': 4e-6}, 'Z': {'A': -12e-6, 'B': -8e-6}, 'X': {'C': 14e-6}}
    view = view_of(errors)
    assert np.abs(view.error()).max() > 1e-6
    np.testing.assert_allclose(view.error(squareness=False), 0.0, atol=1e-9)


def test_sphere_runout_is_no_error_of_the_nest():
    """A sphere off the spindle axis is known from its run-out; it moves no picture."""
    rng = np.random.default_rng(33)
    cycles = [
        noisy(static_cycle(setup, lambda b, c: {'B': {'B': 2e-5}}), 1e-7, rng) for setup in SETUPS
    ]
    plain = present(identify(MACHINE, cycles))
    off = np.array([3e-6, -2e-6, 0.0])
    shifted = []
    for cycle in cycles:
        points = []
        for p in cycle.points:
            b, c = p.feedback[3:]
            table = (turn('B', b) @ turn('C', c))[:3, :3]
            points.append(replace(p, displacement=p.displacement + table.T @ off))
        shifted.append(replace(cycle, points=tuple(points)))
    machine = replace(MACHINE, tool=off)
    view = present(identify(machine, shifted))
    np.testing.assert_allclose(view.error(), plain.error(), atol=2e-9)
