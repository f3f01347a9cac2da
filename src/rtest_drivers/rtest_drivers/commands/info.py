"""Tell what is in a recording: session, machine, cycles, losses, topics. Needs no ROS.

BAG is a recording: a folder with metadata.yaml or one .mcap file, also one that was cut off.
"""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = 'tell what is in a recording'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest info`."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='recorded session')


def run(arguments: argparse.Namespace) -> int:
    """Print what is in one recording."""
    from rtest_drivers.info import describe

    lines = describe(arguments.bag)
    kinds = [line.split(maxsplit=1)[0] for line in lines]
    print('\n'.join(lines))
    print(
        f'{arguments.bag}: {_count(kinds, "plan", "cycle")}, {_count(kinds, "topic")}, '
        f'{_count(kinds, "warning")}'
    )
    return 0


def _count(kinds: list[str], kind: str, noun: str = '') -> str:
    number = kinds.count(kind)
    return f'{number} {noun or kind}{"" if number == 1 else "s"}'
