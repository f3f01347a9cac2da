"""A verdict as JSON, as rows of a table and as text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtest_identification.tolerance import UNITS
from rtest_identification.verdict import Judgement, Verdict

_SHOWN = {'um': 'µm', 'urad': 'µrad', 'arcsec': 'arcsec'}


def as_json(verdict: Verdict) -> dict[str, Any]:
    """The `verdict` of identification.json; SI values, null where not determined."""

    def number(value: float) -> float | None:
        return float(value) if math.isfinite(value) else None

    return {
        'overall': verdict.overall,
        'tolerance_file': Path(verdict.path).name,
        'errors': [
            {
                'symbol': item.key,
                'quantity': item.limits.quantity,
                'value': number(item.value),
                'interval': [number(item.low), number(item.high)],
                'coverage_factor': item.limits.coverage_factor,
                'lower': number(item.limits.lower),
                'upper': number(item.limits.upper),
                'unit': 'rad' if item.limits.angular else 'm',
                'verdict': item.verdict,
                'reason': item.reason,
            }
            for item in verdict.judgements
        ],
    }


def rows(verdict: Verdict) -> list[dict[str, str]]:
    """Rows for a table: error, quantity, value, expanded, tolerance, unit, verdict, reason."""
    return [_row(item) for item in verdict.judgements]


def _row(item: Judgement) -> dict[str, str]:
    scale = 1.0 / UNITS[item.limits.unit]
    value, plus = scale * item.value, scale * (item.high - item.value)
    minus = scale * (item.value - item.low)
    signed = '+' if item.limits.lower > -math.inf else ''
    expanded = f'{plus:.2f}' if abs(plus - minus) < 0.005 else f'+{plus:.2f} -{minus:.2f}'
    lower, upper = scale * item.limits.lower, scale * item.limits.upper
    if lower == -upper:
        tolerance = f'±{upper:g}'
    elif math.isinf(lower):
        tolerance = f'≤ {upper:g}'
    elif math.isinf(upper):
        tolerance = f'≥ {lower:g}'
    else:
        tolerance = f'{lower:g} to {upper:g}'
    known = math.isfinite(item.value)
    return {
        'error': item.key,
        'quantity': item.limits.quantity,
        'value': f'{value:{signed}.2f}' if known else '',
        'expanded': expanded if known else '',
        'tolerance': tolerance,
        'unit': _SHOWN[item.limits.unit],
        'verdict': item.verdict,
        'reason': item.reason,
    }


def lines(verdict: Verdict) -> Sequence[str]:
    """The table as text, one line an error, columns aligned."""
    head = {
        'error': 'error', 'quantity': '', 'value': 'value', 'expanded': 'U', 'unit': '',
        'tolerance': 'tolerance', 'verdict': 'verdict', 'reason': '',
    }
    table = [[row[key] for key in head] for row in [head, *rows(verdict)]]
    width = [max(len(row[column]) for row in table) for column in range(len(head))]
    return [
        '  '.join(
            text.rjust(size) if 2 <= column <= 3 else text.ljust(size)
            for column, (text, size) in enumerate(zip(row, width, strict=True))
        ).rstrip()
        for row in table
    ]
