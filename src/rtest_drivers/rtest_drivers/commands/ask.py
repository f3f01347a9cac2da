"""Ask a running session to measure its cycle anew or to leave it.

The cycle that is being measured ends with the poses it has; they stay in the recording. The same
as calling the services session/repeat and session/skip (std_srvs/Trigger).
"""

from __future__ import annotations

import argparse

from rtest_drivers.domain import chosen_domain

HELP = 'ask a running session to repeat or skip its cycle'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest ask`."""
    parser.add_argument('wish', choices=('repeat', 'skip'),
                        help='measure the cycle anew, or go on with the next one')
    parser.add_argument('--domain', type=int, metavar='N',
                        help="the session's ROS domain (default: ROS_DOMAIN_ID)")
    parser.add_argument('--namespace', default='', metavar='NS',
                        help="the session's ROS namespace")


def run(arguments: argparse.Namespace) -> int:
    """Call the service."""
    from rtest_drivers.nodes.ask import ask_session

    domain = chosen_domain(False, arguments.domain)
    print(f'{arguments.wish}: {ask_session(arguments.wish, domain, arguments.namespace)}')
    return 0
