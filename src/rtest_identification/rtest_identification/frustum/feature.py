"""A toleranced feature, as the way of the tool that makes it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

# Of a displacement of the part of which its surface shows less than this share of the largest, the
# part is not placed by it: a round one turned about its axis. The normals of a path that is given
# to a few digits show it a little.
_HIDDEN = 1e-2


@dataclass(frozen=True)
class Feature:
    """Points of a surface and the tool that cuts them.

    As in section 6.3 of the thesis the tool has no radius: its tip runs along the surface.

    tip : (n, 3) tool tip, frame ``table`` [m]
    axis : (n, 3) unit vectors from the tip into the spindle, frame ``table``
    normal : (n, 3) unit normals of the surface, out of the material, frame ``table``
    quantity : what its form deviation is called
    scale : form deviation per deviation along the normal; a cone's circularity counts across its
        axis and not along its normal
    weight : (n,) length of the path that a point stands for [m]; alike where omitted
    """

    name: str
    tip: np.ndarray
    axis: np.ndarray
    normal: np.ndarray
    quantity: str = 'form deviation'
    scale: float = 1.0
    weight: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.tip)

    @property
    def length(self) -> np.ndarray:
        """(n,) way of the tool tip from the first point [m]."""
        steps = np.linalg.norm(np.diff(self.tip, axis=0), axis=1)
        return np.r_[0.0, np.cumsum(steps)]

    @cached_property
    def shares(self) -> np.ndarray:
        """(n,) weights that add up to one."""
        weight = np.ones(len(self)) if self.weight is None else self.weight
        return weight / weight.sum()

    @cached_property
    def placements(self) -> np.ndarray:
        """(n, r) deviations that small displacements of the whole part make, orthonormal.

        For a cone these are a constant and the first harmonic: what a circle's size and centre
        take up.
        """
        arm = self.tip - self.tip.mean(axis=0)
        size = max(float(np.linalg.norm(arm, axis=1).max()), 1e-9)
        columns = np.hstack([self.normal, np.cross(arm / size, self.normal)])
        root = np.sqrt(self.shares)[:, None]
        u, s, _ = np.linalg.svd(columns * root, full_matrices=False)
        return u[:, s > _HIDDEN * s[0]] / root

    def form(self, deviation: np.ndarray) -> np.ndarray:
        """What is left of deviations when the part is placed best (least squares over the path).

        deviation : (..., n) along the normals, positive where material is left [m]

        Returns (..., n) [m], scaled. To first order a part displaced as a whole has none: what an
        R-test cannot see, where the part sits on the table, does not matter.
        """
        basis = self.placements
        return self.scale * (deviation - ((deviation * self.shares) @ basis) @ basis.T)

    def form_deviation(self, deviation: np.ndarray) -> np.ndarray:
        """(...) peak to peak of `form` [m]; of a cone the least-squares circularity."""
        return np.ptp(self.form(deviation), axis=-1)
