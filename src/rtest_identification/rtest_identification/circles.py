"""Average circles of a turning table, and centres of its turn, with their covariance (3.4 d)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Points on a shorter arc than this do not make a circle [rad].
SHORTEST_ARC = np.radians(45.0)
# From this many points on second harmonics can be told from scatter.
_HARMONIC_POINTS = 7
_ITERATIONS = 20


@dataclass(frozen=True)
class Circle:
    """Least-squares circle in space.

    centre : (3,) [m]; normal : (3,) unit vector; radius : [m]
    cofactor : (7, 7) covariance of centre, normal and radius over the variance of a coordinate;
        of rank 6, since the normal has the length one
    squares : sum of the squared distances from the circle [m2]; freedom : degrees of freedom. With
        seven points and more, second harmonics are not counted as scatter: a squareness of the
        linear axes makes an ellipse of every circle
    """

    centre: np.ndarray
    normal: np.ndarray
    radius: float
    cofactor: np.ndarray
    squares: float
    freedom: int

    @property
    def covariance(self) -> np.ndarray:
        """(7, 7) of centre, normal and radius, by the scatter of this circle's own points."""
        return self.cofactor * (self.squares / self.freedom)


@dataclass(frozen=True)
class Centre:
    """Centre of a turn of a sphere that nominally stands on the axis.

    displacement : (3,) of the centre from its nominal position [m]
    cofactor : (3, 3) of it over the variance of a coordinate
    squares, freedom : as in `Circle`
    """

    displacement: np.ndarray
    cofactor: np.ndarray
    squares: float
    freedom: int


def fit_circle(points: np.ndarray, towards: np.ndarray) -> Circle:
    """Circle nearest to (n, 3) points by nonlinear least squares of the distance in space.

    Each point has a distance along the normal and one along the radius; what it is off along the
    circumference does not count. `towards` is a vector on the side to which the normal points.

    Raises ValueError, saying why, where the points make no circle.
    """
    count = len(points)
    if count < 4:
        raise ValueError(f'{count} points, a circle with an uncertainty needs four')
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
    if spread[1] < 1e-3 * spread[0] or spread[0] == 0.0:
        raise ValueError('the points lie on a line' if spread[0] > 0 else 'the points coincide')
    normal = axes[2] * (1.0 if axes[2] @ towards > 0 else -1.0)
    u, v = _across(normal)
    # The algebraic circle (Kasa) in the plane is linear and a good start.
    flat = (points - middle) @ np.column_stack([u, v])
    size = spread[0]
    design = np.column_stack([flat / size, np.ones(count)])
    start, *_ = np.linalg.lstsq(design, (flat**2).sum(axis=1) / size**2, rcond=None)
    centre = middle + size * (start[0] * u + start[1] * v) / 2.0
    radius = float(np.linalg.norm(points - centre, axis=1).mean())
    for _ in range(_ITERATIONS):
        u, v = _across(normal)
        residual, jacobian = _distances(points, centre, normal, radius, u, v)
        change = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
        centre = centre + change[:3]
        normal = normal + change[3] * u + change[4] * v
        normal /= np.linalg.norm(normal)
        radius += float(change[5])
        if np.abs(change[[0, 1, 2, 5]]).max() < 1e-13 and np.abs(change[3:5]).max() < 1e-13:
            break
    u, v = _across(normal)
    residual, jacobian = _distances(points, centre, normal, radius, u, v)
    arc = covered((points - centre) @ u, (points - centre) @ v)
    if arc < SHORTEST_ARC:
        raise ValueError(
            f'the points cover {np.degrees(arc):.0f} degrees of the circle, at least '
            f'{np.degrees(SHORTEST_ARC):.0f} are needed'
        )
    if (residual**2).sum() > 2 * count * (0.05 * radius) ** 2:
        raise ValueError('the points do not lie on a circle')
    freedom = 2 * count - 6
    if count >= _HARMONIC_POINTS:
        angle = 2.0 * np.arctan2((points - centre) @ v, (points - centre) @ u)
        waves = np.kron(np.eye(2), np.column_stack([np.cos(angle), np.sin(angle)]))
        basis = np.linalg.qr(np.hstack([jacobian, waves]))[0]
        residual = residual - basis @ (basis.T @ residual)
        freedom -= 4
    spread_out = np.zeros((7, 6))
    spread_out[:3, :3] = np.eye(3)
    spread_out[3:6, 3:5] = np.column_stack([u, v])
    spread_out[6, 5] = 1.0
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    cofactor = spread_out @ inverse @ spread_out.T
    return Circle(centre, normal, radius, cofactor, float((residual**2).sum()), freedom)


def _distances(
    points: np.ndarray,
    centre: np.ndarray,
    normal: np.ndarray,
    radius: float,
    u: np.ndarray,
    v: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (2 n,), axial then radial, and Jacobian with centre, tilts to u and v, radius."""
    arm = points - centre
    axial = arm @ normal
    across = arm - axial[:, None] * normal
    length = np.linalg.norm(across, axis=1)
    outward = across / length[:, None]
    tilts = np.column_stack([arm @ u, arm @ v])
    zero, one = np.zeros((len(points), 1)), np.ones((len(points), 1))
    of_axial = np.hstack([np.broadcast_to(-normal, arm.shape), tilts, zero])
    of_radial = np.hstack([-outward, -(axial / length)[:, None] * tilts, -one])
    return np.concatenate([axial, length - radius]), np.vstack([of_axial, of_radial])


def _across(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that make a right-handed frame with the normal."""
    u = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    u /= np.linalg.norm(u)
    return u, np.cross(normal, u)


def covered(x: np.ndarray, y: np.ndarray) -> float:
    """Arc that points about the origin cover: a turn less the largest gap [rad]."""
    angles = np.sort(np.arctan2(y, x))
    gaps = np.diff([*angles, angles[0] + 2.0 * np.pi])
    return float(2.0 * np.pi - gaps.max())


def fit_centre(displacement: np.ndarray, angle: np.ndarray, direction: np.ndarray) -> Centre:
    """Centre of the turn of a sphere on the axis (centre of gravity of 3.5 b).

    What stands still in the table (the initial reset, an eccentric sphere) runs around once a
    turn. It is fitted beside the centre, so that uneven stations and missing poses do not shift
    that.

    Parameters
    ----------
    displacement : (n, 3) from the nominal position [m]; angle : (n,) turned [rad]
    direction : (3,) unit vector of the axis

    Raises ValueError, saying why, where the poses do not tell the two apart.
    """
    count = len(displacement)
    if count < 3:
        raise ValueError(f'{count} points, a centre needs three')
    arc = covered(np.cos(angle), np.sin(angle))
    if arc < SHORTEST_ARC:
        raise ValueError(
            f'the poses cover {np.degrees(arc):.0f} degrees of a turn, at least '
            f'{np.degrees(SHORTEST_ARC):.0f} are needed'
        )
    u, v = _across(direction)
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    design = np.zeros((count, 3, 5))
    design[:, :, :3] = np.eye(3)
    design[:, :, 3] = cosine * u + sine * v
    design[:, :, 4] = cosine * v - sine * u
    design = design.reshape(-1, 5)
    value, *_ = np.linalg.lstsq(design, displacement.reshape(-1), rcond=None)
    residual = displacement.reshape(-1) - design @ value
    cofactor = np.linalg.inv(design.T @ design)[:3, :3]
    return Centre(value[:3], cofactor, float((residual**2).sum()), 3 * count - 5)
