"""`laser.json`, its figures, and what is printed of a laser nest."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from rtest_estimation.laser import CentreStatus
from rtest_estimation.laser.correction import THESIS, Kernel
from rtest_estimation.laser.profile import TOLERANCE
from rtest_estimation.laser.verification import Deviation
from rtest_identification.laser.recorded import KernelCheck, LaserResult, NestCheck, Scan

_UM = 1e6


def kernel_name(kernel: Kernel | None) -> str:
    """For a person, for example ``cubic + degree 1, smoothing 10``."""
    if kernel is None:
        return 'none'
    if kernel == THESIS:
        return 'linear alone (thesis)'
    text = f'{kernel.name.replace("_", " ")} + degree {kernel.degree}'
    return f'{text}, smoothing {kernel.smoothing:g}' if kernel.smoothing else text


def as_dict(result: LaserResult) -> dict[str, Any]:
    """Content of laser.json; SI units, null where not known."""
    return {
        'session': result.session,
        'sphere_radius': result.sphere_radius,
        'nests': [_nest(check) for check in result.checks],
        'scans': [_scan(scan) for scan in result.scans],
        'tolerance': TOLERANCE,
        'warnings': list(result.warnings),
    }


def _nest(check: NestCheck) -> dict[str, Any]:
    nest, verification = check.nest, check.verification
    found: dict[str, Any] = {
        'setup': nest.setup,
        'calibration': nest.calibration,
        'lasers': len(nest.spot),
        'spot': nest.spot.tolist(),
        'direction': nest.direction.tolist(),
        'condition': nest.condition,
        'nodes': len(nest.correction_nodes),
        'residual_not_corrected': nest.residual,
        'kernel': _kernel(check.chosen),
        'kernels': [
            {**_kernel(one.kernel), 'left_out': one.left_out, 'verified': _deviation(one.verified)}
            for one in check.kernels
        ],
        'verification': None,
    }
    if verification is not None:
        found['verification'] = {
            'points': len(check.positions),
            **{status.name.lower(): verification.count(status) for status in CentreStatus},
            'contact_algorithm': _deviation(check.contact),
            'not_corrected': _deviation(verification.raw),
            'corrected': _deviation(verification.corrected),
        }
    return found


def _kernel(kernel: Kernel | None) -> dict[str, Any] | None:
    return None if kernel is None else vars(kernel)


def _deviation(found: Deviation | None) -> dict[str, float] | None:
    return None if found is None else vars(found)


def _scan(scan: Scan) -> dict[str, Any]:
    profile = scan.profile
    return {
        'cycle': scan.cycle,
        'setup': scan.setup,
        'laser': scan.laser,
        'readings': len(scan.reading),
        'without_signal': int((~scan.valid).sum()),
        'noise': profile.noise,
        'largest_smooth_error': float(np.nanmax(np.abs(profile.smooth))),
        'area_1_flat': profile.flat,
        'area_2_accurate': profile.accurate,
        'area_3_measurable': profile.measurable,
        'area_4_reached': profile.bounded,
        'top': profile.top.tolist(),
    }


def write(result: LaserResult, out: Path) -> Path:
    """Write laser.json and the figures into `out`; returns the path of laser.json."""
    from rtest_identification.figures.style import save
    from rtest_identification.laser.figures import scan_figure, verification_figure

    out.mkdir(parents=True, exist_ok=True)
    for scan in result.scans:
        save(scan_figure(scan, result), out, f'profile_{scan.cycle}')
    for check in result.checks:
        if check.verification is not None and check.verification.corrected is not None:
            save(verification_figure(check, result), out, f'verification_{check.nest.setup}')
    path = out / 'laser.json'
    part = path.with_name(path.name + '.part')
    part.write_text(json.dumps(as_dict(result), indent=1, allow_nan=False) + '\n',
                    encoding='utf-8')
    os.replace(part, path)
    return path


def lines(result: LaserResult) -> list[str]:
    """What is printed before the last line."""
    told = [f'warning: {text}' for text in result.warnings]
    for check in result.checks:
        told += _told(check)
    for scan in result.scans:
        profile = scan.profile
        end = '' if profile.bounded else ' (end of the scan)'
        told.append(
            f'{scan.cycle}: laser {scan.laser}, noise {profile.noise * _UM:.2f} µm, areas from '
            f'the top: 1 flat ±{profile.flat * 1e3:.2f}, 2 accurate ±{profile.accurate * 1e3:.2f},'
            f' 3 measurable ±{profile.measurable * 1e3:.2f} mm{end}'
        )
    return told


def _told(check: NestCheck) -> list[str]:
    nest, verification = check.nest, check.verification
    told = [
        f'{nest.setup}: {len(nest.spot)} lasers, {len(nest.correction_nodes)} positions; Eq. 5-4 '
        f'alone leaves {nest.residual * _UM:.2f} µm rms there'
    ]
    head = f'    {"error [µm]":42} {"left-out node":>13}'
    if verification is None:
        return [*told, head, *(_row(one, check) for one in _best_of_each(check))]
    outside = len(check.positions) - verification.count(CentreStatus.VALID)
    told.append(
        f'    verified at {len(check.positions) - outside} of {len(check.positions)} points'
        + (f'; {outside} outside the calibrated volume or without a centre' if outside else '')
    )
    told.append(f'{head} {"mean":>7} {"std":>7} {"max":>7}')
    for name, found in (
        ('contact algorithm (Eq. 2-6)', check.contact), ('not corrected', verification.raw)
    ):
        told.append(f'    {name:42} {"":13}{_numbers(found)}')
    return told + [_row(one, check) for one in _best_of_each(check)]


def _row(one: KernelCheck, check: NestCheck) -> str:
    left = f'{one.left_out * _UM:13.2f}' if one.left_out is not None else f'{"":13}'
    mark = '*' if one.kernel == check.chosen else ' '
    return f'  {mark} {kernel_name(one.kernel):42} {left}{_numbers(one.verified)}'.rstrip()


def _best_of_each(check: NestCheck) -> list[KernelCheck]:
    """Of each kernel the smoothing with the smallest error at left-out nodes."""
    best: dict[tuple[str, int], KernelCheck] = {}
    for one in check.kernels:
        key = (one.kernel.name, one.kernel.degree)
        if key not in best or (one.left_out or np.inf) < (best[key].left_out or np.inf):
            best[key] = one
    return list(best.values())


def _numbers(found: Deviation | None) -> str:
    if found is None:
        return ''
    return ''.join(f' {value * _UM:7.2f}' for value in (found.mean, found.std, found.max))


def summary(result: LaserResult) -> str:
    """For example ``nest 1a 6.50 µm without, 1.09 µm with correction at 1183 points; 3 scans``."""
    parts = []
    for check in result.checks:
        verification = check.verification
        if verification is not None and verification.corrected is not None:
            parts.append(
                f'nest {check.nest.setup} {verification.raw.mean * _UM:.2f} µm without, '
                f'{verification.corrected.mean * _UM:.2f} µm with correction at '
                f'{verification.count(CentreStatus.VALID)} points'
            )
        else:
            parts.append(f'nest {check.nest.setup} calibrated, not verified')
    if result.scans:
        noise = np.median([scan.profile.noise for scan in result.scans]) * _UM
        plural = '' if len(result.scans) == 1 else 's'
        parts.append(f'{len(result.scans)} scan{plural}, noise {noise:.2f} µm')
    return '; '.join(parts)
