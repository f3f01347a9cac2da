"""Whether a measuring chain is fit to measure: judged from a short recorded session.

The session is a nest calibration, a run-out, a cycle of ten visits to one pose and one in which
the sphere stands still in the nest (session file with `kind: check`). Each finding has a value, a
limit, a verdict and what to do. The limits are those at which an R-test with a noise of some
tenths of a micrometre begins to suffer, not those of a standard.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rtest_estimation import runout
from rtest_estimation.pipeline import Finished
from rtest_estimation.records import Kind, NestCalibration, NestKind
from rtest_estimation.standing import Standing
from rtest_identification.finding import OPEN, RIGHT, WRONG, Finding
from rtest_identification.noise_check import noise, temperature

# A gauge that moves by less of its direction along the nest's axis hardly sees the sphere leave.
_LEAST_ALONG = 0.2
# A gain further from one is a wrong unit or scale, not a tilted gauge.
_GAIN = 0.05
_RESIDUAL, _CONDITION = 2e-6, 4.0
_RUNOUT, _RUNOUT_FORM = 10e-6, 1e-6
_REPEATABILITY = 1e-6
# Fewer visits say little of a scatter.
_FEWEST_VISITS = 5
# A gain that is off by more makes a residual by itself.
_GAIN_SEEN = 0.005


def check_chain(
    cycles: Sequence[Finished],
    standing: Standing | None,
    temperatures: Mapping[str, tuple[np.ndarray, np.ndarray]],
    towards: np.ndarray,
    spindle_hz: float | None = None,
) -> list[Finding]:
    """Everything that a check session tells.

    temperatures : sensor to stamps [ns] and values [deg C]
    towards : (3,) unit vector from the nest to where the sphere comes from, frame ``table``
    spindle_hz : of the spindle, where it turns meanwhile
    """
    nests = [one.nest for one in cycles if one.nest is not None]
    problems = [one.problem for one in cycles if one.problem]
    found: list[Finding] = []
    if nests:
        nest = nests[-1]
        # A laser's beam need not go against the approach, and it has no gain.
        found += gauges(nest, towards) if nest.kind is NestKind.CONTACT else []
        found += calibration(nest)
    else:
        # One that was measured and gave nothing is wrong, one that was not is open.
        verdict, why = (WRONG, problems[0]) if problems else (OPEN, 'measure a nest calibration')
        found.append(Finding('nest calibration', '', '', verdict, why))
    return [
        *found, sphere_runout(cycles), repeatability(cycles), *noise(standing, spindle_hz),
        temperature(temperatures),
    ]


def gauges(nest: NestCalibration, towards: np.ndarray) -> list[Finding]:
    """Each gauge: is it pushed in when the sphere comes, and by as much as the axes move."""
    found = []
    for number, direction in enumerate(nest.direction, 1):
        along = -float(direction @ towards)
        verdict, advice = RIGHT, ''
        if along < _LEAST_ALONG:
            verdict = WRONG
            advice = 'it counts the other way: change its sign in the device file'
        if abs(along) < _LEAST_ALONG:
            advice = ('it hardly sees the sphere come; check its channel, its mounting, and '
                      '`direction` under `moves`')
        x, y, z = direction
        found.append(Finding(
            f'gauge {number} responds to', f'X {x:+.3f}, Y {y:+.3f}, Z {z:+.3f}',
            f'at least {_LEAST_ALONG:g} against the approach', verdict, advice,
        ))
    for number, gain in enumerate(nest.gain, 1):
        good = abs(gain - 1.0) <= _GAIN
        found.append(Finding(
            f'gauge {number} gain', f'{gain:.4f}', f'1 ± {_GAIN:g}', RIGHT if good else WRONG,
            '' if good else 'its unit or scale is wrong, or the axes moved by another step',
        ))
    return found


def calibration(nest: NestCalibration) -> list[Finding]:
    """Residual and geometry of the nest calibration."""
    residual, condition = nest.residual <= _RESIDUAL, nest.condition <= _CONDITION
    advice = ('a gauge sticks or is loose, or the axes do not settle; use a smaller step or a '
              'longer dwell')
    if len(nest.gain):
        worst = int(np.argmax(np.abs(nest.gain - 1.0)))
        if abs(nest.gain[worst] - 1.0) > _GAIN_SEEN:
            advice = (f'gauge {worst + 1} has a gain of {nest.gain[worst]:.4f}: correct its scale '
                      f'first; if that is right, {advice}')
    return [
        Finding(
            'nest calibration residual', f'{nest.residual * 1e6:.2f} µm',
            f'{_RESIDUAL * 1e6:g} µm', RIGHT if residual else WRONG,
            '' if residual else advice,
        ),
        Finding(
            'nest geometry, condition', f'{nest.condition:.2f}', f'{_CONDITION:g}',
            RIGHT if condition else WRONG,
            '' if condition else 'the gauges look nearly into one plane; set them at right angles '
            'to each other (1 is best)',
        ),
    ]


def sphere_runout(cycles: Sequence[Finished]) -> Finding:
    """Offset of the sphere from the spindle axis, and how round it runs."""
    what = 'sphere run-out'
    limit = f'{_RUNOUT * 1e6:g} µm, round within {_RUNOUT_FORM * 1e6:g} µm'
    turned = [one.cycle for one in cycles if one.cycle.plan.kind is Kind.SPINDLE_RUNOUT]
    if not turned:
        return Finding(what, '', limit, OPEN, 'measure it: `spindle_runout` in the session file')
    try:
        found = runout.fit(np.array([p.displacement[:2] for p in turned[-1].points]))
    except ValueError as error:
        return Finding(what, '', limit, OPEN, str(error))
    value = f'{found.radius * 1e6:.2f} µm, round within {found.residual * 1e6:.2f} µm'
    if found.residual > _RUNOUT_FORM:
        advice = 'the sphere or its stem is loose, or the spindle does not stand still'
        return Finding(what, value, limit, WRONG, advice)
    if found.radius > _RUNOUT:
        return Finding(what, value, limit, WRONG, 'centre the sphere in its holder')
    return Finding(what, value, limit, RIGHT)


def repeatability(cycles: Sequence[Finished]) -> Finding:
    """Scatter of the visits to the pose that one cycle visits most often."""
    what, limit = 'repeatability of one pose', f'{_REPEATABILITY * 1e6:g} µm rms'
    best = np.empty((0, 3))
    for one in cycles:
        if one.cycle.plan.kind is not Kind.STATIC or not one.cycle.points:
            continue
        commands = one.cycle.plan.commands[[p.index for p in one.cycle.points]]
        moved = np.array([p.displacement for p in one.cycle.points])
        _, which, counts = np.unique(
            commands.round(9), axis=0, return_inverse=True, return_counts=True
        )
        visits = moved[which.ravel() == counts.argmax()]
        best = visits if len(visits) > len(best) else best
    if len(best) < _FEWEST_VISITS:
        advice = 'measure a cycle of `kind: check`, which visits one pose ten times'
        if any(len(one.cycle.missing) > _FEWEST_VISITS for one in cycles):
            advice = 'too many poses are missing; `rtest info` says why'
        return Finding(what, f'{len(best)} visits', limit, OPEN, advice)
    scatter = float(np.sqrt(best.var(axis=0, ddof=1).sum() / 3.0))
    value = f'{scatter * 1e6:.2f} µm in {len(best)} visits'
    if scatter <= _REPEATABILITY:
        return Finding(what, value, limit, RIGHT)
    steps = np.linalg.norm(np.diff(best, axis=0), axis=1)
    across = float(np.linalg.norm(best[-1] - best[0]))
    advice = 'something is loose: nest, sphere holder, table clamping; or an axis has backlash'
    # A drift adds up over the visits, scatter does not.
    if across > 0.7 * steps.sum():
        advice = 'it drifts: let the machine and the gauges warm up'
    return Finding(what, value, limit, WRONG, advice)
