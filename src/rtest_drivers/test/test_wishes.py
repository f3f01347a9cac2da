"""What is granted to a person who asks a session for something."""

from __future__ import annotations

import pytest

from rtest_drivers.wishes import ABORT, CALIBRATE, GRANTED, REPEAT, SKIP, START, Wishes


def granted(wishes: Wishes, simulated: bool = False) -> set[str]:
    return {wish for wish in GRANTED if not wishes.refuses(wish, simulated)}


def test_a_cycle_that_waits_to_be_started_cannot_be_repeated():
    wishes = Wishes()
    wishes.held = '1a-static'
    assert granted(wishes) == {START, SKIP, CALIBRATE, ABORT}


def test_a_cycle_on_a_machine_can_be_interrupted():
    wishes = Wishes()
    wishes.following = True
    assert granted(wishes) == {REPEAT, SKIP, CALIBRATE, ABORT}


def test_a_simulated_cycle_goes_on_to_its_end():
    assert granted(Wishes(), simulated=True) == {CALIBRATE, ABORT}


@pytest.mark.parametrize(('wish', 'why'), [
    (START, 'no cycle waits to be started'),
    (REPEAT, 'there is nothing to repeat or skip'),
    (SKIP, 'there is nothing to repeat or skip'),
    (CALIBRATE, 'there is nothing to calibrate'),
    (ABORT, 'there is nothing to abort'),
])
def test_nothing_is_granted_between_cycles(wish, why):
    assert Wishes().refuses(wish, False) == why
