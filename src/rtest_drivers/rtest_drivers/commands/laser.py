"""What a laser nest is worth: verification points, kernels of the correction, scanned spheres.

BAG is a recording of a session with `nest: {kind: laser}`. Evaluated are its nest calibrations,
the cycles that verify them, and scans over the sphere. laser.json and the figures are written to
the folder `laser` beside the recording, or to --out.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from rtest_drivers.commands.identify import folders, recording_name
from rtest_estimation.errors import UserError

HELP = 'errors of a laser nest: verification points, scanned spheres'
OUTPUT = 'laser'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest laser`."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='recorded session')
    parser.add_argument('--sphere-radius-mm', type=float, metavar='R',
                        help='of the sphere, where the recording has no nest calibration that '
                        'says it')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, or to DIR/NAME of each of several recordings')


def run(arguments: argparse.Namespace) -> int:
    """Evaluate every recording."""
    radius = arguments.sphere_radius_mm
    if radius is not None and not 0.0 < radius < math.inf:
        raise UserError(f'--sphere-radius-mm {radius:g}: expected a positive number of mm')
    for bag, out in folders(arguments.bags, arguments.out, OUTPUT):
        _one(bag, out, None if radius is None else radius * 1e-3)
    return 0


def _one(bag: Path, out: Path, radius: float | None) -> None:
    from rtest_drivers.commands.session import shown
    from rtest_drivers.folders import check_folder, writing
    from rtest_identification.laser import output
    from rtest_identification.laser.recorded import laser_recording

    check_folder(out)
    result = laser_recording(bag, lambda line: print(f'  {line}', flush=True), radius)
    for line in output.lines(result):
        print(f'  {line}')
    with writing(out):
        path = output.write(result, out)
    print(f'{recording_name(bag)}: {output.summary(result)} -> {shown(path.absolute())}',
          flush=True)
