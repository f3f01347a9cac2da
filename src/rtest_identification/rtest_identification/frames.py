"""Frames of a machine at given positions of its axes, from its URDF: what tf is made of.

Every joint of a URDF gives one transform, of its child link in its parent link. Those of fixed
joints stay; those of moving joints follow the position that has the joint's name.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

FIXED, PRISMATIC = 'fixed', 'prismatic'
_KINDS = (FIXED, PRISMATIC, 'revolute', 'continuous')


class DescriptionError(ValueError):
    """A text that is no URDF, or has a joint that cannot be followed; says which and why."""


@dataclass(frozen=True)
class Transform:
    """Where a frame is in its parent.

    translation : (3,) origin of the child, in the parent [m]
    quaternion : (4,) x y z w, turns vectors from the child into the parent
    """

    parent: str
    child: str
    translation: np.ndarray
    quaternion: np.ndarray


@dataclass(frozen=True)
class Joint:
    """One joint of a URDF.

    name : of a moving joint, the letter of its axis
    kind : 'fixed', 'prismatic', 'revolute' or 'continuous'
    place, turn : of the child in the parent while the joint is at zero; place (3,) [m]
    axis : (3,) unit vector, in the child; along it or about it the child moves
    """

    name: str
    kind: str
    parent: str
    child: str
    place: np.ndarray
    turn: Rotation
    axis: np.ndarray

    def at(self, position: float = 0.0) -> Transform:
        """The transform at a position [m] or [rad]."""
        place, turn = self.place, self.turn
        if self.kind == PRISMATIC:
            place = place + turn.apply(self.axis * position)
        elif self.kind != FIXED:
            turn = turn * Rotation.from_rotvec(self.axis * position)
        return Transform(self.parent, self.child, place, turn.as_quat())


def read_joints(description: str) -> tuple[Joint, ...]:
    """The joints of a URDF, in its order. Raises DescriptionError."""
    try:
        robot = ET.fromstring(description)
    except ET.ParseError as error:
        raise DescriptionError(f'no URDF: {error}') from None
    joints = tuple(_joint(element) for element in robot.findall('joint'))
    children = [joint.child for joint in joints]
    for child in set(children):
        if children.count(child) > 1:
            raise DescriptionError(f'link {child}: expected one joint that carries it')
    return joints


def fixed(joints: Sequence[Joint]) -> list[Transform]:
    """Transforms that never change."""
    return [joint.at() for joint in joints if joint.kind == FIXED]


def moving(
    joints: Sequence[Joint], positions: Mapping[str, float]
) -> tuple[list[Transform], list[str]]:
    """Transforms of the moving joints, and the names of those that have no position.

    positions : by the name of the joint [m] or [rad]; NaN is none
    """
    found, missing = [], []
    for joint in joints:
        if joint.kind == FIXED:
            continue
        position = positions.get(joint.name, math.nan)
        if math.isfinite(position):
            found.append(joint.at(position))
        else:
            missing.append(joint.name)
    return found, missing


def _joint(element: ET.Element) -> Joint:
    name, kind = element.get('name', ''), element.get('type', '')
    if kind not in _KINDS:
        raise DescriptionError(f'joint {name}: type {kind!r}, expected {", ".join(_KINDS)}')
    ends = [element.find(end) for end in ('parent', 'child')]
    parent, child = ('' if end is None else end.get('link', '') for end in ends)
    if not parent or not child:
        raise DescriptionError(f'joint {name}: expected a parent and a child link')
    origin = element.find('origin')
    axis = _numbers(name, element.find('axis'), 'xyz', '1 0 0')
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        raise DescriptionError(f'joint {name}: its axis has no direction')
    return Joint(
        name, kind, parent, child,
        place=_numbers(name, origin, 'xyz', '0 0 0'),
        # About X, then Y, then Z of the parent, as URDF has it.
        turn=Rotation.from_euler('xyz', _numbers(name, origin, 'rpy', '0 0 0')),
        axis=axis / length,
    )


def _numbers(joint: str, element: ET.Element | None, key: str, usual: str) -> np.ndarray:
    """(3,) an attribute of a joint's element."""
    text = usual if element is None else element.get(key, usual)
    try:
        numbers = np.array([float(word) for word in text.split()])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise DescriptionError(f'joint {joint}: {key} is {text!r}, expected three numbers')
    return numbers
