"""The nest in a session file: its kind, and the cycles that calibrate and check it."""

from __future__ import annotations

import math

import numpy as np

from rtest_estimation.dwell import DwellRules
from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, NestKind
from rtest_identification.machine import Machine
from rtest_identification.plans import (
    laser_calibration,
    laser_scan,
    laser_verification,
    nest_calibration,
)
from rtest_identification.session_reader import Reader

# What can be meant: half of a dwell at least is used; steps that the gauges see and reach.
DWELL_S = (2.0 * DwellRules().settle, 60.0)
_STEP_MM = (0.05, 5.0)
# Edge of the cube that a laser nest is calibrated in; half a scan and the distance of its lines.
_EDGE_MM, _HALF_MM, _PITCH_MM = (0.1, 5.0), (0.1, 5.0), (0.01, 1.0)
_FEED_MM_MIN = (1.0, 600.0)


def nest_kind(reader: Reader) -> NestKind:
    """The section `nest`; what belongs to the other kind is refused."""
    nest = reader.section('nest', {'kind', 'directions'})
    kinds = {kind.name.lower(): kind for kind in NestKind}
    given = nest.data.get('kind', 'contact')
    if given not in kinds:
        raise UserError(f'{nest.where}: kind: expected {" or ".join(kinds)}, got {given!r}')
    if kinds[given] is NestKind.LASER:
        # Every micrometre of it is in the sphere centres; a contact nest does without.
        reader.required('sphere_radius_mm')
    else:
        for section in ('verification', 'scan'):
            if section in reader.data:
                raise UserError(
                    f'{reader.where}: {section}: is of laser nests; expected nest: {{kind: laser}}'
                )
    return kinds[given]


def calibration_plan(
    reader: Reader, kind: NestKind, machine: Machine, setup: str, sphere: np.ndarray
) -> CyclePlan:
    """The section `nest_calibration` of one set-up."""
    key, build = 'step_mm', nest_calibration
    limits = _STEP_MM
    if kind is NestKind.LASER:
        key, build, limits = 'edge_mm', laser_calibration, _EDGE_MM
    section = reader.section('nest_calibration', {key, 'dwell_s'})
    size = section.number(key, 1.0, limits) * 1e-3
    return build(machine, setup, sphere, size, section.number('dwell_s', 0.3, DWELL_S))


def laser_checks(
    reader: Reader, kind: NestKind, machine: Machine, setup: str, sphere: np.ndarray
) -> list[CyclePlan]:
    """Verification and scans, where the file wants them."""
    plans = []
    if kind is NestKind.LASER and reader.data.get('verification') is not None:
        section = reader.section('verification', {'edge_mm', 'dwell_s'})
        cube = reader.section('nest_calibration', {'edge_mm', 'dwell_s'})
        largest = cube.number('edge_mm', 1.0, _EDGE_MM)
        edge = section.number('edge_mm', min(1.0, largest), _EDGE_MM) * 1e-3
        if edge > largest * 1e-3 + 1e-9:
            raise UserError(
                f'{section.where}: edge_mm: {edge * 1e3:g} is beyond the calibrated cube of '
                f'{largest:g} mm, outside which there are no centres'
            )
        dwell = section.number('dwell_s', 0.2, DWELL_S)
        plans.append(laser_verification(machine, setup, sphere, edge, dwell))
    if kind is NestKind.LASER and reader.data.get('scan') is not None:
        section = reader.section('scan', {'half_mm', 'pitch_mm', 'feed_mm_min'})
        half = section.number('half_mm', 1.0, _HALF_MM) * 1e-3
        pitch = section.number('pitch_mm', 0.1, _PITCH_MM) * 1e-3
        feed = section.number('feed_mm_min', 60.0, _FEED_MM_MIN) / 6e4
        for number, direction in enumerate(_directions(reader), start=1):
            plans.append(
                laser_scan(machine, setup, sphere, number, direction, half, pitch, feed)
            )
    return plans


def _directions(reader: Reader) -> list[np.ndarray]:
    """Unit vectors from the sphere to the lasers, which stand below it, of `nest`."""
    nest = reader.section('nest', {'kind', 'directions'})
    entries = nest.data.get('directions')
    if not isinstance(entries, list) or not entries:
        raise UserError(
            f'{nest.where}: directions: expected a list of {{azimuth_deg, tilt_deg}}, which a '
            'scan needs'
        )
    if not 3 <= len(entries) <= 4:
        raise UserError(f'{nest.where}: directions: expected three or four, got {len(entries)}')
    found = []
    for number, entry in enumerate(entries, start=1):
        where = f'{nest.where}: directions: {number}'
        one = Reader(where, entry if isinstance(entry, dict) else {})
        one.only({'azimuth_deg', 'tilt_deg'})
        azimuth, tilt = (math.radians(one.real(key)) for key in ('azimuth_deg', 'tilt_deg'))
        flat = math.cos(tilt)
        found.append(
            np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), -math.sin(tilt)])
        )
    return found
