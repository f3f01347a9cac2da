"""The URDF of a machine moves as its kinematics do."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rtest_identification.kinematics import predict
from rtest_identification.machine import parse_machine
from rtest_identification.urdf import robot_description

MACHINES = {
    'table-table': """
name: tilting table
chain: [C, B, bed, Y, X, Z]
axes:
  X: {type: linear, direction: [1, 0, 0], range_mm: [-210, 210]}
  Y: {type: linear, direction: [0, 1, 0]}
  Z: {type: linear, direction: [0, 0, 1]}
  B: {type: rotary, direction: [0, 1, 0], sense: -1, range_deg: [-180, 160]}
  C: {type: rotary, direction: [0, 0, 1]}
""",
    'head-table': """
name: head
chain: [X, C, bed, Z, Y, A]
tool_mm: [1, -2, -150]
axes:
  X: {type: linear, direction: [1, 0, 0]}
  Y: {type: linear, direction: [0, 1, 0]}
  Z: {type: linear, direction: [0, 0, 1]}
  A: {type: rotary, direction: [1, 0, 0]}
  C: {type: rotary, direction: [0, 0, 1], sense: -1}
""",
}


def places(description, positions):
    """Rotation and place of every link in the frame machine, from the URDF alone."""
    robot = ET.fromstring(description)
    found = {'machine': (np.eye(3), np.zeros(3))}
    for joint in robot.findall('joint'):
        turn, place = found[joint.find('parent').get('link')]
        origin = joint.find('origin')
        shift = np.zeros(3) if origin is None else np.array(origin.get('xyz').split(), float)
        place = place + turn @ shift
        if joint.get('type') != 'fixed':
            axis = np.array(joint.find('axis').get('xyz').split(), float)
            value = positions[joint.get('name')]
            if joint.get('type') == 'prismatic':
                place = place + turn @ (axis * value)
            else:
                turn = turn @ Rotation.from_rotvec(axis * value).as_matrix()
        found[joint.find('child').get('link')] = (turn, place)
    return found


@pytest.mark.parametrize('name', MACHINES)
def test_the_sphere_is_in_the_table_frame_where_the_kinematics_have_it(name) -> None:
    machine = parse_machine(MACHINES[name])
    description = robot_description(machine, {'1a': np.array([0.0, -0.09, 0.04])})
    rng = np.random.default_rng(5)
    for _ in range(5):
        row = rng.uniform(-0.2, 0.2, 5)
        found = places(description, dict(zip(machine.letters, row, strict=True)))
        turn, place = found['table']
        sphere = turn.T @ (found['sphere'][1] - place)
        assert sphere == pytest.approx(predict(machine, row).centre[0], abs=1e-9)
        nest = turn.T @ (found['nest_1a'][1] - place)
        assert nest == pytest.approx([0.0, -0.09, 0.04], abs=1e-12)


def test_ranges_become_limits_and_an_axis_without_one_turns_freely() -> None:
    robot = ET.fromstring(robot_description(parse_machine(MACHINES['table-table']), {}))
    joints = {joint.get('name'): joint for joint in robot.findall('joint')}
    assert joints['C'].get('type') == 'continuous' and joints['C'].find('limit') is None
    limit = joints['B'].find('limit')
    assert float(limit.get('lower')) == pytest.approx(-np.pi)
    assert float(joints['X'].find('limit').get('upper')) == pytest.approx(0.21)
    names = [link.get('name') for link in robot.findall('link')]
    assert len(names) == len(set(names))
    assert {joint.find('child').get('link') for joint in joints.values()} | {'machine'} == set(
        names
    )
