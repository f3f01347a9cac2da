"""Trying controllers on lines before a session: what answers, how often, how evenly."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rtest_drivers.clock import HostClock
from rtest_drivers.gauges.align import Sample
from rtest_drivers.gauges.config import ControllerConfig
from rtest_drivers.gauges.controller import Controller
from rtest_estimation.records import Status

# Longest wait for the first answers; a network takes longer than a port [s].
_START_S = 8.0


@dataclass(frozen=True)
class ChannelCheck:
    """One gauge or thermometer.

    channel : in the nest, or in the order of its device file, from 1
    last : last valid reading, in the nest's sense [m], or [deg C]; NaN where there was none
    status : of the last reading; None where there was none
    noise : standard deviation of a single reading [m] or [K], from the differences of neighbours,
        so that a drift is not in it; NaN with fewer than three valid readings
    """

    channel: int
    last: float
    status: Status | None
    noise: float


@dataclass(frozen=True)
class ControllerCheck:
    """One controller; times are NaN where there were too few readings.

    problem : '' where it answers, else what is wrong and what to do
    note : why the last reading that was not valid was not
    rate, wanted_rate : readings a second, and what the device file asks for [1/s]
    interval_std, interval_max : of the times between readings [s]
    skew_mean, skew_max : distance in time to the nearest reading of the first controller [s]
    stamp_uncertainty : largest one of a reading's time [s]
    unit, limits : from the device file, the latter [m] or [deg C] or None
    unanswered : questions without a legal answer
    """

    port: str
    protocol: str
    problem: str
    note: str
    rate: float
    wanted_rate: float
    interval_std: float
    interval_max: float
    skew_mean: float
    skew_max: float
    stamp_uncertainty: float
    unit: str
    limits: tuple[float, float] | None
    unanswered: int
    channels: tuple[ChannelCheck, ...]


def check_controllers(
    configs: Sequence[ControllerConfig], seconds: float = 2.0
) -> tuple[ControllerCheck, ...]:
    """Ask every controller for some seconds; one result each, in the order of the device file.

    Raises nothing where a controller does not answer: that is a result.
    """
    clock, changed = HostClock(), threading.Condition()
    samples: list[list[tuple[int, Sample]]] = [[] for _ in configs]

    def notify() -> None:
        with changed:
            changed.notify_all()

    controllers = [
        Controller(one, clock, _collect(found), notify)
        for one, found in zip(configs, samples, strict=True)
    ]
    for controller in controllers:
        controller.start()
    with changed:
        changed.wait_for(lambda: all(c.problem is not None for c in controllers), _START_S)
    time.sleep(seconds)
    for controller in controllers:
        controller.stop()
    for controller in controllers:
        controller.join()
        if controller.failure is not None:
            raise controller.failure
    first = _times(samples[0])
    return tuple(
        _result(controller, found, first)
        for controller, found in zip(controllers, samples, strict=True)
    )


def _collect(found: list[tuple[int, Sample]]) -> Callable[[int, Sample], None]:
    return lambda index, sample: found.append((index, sample))


def _times(found: list[tuple[int, Sample]]) -> np.ndarray:
    """(n,) stamps of the first question's readings [ns]."""
    return np.array([sample.stamp for index, sample in found if index == 0], dtype=np.int64)


def _result(
    controller: Controller, found: list[tuple[int, Sample]], first: np.ndarray
) -> ControllerCheck:
    config = controller.config
    times = _times(found)
    gaps = np.diff(times) * 1e-9
    skew = _distance(times, first)
    problem = controller.problem
    return ControllerCheck(
        port=config.port,
        protocol=config.name,
        problem='no answer yet' if problem is None else problem,
        note=controller.note,
        rate=1.0 / float(gaps.mean()) if len(gaps) else np.nan,
        wanted_rate=config.rate,
        interval_std=float(gaps.std()) if len(gaps) else np.nan,
        interval_max=float(gaps.max()) if len(gaps) else np.nan,
        skew_mean=float(skew.mean()) if len(skew) else np.nan,
        skew_max=float(skew.max()) if len(skew) else np.nan,
        stamp_uncertainty=max((sample.uncertainty for _, sample in found), default=np.nan),
        unit=config.unit,
        limits=config.limits,
        unanswered=controller.errors,
        channels=_channels(config, found),
    )


def _channels(
    config: ControllerConfig, found: list[tuple[int, Sample]]
) -> tuple[ChannelCheck, ...]:
    results, channels = [], iter(config.channels)
    for index, query in enumerate(config.protocol.queries):
        samples = [sample for number, sample in found if number == index]
        for output in range(query.outputs):
            values = np.array([sample.values[output] for sample in samples])
            valid = values[np.isfinite(values)]
            noise = np.sqrt(np.mean(np.diff(valid) ** 2) / 2.0) if len(valid) > 2 else np.nan
            results.append(
                ChannelCheck(
                    next(channels) + 1,
                    float(valid[-1]) if len(valid) else np.nan,
                    samples[-1].status[output] if samples else None,
                    float(noise),
                )
            )
    return tuple(results)


def _distance(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(n,) time from each of `times` to the nearest of `others`, both sorted [s]."""
    if not len(times) or not len(others):
        return np.empty(0)
    after = np.clip(np.searchsorted(others, times), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    distance = np.minimum(np.abs(others[after] - times), np.abs(times - others[before]))
    return distance * 1e-9
