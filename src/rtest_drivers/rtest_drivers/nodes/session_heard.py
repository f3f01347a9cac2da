"""What the node `session` hears of the others on /diagnostics."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from rtest_drivers.cnc.running import NcProgram
from rtest_drivers.complaints import Complaints
from rtest_drivers.nodes.session_voice import Voice
from rtest_estimation.nodes import diagnostics

# A driver tells its state as often [s].
HEARD_S = 1.0


class Heard:
    """What drivers and estimator said last; tells their complaints.

    said : complaint of each driver, '' where it has none
    reasons : by cycle, what was said of it when it was finished: why poses are missing
    feedback_age : of the newest encoder feedback [s]; infinite where there is none, None where
        nothing was heard of it since the cycle began
    """

    def __init__(self, drivers: Sequence[str], voice: Voice) -> None:
        self.said: dict[str, str] = {}
        self.program = NcProgram()
        self.reasons: dict[str, dict[str, str]] = {}
        self.feedback_age: float | None = None
        self._drivers, self._voice = drivers, voice
        self._complaints = Complaints()
        self._poses: tuple[str, int, int, int] | None = None

    def begin_cycle(self) -> None:
        """Forget what was said of the cycle before."""
        self._poses = self.feedback_age = None
        self.program.begin_cycle()

    def poses(self, key: tuple[str, int]) -> tuple[int, int]:
        """Poses of a cycle that were reached so far, and all of them.

        key : its name and the stamp of its plan [ns]
        """
        cycle, stamp, done, poses = self._poses or ('', 0, 0, 0)
        return (done, poses) if (cycle, stamp) == key else (0, poses)

    def why(self) -> str:
        """What the CNC driver complains of, in brackets; '' where it has no complaint."""
        said = self.said.get('cnc', '')
        return f' ({said})' if said else ''

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Take a message."""
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name == 'estimator: cycle':
                if {'cycle', 'started', 'poses_done', 'poses'} <= values.keys():
                    numbers = (int(values[key]) for key in ('started', 'poses_done', 'poses'))
                    self._poses = (values['cycle'], *numbers)
                age = values.get('feedback_age_s')
                self.feedback_age = math.inf if age is None else float(age)
            elif status.name == 'estimator: finished cycle':
                self.reasons[status.message.partition(':')[0]] = values
                continue
            self._note_driver(status, values)
            source = status.name.strip('/').split(':')[0]
            worse = status.level in (diagnostics.WARN, diagnostics.ERROR)
            number = self._voice.cycle_number
            if worse and self._complaints.is_new(source, status.message, number):
                self._voice.say(f'{source}: {status.message}')

    def _note_driver(self, status: DiagnosticStatus, values: dict[str, str]) -> None:
        """What a driver says, and whether an NC program runs."""
        name = status.name.rpartition('/')[2].partition(':')[0]
        if name not in self._drivers:
            return
        self.said[name] = '' if status.level == diagnostics.OK else status.message
        if name == 'cnc':
            self.program.note(values, time.monotonic())
