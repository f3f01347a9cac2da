"""Where a page can be opened: by the computer's name, and by its addresses in numbers."""

from __future__ import annotations

import contextlib
import fcntl
import ipaddress
import socket
import struct

# Bound to, they mean every network this computer is in.
_EVERYWHERE = ('0.0.0.0', '::')
# Of Linux, netdevice(7): requests, flags, and the length of what is handed over (struct ifreq).
_GET_FLAGS, _GET_ADDRESS = 0x8913, 0x8915
_UP, _LOOPBACK, _RUNNING = 0x1, 0x8, 0x40
_REQUEST = 40


def is_local(host: str) -> bool:
    """Whether an address to bind to is this host's own."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == 'localhost'


def named_hosts(host: str) -> list[str]:
    """How others may name a server that is bound to `host`.

    Bound everywhere, that is the computer's name, and for IPv4 its addresses in numbers too:
    tablets often do not find a computer by its name.
    """
    if host not in _EVERYWHERE:
        return [host]
    return [socket.gethostname(), *(own_addresses() if host == '0.0.0.0' else ())]


def page_address(host: str, port: int, key: str = '') -> str:
    """What to open; key : '' where the page itself holds it."""
    named = f'[{host}]' if ':' in host else host
    return f'http://{named}:{port}/' + (f'#{key}' if key else '')


def own_addresses() -> list[str]:
    """IPv4 addresses of the networks that this computer is connected to, without the loopback.

    They are asked of the interfaces: a workshop's network need not have a route to anywhere.
    """
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            request = struct.pack(f'{_REQUEST}s', name.encode())
            # An interface without an IPv4 address, or one that has just gone.
            with contextlib.suppress(OSError):
                (flags,) = struct.unpack_from('H', fcntl.ioctl(asked, _GET_FLAGS, request), 16)
                answer = fcntl.ioctl(asked, _GET_ADDRESS, request)
                if flags & (_UP | _RUNNING | _LOOPBACK) == _UP | _RUNNING:
                    found.append(socket.inet_ntoa(answer[20:24]))
    return found
