"""The report of a cone frustum or another feature: one HTML file that opens offline."""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jinja2
from matplotlib.figure import Figure

from rtest_identification.figures.style import save
from rtest_identification.frustum import figures, output, tables
from rtest_identification.frustum.commands import Commands
from rtest_identification.frustum.cone import Frustum
from rtest_identification.frustum.contour import response
from rtest_identification.frustum.prediction import Prediction, Ranked, diagnosis
from rtest_identification.frustum.thesis import CASES, CONSTANTS, size
from rtest_identification.kinematics import ERROR_LETTERS
from rtest_identification.symbols import location_parameters

_RANKING = (
    'One error at a time, everything else perfect. Errors of different names may make the same '
    'profile, and several together may partly cancel: a single part never tells which it was.'
)


@dataclass(frozen=True)
class Page:
    """What a report says besides its pictures."""

    title: str
    summary: str
    diagnosis: str = ''
    notes: Sequence[str] = ()
    figures: Sequence[tuple[str, ...]] = ()
    text: Sequence[str] = ()
    ranking: Sequence[Ranked] = ()
    ranking_note: str = _RANKING
    summed: bool = False


@dataclass
class Pictures:
    """Figures that are saved into a folder, with how to read them."""

    folder: Path
    made: list[dict[str, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)

    def add(self, name: str, figure: Figure, caption: str) -> None:
        """Save a figure as PNG and SVG."""
        path = save(figure, self.folder, name)[0]
        data = base64.b64encode(path.read_bytes()).decode()
        self.made.append({'name': name, 'caption': caption, 'data': data})


def prediction_report(
    found: Prediction, cone: Frustum | None, feed: float, out: Path
) -> Path:
    """Write the report of a predicted feature. feed : of the tool on the part [m/s]."""
    pictures = Pictures(out)
    around = '' if cone is None else (
        ' Grey circle: nominal, dot: where the path starts; outside it material is left. The axes '
        'are mm of the part, deviations are magnified: read them by the bar.'
    )
    pictures.add(
        'contour', figures.contour(found, cone),
        'Predicted deviation with the part placed best: by all errors of the machine with their '
        'uncertainty, by its location errors and squareness alone, and by everything that changes '
        'along the path (the error maps or effects) alone, as in Fig. 6-9. Where the black line '
        'follows the blue one, tuning location errors helps; where it follows the orange one, it '
        f'does not.{around}',
    )
    pictures.add('ranking', figures.ranking(found.ranking, found.commands.feature.quantity),
                 _RANKING)
    _common(pictures, found.commands, cone, feed)
    page = Page(
        f'{found.commands.feature.name} on {found.commands.machine.name}', output.summary(found),
        diagnosis(found), found.notes, output.figures(found), (), found.ranking, summed=True,
    )
    return write_report(page, pictures)


def ranking_report(
    commands: Commands, ranked: Sequence[Ranked], cone: Frustum | None, feed: float, out: Path
) -> Path:
    """Write the report of a feature on a machine of which no errors are known."""
    pictures = Pictures(out)
    pictures.add(
        'ranking', figures.ranking(ranked, commands.feature.quantity),
        f'{_RANKING} Sizes are alike for all: 10 µm or 0.01°; of a motion with several phases or '
        'shapes the worst one is shown, and of harmonics those to twice a turn.',
    )
    if cone is not None:
        slope = response(commands)
        named = [
            (p.symbol, commands.feature.form(size(p.angular) * slope[:, p.column]))
            for p in location_parameters(commands.machine)
        ]
        pictures.add('profiles', figures.profiles(cone, named), _PROFILES)
    _common(pictures, commands, cone, feed)
    page = Page(
        f'{commands.feature.name} on {commands.machine.name}',
        output.ranking_summary(commands, ranked), '', commands.notes, ranking=ranked,
    )
    return write_report(page, pictures)


def tables_report(
    lines: Sequence[tables.Line], commands: dict[str, Commands], feed: float, out: Path
) -> Path:
    """Write the report of the thesis's tables. commands : of the cases 'a' and 'b'."""
    pictures = Pictures(out)
    pictures.add(
        'tables', figures.tables(lines),
        'Circularity of every row as printed and as computed here; bars are standard deviations '
        'over the simulated machines: how much these differ, not how uncertain the mean is. '
        'Table 6-2 has none.',
    )
    for case, made in commands.items():
        slope = response(made)
        named = []
        for name, axis, letter, *_ in CONSTANTS:
            column = 6 * made.machine.letters.index(axis) + ERROR_LETTERS.index(letter)
            named.append((name, made.feature.form(size(letter in 'ABC') * slope[:, column])))
        pictures.add(f'profiles_{case}', figures.profiles(CASES[case], named),
                     f'Case ({case}). {_PROFILES}')
        _common(pictures, made, CASES[case], feed, f'_{case}')
    page = Page(
        'Tables 6-2 to 6-7: influence of errors on the cone frustum test',
        tables.summary(lines), text=tables.text(lines),
    )
    return write_report(page, pictures)


_PROFILES = (
    'What each constant error of 10 µm or 0.01° does to the circle (Fig. 6-3), about the '
    'least-squares circle; the bar gives the scale of each panel, outside the grey circle '
    'material is left. Panels of one shape cannot be told from each other by this test.'
)


def _common(
    pictures: Pictures, commands: Commands, cone: Frustum | None, feed: float, suffix: str = ''
) -> None:
    if cone is not None:
        pictures.add(
            f'setup{suffix}', figures.setup(cone),
            'The frustum on the table (Fig. 6-1), frame of the table, which turns with it; drawn '
            'at B = C = 0. The centre given is where the normals of the surface meet, which is '
            'where a ball bar has its sphere.',
        )
    pictures.add(
        f'commands{suffix}', figures.commands(commands, feed),
        'Positions of the axes along the path (Fig. 6-2), rotary axes unwrapped. Times as if the '
        'feed was kept; where an axis would have to turn very fast, a machine slows down.',
    )


def write_report(page: Page, pictures: Pictures) -> Path:
    """Write frustum_report.html beside its figures; returns its path."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('rtest_identification', 'frustum'), autoescape=True
    )
    text = environment.get_template('frustum.html.j2').render(page=page, pictures=pictures.made)
    path = pictures.folder / 'frustum_report.html'
    part = path.with_name(path.name + '.part')
    part.write_text(text, encoding='utf-8')
    os.replace(part, path)
    return path
