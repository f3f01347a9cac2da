"""The simulated encoders: noise, steps and faults of the feedback."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rtest_drivers.sim.faults import Window, active
from rtest_drivers.sim.motion import SPINDLE
from rtest_estimation.records import Feedback
from rtest_identification.machine import Machine


@dataclass(frozen=True)
class Encoders:
    """Encoder feedback: period [ns]; of linear [m] and rotary axes [rad] white noise and steps."""

    period: int
    linear_noise: float
    rotary_noise: float
    linear_step: float = 0.0
    rotary_step: float = 0.0


class EncoderReadings:
    """Feedback in order of time: every one draws its noise.

    axes : of the feedback; noise : where the numbers come from
    """

    def __init__(
        self, data: Encoders, machine: Machine, axes: Sequence[str], noise: np.random.Generator
    ) -> None:
        rotary = np.array([name == SPINDLE or machine.axes[name].rotary for name in axes])
        self._axes, self._random = tuple(axes), noise
        self._noise = np.where(rotary, data.rotary_noise, data.linear_noise)
        self._step = np.where(rotary, data.rotary_step, data.linear_step)
        self._latest: Feedback | None = None

    def read(
        self, times: np.ndarray, positions: np.ndarray, windows: Iterable[Window]
    ) -> list[Feedback]:
        """The next feedback as it arrives.

        times : (n,) [ns]; positions : (n, axes) of the machine [m] and [rad]; windows : of the
            faults
        """
        positions = positions + self._random.standard_normal(positions.shape) * self._noise
        if self._step.any():
            step = self._step
            stepped = np.round(positions / np.where(step, step, 1.0)) * step
            positions = np.where(step, stepped, positions)
        stale = active(windows, 'feedback_stale', times)
        silent = active(windows, 'feedback_silent', times)
        feedback = []
        for index, time in enumerate(times):
            fresh = Feedback(int(time), self._axes, positions[index])
            if self._latest is None or not stale[index]:
                self._latest = fresh
            if not silent[index]:
                feedback.append(self._latest)
        return feedback
