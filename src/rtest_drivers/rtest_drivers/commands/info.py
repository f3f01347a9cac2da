"""Tell what is in a recording: session, machine, cycles, losses, topics. Needs no ROS.

BAG is a recording: a folder with metadata.yaml or one .mcap file, also one that was cut off.
With --repair a cut one is mended: a copy with index and metadata.yaml, which every reader opens,
is written to --out; the original is not touched.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rtest_drivers.topics import add_topic_argument, chosen_topics
from rtest_estimation.errors import UserError

HELP = 'tell what is in a recording, or mend it'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest info`."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='recorded session')
    add_topic_argument(parser)
    parser.add_argument('--repair', action='store_true',
                        help='write a mended copy to --out, and say what is missing in it')
    parser.add_argument('--out', type=Path, metavar='FILE',
                        help='with --repair: the folder to make, or one file where it ends in '
                        '.mcap')


def run(arguments: argparse.Namespace) -> int:
    """Print what is in one recording, or what came of mending it."""
    if arguments.repair:
        return _repair(arguments.bag, arguments.out)
    if arguments.out is not None:
        raise UserError('--out: expected together with --repair')
    from rtest_drivers.info import describe

    lines = describe(arguments.bag, chosen_topics(arguments.topic))
    kinds = [line.split(maxsplit=1)[0] for line in lines]
    print('\n'.join(lines))
    print(
        f'{arguments.bag}: {_count(kinds, "plan", "cycle")}, {_count(kinds, "topic")}, '
        f'{_count(kinds, "warning")}'
    )
    return 0


def _repair(bag: Path, out: Path | None) -> int:
    if out is None:
        raise UserError('--repair: expected --out FILE, where the mended recording is to go')
    from rtest_drivers.mend import mend

    mended = mend(bag, out)
    for text in mended.missing:
        print(f'missing   {text}')
    count = sum(mended.messages.values())
    what = f'{count} messages of {len(mended.messages)} topics'
    if mended.path is None:
        print(f'{bag}: whole, {what}; nothing to mend, nothing written')
    else:
        print(f'{bag}: mended, {what}, {mended.path}')
    return 0


def _count(kinds: list[str], kind: str, noun: str = '') -> str:
    number = kinds.count(kind)
    return f'{number} {noun or kind}{"" if number == 1 else "s"}'
