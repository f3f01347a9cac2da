"""What each error of a machine does to a feature: of one size each, or as identified.

Everything an error does is kept as its deviation along the surface normal, so that parts can be
compared, left out and added; the sum is computed with the exact kinematics besides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rtest_estimation.errors import UserError
from rtest_identification.error_field import ErrorField
from rtest_identification.frustum.commands import Commands
from rtest_identification.frustum.contour import contour_error, jacobian, response
from rtest_identification.frustum.thesis import size
from rtest_identification.gap.effects import library
from rtest_identification.gap.scene import Scene
from rtest_identification.kinematics import ERROR_LETTERS
from rtest_identification.machine import Axis
from rtest_identification.observations import Observations
from rtest_identification.symbols import ErrorParameter, location_parameters, parameter

# Trials of the uncertainty: known to 2 %.
TRIALS = 1000
# Sizes in which the parameters of effects are compared, by unit, and how they are called.
_SIZES = {
    'm': (size(False), '10 µm'),
    'rad': (size(True), '0.01°'),
    'rad/rad': (size(True) / (np.pi / 2.0), '0.01° at 90°'),
    'm/m': (size(False) / 0.1, '10 µm per 100 mm'),
    'rad/m': (size(True) / 0.1, '0.01° per 100 mm'),
    '1/m': (size(False) / 0.1**2, '10 µm at 100 mm'),
}
# Low-frequency motions are compared (6.5.2): nobody expects 0.01 deg six times a turn.
_HIGHEST_ORDER = 2
# An error that is not known is mentioned where its usual size changes the form by more [m].
_MATTERS = 0.05e-6
_LINEAR_AXES = (
    'error motions of the linear axes other than squareness are not in an identification: what '
    'they do comes on top'
)
# Key of an effect of time, which a path does not have.
DRIFT = 'drift'


@dataclass(frozen=True)
class Part:
    """One error of a model.

    size : of the error, for a person; deviation : (n,) along the normal that it makes [m]
    standard : (n,) the same for 10 µm or 0.01 deg of it; None for what is no single number
    constant : whether it is a location error or a squareness
    motion : the error motion that it is a component of; its own name where it is no component
    formula : what an effect with a name like `coning/C.2` is
    """

    name: str
    size: str
    deviation: np.ndarray
    standard: np.ndarray | None
    constant: bool
    motion: str = ''
    formula: str = ''


@dataclass(frozen=True)
class Errors:
    """The errors of a machine, and what they do to a feature.

    error, constant_error : (n, 3) of the tool tip by all of them, and by the location errors and
        squareness alone, frame ``table`` [m], exact
    draws, constant_draws : (trials, n) what they may be wrong by, along the normal [m]
    unknown : errors that matter here and are not known: neither in the errors nor in the draws
    """

    parts: tuple[Part, ...]
    error: np.ndarray
    constant_error: np.ndarray
    draws: np.ndarray
    constant_draws: np.ndarray
    notes: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()


def of_sizes(commands: Commands) -> list[Part]:
    """Every location error, squareness and slow error motion of the library in one usual size.

    10 µm or 0.01 deg; of a motion with several parameters or shapes the worst one.
    """
    slope = response(commands)
    parts = [
        Part(p.symbol, _SIZES[p.unit][1], *[size(p.angular) * slope[:, p.column]] * 2, True)
        for p in location_parameters(commands.machine)
    ]
    scene = scene_of(commands, jacobian(commands))
    for effect in library(scene):
        order = int(effect.key.partition('.')[2] or 1)
        if not effect.symbols or effect.key == DRIFT or order > _HIGHEST_ORDER:
            continue
        columns = np.concatenate([
            np.einsum('ni,nip->np', commands.feature.normal, effect.columns(scene, shape))
            * [_SIZES[p.unit][0] for p in effect.parameters]
            for shape in effect.grid
        ], axis=1)
        worst = columns[:, int(np.argmax(commands.feature.form_deviation(columns.T)))]
        parts.append(Part(
            effect.key, _SIZES[effect.parameters[0].unit][1], worst, worst, False,
            formula=effect.formula,
        ))
    return parts


def of_field(
    commands: Commands, field: ErrorField, trials: int = TRIALS, seed: int = 1
) -> Errors:
    """Of an identified machine, with the covariance of everything identified.

    Raises UserError where the path leaves the measured stations.
    """
    positions, slope = commands.positions, response(commands)
    outside = ~field.errors(positions, outside='nan').inside
    if outside.any():
        row = int(np.argmax(outside))
        try:
            field.errors(positions[row])
        except UserError as error:
            raise UserError(f'{commands.where(row)}: {error}') from None
    columns = [p.column for p in field.parameters]
    # What is not determined is taken for zero, and mentioned where it matters.
    lost = [p.symbol in field.undetermined for p in field.parameters]
    constant = np.zeros(slope.shape)
    constant[:, columns] = np.where(lost, 0.0, field.value)
    every = constant.copy()
    parts = []
    unknown: dict[str, str] = {}
    for p in field.parameters:
        if p.symbol in field.undetermined:
            unknown |= _unknown(commands, p, slope)
        else:
            parts.append(constant_part(p, float(constant[0, p.column]), slope))
    design, more = [slope[:, columns]], []
    for nodes in (field.outer, field.inner):
        if nodes is None:
            continue
        read, mine = nodes.read(positions), slope[:, nodes.columns]
        values = read.weights @ nodes.value.T
        every[:, nodes.columns] += values
        for row, column in enumerate(nodes.columns):
            letter = ERROR_LETTERS[column % 6]
            p = parameter(commands.machine, nodes.axis, letter, constant=False)
            if p.symbol in field.undetermined:
                unknown |= _unknown(commands, p, slope)
                continue
            parts.append(Part(
                p.symbol, f'{_range(values[:, row], p.angular)} on the path',
                mine[:, row] * values[:, row], None, False,
                _motion(commands.machine.axes[nodes.axis], letter),
            ))
        if nodes is field.outer:
            spread = mine[:, :, None] * read.weights[:, None, :]
            design.append(spread.reshape(len(positions), -1))
        else:
            roots = _root(nodes.covariance)
            spread = np.einsum('nm,ni,mij->nmj', read.weights, mine, roots)
            more.append(spread.reshape(len(positions), -1))
        # As if the interpolation were off by the same share of its doubt everywhere.
        more.append(mine * read.doubt)
    rng = np.random.default_rng(seed)
    draws = draw(rng, np.hstack(design) @ _root(field.covariance), trials)
    if more:
        draws = draws + draw(rng, np.hstack(more), trials)
    alone = _root(field.covariance[: len(columns), : len(columns)])
    error, constant_error = (
        contour_error(commands, values.reshape(len(positions), -1, 6))
        for values in (every, constant)
    )
    return Errors(
        tuple(parts), error, constant_error, draws, draw(rng, design[0] @ alone, trials),
        (_LINEAR_AXES, *unknown.values()), tuple(unknown),
    )


def constant_part(p: ErrorParameter, value: float, slope: np.ndarray) -> Part:
    """A constant error of some value; slope : `contour.response`."""
    column = slope[:, p.column]
    return Part(
        p.symbol, f'{value * 1e6:.2f} {"µrad" if p.angular else "µm"}', value * column,
        size(p.angular) * column, True,
    )


def _unknown(commands: Commands, p: ErrorParameter, slope: np.ndarray) -> dict[str, str]:
    """An error that is not determined, in words, where it matters."""
    standard = size(p.angular) * slope[:, p.column]
    form = float(commands.feature.form_deviation(standard))
    if form < _MATTERS:
        return {}
    return {p.symbol: (
        f'{p.symbol} was not determined and is taken for zero: {_SIZES[p.unit][1]} of it alone '
        f'would make {form * 1e6:.2f} µm'
    )}


def _motion(axis: Axis, letter: str) -> str:
    """The error motion of a rotary axis that an error is of (ISO 230-7)."""
    along = 'XYZABC'.index(letter) % 3 == int(np.argmax(np.abs(axis.direction)))
    if letter in 'ABC':
        return f'{"angle" if along else "tilt"} of {axis.name}'
    return f'{"axial" if along else "radial"} motion of {axis.name}'


def _range(values: np.ndarray, angular: bool) -> str:
    return f'{values.min() * 1e6:.2f} to {values.max() * 1e6:.2f} {"µrad" if angular else "µm"}'


def _root(covariance: np.ndarray) -> np.ndarray:
    """(..., p, p) factor F with F F^T the covariance, also of one without full rank."""
    values, vectors = np.linalg.eigh(np.nan_to_num(covariance))
    return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]


def draw(rng: np.random.Generator, factor: np.ndarray, trials: int) -> np.ndarray:
    """(trials, n) random deviations with the covariance factor factor^T."""
    return rng.standard_normal((trials, factor.shape[1])) @ factor.T


def scene_of(commands: Commands, slope: np.ndarray) -> Scene:
    """A path as the library of effects sees the poses of a session.

    slope : (n, 3, 6 k) Jacobian of the tool tip at it
    """
    count = len(commands.positions)
    zero, number = np.zeros((count, 3)), np.zeros(count, dtype=int)
    observations = Observations(
        commands.machine, ('path',), ('path',), commands.positions, zero,
        np.zeros((count, 3, 3)), commands.feature.tip, number, np.arange(count),
        commands.approach, np.zeros(count, dtype=np.int64),
    )
    return Scene(observations, slope, zero, 0)
