"""Markers of the magnified picture, on cycles with errors that are known."""

from importlib.util import find_spec

import numpy as np
import pytest

pytestmark = pytest.mark.skipif(
    find_spec('visualization_msgs') is None, reason='needs ROS 2 messages'
)


@pytest.fixture(scope='module')
def markers():
    from pathlib import Path

    from rtest_identification.nodes.markers import position_markers
    from rtest_identification.offline import identify_recording
    from rtest_identification.presentation import present

    bag = Path(__file__).parents[3] / 'bags' / 'short'
    result = identify_recording(bag)
    return result, present(result), position_markers(result, 7_000_000_005).markers


def test_what_was_drawn_before_is_removed_first_and_all_is_in_the_machine_frame(markers) -> None:
    _, _, found = markers
    assert found[0].action == found[0].DELETEALL
    assert {marker.header.frame_id for marker in found} == {'machine'}
    assert (found[1].header.stamp.sec, found[1].header.stamp.nanosec) == (7, 5)
    keys = [(marker.ns, marker.id) for marker in found[1:]]
    assert len(keys) == len(set(keys))


def test_errors_are_drawn_as_large_as_the_note_says(markers) -> None:
    _, view, found = markers
    note = next(marker for marker in found if marker.ns == 'magnification')
    factor = float(note.text.removeprefix('error ').removesuffix('×').replace(',', ''))

    def points(kind):
        return np.array([
            [p.x, p.y, p.z]
            for marker in found if marker.ns.startswith(kind) for p in marker.points
        ])

    command, measured = points('command/'), points('measured/')
    largest = np.linalg.norm(measured - command, axis=1).max()
    full = [n for n in range(len(view.levels)) if (view.level == n).sum() > 4]
    rows = np.isin(view.level, full)
    assert largest == pytest.approx(factor * np.linalg.norm(view.error()[rows], axis=1).max())
    # Lines join each pair.
    ends = points('error/').reshape(-1, 2, 3)
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max() == pytest.approx(largest)
    assert len(ends) == len(command) == len(measured)
