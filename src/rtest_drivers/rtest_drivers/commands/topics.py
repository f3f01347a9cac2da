"""Look at the topics of a running graph where no ROS tools are installed.

list prints every topic with its type, publishers and subscriptions; hz measures for some seconds
how many messages and bytes a second come on each, and the longest gap between two; echo prints the
messages of one topic. docs/topics.md says what is normal.
"""

from __future__ import annotations

import argparse

from rtest_drivers.domain import chosen_domain
from rtest_estimation.errors import UserError

HELP = 'list, measure or print the topics of a running graph'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest topics`."""
    parser.add_argument('what', nargs='?', default='list', choices=('list', 'hz', 'echo'),
                        help='what to do (default: list)')
    parser.add_argument('topic', nargs='?', metavar='TOPIC',
                        help='of echo, and of hz where not all are to be measured')
    parser.add_argument('--seconds', type=float, default=5.0, metavar='S',
                        help='how long hz measures (default: 5)')
    parser.add_argument('--count', type=int, default=0, metavar='N',
                        help='messages that echo prints (default: until Ctrl-C)')
    parser.add_argument('--domain', type=int, metavar='N',
                        help='ROS domain (default: ROS_DOMAIN_ID)')


def run(arguments: argparse.Namespace) -> int:
    """Look, print."""
    from rtest_drivers.nodes import topics

    if arguments.what == 'echo' and not arguments.topic:
        raise UserError('echo: which topic? for example /rtest/gauges')
    if not 0.0 < arguments.seconds <= 3600.0:
        raise UserError(f'--seconds {arguments.seconds:g}: expected more than 0, at most 3600')
    if arguments.count < 0:
        raise UserError(f'--count {arguments.count}: expected 1 or more, or 0 for no end')
    with topics.looker(chosen_domain(False, arguments.domain)) as look:
        if arguments.what == 'list':
            rows = look.topics()
            for row in rows:
                print(f'{row.name:32} {row.type:36} {row.publishers:3} publishers '
                      f'{row.subscriptions:3} subscriptions')
            domain = '' if rows else '; is this the domain of the session? --domain N chooses it'
            print(f'{len(rows)} topics{domain}')
        elif arguments.what == 'hz':
            print(f'{"topic":32} {"1/s":>8} {"kB/s":>9} {"longest gap":>12} {"messages":>9}')
            for name, one in look.rates(arguments.topic, arguments.seconds).items():
                gap = f'{one.longest_gap:.3f} s' if one.messages > 1 else '-'
                print(f'{name:32} {one.rate:8.1f} {one.bytes_a_second / 1e3:9.2f} {gap:>12} '
                      f'{one.messages:9}')
        else:
            for text in look.messages(arguments.topic, arguments.count):
                print(text, '---', sep='\n', flush=True)
    return 0
