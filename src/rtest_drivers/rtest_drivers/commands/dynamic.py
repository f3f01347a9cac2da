"""Evaluate dynamic measurements: continuous readings while a rotary axis turns.

BAG is a recording with dynamic cycles (and the calibration of their nest), as for
`rtest identify`. dynamic.json and dynamic_report.html are written to the folder `dynamic` beside
the recording, or to --out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rtest_drivers.commands.identify import default_output, recording_name

HELP = 'dynamic errors while a rotary axis turns'
OUTPUT = 'dynamic'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest dynamic`."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='recorded session')
    parser.add_argument('--machine', type=Path, metavar='FILE',
                        help='machine file to use instead of the recorded one')
    parser.add_argument('--no-report', action='store_true', help='write dynamic.json only')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, or to DIR/NAME of each of several recordings')


def run(arguments: argparse.Namespace) -> int:
    """Evaluate every recording."""
    several = len(arguments.bags) > 1
    for bag in arguments.bags:
        out = arguments.out / recording_name(bag) if arguments.out and several else arguments.out
        _one(bag, arguments, out or default_output(bag, OUTPUT))
    return 0


def _one(bag: Path, arguments: argparse.Namespace, out: Path) -> None:
    from rtest_drivers.commands.session import shown
    from rtest_drivers.folders import check_folder, writing
    from rtest_identification.dynamic import output
    from rtest_identification.dynamic.offline import dynamic_recording
    from rtest_identification.dynamic.report import write_report

    check_folder(out)
    session = dynamic_recording(
        bag, arguments.machine, lambda line: print(f'  {line}', flush=True)
    )
    for warning in session.warnings:
        print(f'  warning: {warning}')
    with writing(out):
        path = output.write(session, out)
        if not arguments.no_report:
            write_report(session, out)
    for result in session.results:
        for warning in result.warnings:
            print(f'  warning: {result.setup}: {warning}')
        for line in output.lines(result):
            print(f'  {line}')
    found = '; '.join(output.summary(result) for result in session.results)
    print(f'{recording_name(bag)}: {found} -> {shown(path.absolute())}', flush=True)
