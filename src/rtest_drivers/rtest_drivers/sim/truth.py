"""The truth file: everything the simulated cell is (YAML).

``python -m rtest_drivers.sim.truth FILE [CYCLE=POSES ...]`` checks a file: exit status 2 and one
line for a mistake, and a line for each fault that these cycles of a session never meet.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rtest_drivers.sim.encoders import Encoders
from rtest_drivers.sim.errors import GeometricErrors, parse_errors
from rtest_drivers.sim.faults import Fault, parse_faults
from rtest_drivers.sim.fields import Fields, read_yaml
from rtest_drivers.sim.gauges import GaugeData, LaserData
from rtest_drivers.sim.laser import SENSORS
from rtest_drivers.sim.model import load_motions
from rtest_drivers.sim.motion import Drives
from rtest_drivers.sim.warming import Warming, parse_warming
from rtest_estimation.errors import UserError
from rtest_identification.machine import Machine, load_machine

_UM, _MS, _DEG, _MM = 1e-6, 1e-3, math.pi / 180.0, 1e-3


@dataclass(frozen=True)
class Truth:
    """What the simulated cell is.

    runout : (2,) sphere off the spindle axis at S = 0, along X and Y of the tool [m]
    remount : time a change of the set-up takes [s]
    warming : None for a machine that stays as it is
    thin : while it waits long for the next cycle gauges and encoders are read so often only, and
        time may pass as fast as it can [ns]; 0 for always as usual
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
    warming: Warming | None = None
    thin: int = 0


def load_truth(path: Path | str) -> Truth:
    """Read a truth file; `machine`, `model` and `effects` in it are relative to the file.

    Raises UserError naming file, key and what is expected.
    """
    path = Path(path)
    fields = read_yaml(path)
    machine = load_machine(path.parent / str(fields.raw('machine')))
    gauges = _gauges(fields.section('gauges'))
    errors = parse_errors(fields, machine)
    model, effects = fields.raw('model', None), fields.raw('effects', None)
    if model is not None:
        own = path.parent / str(effects) if effects is not None else None
        errors = replace(errors, model=load_motions(path.parent / str(model), machine, own))
    elif effects is not None:
        raise UserError(f'{path}: effects: they are those of a model; expected model: beside it')
    truth = Truth(
        machine=machine,
        errors=errors,
        drives=_drives(fields.section('drives')),
        gauges=gauges,
        encoders=_encoders(fields.section('encoders')),
        runout=np.array(fields.numbers('runout_um', 2, _UM)),
        remount=fields.number('remount_s', 1.0, 0.0),
        seed=fields.integer('seed'),
        faults=parse_faults(fields, len(gauges.tilt)),
        warming=parse_warming(fields, machine),
        thin=round(1e9 * fields.number('waiting_read_every_s', 0.0, 0.0)),
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
    sensor = fields.choice('sensor', SENSORS, None)
    lasers, position_error = None, 0.0
    if sensor is None:
        lower, upper = fields.numbers('range_mm', 2, _MM)
        if not lower < 0.0 < upper:
            raise UserError(f'{fields.where}: range_mm: expected [lower, upper] around 0')
        position_error = fields.number('position_error_um', 0.0, 0.0, _UM)
        noise = fields.number('noise_um', 0.0, 0.0, _UM)
    else:
        lasers = LaserData(
            SENSORS[sensor],
            fields.number('sphere_radius_mm', lower=1.0, scale=_MM),
            fields.number('aim_error_um', 0.0, 0.0, _UM),
            fields.number('distance_error_um', 0.0, 0.0, _UM),
        )
        lower, upper, noise = lasers.sensor.lower, lasers.sensor.upper, lasers.sensor.noise
    outliers, friction = fields.section('outliers'), fields.section('friction')
    data = GaugeData(
        azimuth,
        tilt,
        fields.number('direction_error_deg', 0.0, 0.0, _DEG),
        position_error,
        noise,
        fields.number('dwell_noise_um', 0.0, 0.0, _UM),
        lower,
        upper,
        _period(fields),
        fields.integer('batch', 1, lower=1),
        outliers.number('share', 0.0, 0.0),
        outliers.number('size_um', 0.0, 0.0, _UM),
        lasers,
        fields.number('late_ms', 0.0, scale=_MS),
        friction.number('lag_um', 0.0, 0.0, _UM),
        friction.number('speed_mm_s', 10.0, 0.01, _MM),
        friction.number('power', 0.0),
    )
    outliers.done()
    friction.done()
    fields.done()
    if np.linalg.matrix_rank(data.directions, tol=1e-3) < 3:
        raise UserError(f'{fields.where}: directions: expected three that span the space')
    return data


def _encoders(fields: Fields) -> Encoders:
    encoders = Encoders(
        _period(fields),
        fields.number('linear_noise_um', 0.0, 0.0, _UM),
        fields.number('rotary_noise_urad', 0.0, 0.0, 1e-6),
        fields.number('linear_step_um', 0.0, 0.0, _UM),
        fields.number('rotary_step_urad', 0.0, 0.0, 1e-6),
    )
    fields.done()
    return encoders


def _drives(fields: Fields) -> Drives:
    base = Drives()
    settle, lag, start = (fields.section(name) for name in ('settle', 'lag', 'start'))
    drives = Drives(
        fields.number('linear_mm_s', base.linear, 1.0, _MM),
        fields.number('rotary_deg_s', base.rotary, 1.0, _DEG),
        fields.number('shortest_s', base.shortest, 0.01),
        settle.number('amplitude_um', base.settle, 0.0, _UM),
        settle.number('frequency_hz', base.frequency, 1.0),
        settle.number('decay_ms', base.decay, 0.1, _MS),
        fields.number('rotary_deg_s2', base.acceleration, 1.0, _DEG),
        lag.number('linear_ms', 0.0, 0.0, _MS),
        lag.number('rotary_ms', 0.0, 0.0, _MS),
        start.number('way_ms', 0.0, 0.0, _MS),
        start.number('frequency_hz', base.start_frequency, 1.0),
        start.number('decay_ms', base.start_decay, 0.1, _MS),
    )
    for section in (settle, lag, start):
        section.done()
    fields.done()
    return drives


def _period(fields: Fields) -> int:
    rate = fields.number('rate_hz', lower=0.1)
    if rate > 1e6:
        raise UserError(f'{fields.where}: rate_hz: expected at most 1e6, got {rate:g}')
    return round(1e9 / rate)


def unmet(faults: Sequence[Fault], cycles: Mapping[str, int]) -> list[str]:
    """One sentence for each fault that never occurs in these cycles (name to number of poses)."""
    lines = []
    for fault in faults:
        if fault.cycle is None:
            continue
        if fault.cycle not in cycles:
            why = f'no cycle {fault.cycle!r} in this session, which has {", ".join(cycles)}'
        elif fault.pose is not None and fault.pose >= cycles[fault.cycle]:
            why = f'no pose {fault.pose} in {fault.cycle}, which has {cycles[fault.cycle]} poses'
        else:
            continue
        lines.append(f'faults: {fault.kind}: {why}: it will not occur')
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Check a truth file; see the module."""
    path, *cycles = sys.argv[1:] if arguments is None else arguments
    pairs = (text.rpartition('=') for text in cycles)
    poses = {name: int(count) for name, _, count in pairs}
    try:
        truth = load_truth(path)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    for line in unmet(truth.faults, poses) if poses else ():
        print(f'{path}: {line}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
