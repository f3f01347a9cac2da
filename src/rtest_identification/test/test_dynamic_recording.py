"""From the records of a session to dynamic.json and its report."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dynamic_machine import FAST, SLOW, SPHERE, Hidden, measurement
from independent import LETTERS, NMV

from rtest_estimation.columns import FeedbackColumns
from rtest_estimation.errors import UserError
from rtest_estimation.recording import Recording
from rtest_estimation.records import (
    CyclePlan,
    GaugeBlock,
    Kind,
    NestCalibration,
    NestKind,
)
from rtest_identification.dynamic import output
from rtest_identification.dynamic.offline import centres, dynamic_session
from rtest_identification.dynamic.report import write_report
from rtest_identification.machine import parse_machine
from rtest_identification.offline import estimate_recording

MACHINE = parse_machine(NMV)
T0 = 1_700_000_000_000_000_000
# Three probes at 45 degrees, 120 degrees apart.
V = np.array([[np.cos(a), np.sin(a), 1.0] for a in np.radians([90.0, 210.0, 330.0])]) / 2**0.5
BATCH = 20


def nest_calibration(stamp):
    """Records of the 28 positions of section 2.2.2 and of what the gauges read there."""
    start = np.array([*SPHERE, 0.0, 0.0])
    rows = []
    for _ in range(3):
        for axis in range(3):
            step = 1e-3 * np.eye(5)[axis]
            rows += [start, start + step, start - step]
    rows = np.array([*rows, start])
    plan = CyclePlan(
        stamp, 's', '1a-nest', Kind.NEST_CALIBRATION, '1a', SPHERE, LETTERS, rows, 0.3
    )
    each, move = 40, 20
    path = np.concatenate([
        np.concatenate([
            np.linspace(rows[max(k - 1, 0)], row, move, endpoint=False), np.tile(row, (each, 1))
        ])
        for k, row in enumerate(rows)
    ])
    path = np.concatenate([path, np.tile(rows[-1], (60, 1))])
    times = np.arange(len(path)) * 0.01
    return plan, times, path, (path[:, :3] - SPHERE)


class Held(list):
    """Columns in memory in place of a topic of a file."""

    def pieces(self):
        """As `columns.Stream` gives them."""
        return iter(self)


def session(hidden, feeds):
    rng = np.random.default_rng(3)
    plan, times, path, displacement = nest_calibration(T0)
    plans = [plan]
    feedback = [(T0 + round(t * 1e9), row) for t, row in zip(times, path, strict=True)]
    noise = 5e-8 * rng.normal(size=(len(times), 3))
    gauges = [(T0, 0.01, displacement @ V.T + 2e-5 + noise)]
    stamp = T0 + round((times[-1] + 2.0) * 1e9)
    for number, one in enumerate(measurement(hidden, feeds)):
        begin = one['feedback_time'][0]
        ends = one['feedback'][[0, len(one['feedback']) // 2, -1]]
        plans.append(CyclePlan(
            stamp, 's', f'1a-dynamic-{number}', Kind.DYNAMIC, '1a', SPHERE, LETTERS, ends, 0.0,
            feeds[number][0],
        ))
        feedback += [
            (stamp + round((t - begin) * 1e9), row)
            for t, row in zip(one['feedback_time'], one['feedback'], strict=True)
        ]
        first = stamp + round((one['time'][0] - begin) * 1e9)
        gauges.append((first, 0.001, one['centre'] @ V.T + 2e-5))
        stamp += round((one['length'] + 2.0) * 1e9)
    blocks, sequence = [], 0
    for first, period, values in gauges:
        for k in range(0, len(values), BATCH):
            part = values[k : k + BATCH]
            blocks.append(GaugeBlock(
                first + round(k * period * 1e9), sequence, period, part,
                np.zeros(part.shape, np.uint8),
            ))
            sequence += len(part)
    stamps, positions = (np.array(column) for column in zip(*feedback, strict=True))
    # Of a second at most.
    pieces = [
        FeedbackColumns(LETTERS, stamps[k : k + BATCH], positions[k : k + BATCH])
        for k in range(0, len(stamps), BATCH)
    ]
    return Recording(
        Path('made'), 's', NMV, tuple(plans), Held(blocks), Held(pieces), (), (), (), (), {},
        T0, stamp, 0,
    )


FEEDS = ((3 * SLOW, 0.8), (FAST, 2.2))
LAG = {round(3 * SLOW, 6): 3e-6, round(FAST, 6): 6e-6}


@pytest.fixture(scope='module')
def made():
    return session(Hidden(lag=LAG, late=0.004), FEEDS)


@pytest.fixture(scope='module')
def evaluated(made):
    return dynamic_session(MACHINE, made, estimate_recording(made))


def test_a_recording_gives_what_was_hidden(evaluated):
    (result,) = evaluated.results
    assert result.setup == '1a'
    assert result.cycles == ('1a-dynamic-0', '1a-dynamic-1')
    assert {one.key for one in result.naming.effects} == {'friction-lag', 'clock-offset'}
    assert abs(result.offset.value - 0.004) < 5 * result.offset.stddev
    for one, truth in zip(result.lags, LAG.values(), strict=True):
        # The nest's axes are calibrated to a few parts in ten thousand.
        assert one.gauges[0] == pytest.approx(truth, rel=1e-3, abs=5 * one.gauges[1])


def test_json_and_report(evaluated, tmp_path):
    path = output.write(evaluated, tmp_path)
    data = json.loads(path.read_text())
    (setup,) = data['setups']
    assert setup['axis'] == 'C'
    assert setup['time_offset']['value'] == pytest.approx(0.004, abs=5e-4)
    assert [one['key'] for one in setup['effects']] == ['friction-lag', 'clock-offset']
    assert [one['tangential_lag']['gauges']['value'] for one in setup['feeds']] == pytest.approx(
        [3e-6, 6e-6], rel=1e-2
    )
    assert [np.sign(one['omega']) for one in setup['passes']] == [1, -1, 1, -1]
    assert setup['passes'][2]['error_motion_measured']['turns'] == 2
    assert setup['passes'][2]['error_motion_measured']['asynchronous']['radial'] < 0.5e-6
    assert 'error_motion_measured' not in setup['passes'][0]
    page = write_report(evaluated, tmp_path).read_text()
    for name in ('radial', 'tangential', 'axial', 'lag', 'start', 'parts', 'harmonics'):
        assert (tmp_path / f'dynamic_{name}.png').is_file()
        assert (tmp_path / f'dynamic_{name}.svg').is_file()
        assert f'alt="{name}"' in page
    assert 'src="http' not in page and 'href="http' not in page


def test_lines_for_a_person(evaluated):
    (result,) = evaluated.results
    told = '\n'.join(output.lines(result))
    assert 'friction-lag: contact probes trail the motion, not in the encoders' in told
    assert '3,583 deg/min (5,247 mm/min): tangential lag gauges +6.00' in told
    assert output.summary(result).startswith('1a explained: friction-lag + clock-offset; gauges +')


def test_a_session_without_dynamic_cycle_is_refused(made):
    static = replace(made, plans=made.plans[:1])
    with pytest.raises(UserError, match='no dynamic cycle'):
        dynamic_session(MACHINE, static, estimate_recording(static))


def test_a_dynamic_cycle_without_nest_is_refused(made):
    none = replace(made, plans=made.plans[1:])
    with pytest.raises(UserError, match='no nest calibration of set-up 1a'):
        dynamic_session(MACHINE, none, estimate_recording(none))


def test_readings_that_are_not_valid_are_left_out():
    nest = NestCalibration('n', '1a', 0, V, 0.0, 0.0127, zero=np.zeros(3))
    shift = np.array([[1e-6, 0.0, 0.0], [0.0, 2e-6, 0.0], [0.0, 0.0, 3e-6]])
    status = np.array([[0, 0, 0], [0, 2, 0], [0, 0, 0]], np.uint8)
    found, good = centres(nest, shift @ V.T, status)
    assert good.tolist() == [True, False, True]
    np.testing.assert_allclose(found[good], shift[good], atol=1e-15)
    with pytest.raises(UserError, match='4 gauges, the nest was calibrated with 3'):
        centres(nest, np.zeros((1, 4)), np.zeros((1, 4), np.uint8))


def test_laser_readings_are_solved_on_the_sphere():
    # Beams from the side onto a sphere of radius R, which moves along the first of them.
    radius, spot = 0.0127, 0.0127 * np.eye(3)
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 5e-4
    nest = NestCalibration(
        'n', '1a', 0, -np.eye(3), 0.0, radius, kind=NestKind.LASER, zero=np.zeros(3), spot=spot,
        correction_nodes=np.r_[cube, np.zeros((1, 3))], correction_values=np.zeros((9, 3)),
    )
    # The sphere at (s, 0, 0): the first spot s farther out, the others where the circle of
    # radius sqrt(R2 - s2) is.
    s = 2e-4
    reading = np.array([[-s, *2 * [radius - np.sqrt(radius**2 - s**2)]]])
    found, good = centres(nest, reading, np.zeros((1, 3), np.uint8))
    assert good.all()
    np.testing.assert_allclose(found, [[s, 0.0, 0.0]], atol=1e-9)
