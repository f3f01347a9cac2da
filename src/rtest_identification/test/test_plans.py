"""Cycles: the thesis's static one, the diagnostic one, and the session file that asks for them."""

import numpy as np
import pytest
from independent import NMV, B, C

from rtest_estimation.errors import UserError
from rtest_estimation.records import Kind
from rtest_identification.error_map import STATION, stations
from rtest_identification.kinematics import predict
from rtest_identification.machine import parse_machine
from rtest_identification.moves import synchronous_path
from rtest_identification.plans import OVERRUN, UNEVEN_DEG, diagnostic, program_name, static
from rtest_identification.session_file import load_session

MACHINE = parse_machine(NMV)
SPHERE = np.array([0.0, -0.09, 0.0406])
UNEVEN = np.radians(UNEVEN_DEG)
SESSION = """
machine: machine.yaml
cycle: {b_deg: [-75, 0, 75], c_deg: [0, 90, 180, 270], dwell_s: 0.3}
setups:
  1a: {sphere_mm: [0, -90, 40.6]}
"""


def session(tmp_path, text=SESSION, machine=NMV):
    (tmp_path / 'machine.yaml').write_text(machine)
    (tmp_path / 'session.yaml').write_text(text)
    return tmp_path / 'session.yaml'


def test_the_static_cycle_is_the_thesiss():
    plan = static(MACHINE, '1a', SPHERE, B, C)
    assert len(plan.commands) == 86 and plan.cycle == '1a-static'
    np.testing.assert_allclose(plan.commands[[0, -1], 3:], 0.0)
    assert {tuple(row) for row in plan.commands[1:-1, 3:]} == {(b, c) for b in B for c in C}
    centre = predict(MACHINE, plan.commands).centre
    np.testing.assert_allclose(centre, np.tile(SPHERE, (86, 1)), atol=1e-12)


def test_the_diagnostic_cycle_returns_to_the_first_pose_in_the_middle_and_at_the_end():
    plan = diagnostic(MACHINE, '1a', SPHERE, B, UNEVEN)
    at_first = np.flatnonzero((plan.commands == plan.commands[0]).all(axis=1))
    # 7 x 12 poses and one overrun in each pass. B = C = 0 is also one of each pass's stations.
    assert len(plan.commands) == 2 * (84 + 1) + 3
    assert {0, 86, 172} <= set(at_first.tolist())
    centre = predict(MACHINE, plan.commands).centre
    np.testing.assert_allclose(centre, np.tile(SPHERE, (173, 1)), atol=1e-12)


def test_every_level_is_approached_from_both_sides_and_every_station_of_c_nearly():
    plan = diagnostic(MACHINE, '1a', SPHERE, B, UNEVEN)
    signs = synchronous_path(MACHINE, plan).signs()
    for level in B:
        here = np.abs(plan.commands[:, 3] - level) < 1e-9
        for station in UNEVEN:
            pose = here & (np.abs(plan.commands[:, 4] - station) < 1e-9)
            assert {-1.0, 1.0} <= set(signs[pose, 3]), (level, station)
            if station not in (UNEVEN[0], UNEVEN[-1]):
                assert {-1.0, 1.0} <= set(signs[pose, 4]), (level, station)


def test_an_overrun_is_a_pose_of_its_own_but_no_station_of_its_own():
    plan = diagnostic(MACHINE, '1a', SPHERE, B, UNEVEN)
    assert 7e-4 < OVERRUN < STATION  # twice what a pose may be off its command
    np.testing.assert_allclose(stations(plan.commands[:, 3])[0], B, atol=1e-4)


def harmonic(stations_of, order, beside=1):
    """Orthonormal basis of cos and sin of a harmonic, beside a constant and the lower ones."""
    wave = np.column_stack([np.cos(order * stations_of), np.sin(order * stations_of)])
    if order > beside:
        low = [np.ones(len(stations_of))]
        low += [f(n * stations_of) for n in range(1, beside + 1) for f in (np.cos, np.sin)]
        base = np.linalg.qr(np.column_stack(low))[0]
        wave -= base @ (base.T @ wave)
    u, s, _ = np.linalg.svd(wave, full_matrices=False)
    return u[:, s > 1e-9]


@pytest.mark.parametrize('order', range(1, 6))
def test_even_stations_show_harmonic_n_and_12_minus_n_alike_uneven_ones_do_not(order):
    def cosine(angles):
        pair = harmonic(angles, order, 0).T @ harmonic(angles, 12 - order, 0)
        return np.linalg.svd(pair, compute_uv=False).min()

    assert cosine(C) > 1 - 1e-9
    assert cosine(UNEVEN) < 0.85


def test_uneven_stations_tell_the_harmonics_apart_and_keep_the_low_ones_well_determined():
    orders = np.arange(1, 23)
    gram = np.abs(np.exp(1j * np.outer(orders, UNEVEN)).mean(axis=1))
    assert gram.max() < 0.33  # 1 at 12 for even stations
    worst = max(
        np.linalg.svd(harmonic(UNEVEN, n).T @ harmonic(UNEVEN, m), compute_uv=False).max()
        for n in range(1, 12) for m in range(n + 1, 12)
    )
    assert worst < 0.85
    columns = [f(n * UNEVEN) for n in range(1, 6) for f in (np.cos, np.sin)]
    assert np.linalg.cond(np.column_stack([np.ones(12), *columns])) < 3.5
    gaps = np.diff(np.append(UNEVEN_DEG, 360))
    assert gaps.min() >= 10 and gaps.max() <= 50


def test_a_session_file_without_a_kind_means_the_static_cycle(tmp_path):
    config = load_session(session(tmp_path))
    assert config.kind == 'static'
    assert [plan.cycle for plan in config.plans] == ['1a-nest', '1a-static']
    np.testing.assert_allclose(np.degrees(config.stations[1]), [0, 90, 180, 270])


def test_a_diagnostic_cycle_takes_uneven_stations_unless_the_file_gives_its_own(tmp_path):
    own = SESSION.replace('cycle: {', 'cycle: {kind: diagnostic, ')
    bare = own.replace(' c_deg: [0, 90, 180, 270],', '')
    assert len(load_session(session(tmp_path, own)).stations[1]) == 4
    np.testing.assert_allclose(np.degrees(load_session(session(tmp_path, bare)).stations[1]),
                               UNEVEN_DEG)
    # The stations of a static cycle are not taken over where another kind is wanted.
    changed = load_session(session(tmp_path), 'diagnostic')
    np.testing.assert_allclose(np.degrees(changed.stations[1]), UNEVEN_DEG)
    assert changed.plans[-1].cycle == '1a-diagnostic'


THERMAL = SESSION.replace('cycle: {', 'cycle: {kind: thermal, every_min: 0.7, hours: 0.035, ')


def test_a_thermal_session_repeats_one_static_cycle(tmp_path):
    config = load_session(session(tmp_path, THERMAL))
    # 2.1 min hold three intervals of 0.7 min, which binary fractions do not know.
    names = [f'1a-thermal-{number:02d}' for number in range(1, 5)]
    assert [plan.cycle for plan in config.plans] == ['1a-nest', *names]
    assert (config.every, config.repetitions) == (pytest.approx(42.0), 4)
    assert [plan.cycle for plan in config.distinct] == ['1a-nest', '1a-thermal-01']
    once = load_session(session(tmp_path)).plans[-1]
    for plan in config.plans[1:]:
        assert plan.kind is once.kind
        np.testing.assert_array_equal(plan.commands, once.commands)
    assert [program_name(name) for name in (*names, '1a-static', '1a-thermal')] == [
        *['1a-thermal'] * 4, '1a-static', '1a-thermal',
    ]


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        (' hours: 0.035,', '', 'cycle: hours: missing'),
        ('every_min: 0.7', 'every_min: 0', 'cycle: every_min: expected 0.1 to 1440'),
        ('every_min: 0.7', 'every_min: 3', '0.035 h with a cycle every 3 min are 1 cycles'),
        ('hours: 0.035', 'hours: 300', 'are 25715 cycles; expected 2 to 2000'),
        ('kind: thermal', 'kind: static', 'every_min: expected with kind: thermal only'),
        ('setups:', 'setups:\n  2a: {sphere_mm: [0, -60, 40]}', 'setups: expected one, which'),
    ],
)
def test_mistakes_in_a_thermal_session_are_told_in_one_line(tmp_path, old, new, words):
    assert old in THERMAL
    with pytest.raises(UserError) as caught:
        load_session(session(tmp_path, THERMAL.replace(old, new, 1)))
    assert words in str(caught.value) and '\n' not in str(caught.value)


def test_speeds_approach_table_and_spindle_are_read(tmp_path):
    config = load_session(session(tmp_path, SESSION + """
moves: {linear_mm_min: 1200, rotary_deg_min: 300, clearance_mm: 30, approach_mm_min: 60,
        direction: [0, -1, 0]}
table: {radius_mm: 150, surface_mm: -20, nest_radius_mm: 60, nest_height_mm: 55, swing_mm: 250}
spindle: {radius_mm: 45, distance_mm: 160}
"""))
    assert config.speeds.linear == pytest.approx(0.02)
    assert np.degrees(config.speeds.rotary) == pytest.approx(5.0)
    assert config.approach.clearance == pytest.approx(0.03)
    assert config.approach.speed == pytest.approx(0.001)
    assert config.approach.direction == (0.0, -1.0, 0.0)
    assert config.table.surface == pytest.approx(-0.02) and config.table.swing == 0.25
    assert config.spindle.radius == pytest.approx(0.045)


TURNING = 'dynamic: {axis: C, speeds_deg_min: [358, 3583], turns: [1, 2]}\n'


def test_dynamic_cycles_follow_the_static_one_or_stand_alone(tmp_path):
    both = load_session(session(tmp_path, SESSION + TURNING))
    assert [p.cycle for p in both.plans] == [
        '1a-nest', '1a-static', '1a-dynamic-358', '1a-dynamic-3583']
    without = '\n'.join(line for line in SESSION.splitlines() if not line.startswith('cycle'))
    alone = load_session(session(tmp_path, without + '\n' + TURNING))
    assert (alone.kind, alone.stations) == ('dynamic', ())
    slow, fast = alone.plans[1:]
    assert slow.kind is Kind.DYNAMIC and slow.dwell == 0.0
    assert np.degrees(slow.feed) * 60.0 == pytest.approx(358.0)
    # To and fro, with two turns around zero where the axis has one to each side.
    np.testing.assert_allclose(np.degrees(slow.commands[:, 4]), [0, 360, 0], atol=1e-9)
    np.testing.assert_allclose(np.degrees(fast.commands[:, 4]), [-360, 360, -360], atol=1e-9)
    with pytest.raises(UserError, match='cycle: missing'):
        load_session(session(tmp_path, without + '\n' + TURNING), 'static')
    with pytest.raises(UserError, match='expected cycle, dynamic or both'):
        load_session(session(tmp_path, without))


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('cycle: {', 'cycle: {kind: dynamic, ', 'kind: expected static or diagnostic'),
        ('cycle:', 'dynamic: {axis: X}\ncycle:', 'axis: expected a rotary axis of the table'),
        ('cycle:', 'dynamic: {axis: C}\ncycle:', 'dynamic: speeds_deg_min: missing'),
        ('cycle:', 'dynamic: {axis: C, speeds_deg_min: [9, 9], turns: [1, 1]}\ncycle:',
         'expected different positive numbers'),
        ('cycle:', 'dynamic: {axis: C, speeds_deg_min: [9, 90], turns: [1]}\ncycle:',
         'turns: expected 0.25 to 100 for each of the 2 speeds'),
        ('cycle:', 'dynamic: {axis: C, speeds_deg_min: [9], turns: [3]}\ncycle:',
         'C = -540.000 deg is outside'),
        ('{b_deg: [-75, 0, 75],', '{', 'b_deg: missing'),
        ('{b_deg: [-75, 0, 75],', '{kind: diagnostic,', 'b_deg: missing'),
        ('b_deg', 'a_deg', "unknown key 'a_deg'"),
        ('setups:', 'table: {radius_mm: 100}\nsetups:', 'table: surface_mm: missing'),
        ('setups:', 'spindle: {radius_mm: 50}\nsetups:', 'spindle: distance_mm: missing'),
        ('setups:', 'moves: {direction: [0, 0, 2]}\nsetups:', 'direction: expected a unit'),
        ('setups:', 'moves: {linear_mm_min: -1}\nsetups:', 'linear_mm_min: expected a positive'),
        ('[-75, 0, 75]', '[-75, 0, 165]', 'cycle: b_deg: 165 is outside the range of B'),
        ('[-75, 0, 75]', '[-75, 75]', 'cycle: b_deg: expected 3 stations or more, got 2'),
        ('[-75, 0, 75]', '[-75, 0, 75, 0]', 'cycle: b_deg: 0 and 0 are one and the same'),
        ('0.3', '.inf', 'cycle: dwell_s: expected 0.1 to 60, got inf'),
        ('0.3', '0.09', 'cycle: dwell_s: expected 0.1 to 60, got 0.09'),
        ('0.3', '1.0e+12', 'cycle: dwell_s: expected 0.1 to 60'),
        ('cycle:', 'sphere_radius_mm: .inf\ncycle:', 'sphere_radius_mm: expected 1 to 100'),
        ('cycle:', 'spindle_runout: {stations: 24.5}\ncycle:', 'stations: expected a whole'),
        ('cycle:', 'spindle_runout: {stations: .inf}\ncycle:', 'stations: expected a whole'),
        ('cycle:', 'spindle_runout: {stations: 5}\ncycle:', 'whole number from 6 to 360, got 5'),
        ('cycle:', 'nest_calibration: {step_mm: 10}\ncycle:', 'step_mm: expected 0.05 to 5'),
        ('cycle:', 'nest_calibration: {dwell_s: 0.01}\ncycle:', 'nest_calibration: dwell_s: exp'),
        ('  1a:', '  null:', 'setups: None: expected a name'),
        ('  1a:', '  "":', "setups: '': expected a name"),
        ('  1a:', '  a/b ü:', "setups: 'a/b ü': expected a name"),
        ('  1a:', '  "1": {sphere_mm: [0, 0, 40]}\n  1:', 'setups: 1: given twice'),
        ('-90, 40.6', '-90, 999', 'session.yaml: setups: 1a: 1a-nest: pose 0: Z = 999.000 mm'),
    ],
)
def test_mistakes_in_a_session_file_are_told_in_one_line(tmp_path, old, new, words):
    with pytest.raises(UserError) as caught:
        load_session(session(tmp_path, SESSION.replace(old, new, 1)))
    assert words in str(caught.value) and '\n' not in str(caught.value)
