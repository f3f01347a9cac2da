"""Cycles of a laser nest in a session file, against geometry by hand."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from rtest_estimation.errors import UserError
from rtest_estimation.records import Cycle, CyclePoint, Kind, NestKind
from rtest_identification.kinematics import predict
from rtest_identification.moves import synchronous_path
from rtest_identification.observations import stack, turns
from rtest_identification.session_file import load_session

MACHINE = """
name: test
chain: [C, B, bed, Y, X, Z]
axes:
  X: {type: linear, direction: [1, 0, 0], range_mm: [-210, 210]}
  Y: {type: linear, direction: [0, 1, 0], range_mm: [-105, 105]}
  Z: {type: linear, direction: [0, 0, 1], range_mm: [-200, 200]}
  B: {type: rotary, direction: [0, 1, 0], range_deg: [-180, 160]}
  C: {type: rotary, direction: [0, 0, 1], range_deg: [-360, 360]}
"""
SPHERE = np.array([0.0, -0.07, 0.04])
LASER = {
    'machine': 'machine.yaml',
    'sphere_radius_mm': 25,
    'nest': {'kind': 'laser', 'directions': [{'azimuth_deg': 30, 'tilt_deg': 45},
                                             {'azimuth_deg': 150, 'tilt_deg': 45},
                                             {'azimuth_deg': 270, 'tilt_deg': 45}]},
    'nest_calibration': {'edge_mm': 0.8},
    'verification': {'dwell_s': 0.2},
    'scan': {'half_mm': 1.0, 'pitch_mm': 0.25, 'feed_mm_min': 90},
    'cycle': {'b_deg': [-30, 0, 30], 'c_deg': [0, 120, 240]},
    'setups': {'1a': {'sphere_mm': [0, -70, 40]}, '1b': {'sphere_mm': [0, 0, 90]}},
}


def load(folder, **changes):
    data = {key: value for key, value in {**LASER, **changes}.items() if value is not None}
    (folder / 'machine.yaml').write_text(MACHINE)
    (folder / 'session.yaml').write_text(yaml.safe_dump(data))
    return load_session(folder / 'session.yaml')


def test_what_is_measured_in_which_order(tmp_path):
    config = load(tmp_path)
    assert config.nest is NestKind.LASER
    assert [(plan.cycle, plan.kind) for plan in config.plans] == [
        ('1a-nest', Kind.NEST_CALIBRATION), ('1a-verification', Kind.STATIC),
        ('1a-scan-1', Kind.DYNAMIC), ('1a-scan-2', Kind.DYNAMIC), ('1a-scan-3', Kind.DYNAMIC),
        ('1a-static', Kind.STATIC),
        ('1b-nest', Kind.NEST_CALIBRATION), ('1b-static', Kind.STATIC),
    ]
    plain = load(tmp_path, verification=None, scan=None)
    assert [plan.cycle for plan in plain.plans] == ['1a-nest', '1a-static', '1b-nest', '1b-static']
    contact = load(tmp_path, nest=None, verification=None, scan=None, nest_calibration=None)
    assert contact.nest is NestKind.CONTACT and len(contact.plans[0].commands) == 28


def test_the_sphere_goes_through_the_cubes(tmp_path):
    config = load(tmp_path)
    for plan, edge, count in ((config.plans[0], 0.8e-3, 27), (config.plans[1], 0.8e-3, 1183)):
        off = predict(config.machine, plan.commands).centre - SPHERE
        np.testing.assert_allclose(off[[0, -1]], 0.0, atol=1e-12)
        assert len(np.unique(np.round(off, 9), axis=0)) == count == len(off) - 2
        np.testing.assert_allclose(np.abs(off).max(axis=0), edge / 2, rtol=1e-9)
        assert not plan.commands[:, 3:].any()


def test_a_scan_goes_in_lines_across_its_beam(tmp_path):
    plan = load(tmp_path).plans[3]
    assert plan.feed == pytest.approx(1.5e-3) and plan.dwell == 0.0
    off = plan.commands[:, :3] - plan.commands[0, :3]
    # Azimuth 150 deg, 45 deg down, by hand: (-sqrt(6)/4, sqrt(2)/4, -sqrt(2)/2).
    beam = np.array([-np.sqrt(6) / 4, np.sqrt(2) / 4, -np.sqrt(2) / 2])
    np.testing.assert_allclose(off @ beam, 0.0, atol=1e-12)
    ends = off[1:-1].reshape(-1, 2, 3)
    lines = ends[:, 1] - ends[:, 0]
    assert len(lines) == 9
    np.testing.assert_allclose(np.linalg.norm(lines, axis=1), 2e-3, rtol=1e-9)
    # To and fro, level, 0.25 mm apart.
    np.testing.assert_allclose(lines[1:], -lines[:-1], atol=1e-12)
    np.testing.assert_allclose(lines[:, 2], 0.0, atol=1e-12)
    steps = np.diff(ends.mean(axis=1), axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.25e-3, rtol=1e-9)


def test_a_scan_takes_the_time_of_its_feed(tmp_path):
    config = load(tmp_path)
    scan, static = config.plans[2], config.plans[5]
    path = synchronous_path(config.machine, scan)
    line = np.flatnonzero(path.pose == 2)[0]
    assert path.time[line] == pytest.approx(2.0 / 1.5)
    # A cycle without a feed is as it was.
    same = synchronous_path(config.machine, replace(static, feed=0.0))
    np.testing.assert_array_equal(synchronous_path(config.machine, static).time, same.time)


def test_a_verification_says_nothing_of_rotary_axes(tmp_path):
    config = load(tmp_path)
    verification, static = config.plans[1], config.plans[5]
    assert turns(config.machine, static) and not turns(config.machine, verification)

    def measured(plan):
        points = tuple(
            CyclePoint(row, row, command, np.zeros(5, np.int8), np.zeros(3), np.zeros((3, 3)), 1)
            for row, command in enumerate(plan.commands)
        )
        return Cycle(plan, points, (), 'id', 0)

    both = stack(config.machine, [measured(verification), measured(static)])
    assert both.cycles == ('1a-static',) and len(both) == len(static.commands)
    with pytest.raises(UserError, match='no static cycle'):
        stack(config.machine, [measured(verification)])


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({'nest': {'kind': 'light'}}, "nest: kind: expected contact or laser, got 'light'"),
        ({'nest': {'type': 'laser'}}, "nest: unknown key 'type'"),
        ({'nest': {'kind': 'contact'}}, 'verification: is of laser nests'),
        ({'sphere_radius_mm': None}, 'sphere_radius_mm: missing'),
        ({'nest': {'kind': 'laser'}}, 'nest: directions: expected a list'),
        ({'nest': {'kind': 'laser', 'directions': [{'azimuth_deg': k} for k in range(3)]}},
         'directions: 1: tilt_deg: missing'),
        ({'nest': {'kind': 'laser', 'directions': [{'azimuth_deg': k} for k in range(2)]}},
         'expected three or four, got 2'),
        ({'verification': {'edge_mm': 2}}, 'is beyond the calibrated cube of 0.8 mm'),
        ({'nest_calibration': {'step_mm': 1.0}}, "nest_calibration: unknown key 'step_mm'"),
        ({'scan': {'pitch_mm': 0.0}}, 'scan: pitch_mm: expected 0.01 to 1'),
        ({'verification': 1183}, 'verification: expected a mapping'),
    ],
)
def test_mistakes_are_one_line_with_the_key(tmp_path, changes, words):
    with pytest.raises(UserError, match=words) as error:
        load(tmp_path, **changes)
    assert '\n' not in str(error.value) and 'session.yaml' in str(error.value)
