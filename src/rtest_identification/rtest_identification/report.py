"""The report of an identification: one HTML file that opens offline."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import jinja2

from rtest_identification.pipeline import Identification


def render(result: Identification, folder: Path) -> str:
    """The page as text; writes its figures into `folder` as PNG and SVG too."""
    # matplotlib takes a second to import and nodes do not draw.
    from rtest_identification import figures

    drawn = []
    for error_map in result.maps:
        shapes = ''
        if error_map.left_open:
            shapes = (
                ' Not told from constant errors by any R-test at these stations, and therefore '
                f'left out of the map: {"; ".join(error_map.left_open)}.'
            )
        drawn.append((
            f'error_map_{error_map.axis}',
            figures.error_map(error_map),
            f'Error map of {error_map.axis}: how its position and orientation change with '
            f'{error_map.axis}, in the frame of the axis that carries it. Left: displacements; '
            'right: rotations. Bands are U (k = 2). The mean over the stations is zero: it is in '
            f'the location errors.{shapes}',
        ))
    drawn.append((
        'residuals',
        figures.residuals(result),
        'What the fit leaves at every pose, table frame, in the order measured. Points should '
        'fill the grey band without a pattern; steps, waves or trends are effects that the model '
        'lacks.',
    ))
    pictures = []
    for name, figure, caption in drawn:
        png, _ = figures.save(figure, folder, name)
        data = base64.b64encode(png.read_bytes()).decode()
        pictures.append({'name': name, 'caption': caption, 'data': data})
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('rtest_identification', 'templates'), autoescape=True
    )
    return environment.get_template('report.html.j2').render(
        result=result, rows=_rows(result), pictures=pictures
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
