"""Judge a measuring chain by a short recorded session, before the first real one.

BAG is a session whose file has `cycle: {kind: check, ...}`: nest calibration, sphere run-out, ten
visits to one pose, and the sphere standing still. Prints of each gauge its direction, sign, gain,
noise and strongest line, of the nest its residual and geometry, run-out, repeatability and
temperature: value, limit, verdict, and what to do. Exit status 1 where something is wrong.
`rtest session --check` tries the devices, measures such a session and judges it.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from rtest_estimation.errors import UserError

HELP = 'judge gauges, nest, sphere, repeatability and noise by a recorded check session'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest check`."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='recorded check session')
    parser.add_argument('--direction', type=float, nargs=3, default=(0.0, 0.0, 1.0),
                        metavar=('X', 'Y', 'Z'), help='from the nest to where the sphere comes '
                        'from, frame of the table (default: 0 0 1)')
    parser.add_argument('--spindle-rpm', type=float, metavar='N',
                        help='speed of the spindle while nothing else moved, to name lines')


def run(arguments: argparse.Namespace) -> int:
    """Judge and print; returns the exit status."""
    return judge(arguments.bag, arguments.direction, arguments.spindle_rpm)


def judge(path: Path, direction: Sequence[float], rpm: float | None = None) -> int:
    """Judge the recorded session of a measuring chain, print; 1 where something is wrong, else 0.

    direction : (3,) from the nest to where the sphere comes from, frame ``table``
    rpm : of the spindle while nothing else moved [1/min]
    """
    import numpy as np

    from rtest_estimation.bagfile import read_bag
    from rtest_estimation.recording import TYPES, recording_of, temperatures
    from rtest_estimation.standing import longest_standing
    from rtest_identification.chain_check import check_chain
    from rtest_identification.finding import OPEN, WRONG
    from rtest_identification.offline import estimate_recording

    towards = np.array(direction)
    length = float(np.linalg.norm(towards))
    if not 0.0 < length < math.inf:
        raise UserError('--direction: expected a vector that is not zero')
    if rpm is not None and not 0.0 < rpm < math.inf:
        raise UserError(f'--spindle-rpm: expected a positive number, got {rpm:g}')
    bag = read_bag(path, TYPES)
    recording = recording_of(bag)
    found = check_chain(
        estimate_recording(recording),
        longest_standing(recording.gauges, recording.feedback),
        temperatures(bag, []),
        towards / length,
        None if rpm is None else rpm / 60.0,
    )
    width = max(len(one.what) for one in found)
    for one in found:
        print(f'{one.verdict.upper():6}{one.what:{width}}  {one.value}'
              + (f'  (limit: {one.limit})' if one.limit else ''))
        if one.advice:
            print(f'{"":6}{"":{width}}  -> {one.advice}')
    wrong = [one.what for one in found if one.verdict == WRONG]
    if recording.lost:
        wrong.append(f'{recording.lost} readings lost')
    unknown = sum(one.verdict == OPEN for one in found)
    for what in wrong:
        print(f'rtest: wrong: {what}', file=sys.stderr)
    print(f'{path}: {len(found)} looked at, {len(wrong)} wrong, {unknown} left open')
    return 1 if wrong else 0
