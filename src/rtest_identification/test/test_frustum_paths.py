"""A user's own path: CSV and NC programs, against the cone they were made of."""

import numpy as np
import pytest
from independent import NMV

from rtest_estimation.errors import UserError
from rtest_identification.frustum.commands import command
from rtest_identification.frustum.contour import along_normal, contour_error
from rtest_identification.frustum.output import write_commands
from rtest_identification.frustum.path_file import FLOOR, RIGHT, load_path
from rtest_identification.frustum.thesis import frustum
from rtest_identification.machine import parse_machine

MACHINE = parse_machine(NMV)
CONE = frustum(10.0, (0.0, -20.0, 80.0), 20.0, 80.0)
MADE = command(MACHINE, CONE.feature())
ERRORS = np.zeros((5, 6))
ERRORS[3] = [4e-5, -2e-5, 1e-5, 5e-6, 8e-6, -3e-6]
ERRORS[4, 0] = 3e-5
TIP_HEADER = 'x_mm,y_mm,z_mm,i,j,k'


def tip_table(normals=False):
    rows = np.hstack([1e3 * MADE.feature.tip, MADE.feature.axis, MADE.feature.normal])
    rows = rows if normals else rows[:, :6]
    header = TIP_HEADER + (',nx,ny,nz' if normals else '')
    return '\n'.join(['# a cone', header, *(','.join(f'{v:.6f}' for v in r) for r in rows)])


def words(row):
    scale = [1e3, 1e3, 1e3, 180 / np.pi, 180 / np.pi]
    values = zip('XYZBC', row * scale, strict=True)
    return ' '.join(f'{name}{value:.5f}' for name, value in values)


def program(finely=1):
    rows = command(MACHINE, CONE.feature(360 * finely)).positions
    rows = np.vstack([rows, rows[0]])
    rows[-1, 4] += 2 * np.pi * np.sign(rows[-2, 4] - rows[0, 4])
    lines = ['%', '(A CONE)', 'O0001', 'G21 G90 G17 G40 G49 G80 G94 ; modes', 'G54', 'T1 M6',
             'G64 P0.01', 'S8000 M3', 'G4 P0.5', f'g0 {words(rows[0])}', 'F1000']
    # Modal: G1 once, a word that does not change is left out.
    lines += [f'N{n} {"G1 " if n == 0 else ""}{words(row)}' for n, row in enumerate(rows[1:])]
    return '\n'.join([*lines, 'G0 Z200', 'M5', 'M30', 'this is not read any more'])


def saved(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    return path


def deviation(made):
    return along_normal(made, contour_error(made, ERRORS))


def form(made):
    return made.feature.form_deviation(deviation(made))


WANT = form(MADE) / MADE.feature.scale


@pytest.mark.parametrize('normals', [False, True])
def test_tip_and_axis(tmp_path, normals):
    made = load_path(saved(tmp_path, 'cone.csv', tip_table(normals)), MACHINE)
    np.testing.assert_allclose(made.feature.normal, MADE.feature.normal, atol=1e-5)
    np.testing.assert_allclose(made.positions, MADE.positions, atol=1e-5)
    assert form(made) == pytest.approx(WANT, rel=1e-4)


def test_positions_of_the_axes(tmp_path):
    made = load_path(write_commands(MADE, tmp_path), MACHINE)
    np.testing.assert_allclose(made.positions, MADE.positions, atol=1e-9)
    np.testing.assert_allclose(made.feature.tip, MADE.feature.tip, atol=1e-9)
    np.testing.assert_allclose(deviation(made), deviation(MADE), atol=1e-12)


def test_an_nc_program(tmp_path):
    made = load_path(saved(tmp_path, 'cone.ngc', program()), MACHINE)
    # Straight blocks a degree apart are nearly the cone, with facets.
    assert form(made) == pytest.approx(WANT, rel=0.02)
    finer = load_path(saved(tmp_path, 'fine.ngc', program(3)), MACHINE)
    assert form(finer) == pytest.approx(WANT, rel=1e-3)
    assert made.notes == ()


def test_a_plunge_cuts_no_flank(tmp_path):
    text = program().replace(
        'F1000\n', f'F1000\nG1 Z{1e3 * MADE.positions[0, 2] - 4.5:.5f}\n'
        f'G1 Z{1e3 * MADE.positions[0, 2]:.5f}\n', 1
    )
    made = load_path(saved(tmp_path, 'cone.ngc', text), MACHINE)
    assert made.notes[0].startswith('10 of ') and 'left out' in made.notes[0]
    assert form(made) == pytest.approx(WANT, rel=0.02)


def test_where_the_surface_is(tmp_path):
    path = saved(tmp_path, 'cone.csv', tip_table())
    left, right = load_path(path, MACHINE), load_path(path, MACHINE, RIGHT)
    np.testing.assert_allclose(right.feature.normal, -left.feature.normal)
    floor = load_path(path, MACHINE, FLOOR)
    np.testing.assert_allclose(floor.feature.normal, MADE.feature.axis, atol=1e-6)
    # A straight line along X with an upright tool: its left is +Y, the surface faces -Y.
    line = [f'{x},0,50,0,0,1' for x in range(-20, 21, 5)]
    path = saved(tmp_path, 'line.csv', '\n'.join([TIP_HEADER, *line]))
    np.testing.assert_allclose(load_path(path, MACHINE).feature.normal, [[0, -1, 0]] * 9)


def test_a_straight_line_shows_straightness_alone(tmp_path):
    line = [f'{x},0,50,0,0,1' for x in range(-50, 51, 5)]
    made = load_path(saved(tmp_path, 'line.csv', '\n'.join([TIP_HEADER, *line])), MACHINE)
    x = made.axis('X')
    errors = np.zeros((21, 5, 6))
    # Y straightness of X: offset and slope are the part's placing, c x^2 with c (50 mm)^2 = 10 µm
    # leaves 10 µm.
    errors[:, 0, 4] = 3e-6 + 1e-4 * x + 10e-6 * (x / 0.05) ** 2
    found = made.feature.form_deviation(along_normal(made, contour_error(made, errors)))
    assert found == pytest.approx(10e-6, rel=1e-6)


def broken(line, text):
    lines = tip_table().splitlines()
    lines[line - 1] = text
    return '\n'.join(lines)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (broken(5, '1,2,3'), r'path\.csv:5: 3 numbers, expected 6'),
        (broken(5, '1,2,three,0,0,1'), r'path\.csv:5: expected numbers'),
        (broken(5, '1,2,inf,0,0,1'), r'path\.csv:5: a number is not finite'),
        (broken(7, '1,2,3,0,0,2'), r'path\.csv:7: i, j, k: expected a unit vector, got length 2'),
        (broken(2, 'x_mm,y_mm,z_mm,i,j,i'), r'path\.csv:2: two columns of one name'),
        (broken(2, 'x_mm,y_mm,z_m,i,j,k'), 'expected x_mm, y_mm, z_mm, i, j, k'),
        (broken(2, 'X_mm,Y_mm,Z_mm,B_deg,A_deg,nz'), 'or X_mm, Y_mm, Z_mm, B_deg, C_deg'),
        (broken(2, 'x_in,y_in,z_in,i,j,k'), 'j, k, or X_mm, Y_mm, Z_mm, B_deg, C_deg, each with'),
        ('\n'.join(tip_table().splitlines()[:6]), '4 points, expected 7 to 20000'),
        ('\n'.join([TIP_HEADER, *['1,2,3,0,0,1'] * 9]), r'path\.csv:2: .*give nx, ny, nz'),
        (TIP_HEADER + '\n', '0 points'),
    ],
)
def test_mistakes_in_a_table(tmp_path, text, message):
    with pytest.raises(UserError, match=message) as caught:
        load_path(saved(tmp_path, 'path.csv', text), MACHINE)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('line', 'text', 'message'),
    [
        (20, 'G2 X1 Y1 I1 J0', 'G2 is an arc'),
        (20, 'G91 X1', 'G91 is incremental'),
        (20, 'G20', 'G20 is inches'),
        (20, 'G43.4 H1', 'G43.4 is TCP mode'),
        (20, 'M428', 'M428: what it does is not known'),
        (20, 'G73 Z1', 'G73: expected straight blocks'),
        (20, 'X1 X2', 'two words X in one block'),
        (20, 'X1 Y', "'Y': expected a letter with a number"),
        (20, 'G1 X1 (OPEN', r"'\(OPEN': expected a letter"),
        (20, 'G1 X1 R5', 'R5: not one of the words'),
        (20, 'G0 G1 X1', 'two of G0 and G1 in one block'),
        (20, 'G1 X1 G1 Y1', 'two of G0 and G1 in one block; give each its own'),
        (20, 'G4 X1 Y2', r'a dwell \(G4\) in one block with a move'),
        (20, 'A10', 'A10: not one of the words'),
        (10, 'X1', 'axes move before any G0 or G1'),
        (10, 'G0 X1 Y1 Z1 B1', 'where C start from is not known'),
    ],
)
def test_mistakes_in_a_program(tmp_path, line, text, message):
    lines = program().splitlines()
    lines[line - 1] = text
    # The message that belongs to this line, or to the first cutting move after it.
    with pytest.raises(UserError, match=rf'path\.ngc:\d+: .*{message}') as caught:
        load_path(saved(tmp_path, 'path.ngc', '\n'.join(lines)), MACHINE)
    number = int(str(caught.value).split('path.ngc:')[1].split(':')[0])
    assert number in (line, 12)
    assert '\n' not in str(caught.value)


def test_a_dwell_by_x_and_what_follows_a_percent_sign_move_nothing(tmp_path):
    plain = load_path(saved(tmp_path, 'a.ngc', program()), MACHINE)
    text = program().replace('F1000\n', 'F1000\nG4 X1\n').replace('M30\n', '%\nX100 Y100\n')
    same = load_path(saved(tmp_path, 'b.ngc', text), MACHINE)
    np.testing.assert_array_equal(same.positions, plain.positions)
    # Every point knows the line that it is on: one for the dwell, 12 is the first block.
    assert plain.where(0) == 'a.ngc:12' and same.where(0) == 'b.ngc:13'
    table = load_path(saved(tmp_path, 'c.csv', tip_table()), MACHINE)
    assert table.where(1) == 'c.csv:4'


def test_choices_that_would_say_nothing_are_refused(tmp_path):
    with pytest.raises(UserError, match='has normals, so --surface says nothing'):
        load_path(saved(tmp_path, 'a.csv', tip_table(True)), MACHINE, RIGHT)
    for path in (write_commands(MADE, tmp_path), saved(tmp_path, 'a.ngc', program())):
        with pytest.raises(UserError, match='gives the positions of the axes: leave --solution'):
            load_path(path, MACHINE, solution='negative')


def test_nothing_to_judge(tmp_path):
    with pytest.raises(UserError, match='no cutting move'):
        load_path(saved(tmp_path, 'a.ngc', 'G0 X1\nM30\nG1 X2'), MACHINE)
    start = 'G0 X0 Y0 Z0 B0 C0\n'
    with pytest.raises(UserError, match='along its own axis only'):
        load_path(saved(tmp_path, 'b.ngc', f'{start}G1 Z-20'), MACHINE)
    long = 'G0 X-200 Y0 Z0 B0 C0\nG1 X200\n' + 60 * 'X-200\nX200\n'
    with pytest.raises(UserError, match='48400 pieces of 1 mm or 1 deg, expected 20000 at most'):
        load_path(saved(tmp_path, 'd.ngc', long), MACHINE)
    with pytest.raises(UserError, match='cannot read the path'):
        load_path(tmp_path / 'absent.csv', MACHINE)
    with pytest.raises(UserError, match='surface'):
        load_path(saved(tmp_path, 'c.csv', tip_table()), MACHINE, 'up')
