"""The contour error: where the tool tip goes on the part, less where it should go.

Exact through `kinematics.predict`, and linear in the errors through its analytic Jacobian where
very many errors are tried.
"""

from __future__ import annotations

import numpy as np

from rtest_identification.frustum.commands import Commands
from rtest_identification.kinematics import predict


def contour_error(commands: Commands, errors: np.ndarray) -> np.ndarray:
    """Error (n, 3) of the tool tip, frame ``table`` [m], exact.

    errors : (k, 6) or (n, k, 6) errors A B C X Y Z of every axis, as `kinematics.predict` takes
        them [rad], [m]
    """
    machine, positions = commands.machine, commands.positions
    return predict(machine, positions, errors).centre - predict(machine, positions).centre


def along_normal(commands: Commands, error: np.ndarray) -> np.ndarray:
    """(n,) deviation of the surface from errors (n, 3): positive where material is left [m]."""
    return np.einsum('ni,ni->n', commands.feature.normal, error)


def jacobian(commands: Commands) -> np.ndarray:
    """(n, 3, 6 k) tool tip error per error of every axis, as `kinematics.predict` gives it."""
    return predict(commands.machine, commands.positions, jacobian=True).jacobian


def response(commands: Commands) -> np.ndarray:
    """(n, 6 k) deviation along the normal per error of every axis [m/rad], [m/m]."""
    return np.einsum('ni,nik->nk', commands.feature.normal, jacobian(commands))
