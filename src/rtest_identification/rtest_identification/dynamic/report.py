"""The report of a dynamic measurement: one HTML file that opens offline, and its figures."""

from __future__ import annotations

import base64
import math
import os
from pathlib import Path
from typing import Any

import jinja2

from rtest_identification.dynamic import output
from rtest_identification.dynamic.motion import COMPONENTS
from rtest_identification.dynamic.offline import DynamicSession
from rtest_identification.dynamic.pipeline import DynamicResult

_POLAR = (
    '{word} displacement of the sphere, drawn on the circle on which it follows the nest, as seen '
    'from above the turning axis; the dotted circle is no displacement, the bar in the middle is '
    'the scale of the displacement. {how} The centre offset of the axis is taken out. Where both '
    'lines go together the drives did it; what only the R-test shows is geometric, dynamic or of '
    'the gauges.'
)
_CAPTIONS = {
    'radial': _POLAR.format(
        word='Radial',
        how='Outside of it the circle of the sphere is larger than that of the nest.'),
    'tangential': _POLAR.format(
        word='Tangential',
        how='It counts along the motion: inside of it the sphere is behind the nest.'),
    'axial': 'Axial displacement along the turn, positive along the turning axis; full lines turn '
    'positively, faint ones negatively. At both ends means are over shorter times and scatter '
    'more.',
    'lag': 'How far the sphere is behind the nest on average: half the difference of the two '
    'directions; bars are U (k = 2) of the noise, often smaller than the marks. In proportion to '
    'speed and in the feedback: servo gains of the axes differ. Not in the feedback and not in '
    'proportion to speed: friction of the probes.',
    'start': 'Tangential displacement from its steady mean while the axis starts or reverses, '
    'from 10 ms after the first motion. What both lines show is a transient of the drives.',
    'parts': 'The displacement split: what the encoders show (servo), what depends on the angle '
    'alone (geometric), and the dynamic rest; grey is what is left of it after the effects that '
    'were named. Faint lines turn negatively.',
    'harmonics': 'Amplitudes of the mean turn. Bars: R-test, marks: feedback. What is equal at '
    'all speeds and in both directions is geometric.',
}


def write_report(session: DynamicSession, out: Path) -> Path:
    """Write dynamic_report.html and its figures (PNG and SVG) into `out`; returns its path."""
    # matplotlib takes a second to import and nodes do not draw.
    from rtest_identification.dynamic import figures
    from rtest_identification.figures.style import save

    out.mkdir(parents=True, exist_ok=True)
    sections = []
    for result in session.results:
        drawn = {
            'radial': figures.polar(result, 0), 'tangential': figures.polar(result, 1),
            'axial': figures.axial(result), 'lag': figures.lag(result),
            'start': figures.start(result), 'parts': figures.parts(result),
        }
        if result.measured:
            drawn['harmonics'] = figures.harmonics(result)
        before = f'dynamic_{result.setup}' if len(session.results) > 1 else 'dynamic'
        pictures = []
        for name, figure in drawn.items():
            path = save(figure, out, f'{before}_{name}')[0]
            data = base64.b64encode(path.read_bytes()).decode()
            pictures.append({'name': name, 'caption': _CAPTIONS[name], 'data': data})
        sections.append({
            'result': result, 'pictures': pictures, 'lines': output.lines(result),
            'summary': output.summary(result), 'passes': _passes(result),
        })
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('rtest_identification.dynamic'), autoescape=True
    )
    page = environment.get_template('dynamic.html.j2').render(
        session=session, sections=sections, components=COMPONENTS,
    )
    path = out / 'dynamic_report.html'
    part = path.with_name(path.name + '.part')
    part.write_text(page, encoding='utf-8')
    os.replace(part, path)
    return path


def _passes(result: DynamicResult) -> list[dict[str, Any]]:
    """Synchronous and asynchronous error motion and the start of every pass, as text."""
    rows = []
    for number, one in enumerate(result.scene.motion.passes):
        turn = next((t for t in result.measured if t.number == number), None)
        start = next(t for t in result.transients if t.number == number)
        row = {
            'label': one.label.replace('-', '−'), 'turns': '', 'synchronous': [''] * 3,
            'asynchronous': [''] * 3,
            'start': f'{1e6 * start.peak[0]:+.2f} / {1e6 * start.peak[1]:+.2f}',
            'word': 'reversal' if start.reverses else 'start',
        }
        if turn is not None:
            row['turns'] = f'{len(turn.turns)}' if turn.covered == 1.0 else f'{turn.covered:.2f}'
            row['synchronous'] = [f'{1e6 * v:.2f}' for v in turn.synchronous]
            row['asynchronous'] = [
                f'{1e6 * v:.2f}' if math.isfinite(v) else 'one turn' for v in turn.asynchronous
            ]
        rows.append(row)
    return rows
