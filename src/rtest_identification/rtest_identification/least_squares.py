"""Linear least squares that says what the data do not determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_identification.symbols import RANK_TOLERANCE


@dataclass(frozen=True)
class Solution:
    """Minimum-norm least-squares solution in scaled unknowns.

    value : (p,); cofactor : (p, p) covariance over the variance factor
    inverse : (p, n) value per observation
    rank, condition : of the scaled design, condition of the determined part
    determined : (p,) bool, False where an unknown takes part in what the data leave open
    nullspace : (p, p - rank) directions the data leave open, in scaled unknowns
    """

    value: np.ndarray
    cofactor: np.ndarray
    inverse: np.ndarray
    rank: int
    condition: float
    determined: np.ndarray
    nullspace: np.ndarray


def solve(design: np.ndarray, observed: np.ndarray, scale: np.ndarray) -> Solution:
    """Solve design @ value = observed in the least-squares sense.

    Parameters
    ----------
    design : (n, p), rows whitened
    observed : (n,) or (n, m); the solution's value is then (p, m)
    scale : (p,) typical ratio of the unknowns' sizes, so that lengths and angles compare; the
        minimum norm is that of value / scale
    """
    count = design.shape[1]
    u, s, vt = np.linalg.svd(design * scale, full_matrices=False)
    rank = int(np.sum(s > RANK_TOLERANCE * s[0])) if len(s) and s[0] > 0 else 0
    kept = vt[:rank].T / s[:rank]
    inverse = scale[:, None] * (kept @ u[:, :rank].T)
    cofactor = (kept @ kept.T) * np.outer(scale, scale)
    # What vt does not span completes it: the complement of the kept right singular vectors.
    complement = np.eye(count) - vt[:rank].T @ vt[:rank]
    values, vectors = np.linalg.eigh(complement)
    nullspace = vectors[:, values > 0.5]
    determined = np.sqrt((nullspace**2).sum(axis=1)) < 1e-3
    condition = float(s[0] / s[rank - 1]) if rank else float('inf')
    return Solution(inverse @ observed, cofactor, inverse, rank, condition, determined, nullspace)
