"""Commissioning: does the controller answer, how fast, with what."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rtest_estimation.records import Feedback


class Watched(Protocol):
    """A backend of the CNC driver that tells of itself."""

    @property
    def rate(self) -> float:
        """How often it is to give feedback [1/s]."""

    def open(self) -> None:
        """Connect."""

    def read(self, timeout: float) -> list[Feedback]:
        """Feedback since the last call."""

    def close(self) -> None:
        """Disconnect."""

    def problem(self) -> str:
        """What is wrong while the connection stands, in one line; '' where all is well."""

    def uncertainty(self) -> float:
        """Of the stamps [s]; NaN where it is not known."""

    def told(self) -> dict[str, str]:
        """What diagnostics show."""


@dataclass(frozen=True)
class CncCheck:
    """What a controller did for some time.

    answers : whether it could be opened and gave feedback
    problem : what is wrong, '' where nothing is
    rate, wanted_rate : feedback a second, and what the device file asks for [1/s]
    jitter, gap : standard deviation and largest of the time between two stamps [s]; NaN where
        fewer than three came
    uncertainty : of the stamps [s]
    position : axis to its last value [m] or [rad]
    frozen : whether no digit of any axis has changed: it stands still, or its values are dead
    told : what else it tells of itself
    """

    answers: bool
    problem: str
    rate: float = math.nan
    jitter: float = math.nan
    gap: float = math.nan
    uncertainty: float = math.nan
    position: dict[str, float] | None = None
    frozen: bool = False
    told: dict[str, str] | None = None
    wanted_rate: float = math.nan


def check(backend: Watched, seconds: float = 2.0) -> CncCheck:
    """Open a controller, follow it for `seconds`, close it; never raises ConnectionError."""
    feedback: list[Feedback] = []
    try:
        backend.open()
        limit = time.monotonic() + seconds
        while (left := limit - time.monotonic()) > 0.0:
            feedback += backend.read(min(left, 0.2))
        found = backend.problem(), backend.uncertainty(), backend.told()
    except ConnectionError as error:
        found = str(error), math.nan, {}
    finally:
        backend.close()
    problem, uncertainty, told = found
    if not feedback:
        return CncCheck(
            False, problem or f'no feedback in {seconds:g} s', told=told, wanted_rate=backend.rate
        )
    steps = np.diff([one.stamp for one in feedback]) * 1e-9
    known = len(steps) > 1
    last = feedback[-1]
    return CncCheck(
        True,
        problem,
        1.0 / float(steps.mean()) if known else math.nan,
        float(steps.std()) if known else math.nan,
        float(steps.max()) if known else math.nan,
        uncertainty,
        dict(zip(last.axes, map(float, last.position), strict=True)),
        known and all(np.array_equal(one.position, last.position) for one in feedback),
        told,
        backend.rate,
    )
