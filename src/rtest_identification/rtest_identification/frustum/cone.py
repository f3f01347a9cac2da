"""The cone frustum of NAS 979, as in Fig. 6-1 of the thesis, and its ball-bar equivalent."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.frustum.feature import Feature
from rtest_identification.kinematics import rotation

# Points of the tool path: every degree of the cone.
POINTS = 360
_Y = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Frustum:
    """A cone frustum on the table, narrowing away from it, cut with the side of the tool.

    tilt : φ, of the cone's axis about -Y of the table, so that it leans to -X [rad]
    half_apex : ψ, between the cone's axis and its surface [rad]
    diameter : D, of the tool path circle [m]
    centre : (3,) where the normals of the surface along the tool path meet, frame ``table`` [m].
        A ball bar that measures the same path has its table-side sphere there. The centre of the
        path circle is further along the cone's axis (`circle_centre`)

    Raises UserError where it is no cone.
    """

    tilt: float
    half_apex: float
    diameter: float
    centre: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not 0.0 <= self.half_apex < math.pi / 2:
            raise UserError(
                f'psi: the half-apex angle is {math.degrees(self.half_apex):g} deg, expected 0 to '
                'less than 90'
            )
        if not abs(self.tilt) < math.pi:
            raise UserError(
                f'phi: the tilt is {math.degrees(self.tilt):g} deg, expected more than -180 and '
                'less than 180'
            )
        if not 0.0 < self.diameter < math.inf:
            raise UserError(f'diameter: {self.diameter * 1e3:g} mm, expected more than 0')

    @property
    def frame(self) -> np.ndarray:
        """(3, 3) axes of the cone as columns, frame ``table``; the third is its axis."""
        return rotation(_Y, np.array(-self.tilt))

    @property
    def height(self) -> float:
        """Of the tool path circle above `centre`, along the cone's axis [m]."""
        return 0.5 * self.diameter * math.tan(self.half_apex)

    @property
    def circle_centre(self) -> np.ndarray:
        """(3,) centre of the tool path circle, frame ``table`` [m]."""
        return np.asarray(self.centre) + self.height * self.frame[:, 2]

    @property
    def bar_length(self) -> float:
        """From `centre` to the tool path [m]."""
        return 0.5 * self.diameter / math.cos(self.half_apex)

    def about_circle(self, circle_centre: np.ndarray) -> Frustum:
        """The same cone with the centre of its tool path circle there (3,) [m]."""
        moved = np.asarray(circle_centre) - self.height * self.frame[:, 2]
        return Frustum(self.tilt, self.half_apex, self.diameter, tuple(map(float, moved)))

    def feature(self, points: int = POINTS) -> Feature:
        """The tool path, from the +X side of the circle on, right-handed about the axis.

        The last point is one step before the first one.
        """
        angle = 2.0 * np.pi * np.arange(points) / points
        radial = np.stack([np.cos(angle), np.sin(angle), np.zeros(points)], axis=1)
        along = np.array([0.0, 0.0, 1.0])
        sine, cosine = math.sin(self.half_apex), math.cos(self.half_apex)
        turn = self.frame.T
        return Feature(
            f'cone frustum, phi {math.degrees(self.tilt):g} deg, '
            f'psi {math.degrees(self.half_apex):g} deg',
            np.asarray(self.centre) + (0.5 * self.diameter * radial + self.height * along) @ turn,
            (cosine * along - sine * radial) @ turn,
            (cosine * radial + sine * along) @ turn,
            'circularity',
            1.0 / cosine,
        )

    def section(self, tip: np.ndarray) -> np.ndarray:
        """Where a surface through points meets the plane of the tool path circle.

        tip : (n, 3) frame ``table`` [m]

        Returns (n, 2) about the circle's centre [m]: each point is moved along a generatrix of the
        nominal cone. To first order its radius is D/2 + e_r + e_z tan psi.
        """
        local = (tip - self.circle_centre) @ self.frame
        radius = np.hypot(local[:, 0], local[:, 1])
        return local[:, :2] * (1.0 + local[:, 2:] * math.tan(self.half_apex) / radius[:, None])

    def bar_reading(self, tip: np.ndarray) -> np.ndarray:
        """(n,) reading of a ball bar from `centre` to the tip (n, 3): change of its length [m]."""
        return np.linalg.norm(tip - np.asarray(self.centre), axis=1) - self.bar_length
