"""What a correction is written as: tables, compensation of single axes, programs; the command."""

import argparse
import json
import re
from itertools import pairwise

import numpy as np
import pytest
from correction_case import (
    ANGLE,
    B_ONLY,
    BACKLASH,
    MACHINE,
    SCALE,
    VALUES,
    B,
    C,
    X,
    effect,
    identified,
    known_errors,
    model,
    random_poses,
)

from rtest_drivers.commands import correct as command
from rtest_drivers.config import config_path
from rtest_drivers.sim.errors import GeometricErrors, Term
from rtest_drivers.sim.kinematics import sphere_in_table
from rtest_estimation.errors import UserError
from rtest_identification import output
from rtest_identification.correction.compensation import axis_tables, elsewhere
from rtest_identification.correction.known import KnownErrors, of_model
from rtest_identification.correction.output import positions_text
from rtest_identification.correction.program import path_program, rewrite
from rtest_identification.correction.step import correct
from rtest_identification.correction.table import table
from rtest_identification.frustum.commands import command as cone_commands
from rtest_identification.frustum.gcode import read_blocks
from rtest_identification.frustum.output import write_commands
from rtest_identification.frustum.path_file import load_path
from rtest_identification.frustum.thesis import frustum
from rtest_identification.gap.model_file import save_model
from rtest_identification.machine import parse_machine

CONE = cone_commands(MACHINE, frustum(10.0, (0.0, -20.0, 80.0), 30.0, 80.0).feature(90))


@pytest.fixture(scope='module')
def known():
    return known_errors()


# --- tables ---


def test_table_rows_add_to_the_commands(known, tmp_path):
    made = table(known, [(0.0, -0.09, 0.0406), (0.0, 0.0, 0.1406)])
    assert made.left_out == 0 and len(made.place) == 2 * 7 * 12
    text = positions_text(made.correction).splitlines()
    assert 'ADDED' in text[0] and 'rotation about the tool axis' in text[1]
    names, row = text[2].split(','), [float(v) for v in text[20].split(',')]
    by_name = dict(zip(names, row, strict=True))
    assert names[1:11] == ['X_mm', 'Y_mm', 'Z_mm', 'B_deg', 'C_deg', 'dX_mm', 'dY_mm', 'dZ_mm',
                           'dB_deg', 'dC_deg']
    # Its words, added and run on the true machine, put the sphere where it belongs.
    scale = np.array([1e-3] * 3 + [np.pi / 180] * 2)
    command_, change = (
        np.array([by_name[name] for name in names[k : k + 5]]) * scale for k in (1, 6)
    )
    wanted = sphere_in_table(MACHINE, command_[None])
    off = [np.linalg.norm(sphere_in_table(MACHINE, p[None], B_ONLY.errors) - wanted)
           for p in (command_, command_ + change)]
    assert by_name['before_um'] == pytest.approx(1e6 * off[0], abs=0.6)
    assert off[0] > 3e-5 and off[1] < 6e-7


# --- compensation of single axes ---


def linuxcnc(text, positions, upwards):
    """What LinuxCNC adds to the command of a joint, COMP_FILE_TYPE 0 (motion/control.c)."""
    rows = np.array([[float(v) for v in line.split(' ')] for line in text.splitlines()])
    assert rows.shape[1] == 3 and len(rows) <= 256 and (np.diff(rows[:, 0]) > 0).all()
    trim = rows[:, 0] - rows[:, 1 if upwards else 2]
    at = np.clip(np.searchsorted(rows[:, 0], positions, side='right') - 1, 0, len(rows) - 2)
    slope = (trim[at + 1] - trim[at]) / (rows[at + 1, 0] - rows[at, 0])
    inside = np.clip(positions, rows[0, 0], rows[-1, 0])
    return trim[at] + slope * (inside - rows[at, 0])


def test_compensation_files_take_the_own_errors_of_axes_away():
    known = of_model(model(SCALE, ANGLE, **{'E_B(0Y)B': 4e-5}), MACHINE)
    tables, refused = axis_tables(known)
    assert [one.axis.name for one in tables] == ['X', 'B'] and not elsewhere(known)
    assert set(refused) == {'Y', 'Z', 'C'}
    errors = GeometricErrors({'E_B(0Y)B': 4e-5}, {
        'E_X(Y)X': (Term('power', 'X', 1, 4e-6, full=0.1),),
        'E_B(Y)B': (Term('harmonic', 'B', 1, 1e-5, -2e-5),),
    })
    positions = random_poses(MACHINE, 50, 5)
    wanted = sphere_in_table(MACHINE, positions)
    moved = positions.copy()
    for one, column, unit in zip(tables, (X, B), (1e-3, np.pi / 180), strict=True):
        moved[:, column] += unit * linuxcnc(one.text(), positions[:, column] / unit, True)
    before = np.linalg.norm(sphere_in_table(MACHINE, positions, errors) - wanted, axis=1)
    after = np.linalg.norm(sphere_in_table(MACHINE, moved, errors) - wanted, axis=1)
    assert before.max() > 5e-6 and after.max() < 3e-9


def test_backlash_is_in_the_two_directions_of_a_file():
    (one,), _ = axis_tables(of_model(model(BACKLASH), MACHINE))
    # Half of it too far after coming upwards: then the command must be less.
    here = np.array([10.0])
    assert linuxcnc(one.text(), here, True) == pytest.approx(np.degrees([-1.5e-5]), abs=2e-7)
    assert linuxcnc(one.text(), here, False) == pytest.approx(np.degrees([1.5e-5]), abs=2e-7)
    change = one.change(np.radians([10.0, 10.0, 10.0]), np.array([1.0, -1.0, 0.0]))
    assert change == pytest.approx([-1.5e-5, 1.5e-5, 0.0], abs=1e-12)


def test_a_file_is_refused_where_one_axis_does_not_suffice():
    def growing(positions, approach):
        errors = np.zeros((len(positions), 5, 6))
        errors[:, C, 2] = 1e-5 * np.sin(positions[:, C]) * np.abs(positions[:, B])
        errors[:, B, 0] = 2e-5
        return errors

    known = KnownErrors(MACHINE, growing, lambda p: np.ones(len(p), dtype=bool))
    tables, refused = axis_tables(known)
    assert not tables and elsewhere(known) == ['E_AB']
    assert 'changes by' in refused['C'] and 'with other axes' in refused['C']
    assert refused['B'] == 'no error in its own direction is known of it'


def test_a_file_keeps_to_what_was_measured(known):
    (one,), refused = axis_tables(known)
    assert one.axis.name == 'B' and set(refused) == {'X', 'Y', 'Z', 'C'}
    assert np.degrees(one.nominal[[0, -1]]) == pytest.approx([-75.0, 75.0], abs=1e-3)
    truth = B_ONLY.errors.dependent('E_B(Y)B', {'B': one.nominal})
    assert one.forward == pytest.approx(
        truth + B_ONLY.errors.constants['E_B(0Y)B'], abs=2e-6
    )


def test_an_endless_axis_has_no_file_and_stops_no_other():
    text = MACHINE.text.replace('range_deg: [-360, 360]', 'range_deg: [-.inf, .inf]')
    tables, refused = axis_tables(of_model(model(SCALE, BACKLASH), parse_machine(text)))
    assert [one.axis.name for one in tables] == ['X']
    assert refused['C'] == 'its range is not in the machine file'


# --- NC programs ---


PROGRAM = """%
O0012
(a part; with G1 X1 in a comment)
G21 G90 G94
G0 Z150
G0 X10. Y-20. B5. C0 (to the start)
N10 g1 x12.5 F600 M8
B60 C30
G93 Y-10 Z140 C75 F2.5
G94 G0 Z180 ; away
M30
X1 is not read any more
"""


def test_a_program_keeps_everything_but_the_positions(known, tmp_path):
    path = tmp_path / 'part.ngc'
    made = rewrite(path, PROGRAM, known)
    lines = made.text.splitlines()
    assert lines[:2] == ['%', 'O0012'] and lines[2].startswith('(POSITIONS CORRECTED')
    assert lines[3:6] == ['(a part; with G1 X1 in a comment)', 'G21 G90 G94', 'G0 Z150']
    assert lines[6].startswith('G0 X9.9') and lines[6].endswith('(to the start)')
    assert lines[7].startswith('N10 g1 X12.4') and lines[7].endswith(' F600 M8')
    assert lines[-2:] == ['M30', 'X1 is not read any more'] and '; away' in lines[-3]
    assert made.notes == (
        f'{path}: line 5: not corrected: the positions of other axes are not known there',
    )
    nominal = read_blocks(path, PROGRAM, MACHINE)
    corrected = read_blocks(path, made.text, MACHINE)
    assert len(corrected.end) > len(nominal.end) == 3
    # Inverse time: the pieces together take as long as the block did.
    start, end = (next(k for k, line in enumerate(lines) if code in line)
                  for code in ('G93', 'G94 G0'))
    timed = [float(line.rpartition('F')[2]) for line in lines[start:end]]
    assert sum(1.0 / feed for feed in timed) == pytest.approx(1.0 / 2.5, rel=1e-3)


def test_along_corrected_blocks_the_tool_stays_on_its_way(known, tmp_path):
    path = tmp_path / 'part.ngc'
    text = 'G0 X10 Y-20 Z150 B5 C0\nG1 B70 C60 F500\nX40 Z120\nM2\n'
    nominal = read_blocks(path, text, MACHINE)
    corrected = read_blocks(path, rewrite(path, text, known).text, MACHINE)
    whole = corrected.end[-1] - corrected.start[0]
    first = np.argmin(np.abs(corrected.end[:, B] - nominal.end[0, B])) + 1
    worst = [0.0, 0.0]
    for start, end, rows in (
        (nominal.start[0], nominal.end[0], slice(0, first)),
        (nominal.start[1], nominal.end[1], slice(first, None)),
    ):
        count = len(corrected.end[rows])
        for piece, (a, b) in enumerate(zip(corrected.start[rows], corrected.end[rows],
                                           strict=True)):
            share = np.linspace(0.0, 1.0, 6)[:, None]
            meant = start + (piece + share) / count * (end - start)
            wanted = sphere_in_table(MACHINE, meant)
            for k, run in enumerate((meant, a + share * (b - a))):
                off = sphere_in_table(MACHINE, run, B_ONLY.errors) - wanted
                worst[k] = max(worst[k], np.linalg.norm(off, axis=1).max())
    assert np.linalg.norm(whole) > 0.03
    assert worst[0] > 3e-5 and worst[1] < 8e-7


def words_of(line):
    return {name: float(value) for name, value in re.findall(r'([XYZBC])(-?[\d.]+)', line)}


def off_along(text, start, end, errors):
    """Worst distance from its way of a tool that runs a program's G1 blocks, by the simulation.

    The program was one straight block from start to end, of which C alone moves.
    """
    rows = np.array([[words_of(line)[n] for n in 'XYZBC'] for line in text.splitlines()
                     if line[:1] in 'GX' and words_of(line)]) * ([1e-3] * 3 + [np.pi / 180] * 2)
    share = np.linspace(0.0, 1.0, 41)[:, None]
    run = np.concatenate([a + share * (b - a) for a, b in pairwise(rows)])
    meant = np.tile(start, (len(run), 1))
    meant[:, C] = np.clip(run[:, C], start[C], end[C])
    off = sphere_in_table(MACHINE, run, errors) - sphere_in_table(MACHINE, meant)
    return np.linalg.norm(off, axis=1).max(), len(rows) - 1


def test_a_block_as_long_as_the_period_of_an_error_is_cut(tmp_path):
    # Four times a turn, seen every quarter of one: the same at all of these points.
    known = of_model(model(effect('radial/C.4', a_X=(1e-5, 'm'), b_X=(0.0, 'm'), a_Y=(0.0, 'm'),
                                  b_Y=(0.0, 'm'))), MACHINE)
    errors = GeometricErrors({}, {'E_X(B)C': (Term('harmonic', 'C', 4, 1e-5, 0.0),)})
    text = 'G0 X50 Y0 Z50 B0 C0\nG1 X50 Y0 Z50 B0 C360 F500\nM2\n'
    start, end = np.array([0.05, 0.0, 0.05, 0.0, 0.0]), np.array([0, 0, 0, 0, 2.0 * np.pi])
    before, _ = off_along(text, start, end, errors)
    made = rewrite(tmp_path / 'p.ngc', text, known)
    after, pieces = off_along(made.text, start, end, errors)
    assert before == pytest.approx(1e-5, rel=1e-3) and pieces > 40
    assert after < 2.5e-7
    # What is told is what is found along the way, rounding of the words included.
    told = np.linalg.norm(made.along.after.shift, axis=1).max()
    assert 0.6 * after < told <= 1.001 * after
    assert np.linalg.norm(made.along.before.shift, axis=1).max() == pytest.approx(before, rel=1e-2)


def test_even_an_error_of_the_period_of_the_points_is_found(tmp_path):
    def worm(positions, approach):
        errors = np.zeros((len(positions), 5, 6))
        errors[:, C, 3] = 2e-6 * np.sin(360.0 * positions[:, C])
        return errors

    known = KnownErrors(MACHINE, worm, lambda p: np.ones(len(p), dtype=bool))
    made = rewrite(tmp_path / 'p.ngc', 'G0 X50 Y0 Z50 B0 C0\nG1 C10 F500\nM2\n', known)
    moves = read_blocks(tmp_path / 'p.ngc', made.text, MACHINE)
    # Sagitta of a chord of a sine: amplitude * (order * length)^2 / 8 on its crest.
    assert 2e-6 * (360.0 * np.diff(moves.end[:, C])).max() ** 2 / 8.0 < 2e-7
    assert np.linalg.norm(made.along.after.shift, axis=1).max() < 2.5e-7


def test_play_is_taken_up_before_the_tool_goes_back(tmp_path):
    known = of_model(model(effect('backlash/X', h=(2e-5, 'm'))), MACHINE)
    text = 'G0 X-10 Y0 Z50 B0 C0\nG0 X0\nG1 X50 F500\nX0\nM2\n'
    made = rewrite(tmp_path / 'p.ngc', text, known)
    rows = [words_of(line) for line in made.text.splitlines() if not line.startswith('(')]
    # Half of it too far each way.
    assert [row['X'] for row in rows if row] == pytest.approx([-10, -0.01, 49.99, 50.01, 0.01])
    timed = rewrite(tmp_path / 'p.ngc', text.replace('G1', 'G93 G1').replace('X0\nM2',
                                                                             'X0 F2\nM2'), known)
    assert [line.rpartition('F')[2] for line in timed.text.splitlines()[4:6]] == [
        '60000.000', '2.000']


def test_a_dwell_moves_nothing(tmp_path, known):
    text = 'G0 X0 Y0 Z150 B5 C0\nG4 X1\nG4 P0.5\nG1 X-20 F500\nM2\n'
    nominal = read_blocks(tmp_path / 'p.ngc', text, MACHINE)
    assert nominal.start[0, X] == 0.0 and len(nominal.end) == 1
    lines = rewrite(tmp_path / 'p.ngc', text, known).text.splitlines()
    assert lines[2:4] == ['G4 X1', 'G4 P0.5']
    for line in ('G4 X1 Y2', 'G1 G4 X1', 'G4 P1 X1', 'G4 B1'):
        with pytest.raises(UserError, match=r'p\.ngc:2: a dwell \(G4\) in one block with a move'):
            read_blocks(tmp_path / 'p.ngc', text.replace('G4 X1', line), MACHINE)


def test_a_number_with_a_comment_stays_first_and_a_percent_sign_ends(tmp_path, known):
    text = '%\nO0007 (PART A)\n(B)\nG0 X0 Y0 Z150 B5 C0\nG1 X-20 F500\n%\nX100\n'
    lines = rewrite(tmp_path / 'p.ngc', text, known).text.splitlines()
    assert lines[:2] == ['%', 'O0007 (PART A)'] and lines[3] == '(B)'
    assert lines[2].startswith('(POSITIONS CORRECTED')
    assert lines[-2:] == ['%', 'X100']


def test_a_block_with_a_stop_stays_whole_and_is_told(known, tmp_path):
    text = 'G0 X10 Y-20 Z150 B5 C0\nG1 B70 F500 M8\nB-70 M0\nX11 M0\nM2\n'
    made = rewrite(tmp_path / 'p.ngc', text, known)
    lines = made.text.splitlines()
    assert lines[2].endswith('F500 M8') and lines[3].startswith('X') and 'M' not in lines[3]
    assert [line[-2:] for line in lines[-3:]] == ['M0', 'M0', 'M2']
    (note,) = made.notes
    assert 'line 3: corrected at the end only' in note and float(note.split()[-2]) > 1.0


@pytest.mark.parametrize(('line', 'match'), [
    ('G2 X1 Y1 I1 J0', 'arc'), ('G43 H1', 'tool length'), ('G91', 'incremental'),
])
def test_a_program_that_says_something_else_is_refused(known, tmp_path, line, match):
    with pytest.raises(UserError, match=match):
        rewrite(tmp_path / 'p.ngc', f'G0 X0 Y0 Z0 B0 C0\n{line}\nG1 X1\nM2\n', known)


@pytest.mark.parametrize('controller', ['linuxcnc', 'iso'])
def test_a_path_becomes_a_program(known, tmp_path, controller):
    wanted = correct(MACHINE, CONE.positions, known.at(CONE.positions, CONE.approach))
    made = path_program(CONE, known, 1.0 / 60.0, controller)
    text = made.text
    assert made.correction.positions == pytest.approx(wanted.positions, abs=1e-12)
    if controller == 'linuxcnc':
        blocks = read_blocks(tmp_path / 'p.ngc', text.replace('G1 X', 'G0 X', 1), MACHINE)
        # Every point is still gone through, whether a move was cut or not.
        off = np.abs(blocks.end[:, None] - wanted.positions[1:]).max(axis=2).min(axis=0)
        assert off.max() < 2e-7 and len(blocks.end) >= 89
    feeds = [float(line.rpartition('F')[2]) for line in text.splitlines()
             if line.startswith('G1')][1:]
    way = np.linalg.norm(np.diff(CONE.feature.tip, axis=0), axis=1).sum()
    assert sum(60.0 / feed for feed in feeds) == pytest.approx(way * 60.0, rel=1e-3)


# --- the command ---


def run(*arguments):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(one) for one in arguments]))


@pytest.fixture(scope='module')
def identification(tmp_path_factory):
    return output.write(identified(), tmp_path_factory.mktemp('identified'))['json']


def test_the_command_corrects_a_session(identification, tmp_path, capsys):
    out = tmp_path / 'out'
    assert run('--identification', identification, '--plan', config_path('demo.yaml'),
               '--out', out) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[-1].startswith('demo.yaml: 344 poses, tool point 40.') and ' -> 0.00' in told[-1]
    assert told[-1].endswith(str(out / 'correction.json'))
    assert sum('no compensation file for' in line for line in told) == 4
    assert (out / 'B.comp').is_file() and 'COMP_FILE_TYPE = 0' in (
        out / 'compensation.ini').read_text()
    data = json.loads((out / 'correction.json').read_text())
    assert set(data['predicted']) == {'table', *(f'{s}-static' for s in ('1a', '1b', '2a', '2b'))}
    found = data['predicted']['1a-static']
    assert found['after']['shift'] < 1e-8 < 1e-7 < found['spread'] < 3e-7
    assert data['compensation_files']['axes'] == ['B']
    assert {'E_XB', 'E_AC', 'E_CX'} <= set(data['compensation_files']['in_none'])
    program = (out / '2b-static-corrected.ngc').read_text()
    table_ = np.loadtxt(out / '2b-static-corrected.csv', delimiter=',', skiprows=3)
    last = re.split(r'\(.*POSE 85\)', program)[0].splitlines()[-1]
    words = {word[0]: float(word[1:]) for word in last.split()}
    assert [words[n] for n in 'XYZBC'] == pytest.approx(table_[-1, 1:6] + table_[-1, 6:11],
                                                        abs=6e-5)


def test_the_command_corrects_paths(identification, tmp_path, capsys):
    path = write_commands(CONE, tmp_path)
    assert run('--identification', identification, '--path', path, '--out', tmp_path / 'a') == 0
    made = np.loadtxt(tmp_path / 'a' / 'commands-corrected.csv', delimiter=',', skiprows=3)
    positions = load_path(path, MACHINE).positions
    assert made[:, 4] == pytest.approx(np.degrees(positions[:, B]), abs=1e-6)
    (tmp_path / 'part.ngc').write_text(PROGRAM)
    assert run('--identification', identification, '--path', tmp_path / 'part.ngc',
               '--out', tmp_path / 'b') == 0
    assert 'N10 g1' in (tmp_path / 'b' / 'part-corrected.ngc').read_text()
    assert 'line 5: not corrected' in capsys.readouterr().out


def test_what_is_told_of_a_path_is_of_that_path(identification, tmp_path, capsys):
    path = tmp_path / 'k.ngc'
    path.write_text('G0 X0 Y104.999 Z150 B0 C0\nG1 X60 F500\nC90\nM2\n')
    assert run('--identification', identification, '--path', path, '--out', tmp_path / 'o') == 0
    told = capsys.readouterr().out.splitlines()
    data = json.loads((tmp_path / 'o/correction.json').read_text())
    mine = data['predicted']['k.ngc']
    files = data['compensation_files']['predicted_with_them_alone']['k.ngc']
    (line,) = (line for line in told if 'compensation files alone' in line and '->' in line)
    assert line.startswith('  k.ngc, compensation files alone')
    assert f'-> {files["after"]["shift"] * 1e6:.3f} µm' in line
    assert files['after']['shift'] < files['before']['shift']
    assert not any(line.startswith('  warning') for line in told)
    # The largest along the way, and what a workpiece zero cannot take away.
    assert f'{mine["after"]["shift_largest"] * 1e6:.3f} at most' in told[-1]
    assert mine['placed'] < 0.5 * mine['before']['shift']
    # A hundredth of a millimetre over the end of Y is seen, and who takes it there.
    (note,) = (line for line in told if 'its range is -105 to 105' in line)
    assert re.search(r'to 105\.01\d\d mm', note) and 'the correction that takes it there' in note
    assert 'the machine cannot run it, out of range: Y' in told[-1]


def test_files_that_make_a_path_worse_are_warned_of(tmp_path, capsys):
    # 100 urad at 100 mm above B are 10 um along X, which the place of B makes up for.
    save_model(model(**{'E_B(0Y)B': 1e-4, 'E_X(0Y)B': -1e-5}), tmp_path / 'model.yaml')
    path = tmp_path / 'y.ngc'
    path.write_text('G0 X0 Y0 Z100 B0 C0\nG1 Y50 F500\nM2\n')
    assert run('--model', tmp_path / 'model.yaml', '--path', path, '--out', tmp_path / 'o') == 0
    told = capsys.readouterr().out.splitlines()
    (line,) = (line for line in told if 'compensation files alone:' in line)
    assert 'tool point 0.00 ' in line and '-> 10.000 µm rms' in line
    assert told[told.index(line) + 1].startswith('  warning: the compensation files alone make')


def test_the_command_takes_a_model(tmp_path, capsys):
    save_model(model(SCALE, **VALUES), tmp_path / 'model.yaml')
    assert run('--model', tmp_path / 'model.yaml', '--at', 0, 0, 100, '--out', tmp_path / 'o') == 0
    told = capsys.readouterr().out
    assert 'X.comp: the own error of X' in told
    assert 'in no compensation file: E_CX, E_XB, E_AC: they act across' in told
    rows = np.loadtxt(tmp_path / 'o' / 'correction.csv', delimiter=',', skiprows=3)
    assert len(rows) == 7 * 12 and rows[:, 2] == pytest.approx(100.0)


def test_mistakes_are_told_in_one_line(identification, tmp_path):
    (tmp_path / 'full').mkdir()
    (tmp_path / 'full' / 'old.ngc').write_text('G0 X0\n')
    far = tmp_path / 'far.ngc'
    far.write_text('G0 X0 Y0 Z0 B0 C0\nG1 B100 F100\nM2\n')
    for arguments, match in (
        (['--out', tmp_path / 'full'], 'is not empty'),
        (['--effects', 'e.yaml'], 'give the --model'),
        (['--plan', 'p.yaml', '--machine', 'm.yaml'], 'names the machine'),
        (['--path', 'p.csv', '--feed', '0'], 'positive'),
        (['--path', far, '--feed', '500'], '--feed: is of a --path as CSV'),
        (['--path', far, '--controller', 'iso'], '--controller: is of new programs'),
        (['--at', 'nan', '0', '0'], 'finite'),
        (['--at', '5000', '0', '0'], 'reaches none of these places'),
        (['--path', tmp_path / 'no.ngc'], 'cannot read'),
        (['--path', far], r'far\.ngc:2: B = 100, C = 0 deg is outside the measured stations of B'),
        (['--machine', config_path('head_table.yaml')], 'not an identification.json|is of mach'),
    ):
        with pytest.raises(UserError, match=match) as caught:
            run('--identification', identification, *arguments, *(
                [] if '--out' in arguments else ['--out', tmp_path / 'new']
            ))
        assert '\n' not in str(caught.value)
    assert not (tmp_path / 'new').exists()
