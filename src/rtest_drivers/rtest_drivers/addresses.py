"""Addresses in device files: whether they can be one, before anything is asked of a network."""

from __future__ import annotations

from urllib.parse import SplitResult, urlsplit


def split_url(url: str) -> SplitResult | None:
    """Parts of scheme://HOST[:PORT]..., None where it is no such URL of ASCII without spaces."""
    try:
        parts = urlsplit(url)
        good = parts.port != 0 and host_is_good(parts.hostname or '')
    except ValueError:  # Of the port, or of brackets around the host.
        return None
    return parts if good and url.isascii() and _is_word(url) else None


def host_is_good(host: str) -> bool:
    """Whether it can be the name or the address of a host: no empty or overlong label."""
    try:
        host.encode('idna')
    except UnicodeError:
        return False
    return bool(host) and _is_word(host)


def _is_word(text: str) -> bool:
    return text.isprintable() and not any(character.isspace() for character in text)
