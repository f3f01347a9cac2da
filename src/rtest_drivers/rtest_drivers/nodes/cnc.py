"""The CNC driver: encoder feedback on 'rtest/cnc/feedback'."""

from __future__ import annotations

import sys
from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState

from rtest_drivers.backends import CNC_BACKENDS, CncBackend
from rtest_drivers.nodes.driver import Driver, run
from rtest_drivers.rate import Rate
from rtest_estimation.nodes.publish import header
from rtest_estimation.records import Feedback


class Cnc(Driver):
    """Lifecycle node 'cnc'."""

    def __init__(self) -> None:
        super().__init__('cnc', 'rtest/cnc/feedback', JointState, CNC_BACKENDS)
        self._parameter('frame_id', 'machine', 'frame of the feedback')
        self.start()

    def start(self) -> None:
        """Count from zero."""
        self._rate = Rate()
        self._messages = self._stale = self._stale_now = 0
        self._last = -1

    def messages(self, records: Sequence[Feedback]) -> list[JointState]:
        """One message for each feedback; stale ones go on as they are and are counted."""
        return [self._message(record) for record in records]

    def _message(self, record: Feedback) -> JointState:
        frame = self.get_parameter('frame_id').value
        message = JointState(header=header(record.stamp, frame), name=list(record.axes))
        message.position = array('d', np.ascontiguousarray(record.position).tobytes())
        self._messages += 1
        if record.stamp <= self._last:
            self._stale += 1
            self._stale_now += 1
        else:
            self._last = record.stamp
            self._rate.add(record.stamp, 1)
        return message

    def health(self) -> tuple[str, dict[str, Any]]:
        """Whether the CNC repeats old feedback."""
        stale, self._stale_now = self._stale_now, 0
        text = ''
        if stale:
            text = f'feedback is stale: {stale} messages since the last look with an old stamp'
        return text, {
            'rate_hz': self._rate.take(),
            'messages': self._messages,
            'stale': self._stale,
        }

    def told(self, backend: CncBackend) -> tuple[str, dict[str, Any]]:
        """What the controller says of itself."""
        return backend.problem(), backend.told()


def main(args: list[str] | None = None) -> int:
    """Entry point of the node."""
    return run(Cnc, args)


if __name__ == '__main__':
    sys.exit(main())
