"""The ROS domain of a session: a valid one, and one that no other session is in."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator

from rtest_drivers.config import config_path
from rtest_estimation.errors import UserError

LARGEST = 232
# A domain's ports start at 7400 + 250 x domain; above 101 they meet the system's ephemeral ports.
_PORT_BASE, _PORT_STEP, _DOMAINS = 7400, 250, 101
# What would let a simulated session be seen from elsewhere.
_ELSEWHERE = ('ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS', 'ROS_DISCOVERY_SERVER')
_RANGE, _PROFILES = 'ROS_AUTOMATIC_DISCOVERY_RANGE', 'FASTRTPS_DEFAULT_PROFILES_FILE'


def session_environment(simulated: bool, domain: int) -> dict[str, str]:
    """Environment of the nodes: on this host only, unless the user's says where else.

    A simulated cell stays here whatever the user's environment says.
    """
    environment = {**os.environ, 'ROS_DOMAIN_ID': str(domain), 'PYTHONUNBUFFERED': '1'}
    if simulated:
        for name in _ELSEWHERE:
            environment.pop(name, None)
        environment[_RANGE] = 'LOCALHOST'
    elif not any(name in environment for name in (*_ELSEWHERE, _RANGE)):
        environment[_RANGE] = 'LOCALHOST'
    if environment.get(_RANGE) == 'LOCALHOST':
        # The range alone is about who is looked for: the nodes would still listen everywhere.
        environment.setdefault(_PROFILES, str(config_path('this_host.xml')))
    return environment


def chosen_domain(simulated: bool, domain: int | None) -> int | None:
    """The domain a user has chosen: --domain or, but for a simulated cell, the environment's.

    Returns None where it is ours to choose. Raises UserError for what is no domain.
    """
    name, text = '--domain ', str(domain)
    if domain is None:
        if simulated:
            return None
        name, text = 'ROS_DOMAIN_ID=', os.environ.get('ROS_DOMAIN_ID') or '0'
    if not (text.isascii() and text.isdecimal() and int(text) <= LARGEST):
        raise UserError(f'{name}{text}: expected a number from 0 to {LARGEST}')
    return int(text)


@contextlib.contextmanager
def held_domain(simulated: bool, domain: int | None, namespace: str = '') -> Iterator[int]:
    """The ROS domain of a session, which no other session of this host joins meanwhile.

    A simulated session needs one for itself, because of the clock; others may share one in
    different namespaces.

    Raises UserError where a session runs in the chosen domain, and for what is no domain.
    """
    chosen = chosen_domain(simulated, domain)
    with contextlib.ExitStack() as held:
        if chosen is None:
            yield _hold_free(held)
            return
        space = '' if simulated else namespace.strip('/')
        try:
            held.enter_context(_name(chosen, space))
        except OSError:
            raise UserError(
                f'a session runs in ROS domain {chosen} already; choose another with --domain'
            ) from None
        yield chosen


def free_domain() -> int:
    """A ROS domain (1 to 101) with no participant on this host, in which no session starts."""
    with contextlib.ExitStack() as held:
        return _hold_free(held)


def _hold_free(held: contextlib.ExitStack) -> int:
    """A free domain, whose name is held until `held` closes."""
    first = os.getpid() % _DOMAINS
    for step in range(_DOMAINS):
        domain = 1 + (first + step) % _DOMAINS
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
        ):
            # Where the first participant of a domain listens.
            probe.bind(('', _PORT_BASE + _PORT_STEP * domain + 10))
            held.enter_context(_name(domain))
            return domain
    raise UserError('no free ROS domain on this host; choose one with --domain')


def _name(domain: int, space: str = '') -> socket.socket:
    """Hold the name of a session's domain; raises OSError where somebody else has it.

    It is no file, but gone with the process that holds it.
    """
    name = socket.socket(socket.AF_UNIX)
    try:
        name.bind(f'\0rtest-session-{domain}-{space}')
    except OSError:
        name.close()
        raise
    return name
