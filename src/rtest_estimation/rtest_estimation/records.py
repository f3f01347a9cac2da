"""What travels between the steps: readings, encoder feedback, plans, finished cycles.

SI units throughout (m, rad, s); time is integer nanoseconds since the epoch. The records mirror
the messages of ``rtest_msgs`` but need no ROS.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np


class Kind(IntEnum):
    """What a cycle is for (constants of ``rtest_msgs/CyclePlan``)."""

    STATIC = 0
    DYNAMIC = 1
    NEST_CALIBRATION = 2
    SPINDLE_RUNOUT = 3


class Status(IntEnum):
    """State of a single reading (``rtest_msgs/GaugeSamples.status``)."""

    VALID = 0
    OUT_OF_RANGE = 1
    NO_SIGNAL = 2
    DEVICE_ERROR = 3


class NestKind(IntEnum):
    """Measuring principle of a sensors nest (constants of ``rtest_msgs/NestCalibration``)."""

    CONTACT = 0
    LASER = 1


@dataclass(frozen=True)
class GaugeBlock:
    """Simultaneous readings of every gauge of one nest, as one message carried them.

    stamp : acquisition time of the first reading [ns]
    sequence : index of the first reading since the driver started
    period : time between readings [s]; 0 when there is one reading
    displacement : (n, channels) float64 [m], positive along the gauge direction
    status : (n, channels) uint8, see `Status`
    times : (n,) int64 [ns] of a block that is made of several messages; None for a single one
    """

    stamp: int
    sequence: int
    period: float
    displacement: np.ndarray
    status: np.ndarray
    times: np.ndarray | None = None

    @property
    def stamps(self) -> np.ndarray:
        """(n,) int64 acquisition time of every reading [ns]."""
        if self.times is not None:
            return self.times
        steps = np.arange(len(self.displacement)) * (self.period * 1e9)
        return self.stamp + np.rint(steps).astype(np.int64)


@dataclass(frozen=True)
class Feedback:
    """Encoder positions at one instant.

    stamp : [ns]; axes : letters; position : (k,) float64 [m] or [rad], in the order of `axes`.
    """

    stamp: int
    axes: tuple[str, ...]
    position: np.ndarray


@dataclass(frozen=True)
class Temperature:
    """Reading of a thermometer.

    stamp : [ns]; sensor : its name; value : [deg C]; variance : [K2], 0 where it is not known
    """

    stamp: int
    sensor: str
    value: float
    variance: float = 0.0


@dataclass(frozen=True)
class CyclePlan:
    """What the machine is commanded to do in one measurement cycle.

    stamp : start of the cycle [ns]
    sphere : (3,) nominal sphere centre, frame ``table`` [m]
    commands : (poses, axes) float64 [m] or [rad], in visiting order
    dwell : time the axes stand still at a pose [s]; 0 for a dynamic cycle
    feed : path speed of a dynamic cycle [m/s] or [rad/s]
    """

    stamp: int
    session: str
    cycle: str
    kind: Kind
    setup: str
    sphere: np.ndarray
    axes: tuple[str, ...]
    commands: np.ndarray
    dwell: float
    feed: float = 0.0
    frame: str = 'machine'


@dataclass(frozen=True)
class CyclePoint:
    """The sphere centre at one pose.

    index : row of the plan
    stamp : middle of the readings [ns]
    feedback : (axes,) mean encoder feedback, in the plan's axes [m] or [rad]
    approach : (axes,) sign of each axis's last motion before the pose: -1, 0 or +1
    displacement : (3,) sphere centre relative to the nest, frame ``table`` [m]
    covariance : (3, 3) of the displacement, from the scatter of the readings [m2]
    readings : how many readings were averaged
    disagreement : rms of what more than three gauges leave of each other [m]; 0 with three
    """

    index: int
    stamp: int
    feedback: np.ndarray
    approach: np.ndarray
    displacement: np.ndarray
    covariance: np.ndarray
    readings: int
    disagreement: float = 0.0


@dataclass(frozen=True)
class Missing:
    """A pose of the plan without a valid point, and why."""

    index: int
    reason: str


@dataclass(frozen=True)
class Cycle:
    """A finished cycle: the plan and what was measured at its poses.

    stamp : end of the cycle [ns]
    calibration : id of the nest calibration that was used; empty where there was none
    """

    plan: CyclePlan
    points: tuple[CyclePoint, ...]
    missing: tuple[Missing, ...]
    calibration: str
    stamp: int


@dataclass(frozen=True)
class NestCalibration:
    """What turns gauge readings into a sphere centre.

    direction : (gauges, 3) unit vectors, frame ``table``; V_i of Eq. 2-3
    residual : rms distance between commanded and estimated positions [m]
    sphere_radius : [m]
    covariance : (gauges, 3, 3) of each direction; empty where it is not known
    zero : (gauges,) readings with the sphere at its initial position [m]
    gain : (gauges,) length of each direction before it was made a unit vector
    gain_stddev : (gauges,) standard uncertainty of the gain
    condition : condition number of the directions; LASER: of the surface normals at the spots
    spot : LASER: (gauges, 3) where each beam meets the sphere at its initial position, relative
        to the sphere centre there [m]; P_i0 of Eq. 5-2
    correction_nodes : LASER: (n, 3) estimated centres at the calibration positions [m]
    correction_values : LASER: (n, 3) what to add to an estimate there [m] (Eq. 5-5)
    """

    calibration: str
    setup: str
    stamp: int
    direction: np.ndarray
    residual: float
    sphere_radius: float
    kind: NestKind = NestKind.CONTACT
    covariance: np.ndarray = field(default_factory=lambda: np.empty((0, 3, 3)))
    zero: np.ndarray = field(default_factory=lambda: np.empty(0))
    gain: np.ndarray = field(default_factory=lambda: np.empty(0))
    gain_stddev: np.ndarray = field(default_factory=lambda: np.empty(0))
    condition: float = float('nan')
    spot: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    correction_nodes: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    correction_values: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))

    @property
    def sensitive(self) -> np.ndarray:
        """(gauges, 3) unit vectors along which a small motion of the sphere is read.

        Of a laser the surface normal at its spot: the beam's own direction shows in the curvature
        of the sphere alone and is known to degrees only.
        """
        return self.spot / self.sphere_radius if self.kind is NestKind.LASER else self.direction
