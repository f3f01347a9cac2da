"""Show a running cell on a page: devices, gauges, poses, results, and its controls.

Serves http://127.0.0.1:8090/ until Ctrl-C. Opening and closing the page, or this command, changes
nothing in the session. With --host others on the network can look; who has the address that is
printed, with its key, can also start, repeat, skip, calibrate, abort and mark.
"""

from __future__ import annotations

import argparse
import os
import socket

from rtest_drivers.domain import chosen_domain
from rtest_drivers.graph import VIEW_HOST, VIEW_PORT, ros_arguments, view_node
from rtest_estimation.errors import UserError

HELP = 'show a running cell on a page in the browser'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest view`."""
    parser.add_argument('--host', default=VIEW_HOST, metavar='ADDRESS',
                        help='address to serve at (default: 127.0.0.1, this computer only; '
                        '0.0.0.0: every network it is in)')
    parser.add_argument('--port', type=int, default=VIEW_PORT, metavar='N',
                        help=f'port to serve at (default: {VIEW_PORT})')
    parser.add_argument('--domain', type=int, metavar='N',
                        help='ROS domain of the cell (default: ROS_DOMAIN_ID)')
    parser.add_argument('--namespace', default='', metavar='NS', help='ROS namespace of the cell')
    parser.add_argument('--remap', action='append', default=[], metavar='FROM:=TO',
                        help='remap a topic or service; may be given several times')


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until it is told to stop."""
    from rtest_drivers.nodes.view import main

    node = view_node(arguments.host, arguments.port)
    check_address(arguments.host, arguments.port)
    os.environ['ROS_DOMAIN_ID'] = str(chosen_domain(False, arguments.domain))
    return main(['--ros-args', *ros_arguments(node, arguments.namespace, arguments.remap)])


def check_address(host: str, port: int) -> None:
    """Refuse an address that a page cannot be served at, before anything is started.

    Raises UserError.
    """
    try:
        family = socket.AF_INET6 if ':' in host else socket.AF_INET
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        raise UserError(
            f'{host}:{port}: no page can be served there: {error.strerror}; choose another '
            '--port or --host'
        ) from None
