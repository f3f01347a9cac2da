"""The simulated laser nest: four displacement sensors, what they read on a sphere and when not.

What is fixed by the sources: ranges and spots (Table 5-1), how far from the top of a sphere of
12.7 mm radius light returns and the noise level (Table 5-2). What is chosen to agree with the rest
of the thesis:

Incidence error. Tilting the surface the other way reverses it (section 5.3.3-(5)), so it is odd in
the tilt. An odd cubic alone cannot be the whole: as large as the profile of Fig. 5-15 allows, 3 µm
at 1 mm from the top of a 50 mm sphere, it leaves less than a tenth of the 6.5 µm that Table 5-5
has in the cube of 1 mm; and made so large that it leaves 6.5 µm, it would leave 4 µm after the
thesis's correction on three levels, which cannot follow a cubic, where the thesis has 1.4 µm. What
grows with the distance from the reference distance does not show in a scan at constant distance:
a triangulating sensor that looks at the mirror reflection sees its image wander with the tilt as
soon as it is out of focus. The error is therefore

    cubic (s / s_max)^3 + defocus s d

with s the sine of the tilt in the sensor's plane and d the reading. `cubic` follows area 2 of
Table 5-2, `defocus` is set so that the mean deviation without correction is 6.5 µm; the standard
deviation is then 4.2 µm (thesis 3.8). The thesis's correction leaves 0.8 µm of it without noise,
and 1.4 +- 0.6 µm (1.4 +- 0.7) with the speckle below and a machine that positions to 0.2 µm. In
the cubes of 0.24 and 0.4 mm on the smaller sphere the model has half of Table 5-3.

Speckle. It belongs to the place on the surface: a sphere that stands still shows the same error
for ever, and again when it comes back, which is why Table 5-3 repeats to 0.5 µm. Of LK-G10's noise
level of 1 µm only half can be of this kind, or 1.4 µm after correction could not be; the rest
changes from reading to reading. The other sensors are split so that their repeatability and mean
error in Table 5-3 are possible. Spikes (LT-9010MS, up to 6 µm) are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_estimation.records import Status

# Radius of the sphere on which Table 5-2 was measured [m].
_TABLE_RADIUS = 12.7e-3
# Waves that make up the speckle of a surface; its grain is about the spot of the beam.
_WAVES = 32


@dataclass(frozen=True)
class Sensor:
    """A displacement laser.

    lower, upper : range of the readings around the reference distance [m]
    spot : diameter of the beam at the surface [m]
    steepest : sine of the largest tilt of the surface that returns light
    cubic : incidence error at that tilt [m]; defocus : per sine of the tilt and metre of reading
    speckle : standard deviation of what belongs to the place on the surface [m]
    noise : standard deviation of what changes from reading to reading [m]
    """

    lower: float
    upper: float
    spot: float
    steepest: float
    cubic: float
    defocus: float
    speckle: float
    noise: float


SENSORS = {
    'LK-G10': Sensor(
        -1e-3, 1e-3, 20e-6, 0.6e-3 / _TABLE_RADIUS, 8e-6, 1.07, 0.5e-6, 0.87e-6
    ),
    'LK-H052': Sensor(
        -10e-3, 10e-3, 50e-6, 2.5e-3 / _TABLE_RADIUS, 7.2e-6, 0.0, 4.6e-6, 2e-6
    ),
    'SI-F10': Sensor(
        -0.525e-3, 0.525e-3, 40e-6, 0.3e-3 / _TABLE_RADIUS, 0.4e-6, 0.0, 0.09e-6, 0.05e-6
    ),
    'LT-9010MS': Sensor(
        -0.3e-3, 0.3e-3, 2e-6, 1.5e-3 / _TABLE_RADIUS, 11e-6, 0.0, 0.3e-6, 0.4e-6
    ),
}


@dataclass(frozen=True)
class Mounting:
    """How a laser nest is set up.

    azimuth, tilt : (lasers,) [rad]; a laser under the sphere points to it from `azimuth` about
        the table's Z and `tilt` below the horizontal
    direction_error : standard deviation of each beam's direction [rad]
    aim_error : how far beside the sphere centre a beam passes, standard deviation [m]
    distance_error : of each reading at the initial position, standard deviation [m]
    """

    azimuth: np.ndarray
    tilt: np.ndarray
    direction_error: float = 0.0
    aim_error: float = 0.0
    distance_error: float = 0.0


@dataclass(frozen=True)
class LaserNest:
    """A nest as it was mounted once.

    radius : of the sphere [m]
    origin : (3,) sphere centre when the nest was aimed, frame ``table`` [m]
    directions : (lasers, 3) unit vectors from the sphere to the lasers, frame ``table``
    planes : (lasers, 3) unit vectors across them, in the plane of each sensor's optics
    beams : (lasers, 3) a point of each beam, relative to `origin` [m]
    zeros : (lasers,) readings at the origin [m]
    waves : (waves, 3) wave vectors of the speckle [1/m]; phases : (lasers, waves) [rad]
    """

    sensor: Sensor
    radius: float
    origin: np.ndarray
    directions: np.ndarray
    planes: np.ndarray
    beams: np.ndarray
    zeros: np.ndarray
    waves: np.ndarray
    phases: np.ndarray

    def read(
        self,
        sphere: np.ndarray,
        rng: np.random.Generator,
        to_sphere: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `measure`, with noise of the sensor's size drawn from `rng`."""
        noise = self.sensor.noise * rng.standard_normal((len(sphere), len(self.beams)))
        return self.measure(sphere, noise, to_sphere)

    def measure(
        self, sphere: np.ndarray, noise: np.ndarray, to_sphere: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Readings (n, lasers) [m] and status (n, lasers) uint8 of sphere centres (n, 3).

        sphere : frame ``table`` [m]
        noise : (n, lasers) that changes from reading to reading [m]
        to_sphere : (n, 3, 3) or (3, 3) rotation from ``table`` to the sphere, whose surface
            carries the speckle; by default the sphere turns with the table

        Without signal the reading is 0, out of range it stays at the end of the range.
        """
        sensor = self.sensor
        distance, sine, normal = self._meet(sphere - self.origin)
        reading = distance + sensor.cubic * (sine / sensor.steepest) ** 3
        reading += sensor.defocus * sine * distance
        if sensor.speckle:
            reading += self._speckle(normal, to_sphere)
        reading += noise
        held = np.clip(reading, sensor.lower, sensor.upper)
        across = normal - _dot(normal, self.directions)[..., None] * self.directions
        lost = ~(_dot(across, across) <= sensor.steepest**2)
        status = np.where(held == reading, Status.VALID, Status.OUT_OF_RANGE)
        status = np.where(lost, Status.NO_SIGNAL, status).astype(np.uint8)
        return np.where(lost, 0.0, held), status

    def _meet(self, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance read [m], tilt's sine in the sensor's plane, normal at the spot (n, l, 3).

        NaN where the beam misses the sphere.
        """
        # Foot of the perpendicular from the centre to the beam, then half the chord along it.
        to_beam = self.beams - centre[:, None]
        along = _dot(to_beam, self.directions)
        foot = to_beam - along[..., None] * self.directions
        with np.errstate(invalid='ignore'):
            chord = np.sqrt(self.radius**2 - _dot(foot, foot))
        normal = (foot + chord[..., None] * self.directions) / self.radius
        # `beams` is where each beam met the sphere at the origin: the way since then.
        return chord - along + self.zeros, _dot(normal, self.planes), normal

    def _speckle(self, normal: np.ndarray, to_sphere: np.ndarray | None) -> np.ndarray:
        surface = self.radius * normal
        if to_sphere is not None:
            turn = np.broadcast_to(to_sphere, (len(normal), 3, 3))
            surface = np.einsum('nij,nlj->nli', turn, surface)
        total = np.zeros(surface.shape[:2])
        for wave, phase in zip(self.waves, self.phases.T, strict=True):
            total += np.cos(surface @ wave + phase)
        return self.sensor.speckle * np.sqrt(2.0 / len(self.waves)) * total


def mount(
    sensor: Sensor,
    mounting: Mounting,
    sphere: np.ndarray,
    radius: float,
    rng: np.random.Generator,
) -> LaserNest:
    """Aim a nest at the nominal sphere centre (3,) [m], as well as it can be done by hand."""
    flat = np.cos(mounting.tilt)
    directions = np.column_stack(
        [flat * np.cos(mounting.azimuth), flat * np.sin(mounting.azimuth), -np.sin(mounting.tilt)]
    )
    count = len(directions)
    directions += mounting.direction_error * rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # The optics lie beside each other horizontally; a vertical sensor's lie along X.
    level = np.hypot(directions[:, 0], directions[:, 1]) > 1e-3
    planes = np.where(level[:, None], np.cross(directions, [0.0, 0.0, 1.0]), [1.0, 0.0, 0.0])
    planes -= _dot(planes, directions)[:, None] * directions
    planes /= np.linalg.norm(planes, axis=1, keepdims=True)
    aside = mounting.aim_error * rng.standard_normal((count, 3))
    aside -= _dot(aside, directions)[:, None] * directions
    depth = np.sqrt(radius**2 - _dot(aside, aside))
    return LaserNest(
        sensor, radius, np.asarray(sphere, dtype=float), directions, planes,
        aside + depth[:, None] * directions,
        mounting.distance_error * rng.standard_normal(count),
        rng.standard_normal((_WAVES, 3)) / sensor.spot,
        rng.uniform(0.0, 2.0 * np.pi, (count, _WAVES)),
    )


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(axis=-1)
