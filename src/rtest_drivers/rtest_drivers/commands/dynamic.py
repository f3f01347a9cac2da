"""Evaluate dynamic measurements: continuous readings while a rotary axis turns.

BAG is a recording with dynamic cycles (and the calibration of their nest), as for
`rtest identify`. dynamic.json and dynamic_report.html are written to the folder `dynamic` beside
the recording, or to --out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rtest_drivers.commands.identify import default_output, folders, recording_name

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
    for bag, out in folders(arguments.bags, arguments.out, OUTPUT):
        evaluate(bag, out, arguments.machine, not arguments.no_report)
    return 0


def evaluate(
    bag: Path, out: Path | None = None, machine: Path | None = None, report: bool = True
) -> Path:
    """Evaluate one recording, with progress and a last line that says what was found.

    machine : another machine file than the recorded one

    Returns the path of dynamic.json.
    """
    from rtest_drivers.commands.session import shown
    from rtest_drivers.folders import check_folder, writing
    from rtest_identification.dynamic import output
    from rtest_identification.dynamic.offline import dynamic_recording
    from rtest_identification.dynamic.report import write_report

    folder = out or default_output(bag, OUTPUT)
    check_folder(folder)
    session = dynamic_recording(bag, machine, lambda line: print(f'  {line}', flush=True))
    for warning in session.warnings:
        print(f'  warning: {warning}')
    for result in session.results:
        for warning in result.warnings:
            print(f'  warning: {result.setup}: {warning}')
        for line in output.lines(result):
            print(f'  {line}')
    with writing(folder):
        path = output.write(session, folder)
        if report:
            write_report(session, folder)
    found = '; '.join(output.summary(result) for result in session.results)
    print(f'{recording_name(bag)}: {found} -> {shown(path.absolute())}', flush=True)
    return path
