"""Give every error over time and temperature: a cycle repeated while the machine warms up.

BAG is a recording, as for `rtest identify`, of one session that repeats a short cycle at one
sphere position, with temperatures where there are thermometers. thermal.json and
thermal_report.html are written to the folder `thermal` beside the recording, or to --out.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rtest_drivers.commands.identify import default_output, recording_name

if TYPE_CHECKING:
    from rtest_identification.thermal.pipeline import Thermal

HELP = 'errors over time and temperature from repeated cycles'
OUTPUT = 'thermal'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest thermal`."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='recorded session')
    parser.add_argument('--machine', type=Path, metavar='FILE',
                        help='machine file to use instead of the recorded one')
    parser.add_argument('--priors', type=Path, metavar='FILE',
                        help='error motions of the linear axes as far as they are known, for the '
                        'uncertainty of the reference; for example config/priors_example.yaml')
    parser.add_argument('--no-report', action='store_true', help='write thermal.json only')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, or to DIR/NAME of each of several recordings')


def run(arguments: argparse.Namespace) -> int:
    """Identify every recording."""
    several = len(arguments.bags) > 1
    for bag in arguments.bags:
        out = arguments.out / recording_name(bag) if arguments.out and several else arguments.out
        evaluate(bag, out, arguments.machine, arguments.priors, not arguments.no_report)
    return 0


def evaluate(
    bag: Path,
    out: Path | None = None,
    machine: Path | None = None,
    priors: Path | None = None,
    report: bool = True,
    quiet: bool = False,
) -> Path:
    """Evaluate one recording, with progress and a last line that says what was found.

    quiet : without what a session has said of its cycles already

    Returns the path of thermal.json.
    """
    from rtest_drivers.commands.session import shown
    from rtest_drivers.folders import check_folder, writing
    from rtest_identification.thermal import output, words
    from rtest_identification.thermal.offline import thermal_recording

    out = out or default_output(bag, OUTPUT)
    check_folder(out)
    result = thermal_recording(
        bag, machine, lambda line: quiet or print(f'  {line}', flush=True), priors_path=priors
    )
    for line in _lines(result):
        print(f'  {line}')
    with writing(out):
        path = output.write(result, out)
        if report:
            from rtest_identification.thermal.report import write_report

            write_report(result, out)
    print(f'{recording_name(bag)}: {words.summary(result)} -> {shown(path.absolute())}',
          flush=True)
    return path


def _lines(result: Thermal) -> list[str]:
    """Warnings, temperatures, and what is known of every error that drifts."""
    from rtest_identification.thermal import words

    lines = [f'missing: {line}' for line in words.missing(result)]
    lines += [f'warning: {warning}' for warning in result.warnings]
    for one in result.thermometers:
        if change := words.warming(result, one):
            lines.append(f'{one.sensor}: {change}')
    for one in result.drifting:
        lines.append(words.drift(one))
        lines += [f'  time constant {words.tau(c)}' for c in one.constants]
        if explained := words.explained(one):
            lines.append(f'  {explained}')
    return lines
