"""What the page is told of a cell: life of devices, gauges, poses, results."""

import json
import math

import numpy as np
import pytest

from rtest_drivers.config import config_path
from rtest_drivers.view import results
from rtest_drivers.view.devices import Report, Stream
from rtest_drivers.view.gauges import parse_ranges
from rtest_drivers.view.state import CellState
from rtest_estimation.records import (
    Cycle,
    CyclePlan,
    CyclePoint,
    Feedback,
    GaugeBlock,
    Kind,
    Missing,
    Status,
    Temperature,
)

SECOND = 1_000_000_000
ACTIVE = {'state': 'active'}


def block(stamp, sequence, values, status=None):
    values = np.atleast_2d(np.array(values, dtype=float))
    states = np.zeros(values.shape) if status is None else np.atleast_2d(status)
    period = 0.01 if len(values) > 1 else 0.0
    return GaugeBlock(stamp, sequence, period, values, states.astype(np.uint8))


def run(state, start, end, rate=50.0, driver=True):
    """Readings and driver reports from `start` to `end` [s], wall time as the devices'."""
    count = round((end - start) * rate)
    for n in range(count + 1):
        now = start + n / rate
        state.add_gauges(block(round(now * SECOND), round(now * rate), [[1e-6, 2e-6, 3e-6]]), now)
        if driver and n % round(rate / 2) == 0:
            state.add_report(Report('gauges: driver', 0, 'active', ACTIVE, now))


def device(state, now, name='gauges'):
    return next(one for one in state.tick(now)['devices'] if one['name'] == name)


def plan(kind=Kind.STATIC, cycle='1a', stamp=SECOND, session='monday'):
    # Two stations of B by three of C, and C = 0 at B = 0 again at the end.
    poses = [(b, c) for b in (0.0, 0.5) for c in (0.0, 1.0, 2.0)] + [(0.0, 0.0)]
    commands = np.array([[0.0, 0.01, 0.0, b, c] for b, c in poses])
    return CyclePlan(stamp, session, cycle, kind, 's', np.zeros(3), tuple('XYZBC'), commands, 0.3)


def point(index):
    return CyclePoint(index, SECOND, np.zeros(5), np.zeros(5, dtype=np.int8), np.zeros(3),
                      np.eye(3), 10)


def state_with_machine():
    state = CellState()
    state.add_machine(config_path('nmv1500dcg.yaml').read_text())
    return state


# ---- life ----


def test_rate_is_that_of_the_readings_not_of_the_messages_looked_at() -> None:
    stream = Stream()
    # Every second message was looked at; the running number says how many readings there were.
    for n in range(0, 40, 2):
        stream.add(n * SECOND // 20, 10 * n, n / 20)
    assert stream.rate == pytest.approx(200.0)


def test_a_driver_that_restarts_counts_anew() -> None:
    stream = Stream()
    stream.add(5 * SECOND, 1000, 5.0)
    stream.add(6 * SECOND, 0, 6.0)
    assert stream.rate is None
    stream.add(7 * SECOND, 50, 7.0)
    assert stream.rate == pytest.approx(50.0)


def test_a_device_that_stops_is_red_within_two_seconds() -> None:
    state = CellState()
    run(state, 0.0, 5.0)
    assert device(state, 5.1)['level'] == 'ok'
    assert device(state, 5.1)['rate'] == pytest.approx(50.0, rel=0.05)
    dead = device(state, 6.9)
    assert dead['level'] == 'error'
    assert dead['age'] == pytest.approx(1.9)
    # The driver goes on saying that it is active, no data come: the device or its cable.
    state.add_report(Report('gauges: driver', 0, 'active', ACTIVE, 6.9))
    assert 'no data for 1.9 s' in device(state, 6.9)['text']
    # Its values are old, and say so.
    assert {one['text'] for one in state.tick(6.9)['gauges']} == {'old value'}


def test_a_slow_device_is_not_red_between_its_readings() -> None:
    state = CellState()
    for n in range(6):
        state.add_temperature(Temperature(10 * n * SECOND, 'bed', 20.5), 10.0 * n)
    assert device(state, 59.0, 'temperature bed')['level'] == 'ok'
    assert device(state, 101.0, 'temperature bed')['level'] == 'error'


def test_what_the_driver_says_counts() -> None:
    state = CellState()
    run(state, 0.0, 2.0)
    state.add_report(Report('gauges: driver', 2, 'port: no answer', ACTIVE, 2.0))
    assert device(state, 2.1)['level'] == 'error'
    assert device(state, 2.1)['text'] == 'port: no answer'
    state.add_report(Report('gauges: driver', 0, 'inactive', {'state': 'inactive'}, 2.2))
    assert device(state, 2.3)['level'] == 'idle'


def test_silence_after_the_end_of_a_session_is_no_fault() -> None:
    state = CellState()
    run(state, 0.0, 2.0)
    state.add_report(Report('session: progress', 0, 'finished', {'state': 'finished'}, 2.0))
    assert device(state, 60.0)['level'] == 'idle'
    assert {(g['level'], g['text']) for g in state.tick(60.0)['gauges']} == {('idle', 'old value')}
    assert device(state, 60.0, 'session')['level'] == 'idle'


def test_somebody_elses_driver_needs_no_diagnostics() -> None:
    state = CellState()
    run(state, 0.0, 2.0, driver=False)
    assert device(state, 2.1)['level'] == 'ok'
    assert device(state, 4.0)['level'] == 'error'


def test_a_node_that_computes_is_busy_and_one_that_is_gone_is_told() -> None:
    state = CellState()
    for name in ('identifier: session', 'estimator: cycle'):
        state.add_report(Report(name, 0, 'works', {}, 0.0))
    assert device(state, 2.0, 'identifier')['level'] == 'ok'
    assert device(state, 10.0, 'identifier')['text'] == 'computes: silent for 10 s'
    assert device(state, 60.0, 'identifier')['level'] == 'warn'
    assert device(state, 60.0, 'estimator')['level'] == 'error'
    assert device(state, 121.0, 'identifier')['level'] == 'error'


# ---- gauges, axes ----


def test_ranges_as_the_drivers_tell_them() -> None:
    assert parse_ranges('-1 1; -3.5 3.5; ?') == [
        pytest.approx((-1e-3, 1e-3)), pytest.approx((-3.5e-3, 3.5e-3)), None
    ]
    assert parse_ranges('1 -1; nan 3') == [None, None]


def test_gauges_in_micrometres_with_what_is_wrong() -> None:
    state = CellState()
    state.add_report(Report('gauges: driver', 0, 'active',
                            {**ACTIVE, 'gauge_range_mm': '-1 1; -1 1; ?'}, 0.0))
    state.add_gauges(block(0, 0, [[12.5e-6, 0.97e-3, 0.0]], [[0, 0, Status.NO_SIGNAL]]), 0.0)
    one, two, three = state.tick(0.1)['gauges']
    assert (one['value'], one['range'], one['level']) == (12.5, [-1000.0, 1000.0], 'ok')
    assert (two['level'], two['text']) == ('warn', 'near the end of its range')
    assert (three['value'], three['range'], three['text']) == (None, None, 'no signal')
    assert three['level'] == 'error'


def test_an_empty_nest_is_no_fault() -> None:
    state = CellState()
    state.add_gauges(block(0, 0, [[0.0, 0.0]], [[Status.NO_SIGNAL] * 2]), 0.0)
    assert {one['level'] for one in state.tick(0.1)['gauges']} == {'idle'}


def test_the_strip_holds_the_extremes_between_two_looks() -> None:
    state = CellState()
    state.add_gauges(block(0, 0, [[1e-6], [9e-6], [-4e-6]]), 0.0)
    state.add_gauges(block(SECOND, 3, [[2e-6]]), 0.05)
    assert state.tick(0.1)['spans'] == [[-4.0, 9.0]]
    # Nothing came since: nothing is drawn.
    assert state.tick(0.2)['spans'] == [None]
    assert [row['spans'] for row in state.history] == [[[-4.0, 9.0]], [None]]


def test_axes_in_mm_and_degrees_within_their_range() -> None:
    state = state_with_machine()
    state.add_feedback(Feedback(0, ('X', 'B', 'S'), np.array([0.0123, math.pi / 2, 1.0])), 3, 0.0)
    x, b, s = state.tick(0.1)['axes']
    assert (x['value'], x['unit'], x['range']) == (12.3, 'mm', [-210.0, 210.0])
    assert (b['value'], b['unit']) == (90.0, '°')
    assert b['range'] == pytest.approx([-180.0, 160.0])
    assert s['value'] == pytest.approx(57.29578) and s['range'] is None


def test_every_record_is_json_also_with_values_that_are_no_numbers() -> None:
    state = state_with_machine()
    state.add_feedback(Feedback(0, ('X',), np.array([math.nan])), 1, 0.0)
    state.add_gauges(block(0, 0, [[math.nan, math.inf]]), 0.0)
    json.dumps(state.tick(0.1), allow_nan=False)


# ---- poses ----


def test_the_map_fills_and_then_says_what_is_missing_and_why() -> None:
    state = state_with_machine()
    state.add_plan(plan())
    state.add_report(Report('estimator: cycle', 0, '', {
        'cycle': '1a', 'started': str(SECOND), 'poses_done': '2', 'poses': '7'}, 0.0))
    shown = state.parts['cycle:0'][1]
    assert shown['rows'] == ['B 0°', 'B 28.648°']
    assert len(shown['columns']) == 3
    assert shown['places'][4] == (1, 1) and shown['places'][6] == (0, 0)
    # The machine was there; whether something was measured is known when the cycle has come.
    assert shown['states'] == ['reached'] * 2 + ['open'] * 5
    assert (shown['reached'], shown['done']) == (2, 0)
    missing = (Missing(3, ''), Missing(6, ''))
    state.add_cycle(Cycle(plan(), tuple(point(n) for n in (0, 1, 2, 4, 5)), missing, '', SECOND))
    state.add_report(Report('estimator: finished cycle', 1, '1a: 5 of 7 poses',
                            {'pose 3': 'not settled', 'pose 6': 'no signal'}, 0.0))
    shown = state.parts['cycle:0'][1]
    assert shown['states'] == ['done'] * 3 + ['missing'] + ['done'] * 2 + ['missing']
    assert shown['reasons'] == {'3': 'not settled', '6': 'no signal'}
    assert (shown['done'], shown['missing']) == (5, 2)


def test_reasons_may_come_before_the_cycle() -> None:
    state = state_with_machine()
    state.add_plan(plan())
    state.add_report(Report('estimator: finished cycle', 1, '1a: 6 of 7 poses',
                            {'pose 6': 'late'}, 0.0))
    state.add_cycle(Cycle(plan(), tuple(map(point, range(6))), (Missing(6, ''),), '', SECOND))
    assert state.parts['cycle:0'][1]['reasons'] == {'6': 'late'}


def test_a_nest_calibration_is_laid_out_in_its_order() -> None:
    state = state_with_machine()
    state.add_plan(plan(Kind.NEST_CALIBRATION))
    shown = state.parts['cycle:0'][1]
    assert shown['rows'] == [] and shown['places'] == [(0, n) for n in range(7)]
    assert shown['names'][0] == 'X 0 mm, Y 10 mm, Z 0 mm, B 0°, C 0°'


def test_another_session_begins_anew() -> None:
    state = state_with_machine()
    state.add_plan(plan())
    state.add_result('location', {'rows': []})
    state.add_plan(plan(session='tuesday', cycle='1b'))
    assert state.parts['location'][1] is None
    assert state.parts['cycle:0'][1]['cycle'] == '1b'


def test_a_page_opened_late_keeps_what_came_before_the_first_plan() -> None:
    for plan_first in (True, False):
        state = state_with_machine()
        if plan_first:
            state.add_plan(plan())
        state.add_result('location', {'rows': []})
        state.add_result('map:B', {'axis': 'B'})
        state.add_mark('door opened')
        if not plan_first:
            state.add_plan(plan())
        state.add_plan(plan(cycle='1b'))
        assert state.parts['location'][1] == {'rows': []}
        assert state.parts['map:B'][1] == {'axis': 'B'}
        assert state.parts['marks'][1] == ['door opened']
        assert state.parts['cycle:1'][1]['cycle'] == '1b'


def test_nodes_of_the_session_before_are_forgotten() -> None:
    state = state_with_machine()
    state.add_plan(plan())
    state.add_report(Report('cell: simulation', 0, '', {}, 0.0))
    state.add_report(Report('estimator: cycle', 0, '', {}, 60.0))
    state.add_plan(plan(session='tuesday'))
    names = [one['name'] for one in state.tick(60.5)['devices']]
    assert 'cell' not in names and 'estimator' in names


# ---- results ----


def test_all_warnings_of_the_identifier_stay_with_the_results() -> None:
    state = CellState()
    said = {f'warning {n}': f'text {n}' for n in range(1, 12)}
    state.add_report(Report('identifier: session', 1, '8 errors', said, 0.0))
    revision, shown = state.parts['warnings']
    assert shown == [f'text {n}' for n in range(1, 12)]
    state.add_report(Report('identifier: session', 1, '8 errors', said, 1.0))
    assert state.parts['warnings'][0] == revision
    state.add_report(Report('session: progress', 0, 'finished', {'state': 'finished'}, 2.0))
    state.tick(600.0)
    assert state.parts['warnings'][1] == shown
    # What is cured is no longer warned of.
    state.add_report(Report('identifier: session', 0, '8 errors', {}, 3.0))
    assert state.parts['warnings'][1] == []


def test_what_is_said_of_the_verdict_on_the_model_stays_with_it() -> None:
    state = CellState()
    notes = {'note 1': 'unexplained at B = -40.0 deg: rms 2.10 µm', 'note 2': 'C = 0'}
    state.add_report(Report('identifier: model gap', 1, 'unknown effect', notes, 0.0))
    assert state.parts['gap_notes'][1] == list(notes.values())
    assert state.tick(0.5)['devices'][3]['text'] == 'unknown effect'


def test_location_errors_with_expanded_uncertainty() -> None:
    found = results.location_table(
        ['E_X(0Y)B', 'E_A(0Y)B'], [-7.8e-6, 18e-6], [1e-14, 0.0, 0.0, 4e-12], 2.5e-7
    )
    assert found['rows'][0] == {'symbol': 'E_X(0Y)B', 'value': -7.8, 'U': 0.2, 'unit': 'µm'}
    assert found['rows'][1] == {'symbol': 'E_A(0Y)B', 'value': 18.0, 'U': 4.0, 'unit': 'µrad'}
    assert found['residual'] == 0.25


def test_error_maps_over_one_axis_and_over_both() -> None:
    one = results.error_map('B', ['E_X(Y)B'], [0.0, 0.1], [], [1e-6, math.nan], [1e-7, math.nan])
    assert one['symbols'][0]['lines'] == [[1.0, None]]
    assert one['symbols'][0]['U'] == [[0.2, None]]
    assert one['levels'] == [] and one['over'][1] == pytest.approx(5.7296)
    both = results.error_map('C', ['E_C(B)C'], [0.0, 0.1], [0.0, 1.0, 2.0],
                             [n * 1e-6 for n in range(6)], [0.0] * 6)
    assert both['symbols'][0] == {'symbol': 'E_C(B)C', 'unit': 'µrad',
                                  'lines': [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]],
                                  'U': [[0.0] * 3] * 2}


def test_a_recorder_that_is_silent_is_told_where_its_numbers_are() -> None:
    state = CellState()
    values = {'bytes': '37000', 'lost': '0'}
    state.add_report(Report('recorder: recording', 0, 'recording', values, 0.0))
    assert state.tick(2.0)['recording']['text'] == 'recording'
    told = state.tick(4.0)['recording']
    assert told['level'] == 'error' and 'nothing heard for 4 s' in told['text']
    assert device(state, 4.0, 'recorder')['level'] == 'error'
    state.add_report(Report('recorder: recording', 0, 'recording', values, 5.0))
    assert state.tick(5.5)['recording']['level'] == 'ok'
    # The end of a session is no silence.
    state.add_report(Report('session: progress', 0, 'finished', {'state': 'finished'}, 6.0))
    assert state.tick(60.0)['recording']['level'] == 'ok'


def test_notes_of_the_identifier_are_shown_beside_its_warnings() -> None:
    state = CellState()
    said = {'warning 1': 'w', 'note 1': 'error motions are not in U', 'note 2': 'n'}
    state.add_report(Report('identifier: session', 1, '8 errors', said, 0.0))
    assert state.parts['warnings'][1] == ['w']
    assert state.parts['notes'][1] == ['error motions are not in U', 'n']


def test_a_mark_needs_somebody_who_records_it() -> None:
    state = CellState()
    assert 'no recorder' in state.problem(0.5)
    state.add_report(Report('/recorder', 0, 'recording', {}, 0.0))
    assert state.problem(0.5) == ''
    assert 'nothing was heard' in state.problem(5.0)
    state.add_report(Report('/recorder', 0, 'finished', {}, 0.0))
    assert 'finished' in state.problem(0.5)
