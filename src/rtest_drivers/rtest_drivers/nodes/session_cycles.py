"""Cycles of the node `session`: their plans go out, and what came of them comes back."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from rclpy.publisher import Publisher
from rtest_msgs.msg import Cycle, NestCalibration

from rtest_drivers.nodes.session_heard import Heard
from rtest_drivers.nodes.session_voice import Voice
from rtest_drivers.nodes.session_waiting import Wait
from rtest_drivers.schedule import NANOSECONDS, calibration_outcome, outcome, turn
from rtest_estimation.nodes import publish
from rtest_estimation.records import CyclePlan, Kind

# Name of a cycle and the stamp of its plan [ns]: one that is measured anew has another stamp.
Key = tuple[str, int]


class Cycles:
    """The cycles that were started, and those that came back finished.

    plans : publisher of the plans
    now : time of the session [ns]
    """

    def __init__(
        self,
        session: str,
        plans: Publisher,
        now: Callable[[], int],
        wait: Wait,
        voice: Voice,
        heard: Heard,
    ) -> None:
        self._session, self._plans, self._now, self._wait = session, plans, now, wait
        self._voice, self._heard = voice, heard
        self._open: dict[Key, CyclePlan] = {}
        self._finished: dict[Key, Cycle] = {}
        self._nests: dict[str, NestCalibration] = {}

    @property
    def any_open(self) -> bool:
        """Whether a cycle was started whose end was not told."""
        return bool(self._open)

    def finished(self, key: Key) -> bool:
        """Whether a cycle came back."""
        return key in self._finished

    def tell_turn(self, plan: CyclePlan, due: int) -> None:
        """Say when a repeated cycle is to begin, or that it is late. due : [ns], 0 for at once."""
        text, late = turn(due, self._now()) if due else ('', False)
        if late:
            self._voice.warn_cycle(plan, text)
        if text:
            self._voice.status = f'waiting for {plan.cycle}'
            self._voice.say_cycle(plan, text)

    def start(self, plan: CyclePlan, due: int = 0) -> Key:
        """Publish a plan; returns the key of its cycle. The one before ends with it.

        due : when the cycle begins [ns]; at once where that is past
        """
        stamp = max(self._now(), due)
        key = (plan.cycle, stamp)
        doing = 'waiting for' if due > self._now() else 'measuring'
        self._voice.status = f'{doing} {plan.cycle}'
        self._heard.begin_cycle()
        self._open[key] = plan
        self._plans.publish(
            publish.cycle_plan(replace(plan, session=self._session, stamp=stamp))
        )
        return key

    def tell_finished(self) -> None:
        """Tell the outcome of every cycle that has come, also of one that had stopped before."""
        for key, plan in list(self._open.items()):
            if key in self._finished:
                del self._open[key]
                self._voice.say_cycle(plan, self._outcome(plan, self._finished[key]))
                self._heard.reasons.pop(plan.cycle, None)

    def _outcome(self, plan: CyclePlan, cycle: Cycle) -> str:
        reasons: Mapping[str, str] = {}
        if cycle.missing:
            # The reasons are on another topic and may come a moment later.
            self._wait(lambda: plan.cycle in self._heard.reasons, 1.0)
            reasons = self._heard.reasons.get(plan.cycle, {})
        text = outcome(plan, len(cycle.points), len(cycle.missing), reasons)
        if plan.kind is Kind.NEST_CALIBRATION:
            # The calibration is on another topic and may come a moment later.
            self._wait(lambda: cycle.calibration in self._nests, 1.0 if cycle.calibration else 0.0)
            nest = self._nests.get(cycle.calibration)
            told = calibration_outcome(nest.residual, nest.kind) if nest else 'no calibration'
            text += f', {told}'
        return text

    def lost(self, started: Mapping[str, Sequence[Key]]) -> list[str]:
        """Cycles of which no attempt says anything; single missing poses are no problem.

        started : by name, the keys of all attempts
        """
        return [
            name for name, keys in started.items()
            if not any(key in self._finished and _says(self._finished[key]) for key in keys)
        ]

    def on_cycle(self, message: Cycle) -> None:
        """Take a finished cycle."""
        if message.plan.session == self._session:
            stamp = message.plan.header.stamp
            key = (message.plan.cycle, stamp.sec * NANOSECONDS + stamp.nanosec)
            known = self._finished.get(key)
            # Somebody else's estimator may take our plans too, and have nothing to say of them.
            if known is None or len(message.points) > len(known.points):
                self._finished[key] = message

    def on_nest(self, message: NestCalibration) -> None:
        """Take a calibration of a nest."""
        self._nests[message.calibration] = message


def _says(cycle: Cycle) -> bool:
    """Whether a finished cycle says anything.

    Displacements of poses count from the first point: alone it is zero. A dynamic cycle has
    readings only, of which those between its poses count.
    """
    if cycle.plan.kind == Kind.DYNAMIC:
        return len(cycle.plan.commands) // len(cycle.plan.axes) - len(cycle.missing) > 1
    return len(cycle.points) > 1
