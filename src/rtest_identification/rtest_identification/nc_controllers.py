"""What differs between NC controllers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Controller:
    """How a controller is told what differs between controllers.

    seconds : a dwell of n seconds; blend : corner rounding within n mm
    tcp_on, tcp_off : blocks that switch TCP mode, from rest; tcp_note : what they expect
    end : of a program
    """

    name: str
    seconds: str
    blend: str
    tcp_on: tuple[str, ...]
    tcp_off: tuple[str, ...]
    tcp_note: str
    end: str

    def dwell(self, seconds: float) -> str:
        """The block that waits."""
        return self.seconds.format(s=seconds, ms=round(seconds * 1e3))


_SWITCHKINS = 'KINEMATICS WITH SPARM=IDENTITYFIRST: TYPE 0 IS IDENTITY, TYPE 1 IS TCP'
# LinuxCNC switches while the last move still comes to its end, and leaves the rest of it out.
_REST = 'G4 P0.1'
CONTROLLERS = {
    'linuxcnc': Controller(
        'LinuxCNC', 'G4 P{s:.3f}', 'G64 P{mm:.4f}', (_REST, 'M428'), (_REST, 'M429'),
        f'{_SWITCHKINS}; M428 AND M429 REMAPPED TO TYPE 1 AND 0', 'M2',
    ),
    # What M428 and M429 are remapped to, for a configuration without them.
    'linuxcnc-m68': Controller(
        'LinuxCNC', 'G4 P{s:.3f}', 'G64 P{mm:.4f}',
        (_REST, 'M68 E3 Q1', 'M66 E0 L0'), (_REST, 'M68 E3 Q0', 'M66 E0 L0'),
        f'{_SWITCHKINS}; MOTION.ANALOG-OUT-03 IS NETTED TO MOTION.SWITCHKINS-TYPE', 'M2',
    ),
    'iso': Controller(
        'ISO', 'G4 P{ms:d}', 'G64', ('G43.4 H1',), ('G49',),
        'G43.4 WITH PROGRAMMING IN THE TABLE COORDINATE SYSTEM; H1 IS THE LENGTH TO THE SPHERE '
        'CENTRE', 'M30',
    ),
}
