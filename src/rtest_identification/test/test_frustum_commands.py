"""Commands of the axes: hand-derived cases, both regimes, any chain, against plain matrices."""

import numpy as np
import pytest
from independent import NMV, chain_centre
from scipy.spatial.transform import Rotation

from rtest_estimation.errors import UserError
from rtest_identification.frustum.commands import (
    NEGATIVE,
    POSITIVE,
    command,
    out_of_range,
    tool_axis,
)
from rtest_identification.frustum.cone import Frustum
from rtest_identification.frustum.feature import Feature
from rtest_identification.frustum.thesis import CASES, frustum
from rtest_identification.kinematics import predict
from rtest_identification.machine import parse_machine

MACHINE = parse_machine(NMV)
TOOL = (0.01, -0.02, -0.15)
CHAINS = {
    'both in the table': '[C, B, bed, Y, X, Z]',
    'one in the head': '[C, bed, Y, X, Z, B]',
    'two in the head': '[bed, Y, X, Z, C, B]',
    'other names': '[B, A, bed, Y, X, Z]',
}
# A table that turns by C on an axis that lies 45 deg between Y and Z (nutating).
NUTATING = NMV.replace(
    'B: {type: rotary, direction: [0, 1, 0]',
    'B: {type: rotary, direction: [0, 0.7071067811865476, 0.7071067811865476]',
)


def chain_machine(name, sense):
    text = NMV.replace('[C, B, bed, Y, X, Z]', CHAINS[name]).replace('sense: 1', f'sense: {sense}')
    if name == 'other names':
        # A tilts about X, and B turns about Z at A = 0 under another letter.
        text = text.replace('  B: {type: rotary, direction: [0, 1, 0]',
                            '  A: {type: rotary, direction: [1, 0, 0]')
        text = text.replace('  C: {type', '  B: {type')
    if 'head' in name:
        text += f'tool_mm: [{", ".join(str(1e3 * t) for t in TOOL)}]\n'
    return parse_machine(text)


def one_point(axis, count=3):
    axis = np.tile(np.asarray(axis, dtype=float), (count, 1))
    tip = np.array([[0.05, 0.0, 0.1]] * count)
    return Feature('point', tip, axis, axis)


def degrees(made, name):
    return np.degrees(made.axis(name))


@pytest.mark.parametrize(
    ('axis', 'solution', 'b', 'c', 'x', 'y', 'z'),
    [
        # Ry(-90) turns the table's X up to the spindle: the tip (50, 0, 100) goes to
        # Ry(-90) (50, 0, 100) = (-100, 0, 50).
        ((1, 0, 0), NEGATIVE, -90, 0, -100, 0, 50),
        # The same with B = +90 and C = 180: Rz(180) (50, 0, 100) = (-50, 0, 100), then
        # Ry(90) (-50, 0, 100) = (100, 0, 50).
        ((1, 0, 0), POSITIVE, 90, 180, 100, 0, 50),
        # The table's Y up: C = -90 brings Y to X: Rz(-90) (50, 0, 100) = (0, -50, 100), then
        # Ry(-90) of it = (-100, -50, 0).
        ((0, 1, 0), NEGATIVE, -90, -90, -100, -50, 0),
        # Nothing turns, C is free and stays at zero.
        ((0, 0, 1), NEGATIVE, 0, 0, 50, 0, 100),
    ],
)
def test_by_hand(axis, solution, b, c, x, y, z):
    made = command(MACHINE, one_point(axis), solution)
    assert degrees(made, 'B')[0] == pytest.approx(b, abs=1e-9)
    assert np.cos(made.axis('C')[0] - np.radians(c)) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(1e3 * made.positions[0, :3], [x, y, z], atol=1e-9)


def test_sense_turns_the_commands_round():
    other = parse_machine(NMV.replace('sense: 1', 'sense: -1'))
    made = command(other, one_point((1, 0, 0)), POSITIVE)
    assert degrees(made, 'B')[0] == pytest.approx(90.0)
    np.testing.assert_allclose(1e3 * made.positions[0, :3], [-100, 0, 50], atol=1e-9)


def test_tilt_less_than_the_apex_c_turns_fully():
    # Fig. 6-2 (a): B between -15 and -45 deg, C a whole turn.
    made = command(MACHINE, CASES['a'].feature())
    b, c = degrees(made, 'B'), degrees(made, 'C')
    assert (b.min(), b.max()) == pytest.approx((-45.0, -15.0))
    assert np.all(np.diff(c) < 0) and np.abs(np.diff(c)).max() < 4.0
    # After the last point one more step closes the turn.
    assert np.ptp(c) == pytest.approx(360.0, abs=1.0)
    assert made.approach[:, 4].tolist() == [-1] * 360


def test_tilt_more_than_the_apex_c_swings():
    # Fig. 6-2 (b): B over 2 psi; C between the tangents to the circle, sin C = sin psi / sin phi.
    made = command(MACHINE, CASES['b'].feature(3600))
    b, c = degrees(made, 'B'), degrees(made, 'C')
    assert (b.min(), b.max()) == pytest.approx((-105.0, -45.0))
    swing = np.degrees(np.arcsin(np.sin(np.radians(30)) / np.sin(np.radians(75))))
    assert c.min() == pytest.approx(-180 - swing, abs=1e-4)
    assert c.max() == pytest.approx(-180 + swing, abs=1e-4)
    other = command(MACHINE, CASES['b'].feature(), POSITIVE)
    assert degrees(other, 'B').min() == pytest.approx(45.0)
    assert np.abs(degrees(other, 'C')).max() == pytest.approx(swing, abs=1e-2)


def test_through_the_singularity_the_axes_go_on():
    # phi = psi: the tool passes through the vertical, B through zero; C need not jump.
    made = command(MACHINE, frustum(30.0, (-60.0, 0.0, 120.0)).feature())
    steps = np.abs(np.diff(made.positions[:, 3:], axis=0))
    assert np.degrees(steps.max()) < 2.0
    assert degrees(made, 'B')[0] == pytest.approx(-60.0)
    assert degrees(made, 'B')[-1] > 59.0
    upright = command(MACHINE, frustum(0.0, (0.0, 0.0, 120.0), 0.0).feature())
    assert not upright.positions[:, 3:].any()


def test_near_a_pole_the_note_says_how_fast_the_axis_turns():
    # B passes zero at 0.1 deg; C makes half a turn there, over about twice that on the path.
    made = command(MACHINE, frustum(29.9, (-60.0, 0.0, 120.0)).feature(7200))
    (note,) = (text for text in made.notes if 'pole' in text)
    assert note.startswith('at point 3601 the tool comes within 0.1 deg of a pole (along C)')
    # The tool's axis goes round a cone of 30 deg while the tip goes round a circle of 64.95 mm:
    # 0.441 deg a mm, at 0.1 deg from the pole a turn of 0.441 / sin 0.1 deg.
    rate = np.degrees(np.sin(np.radians(30.0)) / 64.95 / np.sin(np.radians(0.1)))
    assert float(note.split('up to ')[1].split(' deg')[0]) == pytest.approx(rate, rel=0.03)
    assert not any('pole' in text for text in command(MACHINE, CASES['a'].feature()).notes)


@pytest.mark.parametrize('sense', [1, -1])
@pytest.mark.parametrize('name', CHAINS)
def test_any_chain_points_the_tool_and_holds_the_tip(name, sense):
    machine = chain_machine(name, sense)
    feature = frustum(40.0, (-30.0, 20.0, 60.0), 25.0, 80.0).feature(60)
    for solution in (NEGATIVE, POSITIVE):
        made = command(machine, feature, solution)
        tips = predict(machine, made.positions).centre
        np.testing.assert_allclose(tips, feature.tip, atol=1e-12)
        np.testing.assert_allclose(tool_axis(machine, made.positions), feature.axis, atol=1e-12)
        if name == 'other names':
            continue
        for row in (0, 17, 41):
            named = {
                axis: q * (sense if axis in 'BC' else 1)
                for axis, q in zip(machine.letters, made.positions[row], strict=True)
            }
            tool = np.array(machine.tool)
            tip = chain_centre(machine.chain, named, {}, tool)
            up = chain_centre(machine.chain, named, {}, tool + [0, 0, 1.0]) - tip
            np.testing.assert_allclose(tip, feature.tip[row], atol=1e-12)
            np.testing.assert_allclose(up, feature.axis[row], atol=1e-12)
    last = [n for n in machine.chain if n in machine.rotary][-1]
    first = [command(machine, feature, s).axis(last)[0] for s in (NEGATIVE, POSITIVE)]
    assert first[0] < 0 < first[1]


def test_a_nutating_table_reaches_what_it_can():
    machine = parse_machine(NUTATING)
    tilted = one_point(Rotation.from_euler('x', -70, degrees=True).apply([0, 0, 1]))
    made = command(machine, tilted)
    b, c = made.axis('B')[0], made.axis('C')[0]
    tilt = Rotation.from_rotvec(b * np.array([0, 1, 1]) / np.sqrt(2))
    table = tilt * Rotation.from_euler('z', c)
    np.testing.assert_allclose(table.apply(tilted.axis[0]), [0, 0, 1], atol=1e-12)
    # Its spindle can come 90 deg down at most.
    with pytest.raises(UserError, match=r'point: point 1: C and B cannot point the tool along'):
        command(machine, one_point(Rotation.from_euler('x', 100, degrees=True).apply([0, 0, 1])))


def test_axes_out_of_range_are_told():
    made = command(MACHINE, CASES['a'].feature())
    assert made.notes == (
        'Y goes from -120.6 to 120.6 mm, its range is -105 to 105: the machine cannot run this '
        'path as it is placed',
    )
    # B from -40 deg: the other solution is taken, and C starts where its range allows.
    narrow = parse_machine(
        NMV.replace('[-180, 160]', '[-40, 160]').replace('[-360, 360]', '[0, 720]')
    )
    made = command(narrow, CASES['a'].feature())
    assert made.axis('B').min() > 0
    assert made.axis('C').min() >= -1e-9
    # Where errors were measured counts as well.
    inside = command(MACHINE, CASES['a'].feature(), inside=lambda p: p[:, 3] > 0)
    assert inside.axis('B').min() > 0


def test_a_little_out_of_range_is_seen():
    rows = np.zeros((2, 5))
    rows[1, 1] = 0.1050117
    note = out_of_range(MACHINE, rows)['Y']
    assert note.startswith('Y goes from 0.0000 to 105.0117 mm, its range is -105 to 105')


def test_mistakes_are_told():
    with pytest.raises(UserError, match='solution'):
        command(MACHINE, CASES['a'].feature(), 'up')
    three = NMV.replace('[C, B, bed, Y, X, Z]', '[bed, Y, X, Z]')
    three = parse_machine(three[: three.index('  B:')])
    with pytest.raises(UserError, match='two rotary axes, it has 0'):
        command(three, CASES['a'].feature())
    for values, match in (
        ({'half_apex': np.pi / 2}, 'psi'), ({'tilt': 4.0}, 'phi'), ({'diameter': 0.0}, 'diameter'),
    ):
        with pytest.raises(UserError, match=match):
            Frustum(**{'tilt': 0.1, 'half_apex': 0.5, 'diameter': 0.1, 'centre': (0, 0, 0),
                       **values})
