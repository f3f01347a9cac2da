"""Laser nests in recordings: scans and verification points of spheres with a known error."""

from pathlib import Path

import numpy as np
import pytest

from rtest_estimation.errors import UserError
from rtest_estimation.pipeline import EstimationRules
from rtest_estimation.recording import Recording
from rtest_estimation.records import CyclePlan, Feedback, GaugeBlock, Kind, NestKind
from rtest_identification.laser.output import as_dict, lines, summary
from rtest_identification.laser.recorded import evaluate
from rtest_identification.offline import rules_of

R, HZ, T0 = 25e-3, 100, 1_700_000_000_000_000_000
AXES = ('X', 'Y', 'Z', 'B', 'C')
RULES = EstimationRules(sphere_radius=R, nest=NestKind.LASER)
# Of 1 um at 0.5 mm along X from the top, odd, as the inclination makes it.
CUBIC = 1e-6 / 5e-4**3
LOST = 8e-4


def scan_plan(stamp=T0, half=1e-3, pitch=1e-4, feed=4e-3):
    rows = np.arange(-half, half + pitch / 2, pitch)
    ends = [(s * half, y, 0) for k, y in enumerate(rows) for s in ((-1, 1) if k % 2 else (1, -1))]
    rows = np.zeros((len(ends) + 2, 5))
    rows[1:-1, :3] = ends
    return CyclePlan(
        stamp, 's', '1a-scan-1', Kind.DYNAMIC, '1a', np.zeros(3), AXES, rows, 0.0, feed
    )


def driven(plan):
    """(n,) stamps and (n, 3) positions at constant feed, standing half a second at every pose."""
    positions = []
    for before, after in zip(plan.commands[:-1, :3], plan.commands[1:, :3], strict=True):
        steps = max(2, int(np.linalg.norm(after - before) / plan.feed * HZ))
        share = np.arange(steps)[:, None] / steps
        positions += [*(before + share * (after - before)), *np.tile(after, (HZ // 2, 1))]
    positions += [plan.commands[-1, :3]] * HZ
    return plan.stamp + np.arange(len(positions)) * (10**9 // HZ), np.array(positions)


def seen_from_below(positions):
    """Reading of a laser that looks up at the sphere, and whether light comes back."""
    x, y = positions[:, 0], positions[:, 1]
    reading = -positions[:, 2] + np.sqrt(R**2 - x**2 - y**2) - R + CUBIC * x**3
    return reading, np.hypot(x, y) < LOST


def recording(plans, stamps, positions, readings, status):
    feedback = tuple(
        Feedback(int(t), AXES, np.r_[p, 0.0, 0.0]) for t, p in zip(stamps, positions, strict=True)
    )
    blocks = tuple(
        GaugeBlock(int(stamps[k]), k, 1 / HZ, readings[k : k + 10], status[k : k + 10])
        for k in range(0, len(stamps), 10)
    )
    return Recording(
        Path('somewhere'), 's', None, tuple(plans), blocks, feedback, (), (), (), (), {}, 0, 0, 0
    )


@pytest.fixture(scope='module')
def scanned():
    plan = scan_plan()
    stamps, positions = driven(plan)
    reading, valid = seen_from_below(positions)
    status = np.where(valid, 0, 2).astype(np.uint8)[:, None]
    return evaluate(recording([plan], stamps, positions, reading[:, None], status), RULES)


def test_only_the_lines_of_a_scan_count(scanned):
    (scan,) = scanned.scans
    assert (scan.laser, scan.setup) == (1, '1a')
    # 21 lines of 2 mm at 4 mm/s and 100 Hz; neither the ways between nor the standing at the ends.
    assert len(scan.reading) == pytest.approx(21 * 50, rel=0.05)
    rows = np.round(np.abs(scan.place[:, 1]) / 1e-4)
    np.testing.assert_allclose(np.abs(scan.place[:, 1]), rows * 1e-4, atol=1e-9)


def test_the_known_error_of_a_sphere_comes_back(scanned):
    profile = scanned.scans[0].profile
    x = scanned.scans[0].place[:, 0]
    sign = np.sign(np.nansum(profile.error * x**3))
    # The cubic less the straight line that looks like a shift of the top: over a disc of radius a
    # the least-squares line of x^3 is a^2 x / 2.
    expected = CUBIC * (x**3 - LOST**2 / 2 * x)
    valid = scanned.scans[0].valid
    assert np.abs(sign * profile.error - expected)[valid].max() < 0.15e-6
    assert profile.noise < 0.02e-6
    # The line moves the top by its slope times R, to one side: the edge is nearer on the other.
    shift = CUBIC * LOST**2 / 2 * R
    assert np.linalg.norm(profile.top) == pytest.approx(shift, rel=0.03)
    assert profile.bounded and profile.measurable == pytest.approx(LOST - shift, abs=1e-5)
    # |x^3 - a^2 x / 2| reaches 1 um at 0.705 mm from the middle; readings are 0.04 mm apart.
    edge = np.roots([CUBIC, 0, -CUBIC * LOST**2 / 2, -1e-6]).real.max()
    assert profile.accurate == pytest.approx(edge - shift, abs=4e-5)


def test_what_is_written_and_said(scanned):
    data = as_dict(scanned)
    assert data['nests'] == [] and data['scans'][0]['area_4_reached'] is True
    assert data['scans'][0]['area_3_measurable'] == scanned.scans[0].profile.measurable
    assert 'laser 1, noise 0.0' in lines(scanned)[0]
    assert summary(scanned).startswith('1 scan, noise 0.0')


def test_several_lasers_without_a_calibration_are_not_guessed():
    plan = scan_plan()
    stamps, positions = driven(plan)
    reading, _ = seen_from_below(positions)
    three = np.column_stack([reading, reading, reading])
    with pytest.raises(UserError, match='which laser was scanned is not known'):
        evaluate(
            recording([plan], stamps, positions, three, np.zeros(three.shape, np.uint8)), RULES
        )


def test_a_cycle_of_other_moves_is_no_scan():
    plan = scan_plan()
    commands = plan.commands.copy()
    commands[5, 2] = 3e-4
    bent = CyclePlan(**{**vars(plan), 'commands': commands})
    stamps, positions = driven(bent)
    reading, _ = seen_from_below(positions)
    with pytest.raises(UserError, match='no lines in one plane'):
        evaluate(
            recording([bent], stamps, positions, reading[:, None],
                      np.zeros((len(reading), 1), np.uint8)),
            RULES,
        )


class Message:
    """A recorded calibration, as far as it is looked at."""

    def __init__(self, kind, sphere_radius):
        self.kind, self.sphere_radius = kind, sphere_radius


def test_the_recording_says_of_which_kind_its_nest_is():
    steps = np.zeros((7, 5))
    steps[1:, :3] = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    corner = np.vstack([steps, [[1, 1, 1, 0, 0]]])
    for commands, messages, kind, radius in (
        (steps, (), NestKind.CONTACT, None),
        (corner, (), NestKind.LASER, None),
        (corner, (Message(0, 12.7e-3),), NestKind.CONTACT, 12.7e-3),
        (steps, (Message(0, 12.7e-3), Message(1, R)), NestKind.LASER, R),
        (corner, (Message(7, R),), NestKind.LASER, None),
    ):
        plan = CyclePlan(
            T0, 's', 'n', Kind.NEST_CALIBRATION, '1a', np.zeros(3), AXES, commands, 1.0
        )
        found = rules_of(
            Recording(Path(), 's', None, (plan,), (), (), messages, (), (), (), {}, 0, 0, 0)
        )
        assert found.nest is kind
        assert found.sphere_radius == radius if radius else np.isnan(found.sphere_radius)
