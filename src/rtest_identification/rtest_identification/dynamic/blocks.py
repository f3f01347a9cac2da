"""Means of readings over short blocks of time: what the dynamic effects are functions of."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from rtest_estimation.errors import UserError
from rtest_identification.dynamic.motion import Motion, Pass, Readings
from rtest_identification.kinematics import predict, rotation

# Blocks of the steady part end at this angle or time, whichever comes first.
STEADY_ANGLE = np.radians(2.0)
STEADY_TIME = 0.1
# Blocks while the axis starts and stops [s].
TRANSIENT_TIME = 0.005
# So long after a start and before a stop nothing is used: the axis may not move yet, and what
# friction holds at rest is not known [s].
_STARTING = 0.01
# A derivative with respect to time is a difference over this time to either side [s].
_HALF_SPAN = 0.001
# The servo moves where it changes by so many times the scatter of the encoders.
_CLEAR = 5.0
# A pass with fewer readings says nothing.
_FEWEST = 50


@dataclass(frozen=True)
class Scene:
    """Blocks of all passes, in time.

    Components are radial, tangential and axial.

    measured : (n, 3) mean sphere centre relative to the nest [m]
    servo : (n, 3) the same by the encoders, at the same readings [m]
    change : (n, 3) time derivative of `servo`, zero where it is within the scatter of the
        encoders [m/s]; change_noise : (n,) its standard deviation from that, where it is not zero
    begin, end : (n,) [s], CNC's clock; count : (n,) readings
    angle, omega, alpha : (n,) of the rotary axis, its velocity and acceleration [rad], [rad/s],
        [rad/s2]
    number : (n,) index of the pass; place : (n,) within the pass
    steady : (n,) whether the axis runs settled at its feed
    slopes : for each linear axis (n, 3), displacement per motion of that axis
    white : (passes,) standard deviation of the white noise of measured less servo, per component
        and reading [m]
    short : (passes,) scatter of means over the time of a transient's blocks, in the steady part,
        which has the vibration of the motion in it [m]
    """

    motion: Motion
    measured: np.ndarray
    servo: np.ndarray
    change: np.ndarray
    change_noise: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    count: np.ndarray
    angle: np.ndarray
    omega: np.ndarray
    alpha: np.ndarray
    number: np.ndarray
    place: np.ndarray
    steady: np.ndarray
    slopes: dict[str, np.ndarray]
    white: np.ndarray
    short: np.ndarray
    contact: bool

    def __len__(self) -> int:
        return len(self.angle)

    @property
    def time(self) -> np.ndarray:
        """(n,) middle of the blocks [s]."""
        return 0.5 * (self.begin + self.end)

    @property
    def feed(self) -> np.ndarray:
        """(n,) index of the feed."""
        return np.array([one.feed for one in self.motion.passes])[self.number]

    @property
    def path_speed(self) -> np.ndarray:
        """(n,) speed of the sphere along its circle, with the sign of the rotation [m/s]."""
        return self.omega * self.motion.radius

    @cached_property
    def machine_angle(self) -> np.ndarray:
        """(n,) where the sphere is around the axis, as seen in the machine [rad].

        Counted from the first of the two machine axes across the rotary axis: from +X for C.
        """
        motion = self.motion
        machine = motion.machine
        own = machine.axes[motion.axis]
        along = int(np.argmax(np.abs(own.direction)))
        first, second = [(along + 1) % 3, (along + 2) % 3]
        start = motion.tracks[0].positions[0]
        turn = np.eye(3)
        for name in machine.table_side:
            axis = machine.axes[name]
            if axis.rotary and name != motion.axis:
                angle = axis.sense * start[machine.letters.index(name)]
                turn = turn @ rotation(axis.direction, np.asarray(angle))
            elif name == motion.axis:
                turn = turn @ rotation(axis.direction, axis.sense * self.angle)
        place = turn @ motion.frame[0]
        return np.arctan2(place[:, second], place[:, first])

    def keep(self, chosen: np.ndarray) -> Scene:
        """Only these blocks (bool mask or indices)."""
        names = (
            'measured', 'servo', 'change', 'change_noise', 'begin', 'end', 'count', 'angle',
            'omega', 'alpha', 'number', 'place', 'steady',
        )
        slopes = {name: slope[chosen] for name, slope in self.slopes.items()}
        return replace(
            self, slopes=slopes, **{name: getattr(self, name)[chosen] for name in names}
        )

    def of_pass(self, number: int) -> np.ndarray:
        """(k,) indices of the blocks of a pass."""
        return np.flatnonzero(self.number == number)

    def axis_speed(self, axis: str) -> np.ndarray:
        """(n,) nominal velocity of a linear axis that follows the rotary one [m/s]."""
        names = self.motion.machine.linear
        response = np.stack([self.slopes[name] for name in names], axis=2)
        wanted = np.zeros((len(self), 3, 1))
        wanted[:, 1, 0] = self.path_speed
        return np.linalg.solve(response, wanted)[:, names.index(axis), 0]

    def reversals(self, axis: str) -> list[tuple[float, float]]:
        """When an axis turned round [s], and the sign of its motion since."""
        speed = self.omega if axis == self.motion.axis else self.axis_speed(axis)
        slow = np.abs(speed) < 1e-6 * max(np.abs(speed).max(), 1e-12)
        moving = np.flatnonzero(~slow & (np.abs(self.omega) > 0.01 * self.motion.feeds[0]))
        found = []
        for before, after in pairwise(moving):
            if speed[before] * speed[after] >= 0.0:
                continue
            one, other = self.number[before], self.number[after]
            if self.motion.passes[one].cycle != self.motion.passes[other].cycle:
                continue
            if one == other:
                share = speed[before] / (speed[before] - speed[after])
                when = self.time[before] + share * (self.time[after] - self.time[before])
            else:
                when = self.motion.passes[other].start
            found.append((float(when), float(np.sign(speed[after]))))
        return found


def make_scene(motion: Motion, cycles: list[Readings], offset: float = 0.0) -> Scene:
    """Average readings and feedback over blocks.

    offset : by how much the gauges' stamps are later than the CNC's [s]
    """
    parts: list[dict[str, np.ndarray]] = []
    white, short = [], []
    for number, one in enumerate(motion.passes):
        part, noise, scatter = _blocks(motion, cycles[one.cycle], one, _edges(one), offset)
        part['number'] = np.full(len(part['count']), number)
        part['place'] = np.arange(len(part['count']))
        parts.append(part)
        white.append(noise)
        short.append(scatter)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    slopes = _slopes(motion, joined.pop('positions'))
    contact = all(cycle.contact for cycle in cycles)
    return Scene(
        motion=motion, slopes=slopes, white=np.array(white), short=np.array(short),
        contact=contact, **joined,
    )


def _blocks(
    motion: Motion, cycle: Readings, one: Pass, edges: np.ndarray, offset: float
) -> tuple[dict[str, np.ndarray], float, float]:
    """Means of one pass, the white noise of a reading in it, the scatter of short means [m]."""
    track = motion.tracks[one.cycle]
    time = cycle.time - offset
    low, high = np.searchsorted(time, [edges[0], edges[-1]])
    if high - low < _FEWEST:
        raise UserError(
            f'{cycle.cycle}: {high - low} valid gauge readings while {motion.axis} turns; '
            f'at least {_FEWEST} are needed'
        )
    time, centre = time[low:high], cycle.centre[low:high] @ motion.frame.T
    place = np.searchsorted(edges, time, 'right') - 1
    place, count = np.unique(place, return_counts=True)
    first = np.r_[0, np.cumsum(count)[:-1]]

    def mean(values: np.ndarray) -> np.ndarray:
        total = np.add.reduceat(values, first, axis=0)
        return total / count.reshape(-1, *[1] * (values.ndim - 1))

    # Smooth between samples: encoders may be slow beside what happens at a start.
    smooth = Akima1DInterpolator(track.time, track.servo)

    def servo(at: np.ndarray) -> np.ndarray:
        return smooth(np.clip(at, track.time[0], track.time[-1]))

    def omega(at: np.ndarray) -> np.ndarray:
        return np.interp(at, track.time, track.omega)

    here = servo(time)
    change = mean((servo(time + _HALF_SPAN) - servo(time - _HALF_SPAN)) / (2.0 * _HALF_SPAN))
    middle = mean(time)
    half = 0.5 * float(np.median(np.diff(time)))
    logged = slice(*np.searchsorted(track.time, [one.steady[0], one.steady[1]]))
    scatter = _white_noise(track.servo[logged])
    change_noise = np.sqrt(2.0) * scatter / (2.0 * half * count)
    clear = (np.abs(change) > _CLEAR * change_noise[:, None]).any(axis=1)
    begin = middle + half * np.where(count > 1, -count, -1.0)
    part = {
        'measured': mean(centre), 'servo': mean(here), 'change': change * clear[:, None],
        'change_noise': change_noise * clear,
        'begin': begin, 'end': 2.0 * middle - begin, 'count': count,
        'angle': mean(np.interp(time, track.time, track.angle)),
        'omega': mean(omega(time)),
        'alpha': mean((omega(time + _HALF_SPAN) - omega(time - _HALF_SPAN)) / (2.0 * _HALF_SPAN)),
        'steady': (middle > one.steady[0]) & (middle < one.steady[1]),
        'positions': np.stack(
            [np.interp(middle, track.time, p) for p in track.positions.T], axis=1
        ),
    }
    # Readings between two encoder samples share their scatter.
    share = np.median(np.diff(track.time)) / (2.0 * half)
    white = float(np.hypot(_white_noise(centre), scatter * np.sqrt(max(share, 1.0))))
    return part, white, _short_scatter(time, centre - here, one)


def _short_scatter(time: np.ndarray, values: np.ndarray, one: Pass) -> float:
    """Scatter of means over the time of a transient's blocks about those of steady blocks [m]."""
    steady = (time > one.steady[0]) & (time < one.steady[1])
    time, values = time[steady], values[steady]
    few = max(round(TRANSIENT_TIME / float(np.median(np.diff(time)))), 1)
    many = max(round(STEADY_TIME / TRANSIENT_TIME), 2)
    usable = len(values) // (few * many) * few * many
    means = values[:usable].reshape(-1, many, few, 3).mean(axis=2)
    # A straight line over each stretch is what the steady block would follow.
    design = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, many), 1)
    design, _ = np.linalg.qr(design)
    left = means - np.einsum('ik,jk,njc->nic', design, design, means)
    return float(np.sqrt((left**2).sum() / max(left.size * (many - 2) / many, 1.0)))


def _white_noise(values: np.ndarray) -> float:
    """Standard deviation of white noise in (n, 3): smooth motion leaves no third differences."""
    if len(values) < 4:
        return 0.0
    return float(np.sqrt((np.diff(values, 3, axis=0) ** 2).mean() / 20.0))


def _edges(one: Pass) -> np.ndarray:
    """Ends of the blocks of a pass [s]."""
    begin, end = one.steady
    width = min(STEADY_ANGLE / one.speed, STEADY_TIME)

    def steps(low: float, high: float, width: float) -> np.ndarray:
        return np.linspace(low, high, max(round((high - low) / width), 1) + 1)

    return np.r_[
        steps(one.start + _STARTING, begin, TRANSIENT_TIME)[:-1],
        steps(begin, end, width),
        steps(end, one.end - _STARTING, TRANSIENT_TIME)[1:],
    ]


def _slopes(motion: Motion, positions: np.ndarray) -> dict[str, np.ndarray]:
    """(n, 3) displacement per motion of each linear axis; the nominal chain is affine in them."""
    machine = motion.machine
    here = predict(machine, positions).centre
    slopes = {}
    for name in machine.linear:
        moved = positions.copy()
        moved[:, machine.letters.index(name)] += 1.0
        slopes[name] = (predict(machine, moved).centre - here) @ motion.frame.T
    return slopes
