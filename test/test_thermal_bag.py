"""The recorded thermal session: its truth comes back, and what was seen live is what it gives."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from rtest_estimation import messages
from rtest_estimation.bagfile import read_bag
from rtest_estimation.message_reader import DamagedMessage
from rtest_estimation.recording import TYPES
from rtest_identification.offline import machine_of
from rtest_identification.thermal.live import LiveSession
from rtest_identification.thermal.offline import thermal_recording
from rtest_identification.thermal.output import as_dict

BAG = Path(__file__).resolve().parents[1] / 'bags' / 'thermal'
# As config/cell_thermal.yaml has it: where they settle [m], [K], and the lag [min].
ERRORS = {'E_X(0Y)B': -2.037e-6, 'E_Y(0Y)B': -6.112e-6, 'E_Z(0Y)B': -2.037e-6}
SENSORS = {'ambient': (0.432, 150), 'B_cover': (1.416, 40), 'bridge': (0.764, 72),
           'table': (0.0, 60), 'nest': (0.30, 150)}
LAG = 45.0


@pytest.fixture(scope='module')
def result():
    return thermal_recording(BAG)


@pytest.fixture(scope='module')
def minutes(result):
    """Middle of each cycle since the heat began with the first one."""
    return (result.stamp - result.cycles[0].plan.stamp) * 1e-9 / 60.0


def settled(minutes, lag):
    """Change since the first cycle, of one."""
    return np.exp(-minutes[0] / lag) - np.exp(-minutes / lag)


def test_every_cycle_is_there_in_time(result, minutes) -> None:
    assert [c.plan.cycle for c in result.cycles] == [
        f'low-thermal-{number:02d}' for number in range(1, 14)
    ]
    # A quarter of an hour from start to start, whatever the waiting nodes did.
    starts = np.array([cycle.plan.stamp for cycle in result.cycles])
    assert (np.diff(starts) == 900 * 10**9).all()
    assert not result.warnings and not result.missing
    assert minutes[-1] == pytest.approx(180.2, abs=0.1)


def test_the_drift_of_the_cell_comes_back(result, minutes) -> None:
    assert {one.parameter.symbol for one in result.drifting} == set(ERRORS)
    for one in result.errors:
        series = one.series
        truth = ERRORS.get(one.parameter.symbol, 0.0) * settled(minutes, LAG)
        # At the end within U (k = 2), and everywhere as far as of 13 cycles one may be outside.
        off = np.abs(series.value - truth)
        assert (off[1:] < 3.5 * series.stddev[1:]).all(), one.parameter.symbol
        if one.parameter.symbol in ERRORS:
            assert off[-1] < 2.0 * series.stddev[-1]
            assert series.value[-1] == pytest.approx(truth[-1], abs=0.3e-6)
            assert series.stddev[-1] < 0.15e-6
    assert result.map_probability > 0.01


def test_the_time_constants_come_back(result) -> None:
    for one in result.drifting:
        (constant,) = one.constants
        low, high = constant.interval
        assert not constant.undetermined and low < 60.0 * LAG < high
        assert high - low < 60.0 * LAG


def test_the_temperatures_come_back(result, minutes) -> None:
    assert {one.sensor for one in result.thermometers} == set(SENSORS)
    for one in result.thermometers:
        rise, lag = SENSORS[one.sensor]
        celsius, stddev = result.during_cycles(one)
        expanded = 2.0 * np.sqrt(2.0) * stddev
        assert abs(celsius[-1] - celsius[0] - rise * settled(minutes, lag)[-1]) < expanded
        assert expanded < 0.05
    # The cover at the B axis warms most like the errors.
    assert {one.best.sensor for one in result.drifting} == {'B_cover'}


def test_one_cycle_does_not_tell_a_drift_along_y_from_the_map_of_b(result) -> None:
    """Y is along the axis of B: what drifts there from station to station is alike in Y."""
    by = {one.parameter.symbol: one for one in result.within}
    assert by['E_Y(0Y)B'].inseparable and not by['E_X(0Y)B'].inseparable
    assert by['E_Y(0Y)B'].as_map[0][0].symbol == 'E_Y(Y)B'
    # The cycles around it do.
    assert by['E_Y(0Y)B'].drift < 0.0


def test_live_the_same_comes_out_as_from_the_recording(result) -> None:
    """What the estimator and the thermometers published, given to what the node runs."""
    bag = read_bag(BAG, TYPES)
    live, recorded = LiveSession(), []
    for topic, kind in ((t, k) for t, (k, _) in bag.topics.items()):
        for message in bag.messages(topic):
            assert not isinstance(message, DamagedMessage)
            if kind == 'sensor_msgs/msg/Temperature':
                live.add_temperature(messages.temperature(message))
            elif kind == 'rtest_msgs/msg/Cycle':
                recorded.append(messages.cycle(message))
    machine = machine_of(bag)
    pictures = []
    for cycle in recorded:
        live.add_cycle(cycle)
        if cycle.plan.kind == 0:
            pictures.append(live.result(machine))
    assert [len(picture.cycles) for picture in pictures] == list(range(1, 14))
    assert as_dict(pictures[-1]) == as_dict(result)
    # Delivered once more, as latched messages are, nothing changes.
    live.add_cycle(recorded[-1])
    assert as_dict(live.result(machine)) == as_dict(result)
    # And the node published what each cycle gives by itself.
    with AnyReader([BAG]) as reader:
        published = [
            reader.deserialize(data, connection.msgtype)
            for connection, _, data in reader.messages()
            if connection.topic == '/rtest/location_errors'
        ]
    assert len(published) == 13
    for one, cycle in zip(published[::6], [c for c in recorded if c.plan.kind == 0][::6],
                          strict=True):
        alone = live.alone(machine, cycle).location
        known = alone.determined
        assert list(one.symbols) == [s for s, k in zip(alone.symbols, known, strict=True) if k]
        np.testing.assert_array_equal(one.values, alone.value[known])


def test_cycles_cut_short_leave_the_others_usable(result, minutes) -> None:
    """One skipped after eight poses, one before its first."""
    live = LiveSession()
    for number, cycle in enumerate((*result.others, *result.cycles)):
        points = {6: cycle.points[:8], 9: ()}.get(number, cycle.points)
        live.add_cycle(type(cycle)(cycle.plan, points, cycle.missing, cycle.calibration,
                                   cycle.stamp))
    cut = live.result(result.machine)
    assert any('cut short' in warning for warning in cut.warnings)
    assert any('without a valid point' in warning for warning in cut.warnings)
    assert len(cut.cycles) == 12
    for one in cut.errors[:3]:
        truth = ERRORS[one.parameter.symbol] * settled(minutes, LAG)[-1]
        assert abs(one.series.value[-1] - truth) < 2.5 * one.series.stddev[-1]
