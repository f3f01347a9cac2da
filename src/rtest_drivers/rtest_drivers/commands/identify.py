"""Identify the machine's errors from recordings alone, without ROS.

BAG is a recording: a folder with metadata.yaml or one .mcap file, also one that was cut off.
Several recordings are identified one by one. identification.json and report.html are written to
the folder `identification` beside the recording, or to --out.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from rtest_estimation.errors import UserError

if TYPE_CHECKING:
    from rtest_identification.pipeline import Identification

HELP = 'identify the errors of a machine from recordings'
OUTPUT = 'identification'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest identify`."""
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG', help='recorded session')
    parser.add_argument('--machine', type=Path, metavar='FILE',
                        help='machine file to use instead of the recorded one')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, or to DIR/NAME of each of several recordings')
    parser.add_argument('--topic', action='append', default=[], metavar='ROLE=NAME',
                        help='where a recording has several topics of a type: the one that is '
                        'meant, for example gauges=/cell_2/rtest/gauges; may be given often')


def run(arguments: argparse.Namespace) -> int:
    """Identify every recording."""
    several = len(arguments.bags) > 1
    for bag in arguments.bags:
        out = arguments.out / recording_name(bag) if arguments.out and several else arguments.out
        identify(bag, arguments.machine, out, _topics(arguments.topic))
    return 0


def _topics(chosen: list[str]) -> dict[str, str]:
    from rtest_estimation.recording import ROLES

    topics = dict(text.partition('=')[::2] for text in chosen)
    for role, name in topics.items():
        if role not in ROLES or not name.startswith('/'):
            raise UserError(
                f'--topic {role}={name}: expected ROLE=/NAME with a role of {", ".join(ROLES)}'
            )
    return topics


def identify(
    bag: Path,
    machine: Path | None = None,
    out: Path | None = None,
    topics: dict[str, str] | None = None,
) -> Path:
    """Identify one recording, with progress and a last line that says what was found.

    Returns the path of identification.json.
    """
    from rtest_drivers.commands.session import shown
    from rtest_identification import output
    from rtest_identification.offline import identify_recording

    name = recording_name(bag)
    result = identify_recording(
        bag, machine, lambda line: print(f'  {line}', flush=True), topics
    )
    for warning in result.warnings:
        print(f'  warning: {warning}')
    path = output.write(result, out or default_output(bag))['json']
    print(f'{name}: {_found(result)} -> {shown(path.absolute())}', flush=True)
    return path


def _found(result: Identification) -> str:
    """For example `8 location errors, 3 squareness errors, residual 0.26 µm, 344 of 344 poses`."""
    rotary = [p.axis in result.machine.rotary for p in result.location.parameters]
    determined = list(result.location.determined)
    location = sum(turns and good for turns, good in zip(rotary, determined, strict=True))
    square = sum(determined) - location
    used = len(result.observations) - len(result.outliers)
    static = set(result.observations.cycles)
    lost = sum(item.cycle in static for item in result.missing)
    return (
        f'{location} location errors, {square} squareness errors, '
        f'residual {result.fit.rms * 1e6:.2f} µm, '
        f'{used} of {len(result.observations) + lost} poses'
    )


def recording_name(bag: Path) -> str:
    """Name of a recording: of its folder, or of the file where it is a bare file."""
    folder = _folder(bag)
    return (folder or bag.with_suffix('')).absolute().name


def default_output(bag: Path) -> Path:
    """Where the result goes without --out: beside the recording, else into the current folder."""
    folder = _folder(bag)
    beside = folder / OUTPUT if folder else bag.with_name(f'{recording_name(bag)}-{OUTPUT}')
    return beside if _writable(beside) else Path(f'{recording_name(bag)}-{OUTPUT}')


def _writable(folder: Path) -> bool:
    """Whether results may go there: what is write-protected stays as it is, even for root."""
    place = folder if folder.exists() else folder.parent
    return os.access(place, os.W_OK) and bool(place.stat().st_mode & 0o222)


def _folder(bag: Path) -> Path | None:
    """Folder that is the recording, None for a bare file."""
    if bag.is_dir():
        return bag
    return bag.parent if (bag.parent / 'metadata.yaml').is_file() else None
