"""Which complaints of other nodes a session tells."""

from __future__ import annotations

import pytest

from rtest_drivers.complaints import QUIET, Complaints


def test_a_complaint_is_told_once_in_a_cycle_whatever_its_numbers():
    complaints = Complaints()
    assert complaints.is_new('gauges', 'no data for 2.1 s', 1)
    assert not complaints.is_new('gauges', 'no data for 3.1 s', 1)
    assert complaints.is_new('gauges', 'no data for 1.5 s', 2)


def test_a_complaint_that_has_not_changed_is_not_told_in_the_next_cycle():
    complaints = Complaints()
    assert complaints.is_new('gauges', 'gauge 2: no signal', 1)
    assert not complaints.is_new('gauges', 'gauge 2: no signal', 2)


def test_another_complaint_and_another_node_are_told_beside_it():
    complaints = Complaints()
    assert complaints.is_new('gauges', 'no data for 2.1 s', 1)
    assert complaints.is_new('cnc', 'no data for 2.1 s', 1)
    assert complaints.is_new('gauges', 'the cable is out', 1)


@pytest.mark.parametrize('source', QUIET)
def test_what_is_told_at_the_end_is_not_told_before(source):
    assert not Complaints().is_new(source, 'cannot be identified', 1)
