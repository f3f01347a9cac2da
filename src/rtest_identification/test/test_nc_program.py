"""NC programs, read back by a small interpreter of their own and run on an independent machine."""

import re
from itertools import pairwise

import numpy as np
import pytest
from independent import NMV, SETUPS, B, shift, turn

from rtest_estimation.errors import UserError
from rtest_identification.machine import parse_machine
from rtest_identification.moves import Approach, Speeds, synchronous_path
from rtest_identification.nc_program import NcSettings, nc_program
from rtest_identification.plans import (
    UNEVEN_DEG,
    diagnostic,
    dynamic,
    nest_calibration,
    spindle_runout,
    static,
)

MACHINE = parse_machine(NMV)
LETTERS = 'XYZBC'


def read(program):
    """Run a program: positions after every motion with its block time, and events between.

    Knows G0, G1, G4, G93, G94, M0, MSG, M19 and the modal words of a safe start, nothing else.
    """
    at, inverse, moves, events, modes = dict.fromkeys(LETTERS, 0.0), False, [], [], []
    for line in program.splitlines():
        if line.startswith('(MSG,'):
            events.append((len(moves), line[5:-1]))
            continue
        if line.startswith('(POSE '):
            events.append((len(moves), line[1:-1]))
            continue
        if line.startswith(('(', '%', 'O')):
            assert line.isascii() and line.count('(') == line.count(')') <= 1
            continue
        words = dict(re.findall(r'([A-Z])(-?\d+(?:\.\d+)?)', line))
        code = line.split()[0]
        if code in ('G0', 'G1'):
            assert code == 'G0' or 'F' in words
            assert code == 'G0' or set(words) == {'G', 'F', *LETTERS}
            at = at | {k: float(v) for k, v in words.items() if k in LETTERS}
            seconds = 60.0 / float(words['F']) if inverse and code == 'G1' else np.nan
            moves.append((code, np.array([at[k] for k in LETTERS]), seconds))
        elif code in ('G93', 'G94'):
            inverse = code == 'G93'
        else:
            modes.append(line)
        if code in ('G4', 'M0', 'M19'):
            events.append((len(moves), line))
    return moves, events, modes


def written(plan, speeds=None, **settings):
    chosen = NcSettings(**settings)
    path = synchronous_path(MACHINE, plan, speeds, chosen.chord)
    return nc_program(MACHINE, plan, path, Approach(), chosen, 'monday', 0.0127)


def poses(moves, events):
    """Row number to the position at which it is announced, mm and deg."""
    found = {}
    for count, text in events:
        if text.startswith('POSE '):
            found[int(text[5:])] = moves[count - 1][1]
    return found


def on_machine(row):
    """Sphere in the table frame [mm] of positions X Y Z B C [mm, deg], by plain matrices."""
    table = turn('B', np.radians(row[3])) @ turn('C', np.radians(row[4]))
    return (np.linalg.inv(table) @ shift(*row[:3]) @ [0, 0, 0, 1])[:3]


def commands(plan):
    return np.column_stack([plan.commands[:, :3] * 1e3, np.degrees(plan.commands[:, 3:5])])


PLANS = [
    static(MACHINE, '1a', np.array(SETUPS['1a']), B, np.radians([0, 120, 240])),
    diagnostic(MACHINE, '1b', np.array(SETUPS['1b']), B, np.radians(UNEVEN_DEG)),
    static(MACHINE, '2a', np.array(SETUPS['2a']), B, np.radians([0, 180, 360])),
    nest_calibration(MACHINE, '1a', np.array(SETUPS['1a'])),
]


@pytest.mark.parametrize('plan', PLANS, ids=lambda plan: plan.cycle)
def test_a_program_gives_the_plans_commands_back(plan):
    moves, events, modes = read(written(plan))
    found = poses(moves, events)
    assert sorted(found) == list(range(len(plan.commands)))
    np.testing.assert_allclose(
        np.array([found[k] for k in sorted(found)]) - commands(plan), 0.0, atol=0.51e-4
    )
    assert modes[:2] == ['G21 G90 G17 G40 G49 G80 G94', 'G54'] and modes[-1] == 'M2'
    assert [text for _, text in events].count('G4 P0.300') == len(plan.commands)


@pytest.mark.parametrize('plan', PLANS[:3], ids=lambda plan: plan.cycle)
@pytest.mark.parametrize('tolerance', [50e-6, 5e-6])
def test_the_sphere_stays_at_its_place_along_the_blocks(plan, tolerance):
    moves, events, _ = read(written(plan, tolerance=tolerance))
    first = next(count for count, text in events if text == 'POSE 0') - 1
    last = next(count for count, text in reversed(events) if text.startswith('POSE')) - 1
    place, worst = np.asarray(plan.sphere) * 1e3, 0.0
    for (_, start, _), (_, end, _) in pairwise(moves[first:last + 1]):
        for share in np.linspace(0, 1, 9):
            off = on_machine(start + share * (end - start)) - place
            worst = max(worst, float(np.linalg.norm(off)))
    # 60 % of the tolerance are for the chords, the rest for rounded corners.
    assert worst < 0.6 * tolerance * 1e3 + 3e-4
    assert worst > 0.2 * tolerance * 1e3 or plan.setup == '2a'


def test_blocks_take_the_time_of_their_slowest_axis():
    speeds = Speeds(0.02, np.radians(5.0))
    moves, _, _ = read(written(PLANS[0], speeds))
    for (_, start, _), (_, end, seconds) in pairwise(moves):
        if np.isfinite(seconds):
            slowest = np.max(np.abs(end - start) / [20, 20, 20, 5, 5])
            assert seconds == pytest.approx(max(slowest, 0.02), rel=2e-3)


def test_the_sphere_comes_straight_into_the_nest_and_leaves_it_so():
    moves, events, _ = read(written(PLANS[0]))
    confirmed = next(count for count, text in events if text == 'M0')
    assert confirmed == 0, 'nothing moves before somebody has looked'
    into = next(count for count, text in events if text == 'POSE 0')
    rapid = [row for code, row, _ in moves if code == 'G0']
    # Rotary axes, then across, then to the clearance height; never to the nest in rapid.
    assert len(rapid) == 3 and into == 4
    np.testing.assert_allclose(rapid[-1], [0, -90, 90.6, 0, 0])
    np.testing.assert_allclose(moves[3][1], [0, -90, 40.6, 0, 0])
    np.testing.assert_allclose(moves[-1][1], [0, -90, 90.6, 0, 0])


@pytest.mark.parametrize(
    ('controller', 'on', 'off', 'end', 'dwell'),
    [
        ('linuxcnc', 'M428', 'M429', 'M2', 'G4 P0.300'),
        ('linuxcnc-m68', 'M68 E3 Q1', 'M68 E3 Q0', 'M2', 'G4 P0.300'),
        ('iso', 'G43.4 H1', 'G49', 'M30', 'G4 P300'),
    ],
)
def test_in_tcp_mode_the_linear_words_are_the_sphere_in_the_table_frame(
    controller, on, off, end, dwell
):
    plan = PLANS[1]
    moves, events, modes = read(written(plan, tcp=True, controller=controller))
    found = poses(moves, events)
    rows = np.array([found[k] for k in sorted(found)])
    np.testing.assert_allclose(rows[:, 3:], commands(plan)[:, 3:], atol=0.51e-5)
    np.testing.assert_allclose(rows[:, :3], np.tile([0, -90, 140.6], (len(rows), 1)), atol=1e-9)
    # One block a pose, and the approach and the way out.
    assert sum(code == 'G1' for code, _, _ in moves) == len(plan.commands) - 1 + 2
    assert on in modes and modes.index(on) < len(modes) - 1 - modes[::-1].index(off)
    assert modes[-1] == end and dwell in [text for _, text in events]
    if controller != 'iso':
        # The switch would cut off the end of the move before it.
        for switch in (on, off):
            before = [modes[k - 1] for k, text in enumerate(modes) if text == switch]
            assert before and set(before) == {'G4 P0.1'}


def test_only_the_first_stop_has_a_message_which_somebody_has_to_fetch():
    for tcp in (False, True):
        assert written(PLANS[0], tcp=tcp).count('(MSG') == 1


def test_tcp_words_of_a_nest_calibration_are_its_steps():
    moves, events, _ = read(written(PLANS[3], tcp=True))
    found = poses(moves, events)
    np.testing.assert_allclose(found[1] - found[0], [1, 0, 0, 0, 0], atol=1e-9)


def test_a_pause_at_every_pose():
    _, events, _ = read(written(PLANS[0], pause=True))
    texts = [text for _, text in events]
    for pose in range(len(PLANS[0].commands)):
        place = texts.index(f'POSE {pose}')
        assert texts[place:place + 3] == [f'POSE {pose}', 'G4 P0.300', 'M0']


def test_the_spindle_is_oriented_for_a_run_out():
    plan = spindle_runout(MACHINE, '1a', np.array(SETUPS['1a']), 4)
    _, events, _ = read(written(plan))
    oriented = [text for _, text in events if text.startswith('M19')]
    assert oriented == [f'M19 R{a}.000' for a in (0, 90, 180, 270, 0)]


def test_the_header_says_whose_program_it_is():
    text = written(PLANS[0])
    for words in ('1A-STATIC', 'SESSION MONDAY', 'MACHINE NMV', 'SETUP 1A', 'RADIUS 12.7000',
                  'MM AND DEG', 'MIN', 'B+ TURNS THE TABLE RIGHT-HANDED ABOUT 0 1 0'):
        assert words in text
    assert max(map(len, text.splitlines())) <= 80
    assert '-0.0000 ' not in text
    backwards = parse_machine(NMV.replace('sense: 1', 'sense: -1'))
    plan = static(backwards, '1a', np.array(SETUPS['1a']), B, np.radians([0, 120]))
    path = synchronous_path(backwards, plan)
    turned = nc_program(backwards, plan, path, Approach(), NcSettings())
    assert 'B+ TURNS THE TABLE RIGHT-HANDED ABOUT 0 -1 0' in turned


def test_names_of_machines_cannot_end_a_comment():
    strange = parse_machine(NMV.replace('name: NMV', 'name: "Mühle (2) % ;M3"'))
    plan = static(strange, 'a)b', np.array(SETUPS['1a']), B, np.radians([0, 120]))
    path = synchronous_path(strange, plan)
    read(nc_program(strange, plan, path, Approach(), NcSettings()))


def test_axes_that_no_program_can_name_are_refused():
    odd = parse_machine(NMV.replace('  C:', '  C1:').replace('[C, B,', '[C1, B,'))
    plan = static(odd, '1a', np.array(SETUPS['1a']), B, np.radians([0, 120]))
    with pytest.raises(UserError, match='C1'):
        nc_program(odd, plan, synchronous_path(odd, plan), Approach(), NcSettings())


@pytest.mark.parametrize('speed', [358.0, 3583.0])
def test_a_dynamic_cycle_turns_at_its_feed_along_the_circle(speed):
    omega = np.radians(speed) / 60.0
    plan = dynamic(MACHINE, '1a', np.array(SETUPS['1a']), 'C', omega, 2.0)
    moves, events, _ = read(written(plan))
    start, end = (
        next(count for count, text in events if text == f'POSE {pose}') - 1 for pose in (0, 1)
    )
    way = [row for _, row, _ in moves[start:end + 1]]
    seconds = [time for _, _, time in moves[start + 1:end + 1]]
    # Two turns from -360 deg; every block takes its part of the time, 20 ms at least.
    assert sum(seconds) == pytest.approx(720.0 / (speed / 60.0), rel=1e-4)
    assert min(seconds) > 0.0199
    worst = max(
        np.linalg.norm(on_machine(0.5 * (one + other)) - 1e3 * plan.sphere)
        for one, other in pairwise(way)
    )
    # The sagitta of 1 um, or of 1.2 deg where blocks of 20 ms are longer: 90 mm (0.6 deg)^2 / 2.
    assert worst < (1.1e-3 if speed < 1000 else 5.2e-3)
    assert [text for _, text in events].count('G4 P1.000') == 3


def test_in_tcp_mode_a_pass_is_one_block():
    plan = dynamic(MACHINE, '1a', np.array(SETUPS['1a']), 'C', np.radians(60.0), 2.0)
    moves, events, _ = read(written(plan, tcp=True))
    first = next(count for count, text in events if text == 'POSE 0')
    (_, there, seconds), (_, back, same) = moves[first:first + 2]
    np.testing.assert_allclose(there, [*1e3 * plan.sphere, 0.0, 360.0], atol=1e-4)
    np.testing.assert_allclose(back, [*1e3 * plan.sphere, 0.0, -360.0], atol=1e-4)
    assert seconds == same == pytest.approx(12.0, rel=1e-3)
