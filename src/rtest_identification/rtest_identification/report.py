"""The report of an identification: one HTML file that opens offline."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from rtest_identification.pipeline import Identification
from rtest_identification.verdict import Verdict
from rtest_identification.verdict_table import rows as judged_rows


def render(result: Identification, folder: Path, verdict: Verdict | None = None) -> str:
    """The page as text; writes its figures into `folder` as PNG and SVG too.

    verdict : where tolerances were given
    """
    # matplotlib takes a second to import and nodes do not draw.
    from plotly.offline import get_plotlyjs

    from rtest_identification.report_sections import draw

    sections = draw(result, folder)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('rtest_identification', 'templates'), autoescape=True
    )
    environment.filters['base64'] = lambda path: base64.b64encode(path.read_bytes()).decode()
    return environment.get_template('report.html.j2').render(
        result=result, rows=_rows(result), sections=sections, squareness=_squareness(sections),
        shares=list(result.budget.parts), budget=_budget(result), verdict=verdict,
        judged=judged_rows(verdict) if verdict else [],
        plotly=get_plotlyjs() if any(p.script for p in sections.positions) else '',
    )


def _rows(result: Identification) -> list[dict[str, Any]]:
    location = result.location
    rows = []
    for p, value, stddev, good in zip(
        location.parameters, location.value, location.stddev, location.determined, strict=True
    ):
        rows.append({
            'symbol': p.symbol,
            'unit': 'µrad' if p.angular else 'µm',
            'value': f'{1e6 * value:+.2f}' if good else 'not determined',
            'expanded': f'{2e6 * stddev:.2f}' if good else '',
            'arcsec': f'{value * 206264.806:+.2f}' if good and p.angular else '',
        })
    return rows


def _budget(result: Identification) -> list[dict[str, Any]]:
    shares = result.budget
    parts = [1e6 * np.sqrt(np.diag(part)) for part in shares.parts.values()]
    rows = []
    for i, p in enumerate(result.location.parameters):
        if result.location.determined[i]:
            rows.append({
                'symbol': p.symbol,
                'parts': [f'{part[i]:.3f}' for part in parts],
                'total': f'{1e6 * result.location.stddev[i]:.3f}',
                'freedom': f'{shares.freedom[i]:.0f}' if shares.freedom[i] < 1e4 else '> 10 000',
            })
    return rows


def _squareness(sections: Any) -> list[dict[str, str]]:
    """Squareness by section 3.5 beside that of the joint fit."""
    found = sections.separation
    if found is None or not found.differences:
        return []

    def number(value: float, spread: float, good: bool) -> tuple[str, str]:
        return (f'{1e6 * value:+.2f}', f'{2e6 * spread:.2f}') if good else ('not determined', '')

    return [
        dict(zip(
            ('symbol', 'value', 'expanded', 'joint', 'joint_expanded'),
            (symbol, *number(*own), *number(*joint, bool(np.isfinite(joint[0])))),
            strict=True,
        ))
        for symbol, own, joint in zip(
            found.symbols,
            zip(found.value, found.stddev, found.determined, strict=True),
            zip(found.joint, found.joint_stddev, strict=True),
            strict=True,
        )
    ]
