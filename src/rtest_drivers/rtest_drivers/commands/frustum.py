"""Predict the cone frustum test (NAS 979) or another feature, and tell which error matters.

With --identification or --model: what the errors of that machine do to the feature, with
uncertainty, what location errors alone do, and every error ranked. Without: every error motion in
one usual size, ranked. --tables computes Tables 6-2 to 6-7 of the thesis beside the printed
numbers. Writes frustum.json, commands.csv and frustum_report.html with its figures.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from rtest_estimation.errors import UserError

if TYPE_CHECKING:
    from rtest_identification.error_field import ErrorField
    from rtest_identification.frustum.commands import Commands
    from rtest_identification.frustum.cone import Frustum
    from rtest_identification.machine import Machine

HELP = 'predict the cone frustum test or another feature from the errors of a machine'
# Table 6-1, case (a).
_PHI, _PSI, _DIAMETER, _CENTRE = 15.0, 30.0, 129.9, (-81.8, 0.0, 189.3)

# No part is further away or wider [mm].
_FARTHEST = 1e5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest frustum`."""
    parser.add_argument('--machine', type=Path, metavar='FILE',
                        help="machine file (default: the thesis's machine)")
    cone = parser.add_argument_group('the cone frustum (defaults: Table 6-1, case a)')
    cone.add_argument('--phi', type=float, metavar='DEG',
                      help=f'tilt of the cone about -Y of the table (default: {_PHI:g})')
    cone.add_argument('--psi', type=float, metavar='DEG',
                      help=f'half-apex angle (default: {_PSI:g})')
    cone.add_argument('--diameter', type=float, metavar='MM',
                      help=f'of the tool path circle (default: {_DIAMETER:g})')
    cone.add_argument('--centre', type=float, nargs=3, metavar=('X', 'Y', 'Z'),
                      help='where the normals of the surface meet, table frame, mm (default: '
                      f'{" ".join(f"{v:g}" for v in _CENTRE)})')
    cone.add_argument('--centre-of', choices=('normals', 'path'),
                      help='what --centre is: where the normals meet, which is where a ball bar '
                      'has its sphere (default), or the centre of the tool path circle')
    cone.add_argument('--points', type=int, metavar='N',
                      help='points of the tool path (default: 360)')
    parser.add_argument('--feed', type=float, default=1000.0, metavar='MM/MIN',
                        help='of the tool on the part (default: 1000)')
    parser.add_argument('--solution', choices=('auto', 'negative', 'positive'),
                        help='sign of the rotary axis nearest to the tool where the path starts; '
                        'auto (default): negative where the ranges of the axes and the measured '
                        'stations allow it')
    known = parser.add_mutually_exclusive_group()
    known.add_argument('--identification', type=Path, metavar='FILE',
                       help='identification.json of the machine')
    known.add_argument('--model', type=Path, metavar='FILE', help='model.yaml of the machine')
    parser.add_argument('--effects', type=Path, metavar='FILE',
                        help='effects of your own that the model has, as for `rtest gap`')
    parser.add_argument('--path', type=Path, metavar='FILE',
                        help='a feature of your own instead of the cone: CSV (tool tip and axis, '
                        'or positions of the axes) or an NC program of axis positions (G0, G1)')
    parser.add_argument('--surface', choices=('left', 'right', 'floor'),
                        help='where the surface is that --path cuts: left or right of the travel, '
                        'or under the tool (default: left)')
    parser.add_argument('--tables', action='store_true',
                        help='Tables 6-2 to 6-7 of the thesis, printed and computed')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, which must not hold anything yet (default: '
                        'out/frustum-DATE-TIME)')


def run(arguments: argparse.Namespace) -> int:
    """Compute, write, print."""
    from rtest_drivers.commands.session import shown
    from rtest_drivers.config import config_path
    from rtest_drivers.folders import check_folder, writing
    from rtest_drivers.graph import session_name
    from rtest_identification.machine import load_machine

    _check(arguments)
    out = arguments.out or Path('out') / session_name('frustum')
    check_folder(out)
    if out.is_dir() and any(out.iterdir()):
        raise UserError(f'{out}: is not empty; choose another --out')
    machine = load_machine(arguments.machine or config_path('nmv1500dcg.yaml'))
    with writing(out):
        summary = _tables(machine, arguments, out) if arguments.tables else (
            _feature(machine, arguments, out)
        )
    report = out / 'frustum_report.html'
    print(f'{summary} -> {shown(report.absolute())}', flush=True)
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuse options that contradict each other."""
    cone = [
        f'--{name.replace("_", "-")}'
        for name in ('phi', 'psi', 'diameter', 'centre', 'centre_of', 'points')
        if getattr(arguments, name) is not None
    ]
    if arguments.path and cone:
        raise UserError(f'{cone[0]} is of the cone, --path is another feature: give one of them')
    if arguments.surface and not arguments.path:
        raise UserError('--surface is of a --path, the cone has its own')
    if arguments.tables:
        others = [
            f'--{name}' for name in ('machine', 'identification', 'model', 'path', 'solution')
            if getattr(arguments, name)
        ]
        if cone + others:
            raise UserError(
                f"{(cone + others)[0]}: --tables are of the thesis's machine and cones alone"
            )
    if arguments.effects and not arguments.model:
        raise UserError('--effects: give the --model that has them')
    if not 0.0 < arguments.feed < math.inf:
        raise UserError(f'--feed {arguments.feed:g}: expected a positive number of mm/min')
    if arguments.points is not None and not 12 <= arguments.points <= 20_000:
        raise UserError(f'--points {arguments.points}: expected 12 to 20000')


def _tables(machine: Machine, arguments: argparse.Namespace, out: Path) -> str:
    from rtest_identification.frustum import output, tables
    from rtest_identification.frustum.commands import NEGATIVE, command
    from rtest_identification.frustum.report import tables_report
    from rtest_identification.frustum.thesis import CASES

    lines = tables.compare(machine)
    print('\n'.join(tables.text(lines)))
    made = {case: command(machine, cone.feature(), NEGATIVE) for case, cone in CASES.items()}
    output.write_json(output.tables_as_dict(lines), out)
    tables_report(lines, made, arguments.feed / 6e4, out)
    return tables.summary(lines)


def _feature(machine: Machine, arguments: argparse.Namespace, out: Path) -> str:
    from rtest_identification.frustum import output, report
    from rtest_identification.frustum.model_errors import of_model
    from rtest_identification.frustum.prediction import diagnosis, predict_form, rank
    from rtest_identification.frustum.sources import of_field, of_sizes

    feed = arguments.feed / 6e4
    field = _field(machine, arguments.identification) if arguments.identification else None
    commands, cone = _commands(machine, arguments, field)
    if field is not None:
        errors = of_field(commands, field)
    elif arguments.model:
        from rtest_identification.gap.model_file import load_model
        from rtest_identification.gap.user_effects import load_effects

        more = load_effects(arguments.effects, machine) if arguments.effects else []
        errors = of_model(commands, load_model(arguments.model), more)
    else:
        errors = None
    if errors is None:
        ranked = rank(commands, of_sizes(commands))
        data = {
            **output.feature_as_dict(commands, cone),
            'ranking': output.ranking_as_list(ranked), 'notes': list(commands.notes),
        }
        notes, told = commands.notes, []
        summary = output.ranking_summary(commands, ranked)
    else:
        found = predict_form(commands, errors, cone)
        ranked, notes, told = found.ranking, found.notes, [diagnosis(found)]
        data, summary = output.prediction_as_dict(found, cone), output.summary(found)
    for line in (*(f'note: {note}' for note in notes),
                 *output.lines(ranked, commands.feature.quantity), *told):
        print(f'  {line}')
    output.write_json(data, out)
    output.write_commands(commands, out)
    if errors is None:
        report.ranking_report(commands, ranked, cone, feed, out)
    else:
        report.prediction_report(found, cone, feed, out)
    return summary


def _commands(
    machine: Machine, arguments: argparse.Namespace, field: ErrorField | None
) -> tuple[Commands, Frustum | None]:
    from rtest_identification.frustum.commands import AUTO, command
    from rtest_identification.frustum.cone import POINTS
    from rtest_identification.frustum.path_file import load_path

    inside = None if field is None else lambda p: field.errors(p, outside='nan').inside
    if arguments.path:
        return load_path(
            arguments.path, machine, arguments.surface, arguments.solution, inside
        ), None
    cone = _cone(arguments)
    feature = cone.feature(arguments.points or POINTS)
    return command(machine, feature, arguments.solution or AUTO, inside), cone


def _cone(arguments: argparse.Namespace) -> Frustum:
    from rtest_identification.frustum.thesis import frustum

    def given(name: str, default: float) -> float:
        value = getattr(arguments, name)
        return default if value is None else value

    centre = tuple(arguments.centre or _CENTRE)
    if not all(abs(value) <= _FARTHEST for value in centre):
        raise UserError(f'--centre: expected three numbers of mm, {_FARTHEST:g} at most')
    if arguments.diameter is not None and arguments.diameter > _FARTHEST:
        raise UserError(f'--diameter {arguments.diameter:g}: expected {_FARTHEST:g} mm at most')
    cone = frustum(
        given('phi', _PHI), centre, given('psi', _PSI), given('diameter', _DIAMETER)
    )
    if arguments.centre_of == 'path':
        cone = cone.about_circle([1e-3 * value for value in centre])
    return cone


def _field(machine: Machine, path: Path) -> ErrorField:
    """The error field of an identification of this machine."""
    import json

    from rtest_identification.error_field import ErrorField

    field = ErrorField.from_json(path, machine)
    name = json.loads(path.read_text(encoding='utf-8')).get('machine')
    if name and name != machine.name:
        raise UserError(
            f'{path}: is of machine {name!r}, not {machine.name!r}; give its file with --machine'
        )
    return field
