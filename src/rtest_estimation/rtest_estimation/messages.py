"""Messages to records, by field name: works on rclpy messages and on those rosbags reads."""

from __future__ import annotations

from typing import Any

import numpy as np

from rtest_estimation.plain_text import is_name
from rtest_estimation.records import (
    Cycle,
    CyclePlan,
    CyclePoint,
    Feedback,
    GaugeBlock,
    Kind,
    Missing,
    NestCalibration,
    NestKind,
    Temperature,
)

# A period or a channel count beyond these is a damaged message, not a gauge.
MAX_CHANNELS = 16
MAX_PERIOD_S = 3600.0
# No machine goes farther, nor turns a spindle more often in a session [m, rad].
MAX_COMMAND = 1000.0
MAX_POSITION = 1e6


class MessageError(ValueError):
    """A message whose fields contradict each other; says which and what is expected."""


def nanoseconds(stamp: Any) -> int:
    """`builtin_interfaces/Time` to integer nanoseconds since the epoch."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def gauge_block(message: Any) -> GaugeBlock:
    """`rtest_msgs/GaugeSamples` to a `GaugeBlock`.

    Raises MessageError where the array sizes do not fit the number of channels.
    """
    channels = int(message.channels)
    displacement = np.array(message.displacement, dtype=float)
    status = np.array(message.status, dtype=np.uint8)
    if not 1 <= channels <= MAX_CHANNELS:
        raise MessageError(f'GaugeSamples.channels is {channels}, expected 1 to {MAX_CHANNELS}')
    if displacement.size % channels or status.size != displacement.size or not displacement.size:
        raise MessageError(
            f'GaugeSamples has {displacement.size} displacements and {status.size} status values, '
            f'expected readings x {channels} of each'
        )
    period = float(message.period)
    readings = displacement.size // channels
    if not 0.0 <= period <= MAX_PERIOD_S or (readings > 1 and period == 0.0):
        raise MessageError(f'GaugeSamples.period is {period} s with {readings} readings')
    return GaugeBlock(
        nanoseconds(message.header.stamp),
        int(message.sequence),
        period,
        displacement.reshape(readings, channels),
        status.reshape(readings, channels),
    )


def feedback(message: Any) -> Feedback:
    """`sensor_msgs/JointState` to `Feedback`.

    Raises MessageError where names and positions differ in number.
    """
    axes = tuple(str(name) for name in message.name)
    position = np.array(message.position, dtype=float)
    if position.shape != (len(axes),) or not axes:
        raise MessageError(
            f'JointState has {len(axes)} names and {position.size} positions, expected one each'
        )
    if not all(map(is_name, axes)):
        raise MessageError('JointState has names that are no letters of axes')
    # Without a number for an axis the others still count; with a wrong one nothing does.
    if (np.abs(position) > MAX_POSITION).any():
        raise MessageError(f'JointState has a position of {np.nanmax(np.abs(position)):g}')
    return Feedback(nanoseconds(message.header.stamp), axes, position)


def temperature(message: Any) -> Temperature:
    """`sensor_msgs/Temperature` to a `Temperature`; its frame names the sensor.

    Raises MessageError where the frame is no name for a formula or the value no number.
    """
    sensor, value = str(message.header.frame_id), float(message.temperature)
    if not (sensor.isascii() and sensor.isidentifier()):
        raise MessageError(
            f'Temperature.header.frame_id is {sensor!r}, expected the name of the sensor in '
            'letters, digits and _'
        )
    if not np.isfinite(value):
        raise MessageError(f'Temperature of {sensor} is {value}')
    return Temperature(
        nanoseconds(message.header.stamp), sensor, value, float(message.variance)
    )


def cycle_plan(message: Any) -> CyclePlan:
    """`rtest_msgs/CyclePlan` to a `CyclePlan`.

    Raises MessageError where the plan cannot be measured.
    """
    axes = tuple(str(axis) for axis in message.axes)
    names = (str(message.session), str(message.cycle), str(message.setup), *axes)
    if not all(map(is_name, (*names, message.header.frame_id))):
        raise MessageError('CyclePlan has names that cannot be printed in a line')
    where = f'CyclePlan {message.cycle!r}'
    commands = np.array(message.commands, dtype=float)
    if not axes or len(set(axes)) != len(axes):
        raise MessageError(f'{where}: axes are {list(axes)}, expected distinct letters')
    if not commands.size or commands.size % len(axes):
        raise MessageError(
            f'{where}: {commands.size} commands, expected poses x {len(axes)} axes'
        )
    if not (np.abs(commands) <= MAX_COMMAND).all():
        raise MessageError(
            f'{where}: commands hold values that are not finite or beyond {MAX_COMMAND:g} m or rad'
        )
    try:
        kind = Kind(int(message.kind))
    except ValueError:
        raise MessageError(f'{where}: kind is {message.kind}, expected 0 to 3') from None
    dwell = float(message.dwell)
    if not 0.0 <= dwell <= MAX_PERIOD_S:
        raise MessageError(f'{where}: dwell is {dwell} s, expected 0 to {MAX_PERIOD_S:.0f}')
    if kind in (Kind.STATIC, Kind.NEST_CALIBRATION) and dwell == 0.0:
        raise MessageError(f'{where}: dwell is 0 s, a static cycle needs a time to stand still')
    sphere = np.array([message.sphere.x, message.sphere.y, message.sphere.z], dtype=float)
    if not (np.abs(sphere) <= MAX_COMMAND).all():
        raise MessageError(f'{where}: the sphere position is {sphere} m')
    feed = float(message.feed)
    if not 0.0 <= feed <= MAX_COMMAND:
        raise MessageError(f'{where}: feed is {feed} m/s')
    return CyclePlan(
        nanoseconds(message.header.stamp),
        str(message.session),
        str(message.cycle),
        kind,
        str(message.setup),
        sphere,
        axes,
        commands.reshape(-1, len(axes)),
        dwell,
        feed,
        str(message.header.frame_id),
    )


def cycle(message: Any) -> Cycle:
    """`rtest_msgs/Cycle` to a `Cycle`; the reasons of missing poses are not in the message."""
    points = tuple(
        CyclePoint(
            int(point.index),
            nanoseconds(point.stamp),
            np.array(point.feedback, dtype=float),
            np.array(point.approach, dtype=np.int8),
            np.array([point.displacement.x, point.displacement.y, point.displacement.z]),
            np.array(point.covariance, dtype=float).reshape(3, 3),
            int(point.readings),
        )
        for point in message.points
    )
    missing = tuple(Missing(int(index), 'see /diagnostics') for index in message.missing)
    return Cycle(
        cycle_plan(message.plan),
        points,
        missing,
        str(message.calibration),
        nanoseconds(message.header.stamp),
    )


def nest_calibration(message: Any, setup: str = '') -> NestCalibration:
    """`rtest_msgs/NestCalibration` to a `NestCalibration`.

    The readings at the initial position are not in the message: what is read from one holds for
    readings relative to those.

    Raises MessageError where the array sizes do not fit each other.
    """
    names = ('direction', 'spot', 'correction_nodes', 'correction_values')
    arrays = {name: np.array(getattr(message, name), dtype=float) for name in names}
    sizes = {name: array.size for name, array in arrays.items()}
    kind = NestKind(int(message.kind))
    if (
        any(size % 3 for size in sizes.values())
        or sizes['correction_nodes'] != sizes['correction_values']
        or sizes['spot'] not in ((sizes['direction'],) if kind is NestKind.LASER else (0,))
    ):
        raise MessageError(
            f'NestCalibration {message.calibration!r}: '
            + ', '.join(f'{name} has {size} values' for name, size in sizes.items())
            + '; expected three for each gauge or node, and a spot for each laser'
        )
    direction, spot, nodes, values = (array.reshape(-1, 3) for array in arrays.values())
    return NestCalibration(
        str(message.calibration),
        setup,
        nanoseconds(message.header.stamp),
        direction,
        float(message.residual),
        float(message.sphere_radius),
        kind,
        spot=spot,
        correction_nodes=nodes,
        correction_values=values,
    )
