"""The truth file: everything the simulated cell is (YAML)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rtest_drivers.sim.errors import GeometricErrors, parse_errors
from rtest_drivers.sim.faults import Fault, parse_faults
from rtest_drivers.sim.fields import Fields, read_yaml
from rtest_drivers.sim.gauges import GaugeData
from rtest_drivers.sim.motion import Drives
from rtest_estimation.errors import UserError
from rtest_identification.machine import Machine, load_machine

_UM, _MS, _DEG, _MM = 1e-6, 1e-3, math.pi / 180.0, 1e-3


@dataclass(frozen=True)
class Encoders:
    """Encoder feedback: period [ns], white noise of linear [m] and rotary axes [rad]."""

    period: int
    linear_noise: float
    rotary_noise: float


@dataclass(frozen=True)
class Truth:
    """What the simulated cell is.

    runout : (2,) sphere off the spindle axis at S = 0, along X and Y of the tool [m]
    remount : time a change of the set-up takes [s]
    """

    machine: Machine
    errors: GeometricErrors
    drives: Drives
    gauges: GaugeData
    encoders: Encoders
    runout: np.ndarray
    remount: float
    seed: int
    faults: tuple[Fault, ...] = ()


def load_truth(path: Path | str) -> Truth:
    """Read a truth file; `machine` in it is relative to the file.

    Raises UserError naming file, key and what is expected.
    """
    path = Path(path)
    fields = read_yaml(path)
    machine = load_machine(path.parent / str(fields.raw('machine')))
    gauges = _gauges(fields.section('gauges'))
    truth = Truth(
        machine=machine,
        errors=parse_errors(fields, machine),
        drives=_drives(fields.section('drives')),
        gauges=gauges,
        encoders=_encoders(fields.section('encoders')),
        runout=np.array(fields.numbers('runout_um', 2, _UM)),
        remount=fields.number('remount_s', 1.0, 0.0),
        seed=fields.integer('seed'),
        faults=parse_faults(fields, len(gauges.tilt)),
    )
    fields.done()
    return truth


def _gauges(fields: Fields) -> GaugeData:
    entries = fields.entries('directions')
    if len(entries) < 3:
        raise UserError(f'{fields.where}: directions: expected three gauges or more')
    azimuth = np.array([entry.number('azimuth_deg', scale=_DEG) for entry in entries])
    tilt = np.array([entry.number('tilt_deg', scale=_DEG) for entry in entries])
    for entry in entries:
        entry.done()
    lower, upper = fields.numbers('range_mm', 2, _MM)
    if not lower < 0.0 < upper:
        raise UserError(f'{fields.where}: range_mm: expected [lower, upper] around 0')
    outliers = fields.section('outliers')
    data = GaugeData(
        azimuth,
        tilt,
        fields.number('direction_error_deg', 0.0, 0.0, _DEG),
        fields.number('position_error_um', 0.0, 0.0, _UM),
        fields.number('noise_um', 0.0, 0.0, _UM),
        fields.number('dwell_noise_um', 0.0, 0.0, _UM),
        lower,
        upper,
        _period(fields),
        fields.integer('batch', 1, lower=1),
        outliers.number('share', 0.0, 0.0),
        outliers.number('size_um', 0.0, 0.0, _UM),
    )
    outliers.done()
    fields.done()
    if np.linalg.matrix_rank(data.directions, tol=1e-3) < 3:
        raise UserError(f'{fields.where}: directions: expected three that span the space')
    return data


def _encoders(fields: Fields) -> Encoders:
    encoders = Encoders(
        _period(fields),
        fields.number('linear_noise_um', 0.0, 0.0, _UM),
        fields.number('rotary_noise_urad', 0.0, 0.0, 1e-6),
    )
    fields.done()
    return encoders


def _drives(fields: Fields) -> Drives:
    base = Drives()
    settle = fields.section('settle')
    drives = Drives(
        fields.number('linear_mm_s', base.linear, 1.0, _MM),
        fields.number('rotary_deg_s', base.rotary, 1.0, _DEG),
        fields.number('shortest_s', base.shortest, 0.01),
        settle.number('amplitude_um', base.settle, 0.0, _UM),
        settle.number('frequency_hz', base.frequency, 1.0),
        settle.number('decay_ms', base.decay, 0.1, _MS),
    )
    settle.done()
    fields.done()
    return drives


def _period(fields: Fields) -> int:
    rate = fields.number('rate_hz', lower=0.1)
    if rate > 1e6:
        raise UserError(f'{fields.where}: rate_hz: expected at most 1e6, got {rate:g}')
    return round(1e9 / rate)
