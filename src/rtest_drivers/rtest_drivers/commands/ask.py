"""Ask a running session for something: start, repeat, skip, calibrate, abort.

repeat measures the cycle anew, skip goes on with the next one, calibrate measures the nest anew
and then the cycle, abort ends the session with what there is; the cycle that is being measured
ends with the poses it has, and they stay in the recording. start starts the next cycle of a
session with --hold. The same as calling the services session/start and so on
(std_srvs/Trigger). None of them stops the machine.
"""

from __future__ import annotations

import argparse

from rtest_drivers.domain import chosen_domain

HELP = 'ask a running session to start, repeat or skip a cycle, to calibrate, or to end'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest ask`."""
    parser.add_argument('wish', choices=('start', 'repeat', 'skip', 'calibrate', 'abort'),
                        help='what the session is to do')
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
