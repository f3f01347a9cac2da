"""Publish a recording in a ROS graph again, so that live nodes compute from it anew.

BAG is a recording: a folder with metadata.yaml or one .mcap file, also one that was cut off. What
the drivers and the session had published goes out with its stamps and with /clock: machine, plans,
readings, feedback, temperatures. The space bar pauses. An estimator that listens is given time to
take every message, so that it finds what `rtest identify` does, at any rate; start it, the
identifier and whatever else is to follow /clock with the parameter use_sim_time:=true.
"""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

from rtest_drivers.topics import add_topic_argument
from rtest_estimation.errors import UserError

HELP = 'publish a recording again, for live nodes'
MAX = 'max'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest replay`."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='recorded session')
    parser.add_argument('--rate', default='1', metavar='R',
                        help='seconds of the recording per second, or max: as fast as the '
                        'estimator takes it (default: 1)')
    parser.add_argument('--start', type=float, default=0.0, metavar='S',
                        help='begin S seconds after the first message; plans and machine from '
                        'before are published all the same')
    parser.add_argument('--stop', type=float, metavar='S',
                        help='end S seconds after the first message')
    parser.add_argument('--loop', action='store_true', help='begin anew at the end, until Ctrl-C')
    parser.add_argument('--pause', action='store_true',
                        help='wait at the first message for the space bar or the service '
                        'replay/pause')
    parser.add_argument('--all', action='store_true',
                        help='also what estimator, identifier and others had published; for '
                        'viewers, not beside these nodes')
    parser.add_argument('--force', action='store_true',
                        help='go on where somebody else publishes on the same topics')
    add_topic_argument(parser)
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO',
                        help='publish a topic under another name; may be given several times')
    parser.add_argument('--domain', type=int, metavar='N',
                        help='ROS domain (default: ROS_DOMAIN_ID)')


def run(arguments: argparse.Namespace) -> int:
    """Replay one recording."""
    from rtest_drivers.domain import chosen_domain
    from rtest_drivers.graph import check_remaps
    from rtest_drivers.runner import need_ros

    if arguments.stop is not None and not arguments.stop > 0.0:
        raise UserError(f'--stop {arguments.stop:g}: expected a time after --start')
    need_ros()
    check_remaps(arguments.remap)
    os.environ['ROS_DOMAIN_ID'] = str(chosen_domain(False, arguments.domain))
    parameters = {
        'bag': str(arguments.bag),
        'rate': _rate(arguments.rate),
        'start': arguments.start,
        'stop': 0.0 if arguments.stop is None else arguments.stop,
        'loop': arguments.loop,
        'paused': arguments.pause,
        'everything': arguments.all,
        'force': arguments.force,
        'topics': ','.join(arguments.topic),
    }
    words = ['--ros-args', '--disable-external-lib-logs']
    for rule in arguments.remap:
        words += ['-r', rule]
    for name, value in parameters.items():
        words += ['-p', f'{name}:={json.dumps(value)}']
    # Here, not above: the other commands work without ROS.
    from rtest_drivers.nodes.replay import replay

    replay(words)
    return 0


def _rate(text: str) -> float:
    """Seconds per second; 0 for as fast as possible."""
    if text == MAX:
        return 0.0
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0.0 < rate < float('inf'):
        raise UserError(f'--rate {text}: expected a number above 0, or {MAX}')
    return rate
