"""Records to messages."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from rtest_msgs import msg
from std_msgs.msg import Header

from rtest_estimation.records import Cycle, CyclePlan, NestCalibration


def time(nanoseconds: int) -> Time:
    """Integer nanoseconds since the epoch to a stamp."""
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def header(nanoseconds: int, frame: str) -> Header:
    """Header with this stamp and frame."""
    return Header(stamp=time(nanoseconds), frame_id=frame)


def point(vector: np.ndarray) -> Point:
    """(3,) to a point."""
    return Point(x=float(vector[0]), y=float(vector[1]), z=float(vector[2]))


def cycle_plan(plan: CyclePlan) -> msg.CyclePlan:
    """`CyclePlan` to its message."""
    return msg.CyclePlan(
        header=header(plan.stamp, plan.frame),
        session=plan.session,
        cycle=plan.cycle,
        kind=int(plan.kind),
        setup=plan.setup,
        sphere=point(plan.sphere),
        axes=list(plan.axes),
        commands=plan.commands.ravel().tolist(),
        dwell=plan.dwell,
        feed=plan.feed,
    )


def cycle(record: Cycle) -> msg.Cycle:
    """`Cycle` to its message; reasons of missing poses go to /diagnostics."""
    return msg.Cycle(
        header=header(record.stamp, 'table'),
        plan=cycle_plan(record.plan),
        points=[
            msg.CyclePoint(
                index=p.index,
                stamp=time(p.stamp),
                feedback=p.feedback.tolist(),
                approach=p.approach.tolist(),
                displacement=point(p.displacement),
                covariance=p.covariance.ravel(),
                readings=p.readings,
            )
            for p in record.points
        ],
        missing=[m.index for m in record.missing],
        calibration=record.calibration,
    )


def nest_calibration(nest: NestCalibration) -> msg.NestCalibration:
    """`NestCalibration` to its message."""
    return msg.NestCalibration(
        header=header(nest.stamp, 'table'),
        calibration=nest.calibration,
        kind=int(nest.kind),
        sphere_radius=nest.sphere_radius,
        direction=nest.direction.ravel().tolist(),
        spot=nest.spot.ravel().tolist(),
        correction_nodes=nest.correction_nodes.ravel().tolist(),
        correction_values=nest.correction_values.ravel().tolist(),
        residual=nest.residual,
    )
