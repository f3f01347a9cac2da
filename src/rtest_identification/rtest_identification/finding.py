"""A finding about a measuring chain: value, limit, verdict, and what to do."""

from __future__ import annotations

from dataclasses import dataclass

RIGHT, WRONG, OPEN = 'right', 'wrong', 'open'


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    verdict : RIGHT, WRONG, or OPEN where the session does not tell
    advice : what to do where it is not right
    """

    what: str
    value: str
    limit: str
    verdict: str
    advice: str = ''


def exceeds(value: float, spread: float, limit: float) -> str:
    """WRONG beyond the limit and RIGHT within it by more than the uncertainty, else OPEN."""
    if abs(value) - spread > limit:
        return WRONG
    return RIGHT if abs(value) + spread <= limit else OPEN
