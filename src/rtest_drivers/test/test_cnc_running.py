"""Whether an NC program runs, and whether it has left its cycle."""

from __future__ import annotations

import pytest

from rtest_drivers.cnc.running import ENDED_S, NcProgram

LATER = ENDED_S + 0.1


@pytest.mark.parametrize(('values', 'stands'), [
    ({}, True),
    ({'program': ''}, True),
    ({'program': 'IDLE'}, True),
    ({'program': 'RUNNING'}, False),
    ({'program': 'PAUSED'}, False),
    ({'estop': 'on'}, True),
])
def test_a_program_runs_where_the_controller_says_so(values, stands):
    program = NcProgram()
    program.note(values, 0.0)
    assert program.stands is stands
    assert program.reports == 1


def test_a_program_that_ran_and_has_ended_for_a_while_has_left_its_cycle():
    program = NcProgram()
    program.note({'program': 'IDLE'}, 0.0)
    assert not program.has_left(100.0, 3), 'it has not begun'
    program.note({'program': 'RUNNING'}, 100.0)
    assert not program.has_left(200.0, 3)
    program.note({'program': 'IDLE'}, 200.0)
    program.note({'program': 'IDLE'}, 204.0)
    assert not program.has_left(200.0 + ENDED_S, 3)
    assert program.has_left(200.0 + LATER, 3), 'it ended with the first of these reports'


def test_a_program_that_runs_again_has_not_left():
    program = NcProgram()
    for wall, state in enumerate(('RUNNING', 'IDLE', 'RUNNING')):
        program.note({'program': state}, float(wall))
    assert not program.has_left(100.0, 3)


def test_the_program_of_the_cycle_before_is_another_one():
    program = NcProgram()
    program.note({'program': 'RUNNING'}, 0.0)
    program.note({'program': 'IDLE'}, 1.0)
    program.begin_cycle()
    assert not program.has_left(1.0 + LATER, 3)


def test_an_emergency_stop_ends_a_program():
    program = NcProgram()
    program.note({'program': 'RUNNING'}, 0.0)
    program.note({'estop': 'on'}, 1.0)
    assert program.has_left(1.0 + LATER, 0)


def test_where_the_controller_tells_of_no_program_poses_say_that_one_ran():
    program = NcProgram()
    program.note({'estop': 'off'}, 0.0)
    assert not program.has_left(100.0, 3), 'nothing says that it has ended'
    program.note({'estop': 'on'}, 100.0)
    assert not program.has_left(100.0 + LATER, 0)
    assert program.has_left(100.0 + LATER, 3)
