"""The simulated sensors nest: contact gauges or lasers, their mounting, noise and range."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rtest_drivers.sim import laser
from rtest_estimation.records import Status

# Slower than this the sphere stands still [m/s].
_CREEPING = 1e-4


@dataclass(frozen=True)
class LaserData:
    """What lasers have in place of contact gauges.

    radius : of the sphere [m]
    aim_error, distance_error : of a mounting, see `laser.Mounting` [m]
    """

    sensor: laser.Sensor
    radius: float
    aim_error: float = 0.0
    distance_error: float = 0.0


@dataclass(frozen=True)
class GaugeData:
    """What the gauges are.

    azimuth, tilt : (gauges,) [rad]; a gauge under the sphere points to it from `azimuth` about the
        table's Z and `tilt` below the horizontal
    direction_error : standard deviation of each direction after a mounting [rad]
    position_error : standard deviation of the nest's zero against the sphere [m]
    noise : white, of a single reading [m]
    dwell_noise : of the sphere, once per dwell in each direction [m]
    lower, upper : range [m]; period : between readings [ns]; batch : readings in a message
    outliers, outlier : share of readings, standard deviation [m]
    laser : None for contact gauges; noise and range are then the sensor's, and a mounting has
        `position_error` no more
    late : by how much the stamps are later than the encoders' [s]
    friction : how far touching probes trail the motion at `friction_speed` [m], [m/s], and with
        which power of the speed that grows
    """

    azimuth: np.ndarray
    tilt: np.ndarray
    direction_error: float
    position_error: float
    noise: float
    dwell_noise: float
    lower: float
    upper: float
    period: int
    batch: int
    outliers: float = 0.0
    outlier: float = 0.0
    laser: LaserData | None = None
    late: float = 0.0
    friction: float = 0.0
    friction_speed: float = 0.01
    friction_power: float = 0.0

    @property
    def directions(self) -> np.ndarray:
        """(gauges, 3) V_i of Eq. 2-3 as designed, frame ``table``: the way that pushes it in."""
        flat = np.cos(self.tilt)
        return np.column_stack(
            [flat * np.cos(self.azimuth), flat * np.sin(self.azimuth), -np.sin(self.tilt)]
        )


@dataclass(frozen=True)
class Nest:
    """A nest as it was mounted once.

    directions : (gauges, 3) unit vectors, frame ``table``
    origin : (3,) sphere centre at which every gauge reads zero, frame ``table`` [m]
    lower, upper : range [m]
    """

    directions: np.ndarray
    origin: np.ndarray
    lower: float = -math.inf
    upper: float = math.inf

    def measure(
        self, sphere: np.ndarray, noise: np.ndarray, to_sphere: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Readings (n, gauges) [m], held at the ends of the range, and their status uint8.

        noise : (n, gauges) [m]; to_sphere : as of a laser nest, does not matter here
        """
        readings = self.read(sphere) + noise
        held = np.clip(readings, self.lower, self.upper)
        status = np.where(held == readings, Status.VALID, Status.OUT_OF_RANGE).astype(np.uint8)
        return held, status

    def read(self, sphere: np.ndarray) -> np.ndarray:
        """(n, gauges) d_i = V_i . x [m] of sphere centres (n, 3), frame ``table`` (Eq. 2-3)."""
        return (sphere - self.origin) @ self.directions.T


def mount(data: GaugeData, sphere: np.ndarray, rng: np.random.Generator) -> Nest | laser.LaserNest:
    """Put the nest under the nominal sphere centre (3,) [m], as well as it can be done by hand."""
    if data.laser is not None:
        mounting = laser.Mounting(
            data.azimuth, data.tilt, data.direction_error, data.laser.aim_error,
            data.laser.distance_error,
        )
        return laser.mount(data.laser.sensor, mounting, sphere, data.laser.radius, rng)
    directions = data.directions + data.direction_error * rng.standard_normal((len(data.tilt), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = sphere + data.position_error * rng.standard_normal(3)
    return Nest(directions, origin, data.lower, data.upper)


def friction(data: GaugeData, velocity: np.ndarray) -> np.ndarray:
    """(n, 3) by how much the probes show the sphere behind its motion [m].

    velocity : (n, 3) of the sphere, frame ``table`` without the table's own turning [m/s]
    """
    speed = np.linalg.norm(velocity, axis=1)
    size = data.friction * (speed / data.friction_speed) ** data.friction_power
    # A sphere that hardly moves has no side on which to hang back.
    return -velocity * (size / np.maximum(speed, _CREEPING))[:, None]
