"""The sphere and the gauges of a machine whose joints are where LinuxCNC's hardware has them.

The truth is known here only: the errors of the machine, and how the nest was mounted at each
set-up. The gauges are emulated controllers on pseudo-terminals.
"""

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from rtest_drivers.sim.errors import GeometricErrors
from rtest_drivers.sim.gauge_devices import GaugeDevice, Lkg
from rtest_drivers.sim.gauges import Nest
from rtest_drivers.sim.kinematics import sphere_in_table
from rtest_identification.machine import Machine

# A spindle sensor's measuring range to either side [m].
RANGE = 3e-3
NEST_FILE = """
controllers:
  - {{protocol: keyence-lkg, port: {a}, channels: [1, 2], unit: mm, rate_hz: 100}}
  - {{protocol: keyence-lkg, port: {b}, channels: [3], unit: mm, rate_hz: 100}}
"""


class MeasuredSphere:
    """What the gauges show.

    joints : gives the true X Y Z B C [mm], [deg], None where it is not known
    spheres : of the set-ups (3,) [m]; noise : of a reading [m]
    """

    def __init__(
        self,
        machine: Machine,
        errors: GeometricErrors,
        spheres: Sequence[Sequence[float]],
        joints: Callable[[], Sequence[float] | None],
        noise: float = 1e-7,
    ) -> None:
        self._machine, self._errors, self._joints, self._noise = machine, errors, joints, noise
        self._rng = np.random.default_rng(5)
        azimuth = np.radians([30.0, 150.0, 270.0])
        design = np.column_stack(
            [np.cos(azimuth), np.sin(azimuth), -np.ones(3)]
        ) / math.sqrt(2.0)
        self._nests = []
        for sphere in spheres:
            # As well as it can be done by hand.
            directions = design + 0.02 * self._rng.standard_normal((3, 3))
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            origin = np.array(sphere) + 15e-6 * self._rng.standard_normal(3)
            self._nests.append(Nest(directions, origin))

    def read(self) -> list[float]:
        """Displacement of the three gauges [m]; NaN where the sphere is not in the nest."""
        joints = self._joints()
        if joints is None:
            return [math.nan] * 3
        by_axis = dict(zip('XYZBC', joints, strict=True))
        position = [
            math.radians(by_axis[name]) if self._machine.axes[name].rotary
            else by_axis[name] * 1e-3
            for name in self._machine.letters
        ]
        sphere = sphere_in_table(self._machine, np.array([position]), self._errors)
        nest = min(self._nests, key=lambda nest: np.linalg.norm(sphere - nest.origin))
        shown = nest.read(sphere)[0] + self._noise * self._rng.standard_normal(3)
        return np.where(np.abs(shown) < RANGE, shown, math.nan).tolist()

    @contextlib.contextmanager
    def gauges(self, folder: Path) -> Iterator[tuple[Path, list[GaugeDevice]]]:
        """Two controllers of the three gauges; gives the device file of the nest."""
        ports = {'a': folder / 'gauges-a', 'b': folder / 'gauges-b'}
        file = folder / 'nest.yaml'
        file.write_text(NEST_FILE.format(**ports))
        devices = [
            GaugeDevice(Lkg(lambda: self.read()[:2]), ports['a']),
            GaugeDevice(Lkg(lambda: self.read()[2:]), ports['b']),
        ]
        try:
            yield file, devices
        finally:
            for device in devices:
                device.close()
