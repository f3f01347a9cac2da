"""The report of a model gap: one HTML file that opens offline, and its figures."""

from __future__ import annotations

import base64
import os
from pathlib import Path
from typing import TYPE_CHECKING

import jinja2

if TYPE_CHECKING:
    from rtest_identification.gap.offline import SessionGap

_CAPTIONS = {
    'gap_closing': 'How far measurement and model are apart (rms per component), before and after '
    'what was found was added to the model. Down to the dashed line nothing is left but the noise '
    'of these poses. Held-out poses took no part in naming or fitting: there an effect that is '
    'not real makes the gap larger.',
    'gap_over_axes': 'Residual at every pose of both rotary axes, table frame; left three columns '
    'before, right three after, one row a cycle, one colour scale for all. A pattern on the left '
    'that is gone on the right is explained.',
    'gap_over_time_and_direction': 'Left: residual before, over time; a trend is drift, a step a '
    'slip. Right: its mean by the direction in which each axis arrived at the pose; < and > apart '
    'for one axis are backlash.',
    'gap_in_space': 'Residual vectors where the sphere stood in the machine, machine frame, '
    'magnified as stated, before and after.',
}


def write_report(found: SessionGap, out: Path) -> Path:
    """Write gap_report.html and its figures (PNG and SVG) into `out`; returns the page's path."""
    # matplotlib takes a second to import and nodes do not draw.
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from rtest_identification.gap import figures, output

    drawn = {
        'gap_closing': figures.closing(found.result),
        'gap_over_axes': figures.over_axes(found.result),
        'gap_over_time_and_direction': figures.over_time_and_direction(found.result),
        'gap_in_space': figures.in_space(found.result),
    }
    out.mkdir(parents=True, exist_ok=True)
    pictures = []
    for name, figure in drawn.items():
        FigureCanvasAgg(figure)
        figure.savefig(out / f'{name}.png', dpi=120)
        figure.savefig(out / f'{name}.svg')
        data = base64.b64encode((out / f'{name}.png').read_bytes()).decode()
        pictures.append({'name': name, 'caption': _CAPTIONS[name], 'data': data})
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('rtest_identification', 'templates'), autoescape=True
    )
    page = environment.get_template('gap.html.j2').render(
        found=found, result=found.result, summary=output.summary(found.result),
        lines=output.lines(found.result), pictures=pictures, where=output.where,
    )
    path = out / 'gap_report.html'
    part = path.with_name(path.name + '.part')
    part.write_text(page, encoding='utf-8')
    os.replace(part, path)
    return path
