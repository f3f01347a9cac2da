"""A machine that a person starts: it plays one cycle of a session after the other.

Where it is and what its controller tells differ by offsets that the controller does not know.
"""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from rtest_estimation.records import CyclePlan
from rtest_identification.machine import Machine

_STEP_S = 0.02
# Per move, whatever its length; standing at a pose is that of the plan and a little more.
_MOVE_S, _SPARE_S = 0.12, 0.15


class PlayedMachine:
    """Tells its positions every 20 ms in [mm] and [deg], also while it stands.

    tell : the controller's server
    hidden : offset of an axis that the controller does not see [mm], [deg]
    """

    def __init__(
        self, machine: Machine, tell: Callable[[Mapping[str, float]], None],
        hidden: Mapping[str, float],
    ) -> None:
        self._tell, self._letters = tell, machine.letters
        self._scale = np.array([
            180.0 / math.pi if machine.axes[name].rotary else 1e3 for name in machine.letters
        ])
        self._hidden = np.array([hidden.get(name, 0.0) for name in machine.letters])
        self._at = np.zeros(len(machine.letters))
        self._path: list[tuple[float, np.ndarray]] = []
        self._lock = threading.Lock()

    def start(self, plan: CyclePlan) -> None:
        """Go through the poses of a cycle, and home."""
        order = [plan.axes.index(name) for name in self._letters]
        targets = plan.commands[:, order] * self._scale
        when, path = time.monotonic(), []
        for target in [*targets, np.zeros(len(order))]:
            path.append((when := when + _MOVE_S, target))
            path.append((when := when + plan.dwell + _SPARE_S, target))
        with self._lock:
            self._path = [(time.monotonic(), self._at), *path]

    def true(self) -> list[float]:
        """Where the axes are, in the order X Y Z B C [mm], [deg]."""
        self._go_on()
        by_axis = dict(zip(self._letters, self._at + self._hidden, strict=True))
        return [by_axis[name] for name in 'XYZBC']

    @contextlib.contextmanager
    def telling(self) -> Iterator[None]:
        """Tell positions meanwhile."""
        end = threading.Event()

        def loop() -> None:
            while not end.wait(_STEP_S):
                self._go_on()
                self._tell(dict(zip(self._letters, self._at.tolist(), strict=True)))

        thread = threading.Thread(target=loop)
        thread.start()
        try:
            yield
        finally:
            end.set()
            thread.join()

    def _go_on(self) -> None:
        with self._lock:
            if self._path:
                times = [when for when, _ in self._path]
                places = np.array([place for _, place in self._path])
                now = time.monotonic()
                self._at = np.array([np.interp(now, times, axis) for axis in places.T])
