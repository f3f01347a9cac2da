"""The machine as URDF, made from its chain, so that ROS tools show it and know its frames.

Joints have the letters of the axes, as the encoder feedback has; `frames.py` turns both into
frames. Links are `machine` (the bed), `table`, `spindle`, `sphere`, `nest_SETUP`, and what lies
between, `carried_by_AXIS`.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping

import numpy as np

from rtest_identification.machine import Axis, Machine
from rtest_identification.session_file import SessionConfig

# Sizes of what is drawn, the machine file has none [m].
_PLATE, _NEST, _SPINDLE = 0.02, 0.04, 0.03


def robot_description(
    machine: Machine, spheres: Mapping[str, np.ndarray], radius: float = 0.0127
) -> str:
    """URDF of a machine.

    spheres : set-up to (3,) nominal sphere centre, frame ``table`` [m]
    radius : of the sphere [m]
    """
    robot = ET.Element('robot', name=machine.name or 'machine')
    ET.SubElement(robot, 'link', name='machine')
    table = _side(robot, machine, machine.table_side, 'table')
    spindle = _side(robot, machine, machine.tool_side, 'spindle')
    _plate(table, machine, list(spheres.values()))
    _shape(spindle, 'cylinder', (0.0, 0.0, _NEST), radius=0.01, length=2.0 * _SPINDLE)
    sphere = _fixed(robot, 'spindle', 'sphere', machine.tool)
    _shape(sphere, 'sphere', (0.0, 0.0, 0.0), radius=radius)
    for setup, centre in spheres.items():
        nest = _fixed(robot, 'table', f'nest_{re.sub(r"[^A-Za-z0-9_]", "_", setup)}', centre)
        _shape(nest, 'box', (0.0, 0.0, -_NEST / 2.0 - radius), size=f'{_NEST} {_NEST} {_NEST}')
    ET.indent(robot)
    return ET.tostring(robot, encoding='unicode', xml_declaration=True)


def describe(session: SessionConfig) -> str:
    """URDF of a session's machine with the nest at each of its set-ups."""
    spheres = {plan.setup: plan.sphere for plan in session.plans}
    return robot_description(session.machine, spheres, session.sphere_radius)


def _side(
    robot: ET.Element, machine: Machine, names: tuple[str, ...], end: str
) -> ET.Element:
    """Links and joints from the bed outwards; returns the last link, named `end`."""
    parent = 'machine'
    for name in names:
        child = end if name == names[-1] else f'carried_by_{name}'
        link = ET.SubElement(robot, 'link', name=child)
        _joint(robot, machine.axes[name], parent, child)
        parent = child
    return link if names else _fixed(robot, 'machine', end, np.zeros(3))


def _joint(robot: ET.Element, axis: Axis, parent: str, child: str) -> None:
    bounded = math.isfinite(axis.lower) and math.isfinite(axis.upper)
    kind = 'prismatic' if not axis.rotary else 'revolute' if bounded else 'continuous'
    joint = ET.SubElement(robot, 'joint', name=axis.name, type=kind)
    ET.SubElement(joint, 'parent', link=parent)
    ET.SubElement(joint, 'child', link=child)
    # A rotary axis turns by its sense times its position.
    ET.SubElement(joint, 'axis', xyz=_text(axis.direction * (axis.sense if axis.rotary else 1)))
    if kind != 'continuous':
        # Prismatic joints need limits; one without a range in the machine file gets a wide one.
        lower, upper = (axis.lower, axis.upper) if bounded else (-10.0, 10.0)
        ET.SubElement(joint, 'limit', lower=f'{lower:.9g}', upper=f'{upper:.9g}',
                      effort='0', velocity='0')


def _fixed(robot: ET.Element, parent: str, name: str, place: np.ndarray) -> ET.Element:
    link = ET.SubElement(robot, 'link', name=name)
    joint = ET.SubElement(robot, 'joint', name=f'{parent}_to_{name}', type='fixed')
    ET.SubElement(joint, 'parent', link=parent)
    ET.SubElement(joint, 'child', link=name)
    ET.SubElement(joint, 'origin', xyz=_text(place))
    return link


def _plate(link: ET.Element, machine: Machine, spheres: list[np.ndarray]) -> None:
    """A round table below the spheres, across its innermost rotary axis."""
    turning = [n for n in machine.table_side if machine.axes[n].rotary]
    direction = machine.axes[turning[-1]].direction if turning else np.array([0.0, 0.0, 1.0])
    heights = [float(centre @ direction) for centre in spheres]
    arms = [
        float(np.linalg.norm(centre - height * direction))
        for centre, height in zip(spheres, heights, strict=True)
    ]
    below = min(heights, default=0.0) - 2.0 * _NEST
    tilt = math.acos(float(np.clip(direction[2], -1.0, 1.0)))
    turn = (0.0, tilt, math.atan2(direction[1], direction[0]) if tilt else 0.0)
    _shape(link, 'cylinder', tuple(below * direction), turn,
           radius=max([*arms, 0.06]) * 1.25, length=_PLATE)


def _shape(
    link: ET.Element, kind: str, place: tuple[float, ...],
    turn: tuple[float, ...] = (0.0, 0.0, 0.0), **sizes: float | str,
) -> None:
    visual = ET.SubElement(link, 'visual')
    ET.SubElement(visual, 'origin', xyz=_text(np.array(place)), rpy=_text(np.array(turn)))
    geometry = ET.SubElement(visual, 'geometry')
    ET.SubElement(geometry, kind, {k: str(v) for k, v in sizes.items()})


def _text(vector: np.ndarray) -> str:
    return ' '.join(f'{float(value) + 0.0:.9g}' for value in vector)
