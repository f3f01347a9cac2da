"""Plan a measurement: poses, NC programs, checks, and what they will determine.

Writes one NC program for each cycle, its poses as CSV, a session file that measures the plan, and
plan.json. Says before anything is measured which errors the plan determines and how well, what it
cannot show, and how long it takes.
"""

from __future__ import annotations

import argparse
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from rtest_estimation.errors import UserError

if TYPE_CHECKING:
    from rtest_identification.foresight import ExpectedMap, Foresight
    from rtest_identification.plan_output import CheckedPlan

HELP = 'plan a measurement: poses, NC programs, what they will determine'
KINDS = ('static', 'diagnostic')
CONTROLLERS = ('linuxcnc', 'linuxcnc-m68', 'iso')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `rtest plan`."""
    parser.add_argument('--config', type=Path, metavar='YAML',
                        help='session file: machine, cycle, set-ups (default: the demo)')
    parser.add_argument('--kind', choices=KINDS,
                        help="kind of cycle instead of the session file's: the thesis's static "
                        'one, or a diagnostic one with uneven stations, every level from both '
                        'sides and returns to the first pose')
    parser.add_argument('--noise-um', type=float, default=0.25, metavar='N',
                        help='standard deviation of a pose per component that predictions assume '
                        '(default: 0.25)')
    parser.add_argument('--tolerance-um', type=float, default=50.0, metavar='N',
                        help='how far the sphere may leave its place in the nest while the axes '
                        'move (default: 50)')
    parser.add_argument('--controller', choices=CONTROLLERS, default='linuxcnc',
                        help='dialect of the NC programs; linuxcnc-m68 switches TCP mode with M68 '
                        'where M428 and M429 are not remapped (default: linuxcnc)')
    parser.add_argument('--tcp', action='store_true',
                        help="also write programs for the controller's TCP mode")
    parser.add_argument('--pause', action='store_true',
                        help='stop with M0 at every pose until the reading is taken')
    parser.add_argument('--out', type=Path, metavar='DIR',
                        help='write to DIR, which must not hold anything yet (default: '
                        'out/plan-NAME-DATE-TIME)')


def run(arguments: argparse.Namespace) -> int:
    """Plan, check, predict, write."""
    from rtest_drivers.commands.session import shown
    from rtest_drivers.config import config_path
    from rtest_drivers.graph import session_name
    from rtest_identification.nc_program import NcSettings
    from rtest_identification.plan_output import check_session, write_plan
    from rtest_identification.session_file import load_session

    for name in ('noise_um', 'tolerance_um'):
        value = getattr(arguments, name)
        if not 0.0 < value < math.inf:
            option = f'--{name.replace("_", "-")}'
            raise UserError(f'{option} {value:g}: expected a positive number of µm')
    source = arguments.config or config_path('demo.yaml')
    config = load_session(source, arguments.kind)
    settings = NcSettings(
        arguments.controller, pause=arguments.pause, tolerance=arguments.tolerance_um * 1e-6
    )
    checked = check_session(config, settings, arguments.noise_um * 1e-6)
    out = arguments.out or Path('out') / session_name(f'plan-{source.stem}')
    path = write_plan(checked, out, source.stem, settings, arguments.tcp)
    print('\n'.join(_told(checked)))
    seen = checked.foresight
    determined = ''
    if seen is not None:
        determined = (
            f'{seen.poses} poses, {int(seen.location.determined.sum())} of '
            f'{len(seen.location.parameters)} errors determined, '
        )
    print(
        f'{source.stem}: {config.kind} plan, {determined}{_time(checked.duration)}, '
        f'{_count(len(checked.warnings), "warning")} -> {shown(path.absolute())}'
    )
    return 0


def _told(checked: CheckedPlan) -> list[str]:
    """What a person wants to know before measuring."""
    from rtest_identification.plans import program_name

    config, seen = checked.config, checked.foresight
    lines = [f'{config.machine.name}, {config.kind} cycle']
    if seen is not None:
        lines[0] += ': ' + ', '.join(
            f'{name} at {" ".join(f"{math.degrees(v):g}" for v in values)} deg'
            for name, values in zip(config.machine.rotary, config.stations, strict=True)
        )
    lines.append('')
    lines.append(f'{"cycle":20} {"poses":>5} {"blocks":>6} {"time":>9}')
    for plan, path, check in zip(config.distinct, checked.paths, checked.checks, strict=True):
        near = f'  spindle {check.distance * 1e3:.1f} mm away' if check.distance else ''
        lines.append(
            f'{program_name(plan.cycle):20} {len(plan.commands):5} {len(path.positions):6} '
            f'{_time(check.duration):>9}{near}'
        )
    if config.every:
        lines.append(
            f'the last of them {config.repetitions} times, every {_time(config.every)}; what '
            'follows is of one cycle'
        )
    lines += ['', *_ranges(checked)]
    if seen is not None:
        lines += ['', *_errors(seen)]
        for one in (seen.outer_map, seen.inner_map):
            if one is not None:
                lines += ['', *_map(one)]
        lines += ['', *_visibility(seen)]
    lines += ['', f'not checked: {checked.unchecked}']
    return lines + [f'warning: {text}' for text in checked.warnings] + ['']


def _ranges(checked: CheckedPlan) -> list[str]:
    """Used and possible range of every axis, over all cycles."""
    lines = []
    for name in checked.config.machine.letters:
        axis = checked.config.machine.axes[name]
        scale, unit = (180.0 / math.pi, 'deg') if axis.rotary else (1e3, 'mm')
        used = [check.extent[name] for check in checked.checks]
        low = scale * min(lower for lower, _ in used)
        high = scale * max(upper for _, upper in used)
        lines.append(
            f'{name} moves {low:8.2f} to {high:8.2f} {unit} of '
            f'{axis.lower * scale:g} to {axis.upper * scale:g}'
        )
    return lines


def _errors(seen: Foresight) -> list[str]:
    noise = f'noise {seen.noise * 1e6:g} µm a pose and component'
    lines = [
        f'Predicted U (k = 2), {noise}',
        f'{"error":14} {"alone":>8} {"with map":>9}',
    ]
    location = seen.location
    for p, alone, with_map, good in zip(
        location.parameters, location.stddev, location.stddev_with_map, location.determined,
        strict=True,
    ):
        unit = 'µrad' if p.angular else 'µm'
        values = f'{2e6 * alone:8.3f} {2e6 * with_map:9.3f} {unit}' if good else 'not determined'
        lines.append(f'{p.symbol:14} {values}')
    return lines


def _map(one: ExpectedMap) -> list[str]:
    import numpy as np

    stations = f'{one.stddev.shape[1]} stations'
    if one.inner is not None:
        stations = f'{one.stddev.shape[1]} x {one.stddev.shape[2]} poses'
    lines = [f'Map of {one.axis} over {stations}, predicted U (k = 2): median, largest']
    for p, stddev in zip(one.parameters, one.stddev, strict=True):
        known = stddev[np.isfinite(stddev)]
        unit = 'µrad' if p.angular else 'µm'
        values = 'not determined'
        if known.size and p.symbol not in one.undetermined:
            values = f'{2e6 * np.median(known):8.3f} {2e6 * known.max():9.3f} {unit}'
        lines.append(f'{p.symbol:14} {values}')
    return lines + [f'looks like constants: {text}' for text in one.left_open]


def _visibility(seen: Foresight) -> list[str]:
    """What the plan does not show, or not apart, in few lines; each one is in a file."""
    from rtest_identification.visibility import NO_MOTION

    invisible = [
        f'{o.key} ({"" if NO_MOTION in o.taken_by else "taken by "}{", ".join(o.taken_by)})'
        for o in seen.outlooks if o.hidden == o.shapes
    ]
    partly = [
        f'{o.key} ({o.hidden} of {o.shapes} shapes not)'
        for o in seen.outlooks if 0 < o.hidden < o.shapes
    ]
    shown = [o for o in seen.outlooks if o.hidden < o.shapes]
    into_map = [o.key for o in shown if o.in_map]
    clear = sum(o.verdict == 'visible' for o in seen.outlooks)
    lines = []
    for title, items in (
        ('Invisible', invisible),
        ('Partly visible', partly),
        ('Not told from each other', _alike(seen)),
        ('Taken up by the map, where it is fitted', into_map),
    ):
        if items:
            lines += [f'{title}:', *textwrap.wrap('; '.join(items), 97, initial_indent='  ',
                                                  subsequent_indent='  ')]
    return [
        *lines, f'{clear} of {len(seen.outlooks)} error motions are visible and like no other; '
        'the part left of each one is in error_motions.csv',
    ]


def _alike(seen: Foresight) -> list[str]:
    """Error motions that look like others; harmonics of one axis together."""
    orders: dict[tuple[str, str, str], list[str]] = {}
    alone = []
    for o in seen.outlooks:
        family, _, axis = o.key.partition('/')
        name, _, order = axis.partition('.')
        for other in o.like:
            twin_family, _, twin = other.partition('/')
            if order and twin_family == family and twin.startswith(f'{name}.'):
                pair = sorted((order, twin.partition('.')[2]), key=int)
                families = orders.setdefault((name, *pair), [])
                families += [family] if family not in families else []
        others = [k for k in o.like if not (order and k.startswith(f'{family}/{name}.'))]
        if others:
            alone.append(f'{o.key} = {" or ".join(others)}')
    sets: dict[tuple[str, str], list[str]] = {}
    for (name, first, second), families in orders.items():
        sets.setdefault((name, ', '.join(families)), []).append(f'{first} = {second}')
    return [
        f'harmonics of {name}, {", ".join(pairs)} '
        f'({families})'
        for (name, families), pairs in sets.items()
    ] + alone


def _time(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    if seconds < 90.0:
        return f'{seconds:.0f} s'
    return f'{minutes} min' if minutes < 90 else f'{minutes // 60} h {minutes % 60:02d} min'


def _count(number: int, noun: str) -> str:
    return f'{number} {noun}{"" if number == 1 else "s"}'
