"""What the node `session` says: lines for the person who waits, and its status."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.node import Node

from rtest_drivers.wishes import Wishes
from rtest_estimation.nodes import diagnostics
from rtest_estimation.records import CyclePlan


class Voice:
    """Tells what the session does.

    status : what it does now
    cycle_number : place of the cycle in the session file, from 1
    problems : what went wrong so far
    """

    def __init__(self, node: Node, session: str, cycles: Sequence[str], wishes: Wishes) -> None:
        self.status, self.cycle_number = 'waiting for the other nodes', 0
        self.problems: list[str] = []
        self._node, self._session, self._cycles, self._wishes = node, session, cycles, wishes
        self._diagnostics = diagnostics.Diagnostics(node)
        self._started = time.monotonic()

    def say(self, text: str) -> None:
        """One line of progress for the person who waits."""
        print(f'[{time.monotonic() - self._started:3.0f} s] {text}', flush=True)

    def say_cycle(self, plan: CyclePlan, text: str) -> None:
        """One line on a cycle."""
        number = self._cycles.index(plan.cycle) + 1
        self.say(f'{number}/{len(self._cycles)} {plan.cycle}: {text}')

    def warn_cycle(self, plan: CyclePlan, text: str) -> None:
        """A warning on a cycle, in the log."""
        self._node.get_logger().warning(f'{plan.cycle}: {text}')

    def problem(self, text: str) -> None:
        """Something that is missing in the recording, or that went wrong at its end."""
        self.problems.append(text)
        self._node.get_logger().warning(text)
        self.say(text)
        self.diagnose()

    def diagnose(self) -> None:
        """Publish the status on /diagnostics."""
        level = diagnostics.WARN if self.problems else diagnostics.OK
        text = self.problems[-1] if self.problems else self.status
        values = {
            'session': self._session,
            'state': self.status,
            'cycle': self.cycle_number,
            'cycles': len(self._cycles),
            'problems': len(self.problems),
            'waits_for_start': self._wishes.held,
        }
        self._diagnostics.publish(diagnostics.status('session: progress', level, text, values))
