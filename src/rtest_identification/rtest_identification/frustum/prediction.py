"""The predicted form of a feature, its uncertainty, and which error makes it (section 6.6)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rtest_identification.frustum.circles import (
    least_squares_circle,
    minimum_zone_circle,
    zone_width,
)
from rtest_identification.frustum.commands import Commands
from rtest_identification.frustum.cone import Frustum
from rtest_identification.frustum.contour import along_normal
from rtest_identification.frustum.sources import Errors, Part


@dataclass(frozen=True)
class Form:
    """The form of a feature under some errors [m].

    profile : (n,) deviation along the normal with the part placed best, scaled
    deviation : peak to peak of it; for a cone, circularity about the least-squares circle, exact
    zone : for a cone, circularity about the minimum-zone circle, exact; else None
    bar : for a cone, peak to peak of what a ball bar reads about its least-squares circle
    lowest, highest : deviation along the normal as cut, before the part is placed
    """

    profile: np.ndarray
    deviation: float
    zone: float | None
    bar: float | None
    lowest: float
    highest: float


@dataclass(frozen=True)
class Ranked:
    """What one error does to the form [m].

    alone : form deviation that it makes alone; without : that of all errors but this one, None
    where there is no sum; standard : by 10 µm or 0.01 deg of it, None for what is no one number;
    formula : of an effect that its name does not say
    """

    name: str
    size: str
    alone: float
    without: float | None
    standard: float | None
    constant: bool
    formula: str = ''


@dataclass(frozen=True)
class Prediction:
    """What a machine does to a feature.

    form : under all errors; stddev : standard uncertainty of its deviation [m]
    zone_stddev : of the minimum-zone circularity, None where there is none
    floor : mean form deviation that the uncertainty alone would show [m]
    profile_stddev : (n,) of the profile [m]
    constant, constant_stddev : the same under location errors and squareness alone (Fig. 6-9 a)
    varying : under all that is not constant (Fig. 6-9 b), to first order
    motions : form deviation by each error motion that is not constant, the largest first [m]; its
        components may cancel in part
    unknown : errors that matter here and are not in any of these, uncertainties included
    """

    commands: Commands
    form: Form
    stddev: float
    zone_stddev: float | None
    floor: float
    profile_stddev: np.ndarray
    constant: Form
    constant_stddev: float
    varying: Form
    motions: dict[str, float]
    ranking: tuple[Ranked, ...]
    notes: tuple[str, ...]
    unknown: tuple[str, ...] = ()


def form(commands: Commands, error: np.ndarray, cone: Frustum | None = None) -> Form:
    """The form that errors (n, 3) of the tool tip make, frame ``table`` [m].

    cone : where the feature is its tool path
    """
    feature = commands.feature
    deviation = along_normal(commands, error)
    profile = feature.form(deviation)
    ends = float(deviation.min()), float(deviation.max())
    if cone is None:
        return Form(profile, float(np.ptp(profile)), None, None, *ends)
    tip = feature.tip + error
    points = cone.section(tip)
    bar = feature.form_deviation(cone.bar_reading(tip)) / feature.scale
    return Form(
        profile, least_squares_circle(points).circularity,
        minimum_zone_circle(points).circularity, float(bar), *ends,
    )


def predict_form(commands: Commands, errors: Errors, cone: Frustum | None = None) -> Prediction:
    """Form, uncertainty and ranking of a feature under the errors of a machine."""
    feature = commands.feature
    every = form(commands, errors.error, cone)
    constant = form(commands, errors.constant_error, cone)
    profiles = feature.form(along_normal(commands, errors.error) + errors.draws)
    constants = along_normal(commands, errors.constant_error) + errors.constant_draws
    zone_stddev = None
    if cone is not None:
        angle = 2.0 * np.pi * np.arange(len(feature)) / len(feature)
        zone_stddev = float(zone_width(angle, profiles).std())
    return Prediction(
        commands, every, float(np.ptp(profiles, axis=1).std()), zone_stddev,
        float(feature.form_deviation(errors.draws).mean()), profiles.std(axis=0), constant,
        float(feature.form_deviation(constants).std()),
        form(commands, errors.error - errors.constant_error, cone),
        _motions(commands, errors.parts),
        rank(commands, errors.parts, summed=True), (*commands.notes, *errors.notes),
        errors.unknown,
    )


def rank(commands: Commands, parts: Sequence[Part], summed: bool = False) -> tuple[Ranked, ...]:
    """Errors by what they do alone, the largest first.

    summed : whether the parts make up a machine, so that one can be taken out of all
    """
    judge = commands.feature.form_deviation
    total = sum(part.deviation for part in parts) if summed else None
    ranked = [
        Ranked(
            part.name, part.size, float(judge(part.deviation)),
            None if total is None else float(judge(total - part.deviation)),
            None if part.standard is None else float(judge(part.standard)), part.constant,
            part.formula,
        )
        for part in parts
    ]
    return tuple(sorted(ranked, key=lambda one: -one.alone))


def _motions(commands: Commands, parts: Sequence[Part]) -> dict[str, float]:
    sums: dict[str, np.ndarray] = {}
    for part in parts:
        if not part.constant:
            name = part.motion or part.name
            sums[name] = sums.get(name, 0.0) + part.deviation
    judged = {name: float(commands.feature.form_deviation(d)) for name, d in sums.items()}
    return dict(sorted(judged.items(), key=lambda item: -item[1]))


def diagnosis(found: Prediction) -> str:
    """In words: what location errors explain, what the rest does, and which error matters most."""
    every, constant, varying = (
        f'{one.deviation * 1e6:.2f} µm' for one in (found.form, found.constant, found.varying)
    )
    text = f'location errors and squareness alone make {constant} of {every}'
    if not found.motions:
        return f'{text}; nothing else is known of the machine'
    name, worst = next(iter(found.motions.items()))
    return (
        f'{text}, what changes along the path alone {varying}, most of it {name} '
        f'({worst * 1e6:.2f} µm alone)'
    )
