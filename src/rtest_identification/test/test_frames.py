"""Frames from a URDF: where the kinematics have them, and what is no URDF."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_urdf import MACHINES

from rtest_identification.frames import DescriptionError, fixed, moving, read_joints
from rtest_identification.kinematics import predict
from rtest_identification.machine import parse_machine
from rtest_identification.urdf import robot_description

NEST = np.array([0.0, -0.09, 0.04])
HALF = math.sqrt(0.5)


def machine_and_joints(name):
    machine = parse_machine(MACHINES[name])
    return machine, read_joints(robot_description(machine, {'1a': NEST}))


def places(joints, positions):
    """4 x 4 matrix of every frame in the frame machine."""
    transforms, missing = moving(joints, positions)
    assert not missing
    left = [*transforms, *fixed(joints)]
    found = {'machine': np.eye(4)}
    while left:
        one = left.pop(0)
        if one.parent not in found:
            left.append(one)
            continue
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(one.quaternion).as_matrix()
        matrix[:3, 3] = one.translation
        found[one.child] = found[one.parent] @ matrix
    return found


def in_table(found, frame):
    """(3,) origin of a frame, in the frame table."""
    return (np.linalg.inv(found['table']) @ found[frame])[:3, 3]


@pytest.mark.parametrize('name', MACHINES)
def test_the_sphere_is_where_the_kinematics_have_it(name):
    machine, joints = machine_and_joints(name)
    rng = np.random.default_rng(7)
    # Angles beyond a turn too.
    for scale in (0.2, 1.0, 9.0):
        row = rng.uniform(-scale, scale, 5)
        found = places(joints, dict(zip(machine.letters, row, strict=True)))
        assert in_table(found, 'sphere') == pytest.approx(
            predict(machine, row).centre[0], abs=1e-9
        )
        assert in_table(found, 'nest_1a') == pytest.approx(NEST, abs=1e-12)
        for one in moving(joints, dict(zip(machine.letters, row, strict=True)))[0]:
            assert np.linalg.norm(one.quaternion) == pytest.approx(1.0, abs=1e-12)


def test_at_zero_every_frame_of_a_machine_without_a_tool_is_that_of_the_bed():
    machine, joints = machine_and_joints('table-table')
    found = places(joints, dict.fromkeys(machine.letters, 0.0))
    assert set(found) == {
        'machine', 'carried_by_B', 'table', 'carried_by_Y', 'carried_by_X', 'spindle', 'sphere',
        'nest_1a',
    }
    for frame in set(found) - {'nest_1a'}:
        assert found[frame] == pytest.approx(np.eye(4), abs=1e-15)
    assert found['nest_1a'][:3, 3] == pytest.approx(NEST)


def test_a_quarter_turn_of_both_axes_of_a_table():
    _, joints = machine_and_joints('table-table')
    turn = math.pi / 2.0
    positions = {'X': 0.1, 'Y': 0.2, 'Z': 0.0, 'B': turn, 'C': turn}
    transforms = {one.child: one for one in moving(joints, positions)[0]}
    # B turns the other way round: its sense is -1.
    assert (transforms['carried_by_B'].parent, transforms['table'].parent) == (
        'machine', 'carried_by_B'
    )
    assert transforms['carried_by_B'].quaternion == pytest.approx([0.0, -HALF, 0.0, HALF])
    assert transforms['table'].quaternion == pytest.approx([0.0, 0.0, HALF, HALF])
    assert transforms['carried_by_Y'].translation == pytest.approx([0.0, 0.2, 0.0])
    assert transforms['carried_by_X'].translation == pytest.approx([0.1, 0.0, 0.0])
    # (0.1, 0.2, 0) turned back about Y by -90 deg is (0, 0.2, -0.1), and then about Z by 90 deg:
    assert in_table(places(joints, positions), 'sphere') == pytest.approx([0.2, 0.0, -0.1])


def test_a_quarter_turn_of_a_head_and_of_a_table():
    _, joints = machine_and_joints('head-table')
    turn = math.pi / 2.0
    found = places(joints, {'X': 0.05, 'Y': 0.0, 'Z': 0.3, 'A': turn, 'C': turn})
    # A turns the tool (1, -2, -150) mm to (1, 150, -2) mm, Z lifts it by 300 mm.
    assert found['sphere'][:3, 3] == pytest.approx([0.001, 0.15, 0.298])
    # C turns by its sense -1; X lies on it.
    assert in_table(found, 'sphere') == pytest.approx([-0.15 - 0.05, 0.001, 0.298])


def test_a_joint_without_a_position_has_no_transform_and_is_named():
    _, joints = machine_and_joints('table-table')
    positions = {'X': 0.1, 'Y': math.nan, 'B': math.inf, 'C': 0.0, 'S': 5.0}
    transforms, missing = moving(joints, positions)
    assert {one.child for one in transforms} == {'table', 'carried_by_X'}
    assert sorted(missing) == ['B', 'Y', 'Z']
    assert {one.child for one in fixed(joints)} == {'sphere', 'nest_1a'}


URDF = """<robot name="r"><joint name="J" type="{kind}">
<parent link="a"/><child link="b"/>{more}</joint></robot>"""
OTHER = '<joint type="fixed"><parent link="c"/><child link="b"/></joint>'


def test_an_origin_that_is_turned_and_an_axis_of_any_length():
    text = URDF.format(kind='prismatic', more=(
        f'<origin xyz="1 0 0" rpy="{math.pi / 2} 0 {math.pi / 2}"/><axis xyz="2 0 0"/>'
    ))
    (one,), _ = moving(read_joints(text), {'J': 0.5})
    # The axis X is turned about X, which leaves it, and then about Z, which makes it Y.
    assert one.translation == pytest.approx([1.0, 0.5, 0.0])
    turn = Rotation.from_quat(one.quaternion)
    assert turn.apply([0.0, 1.0, 0.0]) == pytest.approx([0.0, 0.0, 1.0])
    assert turn.apply([0.0, 0.0, 1.0]) == pytest.approx([1.0, 0.0, 0.0])


def test_an_axis_that_is_not_given_is_x():
    (one,), _ = moving(read_joints(URDF.format(kind='continuous', more='')), {'J': math.pi / 2})
    assert one.quaternion == pytest.approx([HALF, 0.0, 0.0, HALF])
    assert one.translation == pytest.approx([0.0, 0.0, 0.0])


@pytest.mark.parametrize(('text', 'told'), [
    ('machine: 5', 'no URDF'),
    (URDF.format(kind='floating', more=''), "joint J: type 'floating'"),
    (URDF.format(kind='fixed', more='').replace('child', 'kid'), 'expected a parent and a child'),
    (URDF.format(kind='fixed', more='<origin xyz="1 2"/>'), "xyz is '1 2', expected three"),
    (URDF.format(kind='fixed', more='<origin rpy="0 nan 0"/>'), "rpy is '0 nan 0', expected"),
    (URDF.format(kind='prismatic', more='<axis xyz="0 0 0"/>'), 'its axis has no direction'),
    (URDF.format(kind='fixed', more='').replace('</r', f'{OTHER}</r'), 'link b: expected one'),
])
def test_what_cannot_be_followed_is_told(text, told):
    with pytest.raises(DescriptionError, match=told):
        read_joints(text)
