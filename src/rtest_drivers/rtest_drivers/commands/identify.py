"""Identify the machine's errors from recordings alone, without ROS.

BAG is a recording: a folder with metadata.yaml or one .mcap file, also one that was cut off.
Several recordings are identified one by one. identification.json and report.html are written to
the folder `identification` beside the recording, or to --out.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rtest_drivers.topics import add_topic_argument, chosen_topics
from rtest_estimation.errors import UserError

if TYPE_CHECKING:
    from rtest_identification.pipeline import Identification

HELP = 'identify the errors of a machine from recordings'
OUTPUT = 'identification'
# With fewer trials a standard uncertainty is not known to 10 %.
MIN_TRIALS = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest identify`."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='recorded session')
    parser.add_argument('--machine', type=Path, metavar='FILE',
                        help='machine file to use instead of the recorded one')
    parser.add_argument('--nest', type=Path, metavar='BAG',
                        help='another recording, whose nest calibrations are used instead of the '
                        "recording's own; the nest must not have been taken apart in between")
    parser.add_argument('--tolerance', type=Path, metavar='FILE',
                        help='judge every error by the limits of FILE: pass, fail or undecided '
                        '(ISO 14253-1); for example config/tolerance_example.yaml')
    parser.add_argument('--priors', type=Path, metavar='FILE',
                        help='error motions of the linear axes as far as they are known, for the '
                        'uncertainty; for example config/priors_example.yaml')
    parser.add_argument('--monte-carlo', type=int, default=0, metavar='N', dest='trials',
                        help='check the uncertainty of the location errors by N random trials')
    parser.add_argument('--model', type=Path, metavar='FILE',
                        help='a model.yaml of `rtest gap`, whose effects are taken out')
    parser.add_argument('--effects', type=Path, metavar='FILE',
                        help='effects of your own that the model has')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, or to DIR/NAME of each of several recordings')
    add_topic_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Identify every recording."""
    if arguments.trials and arguments.trials < MIN_TRIALS:
        raise UserError(f'--monte-carlo {arguments.trials}: expected {MIN_TRIALS} trials or more')
    options = Options(
        arguments.machine, chosen_topics(arguments.topic), arguments.tolerance, arguments.priors,
        arguments.model, arguments.trials, arguments.effects, arguments.nest,
    )
    for bag, out in folders(arguments.bags, arguments.out, OUTPUT):
        identify(bag, out, options)
    return 0


def folders(bags: Sequence[Path], out: Path | None, name: str) -> list[tuple[Path, Path]]:
    """Every recording with the folder for its results.

    out : for one recording, or for a folder of each of several; beside the recordings when
        omitted, with this name

    Raises UserError where two recordings would share one.
    """
    found: list[tuple[Path, Path]] = []
    taken: dict[Path, Path] = {}
    for bag in bags:
        if out is None:
            folder = default_output(bag, name)
        else:
            folder = out / recording_name(bag) if len(bags) > 1 else out
        place = folder.resolve()
        if place in taken:
            raise UserError(
                f'{taken[place]} and {bag}: both would be written to {folder}; give them one by '
                'one, with --out'
            )
        taken[place] = bag
        found.append((bag, folder))
    return found


@dataclass(frozen=True)
class Options:
    """How to identify: other files than the recorded ones, and what to do besides.

    trials : of a Monte Carlo propagation; 0 for none
    nest : recording whose nest calibrations are used
    """

    machine: Path | None = None
    topics: dict[str, str] | None = None
    tolerance: Path | None = None
    priors: Path | None = None
    model: Path | None = None
    trials: int = 0
    effects: Path | None = None
    nest: Path | None = None


def identify(
    bag: Path, out: Path | None = None, options: Options | None = None, quiet: bool = False
) -> Path:
    """Identify one recording, with progress and a last line that says what was found.

    quiet : without what a session has said of its cycles already

    Returns the path of identification.json.
    """
    options = options or Options()
    from rtest_drivers.commands.session import shown
    from rtest_drivers.folders import check_folder, writing
    from rtest_identification import output
    from rtest_identification.offline import identify_recording
    from rtest_identification.tolerance import load_tolerances
    from rtest_identification.verdict import judge
    from rtest_identification.verdict_table import lines

    limits = load_tolerances(options.tolerance) if options.tolerance else None
    if out is not None:
        check_folder(out)
    name = recording_name(bag)
    result = identify_recording(
        bag, options.machine, lambda line: quiet or print(f'  {line}', flush=True),
        options.topics, options.priors, options.model, limits, options.effects, options.nest,
    )
    for line in _missing(result):
        print(f'  missing: {line}')
    for warning in result.warnings:
        print(f'  warning: {warning}')
    for line in _trials(result, options.trials):
        print(f'  {line}')
    verdict = judge(result, limits) if limits else None
    for line in lines(verdict) if verdict else ():
        print(f'  {line}')
    folder = out or default_output(bag)
    with writing(folder):
        path = output.write(result, folder, verdict)['json']
    judged = f', verdict: {verdict.summary}' if verdict else ''
    print(f'{name}: {_found(result)}{judged} -> {shown(path.absolute())}', flush=True)
    return path


def _trials(result: Identification, trials: int) -> list[str]:
    """Monte Carlo beside linear propagation, standard uncertainties in µm and µrad."""
    if trials <= 0:
        return []
    from rtest_identification.uncertainty import NOISE, monte_carlo

    scatter = replace(result.location, covariance=result.budget.parts[NOISE])
    draws = monte_carlo(scatter, result.sources, result.fit.rms, trials)
    found = draws.covariance.diagonal() ** 0.5
    return [f'{trials} trials: standard uncertainty by Monte Carlo / linear propagation'] + [
        f'  {p.symbol:10} {1e6 * one:8.3f} /{1e6 * other:8.3f} {"µrad" if p.angular else "µm"}'
        for p, one, other in zip(
            result.location.parameters, found, result.location.stddev, strict=True
        )
    ]


def _found(result: Identification) -> str:
    """For example `8 location errors, 3 squareness errors, residual 0.26 µm, 344 of 344 poses`."""
    rotary = [p.axis in result.machine.rotary for p in result.location.parameters]
    determined = list(result.location.determined)
    location = sum(turns and good for turns, good in zip(rotary, determined, strict=True))
    square = sum(determined) - location
    used = len(result.observations) - len(result.outliers)
    return (
        f'{location} location errors, {square} squareness errors, '
        f'residual {result.fit.rms * 1e6:.2f} µm, '
        f'{used} of {result.poses} poses'
    )


def _missing(result: Identification) -> list[str]:
    """Missing poses by cycle and reason, for example `1a-static 3-17: no gauge readings`."""
    from rtest_estimation.missing import grouped
    from rtest_estimation.records import Missing

    cycles = dict.fromkeys(item.cycle for item in result.missing)
    return [
        f'{cycle} {line}'
        for cycle in cycles
        for line in grouped(
            Missing(item.pose, item.reason) for item in result.missing if item.cycle == cycle
        )
    ]


def recording_name(bag: Path) -> str:
    """Name of a recording: of its folder, or of the file where it is a bare file."""
    folder = _folder(bag)
    return (folder or bag.with_suffix('')).absolute().name


def default_output(bag: Path, name: str = OUTPUT) -> Path:
    """Where the result goes without --out: beside the recording, else into the current folder."""
    folder = _folder(bag)
    beside = folder / name if folder else bag.with_name(f'{recording_name(bag)}-{name}')
    return beside if _writable(beside) else Path(f'{recording_name(bag)}-{name}')


def _writable(folder: Path) -> bool:
    """Whether results may go there: what is write-protected stays as it is, even for root."""
    place = folder if folder.exists() else folder.parent
    return os.access(place, os.W_OK) and bool(place.stat().st_mode & 0o222)


def _folder(bag: Path) -> Path | None:
    """Folder that is the recording, None for a bare file."""
    if bag.is_dir():
        return bag
    return bag.parent if (bag.parent / 'metadata.yaml').is_file() else None
