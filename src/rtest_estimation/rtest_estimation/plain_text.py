"""Texts of strangers that get into reports, file names and terminals."""

from __future__ import annotations

# Characters; names of cycles and set-ups have twenty.
MAX_NAME = 200


def printable(text: str) -> str:
    """The text without what would command a terminal or turn its direction."""
    return ''.join(char if char.isprintable() else '?' for char in text)


def is_name(text: str) -> bool:
    """Whether a text can stand for a name: printable, not of any length; may be empty."""
    return len(text) <= MAX_NAME and text.isprintable()
