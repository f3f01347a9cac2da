"""Correct commands, so that the predicted error of a machine vanishes to first order.

Writes what to add to every axis over stations of the rotary axes and places of the work volume
(correction.csv), the compensation of single axes for LinuxCNC (COMP_FILE) where one axis's own
error suffices, and with --path or --plan corrected positions and NC programs. Use one of the two,
corrected programs or compensation: both would correct twice.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from rtest_estimation.errors import UserError

if TYPE_CHECKING:
    from rtest_identification.correction.known import KnownErrors
    from rtest_identification.correction.step import Correction
    from rtest_identification.session_file import SessionConfig

HELP = 'change commands so that the predicted error of a machine vanishes'
CONTROLLERS = ('linuxcnc', 'iso')
# Of the tool on the part [mm/min].
_FEED = 1000.0


@dataclass
class _Made:
    """Corrections by name, the files of them, notes, and places for the table.

    beyond : axes that leave their range
    """

    corrections: dict[str, Correction] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    places: list[tuple[float, ...]] = field(default_factory=list)
    beyond: set[str] = field(default_factory=set)

    def check_range(self, correction: Correction, name: str = '') -> None:
        """Note which axes leave their range. name : of the cycle, before each note."""
        from rtest_identification.frustum.commands import out_of_range

        anyway = out_of_range(correction.machine, correction.nominal)
        for axis, note in out_of_range(correction.machine, correction.positions).items():
            why = '' if axis in anyway else '; it is the correction that takes it there'
            self.notes.append(f'{name}{note}{why}')
            self.beyond.add(axis)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest correct`."""
    known = parser.add_mutually_exclusive_group(required=True)
    known.add_argument('--identification', type=Path, metavar='FILE',
                       help='identification.json of the machine')
    known.add_argument('--model', type=Path, metavar='FILE', help='model.yaml of the machine')
    parser.add_argument('--effects', type=Path, metavar='FILE',
                        help='effects of your own that the model has, as for `rtest gap`')
    what = parser.add_mutually_exclusive_group()
    what.add_argument('--path', type=Path, metavar='FILE',
                      help='correct a path: CSV (tool tip and axis, or positions of the axes, as '
                      'for `rtest frustum`, which writes its own as commands.csv) or an NC '
                      'program of axis positions (G0, G1)')
    what.add_argument('--plan', type=Path, metavar='YAML',
                      help='correct the cycles of a session file')
    parser.add_argument('--machine', type=Path, metavar='FILE',
                        help="machine file (default: the session file's with --plan, else the "
                        "thesis's machine)")
    parser.add_argument('--at', type=float, nargs=3, action='append', default=[],
                        metavar=('X', 'Y', 'Z'),
                        help='place for the table, table frame, mm; may be repeated (default: '
                        'the spheres of --plan, else a cube of 200 mm)')
    parser.add_argument('--controller', choices=CONTROLLERS,
                        help='dialect of new NC programs (default: linuxcnc)')
    parser.add_argument('--feed', type=float, metavar='MM/MIN',
                        help='of the tool on the part, for a --path as CSV (default: 1000)')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, which must not hold anything yet (default: '
                        'out/correct-DATE-TIME)')


def run(arguments: argparse.Namespace) -> int:
    """Correct, write, print."""
    import numpy as np

    from rtest_drivers.commands.session import shown
    from rtest_drivers.folders import check_folder, writing
    from rtest_drivers.graph import session_name
    from rtest_identification.correction import compensation, output
    from rtest_identification.correction.step import join, judged
    from rtest_identification.correction.table import CUBE, table

    _check(arguments)
    out = arguments.out or Path('out') / session_name('correct')
    check_folder(out)
    if out.is_dir() and any(out.iterdir()):
        raise UserError(f'{out}: is not empty; choose another --out')
    known, made = _corrected(arguments)
    places = [tuple(1e-3 * value for value in row) for row in arguments.at] or made.places
    grid = table(known, places or CUBE)
    made.texts['correction.csv'] = output.table_text(grid)
    whole = {'table': grid.correction, **made.corrections}
    tables, refused = compensation.axis_tables(known)
    elsewhere = compensation.elsewhere(known)
    sums = {name: output.judge(known, one) for name, one in whole.items()}
    alone = {}
    for name, one in whole.items() if tables else ():
        still = np.zeros_like(one.nominal)
        change = compensation.changes(known.machine, tables, one.nominal, still)
        errors = known.at(one.nominal, still)
        alone[name] = judged(known.machine, one.nominal, change, errors)
    notes = [*known.notes, *made.notes]
    if grid.left_out:
        notes.append(
            f'correction.csv: {grid.left_out} of {len(grid.place) + grid.left_out} places and '
            'stations are out of reach or not measured'
        )
    with writing(out):
        data = output.as_dict(
            known, sums, tables, refused, elsewhere,
            {name: output.judge(known, one) for name, one in alone.items()}, notes,
        )
        path = output.write_all(out, data, made.texts, tables)
    parts = list(made.corrections) or ['table']
    total = output.judge(known, join([whole[part] for part in parts]))
    lines = [*(f'note: {note}' for note in notes), *output.told(total)]
    lines += [
        f'{one.axis.name}.comp: the own error of {one.axis.name}, for LinuxCNC' for one in tables
    ]
    lines += [f'no compensation file for {name}: {why}' for name, why in refused.items()]
    if elsewhere:
        lines.append(
            f'in no compensation file: {", ".join(elsewhere)}: they act across their own axis, '
            'which takes several axes at once'
        )
    what = arguments.path or arguments.plan
    name = what.name if what else 'work volume'
    counted = 'points along its way' if arguments.path else 'poses'
    if tables:
        files = output.judge(known, join([alone[part] for part in parts]))
        lines.append(output.summary(f'{name}, compensation files alone', files, counted))
        if files.after.shift > files.before.shift:
            lines.append(
                'warning: the compensation files alone make it worse here: they take away what '
                'makes up for a part of the rest'
            )
    print('\n'.join(f'  {line}' for line in lines))
    axes = ', '.join(sorted(made.beyond))
    beyond = f'; the machine cannot run it, out of range: {axes}' if axes else ''
    print(f'{output.summary(name, total, counted)}{beyond} -> {shown(path.absolute())}',
          flush=True)
    return 0


def _check(arguments: argparse.Namespace) -> None:
    """Refuse options that contradict each other."""
    if arguments.effects and not arguments.model:
        raise UserError('--effects: give the --model that has them')
    if arguments.plan and arguments.machine:
        raise UserError('--machine: the session file of --plan names the machine')
    table = arguments.path and arguments.path.suffix.lower() == '.csv'
    if arguments.feed is not None and not table:
        raise UserError('--feed: is of a --path as CSV; a program has its own')
    if arguments.controller and not (table or arguments.plan):
        raise UserError('--controller: is of new programs, for a --plan or a --path as CSV')
    if arguments.feed is not None and not 0.0 < arguments.feed < math.inf:
        raise UserError(f'--feed {arguments.feed:g}: expected a positive number of mm/min')
    if not all(math.isfinite(value) for row in arguments.at for value in row):
        raise UserError('--at: expected three finite numbers of mm')


def _corrected(arguments: argparse.Namespace) -> tuple[KnownErrors, _Made]:
    from rtest_drivers.config import config_path
    from rtest_identification.correction.known import of_file, of_model
    from rtest_identification.gap.model_file import load_model
    from rtest_identification.machine import load_machine
    from rtest_identification.session_file import load_session

    config = load_session(arguments.plan) if arguments.plan else None
    machine = config.machine if config else load_machine(
        arguments.machine or config_path('nmv1500dcg.yaml')
    )
    if arguments.identification:
        known = of_file(arguments.identification, machine)
    else:
        more = []
        if arguments.effects:
            from rtest_identification.gap.user_effects import load_effects

            more = load_effects(arguments.effects, machine)
        known = of_model(load_model(arguments.model), machine, more)
    if config:
        return known, _session(config, known, arguments.controller or CONTROLLERS[0])
    if arguments.path:
        return known, _path(arguments, known)
    return known, _Made()


def _session(config: SessionConfig, known: KnownErrors, controller: str) -> _Made:
    """Every cycle; those that measure errors are summed up."""
    from rtest_estimation.records import Kind
    from rtest_identification.correction.output import positions_text
    from rtest_identification.correction.session import correct_plan, plan_program
    from rtest_identification.nc_program import NcSettings

    made = _Made()
    suffix = '.nc' if controller == 'iso' else '.ngc'
    for number, plan in enumerate(config.plans, 1):
        corrected, correction = correct_plan(known, plan)
        if plan.kind is Kind.STATIC:
            made.corrections[plan.cycle] = correction
            made.places.append(tuple(plan.sphere))
        made.check_range(correction, f'{plan.cycle}: ')
        made.texts[f'{corrected.cycle}.csv'] = positions_text(correction)
        made.texts[f'{corrected.cycle}{suffix}'] = plan_program(
            config, corrected, NcSettings(controller), number
        )
    return made


def _path(arguments: argparse.Namespace, known: KnownErrors) -> _Made:
    from rtest_identification.correction import program
    from rtest_identification.correction.output import positions_text
    from rtest_identification.correction.step import join
    from rtest_identification.frustum.path_file import load_path

    path, made = arguments.path, _Made()
    if path.suffix.lower() == '.csv':
        commands = load_path(path, known.machine, inside=known.inside)
        controller = arguments.controller or CONTROLLERS[0]
        suffix = '.nc' if controller == 'iso' else '.ngc'
        found = program.path_program(
            commands, known, (arguments.feed or _FEED) / 6e4, controller
        )
    else:
        try:
            text = path.read_text(encoding='utf-8-sig')
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f'{path}: cannot read the program: {error}') from None
        suffix = path.suffix
        found = program.rewrite(path, text, known)
    made.notes += found.notes
    made.texts[f'{path.stem}-corrected{suffix}'] = found.text
    made.corrections[path.name] = found.along
    made.check_range(join([found.correction, found.along]))
    made.texts[f'{path.stem}-corrected.csv'] = positions_text(found.correction)
    return made
