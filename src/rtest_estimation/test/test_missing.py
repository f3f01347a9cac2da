"""Missing poses in words."""

from rtest_estimation.missing import grouped
from rtest_estimation.records import Missing


def test_poses_of_one_reason_are_one_text():
    silent = [Missing(pose, 'no gauge readings') for pose in (3, 4, 5, 7)]
    assert grouped([Missing(6, 'never reached'), *silent]) == [
        '3-5, 7: no gauge readings', '6: never reached',
    ]
    assert grouped([]) == []


def test_reasons_that_differ_in_numbers_only_are_one_with_their_range():
    reasons = {
        1: 'not settled: stood still 0.21 s of 0.30 s',
        2: 'not settled: stood still 0.09 s of 0.30 s',
        5: 'no nest calibration of set-up 1a',
        9: 'not settled: stood still 0.10 s of 0.30 s',
    }
    assert grouped(Missing(pose, reason) for pose, reason in reasons.items()) == [
        '1-2, 9: not settled: stood still 0.09 to 0.21 s of 0.30 s',
        '5: no nest calibration of set-up 1a',
    ]
