"""The backend of the CNC driver on a real LinuxCNC."""

import math
import time
from pathlib import Path

import numpy as np
import pytest
from linuxcnc_cell import Cell, missing, running

from rtest_drivers.cli import main
from rtest_drivers.cnc.check import check
from rtest_drivers.cnc.linuxcnc import LinuxCnc, load_linuxcnc
from rtest_drivers.cnc.linuxcnc_control import Control, make_moves
from rtest_drivers.cnc.sense import Move, judge
from rtest_drivers.config import config_path
from rtest_estimation.dwell import DwellRules, find_dwells
from rtest_estimation.errors import UserError
from rtest_estimation.records import CyclePlan, Feedback, Kind
from rtest_identification.session_file import load_session

pytestmark = [
    pytest.mark.alone, pytest.mark.skipif(bool(missing()), reason=missing()),
]

SESSION = """
machine: {machine}
cycle: {{b_deg: [-10, 0, 10], c_deg: [0, 20, 40], dwell_s: 0.3}}
nest_calibration: {{step_mm: 1.0, dwell_s: 0.3}}
setups:
  a: {{sphere_mm: [0, -60.0, 40.0]}}
moves: {{linear_mm_min: 12000, rotary_deg_min: 4000, approach_mm_min: 3000}}
"""
# Resolution of the NC program and of what linuxcncrsh prints, and the end of the lag.
NEAR = np.array([1.5e-7] * 3 + [2e-7] * 2)


@pytest.fixture(scope='module')
def plan(tmp_path_factory: pytest.TempPathFactory) -> tuple[CyclePlan, Path]:
    """The static cycle of a small session, and the folder with what `rtest plan` wrote of it."""
    folder = tmp_path_factory.mktemp('plan')
    config = folder / 'small.yaml'
    config.write_text(SESSION.format(machine=config_path('nmv1500dcg.yaml')))
    out = folder / 'out'
    assert main(['plan', '--config', str(config), '--controller', 'linuxcnc-m68', '--tcp',
                 '--out', str(out)]) == 0
    return next(p for p in load_session(config).plans if p.kind is Kind.STATIC), out


@pytest.fixture(scope='module')
def cell():
    with running({'X': 0.03, 'B': -0.004}) as cell:
        yield cell


def follow(backend: LinuxCnc, seconds: float) -> list[Feedback]:
    limit = time.monotonic() + seconds
    feedback = []
    while time.monotonic() < limit:
        feedback += backend.read(0.1)
    return feedback


def start(control: Control, cell: Cell, name: str, text: str) -> None:
    """Run a program of a plan past its M0, with which it waits for the sphere to be clear."""
    control.load(cell.program(name, text))
    control.run()
    control.wait(lambda now: now.program == 'PAUSED', 5.0, 'the program did not come to its M0')
    control.resume()


@pytest.mark.parametrize('variant', ['a-static', 'a-static-tcp'])
def test_every_pose_of_a_planned_program_is_seen(
    plan: tuple[CyclePlan, Path], cell: Cell, variant: str
) -> None:
    """In TCP mode LinuxCNC's own kinematics reach the poses: same signs, positions of axes."""
    cycle, folder = plan
    backend, control = cell.watch(), cell.control()
    feedback = []
    try:
        with cell.true_positions() as true:
            start(control, cell, f'{variant}.ngc', (folder / f'{variant}.ngc').read_text())
            limit = time.monotonic() + 120.0
            while control.state().program != 'IDLE':
                assert time.monotonic() < limit
                feedback += follow(backend, 0.2)
            time.sleep(0.5)
            last = backend.read(0.1)[-1].position * 1e3
            seen = np.array(true.latest[1])
        assert control.errors() == []
    finally:
        backend.close()
        control.close()
    stamps = np.array([one.stamp for one in feedback])
    assert (np.diff(stamps) > 0).all()
    assert np.median(np.diff(stamps)) == pytest.approx(5e6, rel=0.02)
    columns = [feedback[0].axes.index(name) for name in cycle.axes]
    positions = np.array([one.position for one in feedback])[:, columns]
    dwells, lost = find_dwells(cycle, stamps, positions, DwellRules())
    assert lost == []
    for dwell in dwells:
        off = np.abs(dwell.feedback - cycle.commands[dwell.index])
        # linear_positions and the order of letters: X Y Z, then B C.
        assert (off < NEAR).all(), (dwell.index, off)
    # Not of each: a busy host may lose some of one.
    assert np.median([dwell.end - dwell.start for dwell in dwells]) * 1e-9 > 0.2
    # The machine stands elsewhere than the controller believes, by what was injected;
    # halsampler prints five digits.
    last[3:] *= 0.18 / math.pi
    assert seen - last == pytest.approx([0.03, 0.0, 0.0, -0.004, 0.0], abs=1.1e-5)


def test_emergency_stop_in_a_cycle_is_told_while_feedback_goes_on(
    plan: tuple[CyclePlan, Path], cell: Cell
) -> None:
    backend, control = cell.watch(), cell.control()
    text = (plan[1] / 'a-static.ngc').read_text()
    try:
        start(control, cell, 'stopped.ngc', text)
        follow(backend, 2.0)
        assert backend.problem() == ''
        control.estop()
        stopped = time.monotonic()
        while 'E-stop is on' not in backend.problem():
            assert time.monotonic() - stopped < 1.0
            assert backend.read(0.1)
        with pytest.raises(UserError, match='E-stop is on or the machine is off'):
            control.run()
        control.machine_on()
        follow(backend, 0.5)
        assert backend.problem() == ''
        start(control, cell, 'stopped.ngc', text)
        follow(backend, 1.0)
        assert control.state().program == 'RUNNING'
        control.pause()
        control.wait(lambda now: now.program == 'PAUSED', 1.0, 'the program did not pause')
        control.resume()
        control.wait(lambda now: now.program == 'RUNNING', 1.0, 'the program did not go on')
        control.abort()
        control.wait(lambda now: now.program == 'IDLE', 5.0, 'the program did not stop')
    finally:
        backend.close()
        control.close()


def test_an_error_put_in_later_is_not_seen_by_the_controller(cell: Cell) -> None:
    backend = cell.watch()
    time.sleep(0.5)  # The machine comes to rest.
    before, was = backend.read(0.1)[-1].position, cell.true_position()
    cell.set_error('C', 0.02)
    time.sleep(0.3)
    moved = np.array(cell.true_position()) - was
    assert moved == pytest.approx([0.0, 0.0, 0.0, 0.0, 0.02], abs=1e-6)
    assert backend.read(0.1)[-1].position == pytest.approx(before, abs=1e-8)
    cell.set_error('C', 0.0)
    backend.close()


def test_check_of_a_standing_machine(cell: Cell) -> None:
    time.sleep(0.5)
    found = check(LinuxCnc(str(cell.folder / 'watch.yaml')), 1.0)
    assert found.answers and found.frozen and found.problem == ''
    assert found.rate == pytest.approx(200.0, rel=0.05)
    assert found.uncertainty < 0.01
    assert set(found.position) == set('XYZBC')


def test_errors_come_after_the_acknowledgement(cell: Cell) -> None:
    control = cell.control()
    try:
        control.errors()
        control.load(cell.folder / 'nowhere.ngc')
        time.sleep(0.5)
        assert 'nowhere.ngc' in ' '.join(control.errors())
    finally:
        control.close()


def test_moves_by_mdi_find_wrong_sign_unit_and_name(cell: Cell) -> None:
    wrong = cell.folder / 'wrong.yaml'
    text = (cell.folder / 'watch.yaml').read_text()
    for right, other in (
        ('X: {index: 0, unit: mm}', 'X: {index: 1, unit: mm}'),
        ('Y: {index: 1, unit: mm}', 'Y: {index: 0, unit: mm}'),
        ('Z: {index: 2, unit: mm}', 'Z: {index: 2, unit: mm, sign: -1}'),
    ):
        assert right in text
        text = text.replace(right, other)
    wrong.write_text(text)
    moves = [Move('X', 1e-3), Move('Y', 1e-3), Move('Z', 1e-3), Move('B', math.radians(1.0)),
             Move('C', math.radians(-1.0))]
    backend, control = LinuxCnc(str(wrong)), cell.control()
    backend.open()
    try:
        before = backend.read(0.1)[-1].position
        recorded = make_moves(control, backend, moves)
        findings = judge(load_linuxcnc(str(wrong)).axes, moves, recorded)
        after = follow(backend, 0.3)[-1].position
    finally:
        backend.close()
        control.close()
    assert [one.kind for one in findings] == ['name', 'name', 'sign', 'right', 'right']
    assert findings[0].moved == ('Y',) and findings[2].ratio == pytest.approx(-1.0, abs=1e-4)
    assert after == pytest.approx(before, abs=1e-7)


def codes(cell: Cell) -> set[str]:
    control = cell.control()
    try:
        told = control._line.get('program_codes').split()
    finally:
        control.close()
    known = ('G0', 'G1', 'G20', 'G21', 'G90', 'G91')
    return {one for one in told if one[0] == 'F' or one in known}


@pytest.mark.parametrize('before', ['G20 G91 G1 F10', 'G21 G90 G0 F250'])
def test_moves_leave_the_modes_as_they_were(
    cell: Cell, before: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend, control = cell.watch(), cell.control()
    try:
        units, rest = before.split(' ', 1)
        control.mdi(units)
        control.mdi(rest)
        control.wait(lambda now: codes(cell) == set(before.split()), 2.0, 'no modes')
        start = backend.read(0.1)[-1].position
        make_moves(control, backend, [Move('X', 1e-3)])
        assert codes(cell) == set(before.split())
        assert follow(backend, 0.3)[-1].position == pytest.approx(start, abs=1e-7)

        def interrupt(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr('rtest_drivers.cnc.linuxcnc_control._moved', interrupt)
        control.mdi('G91' if 'G90' in before else 'G90')
        changed = codes(cell)
        with pytest.raises(KeyboardInterrupt):
            make_moves(control, backend, [Move('X', 1e-3)])
        assert codes(cell) == changed
    finally:
        control.mdi('G21')
        control.mdi('G90 G94')
        control.close()
        backend.close()


def test_moves_wait_for_no_program(cell: Cell) -> None:
    program = cell.program('m0.ngc', 'G21 G90\nM0\nM2\n')
    backend, control = cell.watch(), cell.control()
    try:
        control.load(program)
        control.run()
        control.wait(lambda now: now.program == 'PAUSED', 5.0, 'no stop')
        with pytest.raises(UserError, match='a program is paused; end it first'):
            make_moves(control, backend, [Move('X', 1e-3)])
    finally:
        control.abort()
        control.close()
        backend.close()


def test_check_of_a_session_file_moves_every_axis(
    cell: Cell, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    text = cell.device.read_text()
    wrong = tmp_path / 'wrong.yaml'
    wrong.write_text(text.replace('{index: 4, unit: deg}', '{index: 4, unit: deg, sign: -1}'))
    config = tmp_path / 'session.yaml'
    for device, status in ((cell.device, 0), (wrong, 1)):
        config.write_text(
            SESSION.format(machine=config_path('nmv1500dcg.yaml'))
            + f'devices: {{cnc: {{backend: linuxcnc, file: {device}}}}}\n'
        )
        assert main(['session', '--config', str(config), '--check', '--moves']) == status
        said = capsys.readouterr()
        assert 'X +1 mm: as it should' in said.out and 'B +1 deg: as it should' in said.out
    assert 'C +1 deg: axes: C: sign: 1 instead of -1' in said.err


def test_units_are_held_to_what_linuxcnc_says(cell: Cell) -> None:
    wrong = cell.folder / 'unit.yaml'
    text = (cell.folder / 'watch.yaml').read_text()
    wrong.write_text(text.replace('index: 3, unit: deg', 'index: 3, unit: rad'))
    with pytest.raises(ConnectionError, match='B: unit: LinuxCNC says deg, the device file rad'):
        LinuxCnc(str(wrong)).open()


def test_wrong_passwords(cell: Cell) -> None:
    text = cell.device.read_text()
    for key, word in (('password: open', 'set password'), ('sesame', 'set enable_password')):
        wrong = cell.folder / 'password.yaml'
        wrong.write_text(text.replace(key, key[:-1]))
        with pytest.raises(ConnectionError, match=word):
            LinuxCnc(str(wrong)).open()


def test_dead_task_process_is_noticed_and_then_the_end_of_the_server(cell: Cell) -> None:
    """The last test of this LinuxCNC: it is broken on purpose."""
    watching, looking = LinuxCnc(str(cell.device)), cell.watch()
    watching.open()
    assert follow(watching, 1.0)
    assert watching.told()['watchdog'] == 'on'
    cell.kill_task()
    died, feedback = time.time_ns(), []
    with pytest.raises(ConnectionError, match='task process does not answer'):
        while time.time_ns() - died < 2e9:
            feedback += watching.read(0.1)
    assert time.time_ns() - died < 1e9
    # Nothing that was read after its death is handed on.
    assert all(one.stamp < died for one in feedback)
    with pytest.raises(ConnectionError, match='task process does not answer'):
        watching.open()
    assert follow(looking, 0.2)  # Frozen values, for who only looks on.
    cell.end_server()
    with pytest.raises(ConnectionError, match='lost linuxcncrsh at 127'):
        follow(looking, 10.0)
    with pytest.raises(ConnectionError, match='start LinuxCNC'):
        looking.open()
