"""All that is known of a running cell, thinned to what a page can show.

Hundreds of messages a second come in; `tick` makes of them, ten times a second, one small record.
What changes seldom (the map of poses, results) is a part with a revision, which a page asks for
only when it has changed.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from typing import Any

import numpy as np

from rtest_drivers.view.devices import (
    ERROR,
    IDLE,
    OK,
    WARN,
    Health,
    Report,
    Stream,
    device_health,
    node_health,
)
from rtest_drivers.view.gauges import Gauges, parse_ranges
from rtest_drivers.view.poses import PoseMap
from rtest_estimation.errors import UserError
from rtest_estimation.records import Cycle, CyclePlan, Feedback, GaugeBlock, Temperature
from rtest_identification.machine import Machine, parse_machine

TICK_S = 0.1
# The strip chart reaches back so far [s].
HISTORY_S = 60.0
DRIVERS = ('gauges', 'cnc')
# Who else is expected; others appear when they speak.
_NODES = ('estimator', 'identifier', 'recorder', 'session')
# Which statuses hold what the page shows elsewhere.
_SESSION, _PROGRESS, _FINISHED = (
    'session: progress', 'estimator: cycle', 'estimator: finished cycle'
)
# Lines of the identifier: of the status, what they are numbered as, as which part they are shown.
_TOLD = {
    'identifier: session': (('warning', 'warnings'), ('note', 'notes')),
    'identifier: model gap': (('note', 'gap_notes'),),
}
# A recorder that says nothing for so long may not record either [s].
_RECORDER_SILENT_S = 3.0
_LEVELS = (OK, WARN, ERROR, ERROR)
# When a session begins, who has spoken in this time belongs to it [s].
_RECENT_S = 5.0


class CellState:
    """The cell as one page shows it; `now` is wall time [s] of a clock that nobody sets."""

    def __init__(self) -> None:
        self.history: deque[dict[str, Any]] = deque(maxlen=round(HISTORY_S / TICK_S))
        self.parts: dict[str, tuple[int, Any]] = {}
        self._revision = 0
        self._streams = {name: Stream() for name in DRIVERS}
        self._gauges = Gauges()
        self._feedback: Feedback | None = None
        self._feedbacks = 0
        self._centre: np.ndarray | None = None
        self._centre_heard = -math.inf
        self._temperatures: dict[str, tuple[Temperature, Stream]] = {}
        self._reports: dict[str, Report] = {}
        self._machine: Machine | None = None
        self._maps: list[PoseMap] = []
        self._reasons: dict[str, dict[int, str]] = {}
        self._session = ''
        self._marks: list[str] = []

    # --- what comes in ---

    def add_gauges(self, block: GaugeBlock, now: float) -> None:
        """Readings of the nest."""
        self._gauges.add(block)
        # By the running number: also readings that were not looked at here count.
        self._streams['gauges'].add(block.stamp, block.sequence, now)

    def add_feedback(self, feedback: Feedback, messages: int, now: float) -> None:
        """The newest of so many messages of encoder feedback."""
        self._feedback = feedback
        self._feedbacks += messages
        self._streams['cnc'].add(feedback.stamp, self._feedbacks, now)

    def add_centre(self, centre: np.ndarray, now: float) -> None:
        """(3,) sphere centre relative to the nest, frame ``table`` [m]."""
        self._centre, self._centre_heard = centre, now

    def add_temperature(self, one: Temperature, now: float) -> None:
        """A thermometer's reading."""
        _, stream = self._temperatures.get(one.sensor, (None, Stream()))
        stream.add(one.stamp, 0, now)
        self._temperatures[one.sensor] = (one, stream)

    def add_machine(self, text: str) -> None:
        """The machine's YAML; one that cannot be read leaves the map of poses without axes."""
        try:
            self._machine = parse_machine(text, 'rtest/machine')
        except UserError:
            self._machine = None

    def add_plan(self, plan: CyclePlan) -> None:
        """A cycle begins; another session's plan begins everything anew.

        The first plan that is heard clears nothing: latched topics come in any order, results
        of the same session may be here already.
        """
        before, self._session = self._session, plan.session
        if before and before != plan.session:
            self._maps.clear()
            self._reasons.clear()
            self._marks.clear()
            # Nodes of the session before that are not in this one are nobody's fault.
            last = max((one.heard for one in self._reports.values()), default=0.0)
            self._reports = {
                name: one for name, one in self._reports.items() if last - one.heard < _RECENT_S
            }
            for name in list(self.parts):
                self._put(name, None)
        if any(one.key == (plan.cycle, plan.stamp) for one in self._maps):
            return
        self._maps.append(PoseMap(plan, self._machine))
        self._show_map(len(self._maps) - 1)

    def add_cycle(self, cycle: Cycle) -> None:
        """A finished cycle."""
        self.add_plan(cycle.plan)
        key = (cycle.plan.cycle, cycle.plan.stamp)
        index = next(i for i, one in enumerate(self._maps) if one.key == key)
        self._maps[index].explain(self._reasons.pop(cycle.plan.cycle, {}))
        self._maps[index].finish(cycle)
        self._show_map(index)

    def add_report(self, report: Report) -> None:
        """One status of /diagnostics."""
        self._reports[report.name] = report
        if 'gauge_range_mm' in report.values:
            self._gauges.ranges = parse_ranges(report.values['gauge_range_mm'])
        if report.name == _PROGRESS:
            self._reach(report)
        elif report.name == _FINISHED:
            self._explain(report)
        elif report.name in _TOLD:
            for word, part in _TOLD[report.name]:
                self._tell(report, word, part)

    def add_mark(self, text: str) -> None:
        """A mark that was set in the recording, by this page or by somebody else.

        The message has no time, and a page that was opened later hears it later than it was set.
        """
        self._marks.append(text)
        self._put('marks', self._marks[-20:])

    def add_result(self, name: str, shown: Any) -> None:
        """A result as `results` makes it."""
        self._put(name, shown)

    # --- what goes out ---

    def tick(self, now: float) -> dict[str, Any]:
        """The record of this moment; adds to the history of the strip chart."""
        ended = self._ended()
        gauges = self._health('gauges', ended, now)
        cnc = self._health('cnc', ended, now)
        sphere = self._sphere(now)
        row = {'t': round(now, 3), 'spans': self._gauges.spans(), 'sphere': sphere}
        self.history.append(row)
        return {
            **row,
            'session': self._session_line(now),
            'devices': [
                _row(one) for one in (gauges, cnc, *self._thermometers(ended, now))
            ] + [_row(one) for one in self._nodes(ended, now)],
            'gauges': self._gauges.shown(gauges.level),
            'axes': self._axes(cnc.level in (OK, WARN)),
            'recording': self._recording(ended, now),
        }

    def problem(self, now: float) -> str:
        """What keeps a mark from being recorded; '' for nothing."""
        recorder = next((r for r in self._reports.values() if r.source == 'recorder'), None)
        if recorder is None:
            return 'no recorder in the graph'
        if recorder.level >= 2 or recorder.text == 'finished':
            return f'the recorder does not record: {recorder.text}'
        if now - recorder.heard > _RECORDER_SILENT_S:
            return f'nothing was heard of the recorder for {now - recorder.heard:.0f} s'
        return ''

    # --- parts ---

    def _put(self, name: str, shown: Any) -> None:
        self._revision += 1
        self.parts[name] = (self._revision, shown)

    def _show_map(self, index: int) -> None:
        self._put(f'cycle:{index}', self._maps[index].shown())

    def _reach(self, report: Report) -> None:
        values = report.values
        if not {'cycle', 'started', 'poses_done'} <= values.keys():
            return
        key = (values['cycle'], int(values['started']))
        for index, one in enumerate(self._maps):
            if one.key == key and one.reach(int(values['poses_done'])):
                self._show_map(index)

    def _explain(self, report: Report) -> None:
        """Reasons of missing poses: 'pose 3' to the reason; the cycle's name begins the line."""
        cycle = report.text.partition(':')[0]
        reasons = {
            int(key.removeprefix('pose ')): text
            for key, text in report.values.items() if key.startswith('pose ')
        }
        attempts = [i for i, one in enumerate(self._maps) if one.plan.cycle == cycle]
        if attempts and self._maps[attempts[-1]].finished:
            self._maps[attempts[-1]].explain(reasons)
            self._show_map(attempts[-1])
        else:
            self._reasons[cycle] = reasons

    def _tell(self, report: Report, word: str, part: str) -> None:
        """What the identifier says beside its results, in its order; stays when it is silent."""
        numbers = itertools.takewhile(
            lambda key: key in report.values, (f'{word} {n}' for n in itertools.count(1))
        )
        told = [report.values[key] for key in numbers]
        if told != self.parts.get(part, (0, []))[1]:
            self._put(part, told)

    # --- the record of a moment ---

    def _ended(self) -> bool:
        report = self._reports.get(_SESSION)
        return report is not None and report.values.get('state') == 'finished'

    def _health(self, name: str, ended: bool, now: float) -> Health:
        report = self._reports.get(f'{name}: driver')
        return device_health(name, self._streams[name], report, ended, now)

    def _thermometers(self, ended: bool, now: float) -> list[Health]:
        return [
            Health(
                f'temperature {sensor}', IDLE if ended else ERROR if stream.silent(now) else OK,
                f'{one.value:.2f} °C', stream.rate, stream.age(now),
            )
            for sensor, (one, stream) in sorted(self._temperatures.items())
        ]

    def _nodes(self, ended: bool, now: float) -> list[Health]:
        said: dict[str, list[Report]] = {}
        for report in self._reports.values():
            # A finished cycle is told once, and its outcome is not the node's.
            if report.source not in DRIVERS and report.name != _FINISHED:
                said.setdefault(report.source, []).append(report)
        names = [*_NODES, *sorted(set(said) - set(_NODES))]
        return [
            node_health(said[name], ended, now) if name in said
            else Health(name, IDLE, 'nothing heard yet')
            for name in names
        ]

    def _session_line(self, now: float) -> dict[str, Any]:
        report = self._reports.get(_SESSION)
        if report is None:
            return {'name': self._session, 'level': IDLE, 'text': 'no session heard yet'}
        values = report.values
        return {
            'name': values.get('session', self._session),
            'level': _LEVELS[report.level],
            'text': report.text,
            'state': values.get('state', ''),
            'waits': values.get('waits_for_start', ''),
            'cycle': values.get('cycle', ''),
            'cycles': values.get('cycles', ''),
            'age': round(now - report.heard, 2),
        }

    def _sphere(self, now: float) -> list[float] | None:
        """Displacement [µm]; None where none came lately."""
        if self._centre is None or now - self._centre_heard > 1.0:
            return None
        return [round(float(value) * 1e6, 3) for value in self._centre]

    def _axes(self, alive: bool) -> list[dict[str, Any]]:
        if self._feedback is None:
            return []
        rows = []
        for name, value in zip(self._feedback.axes, self._feedback.position, strict=True):
            axis = self._machine.axes.get(name) if self._machine else None
            turns = axis.rotary if axis else name in 'ABCS'
            scale = 180.0 / math.pi if turns else 1e3
            limits = [axis.lower * scale, axis.upper * scale] if axis else None
            rows.append({
                'name': name,
                'value': round(float(value) * scale, 5) if math.isfinite(value) else None,
                'unit': '°' if turns else 'mm',
                'range': limits if limits and all(map(math.isfinite, limits)) else None,
                'alive': alive,
            })
        return rows

    def _recording(self, ended: bool, now: float) -> dict[str, Any]:
        report = next((r for r in self._reports.values() if r.source == 'recorder'), None)
        if report is None:
            return {'level': IDLE, 'text': 'no recorder heard yet'}
        keys = ('file', 'bytes', 'disk_free', 'messages', 'lost')
        level, text, silent = _LEVELS[report.level], report.text, now - report.heard
        if silent > _RECORDER_SILENT_S and not ended:
            level = ERROR
            text = f'nothing heard for {silent:.0f} s: what comes now may be lost; values are old'
        return {
            'level': level,
            'text': text,
            **{key: report.values[key] for key in keys if key in report.values},
        }


def _row(one: Health) -> dict[str, Any]:
    return {
        'name': one.name,
        'level': one.level,
        'text': one.text,
        'rate': None if one.rate is None else round(one.rate, 1),
        'age': None if one.age is None else round(one.age, 2),
    }
