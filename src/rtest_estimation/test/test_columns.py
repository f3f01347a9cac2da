"""Readings and feedback read many messages at once are those that are read one by one."""

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from test_recording import START, STORE, TYPES, BagMaker, feedback, gauges, header, plan

from rtest_estimation import messages
from rtest_estimation.buffers import FeedbackBuffer, GaugeBuffer
from rtest_estimation.columns import Stream
from rtest_estimation.layout import layout_of
from rtest_estimation.recording import read_recording
from rtest_estimation.records import CyclePlan, GaugeBlock, Kind


def joint_state(stamp, names, positions, frame=''):
    return TYPES['sensor_msgs/msg/JointState'](
        header(stamp, frame), names, np.array(positions, float), np.zeros(0), np.zeros(0)
    )


@pytest.fixture
def mixed(tmp_path):
    """Two drivers on one topic, batches of any size, damage and nonsense in between."""
    rng = np.random.default_rng(3)
    bag = BagMaker(tmp_path / 'mixed.mcap')
    bag.add('/rtest/plan', plan())
    sent, sequence = [], 0
    for number in range(2600):
        readings = 10 if number < 2200 else int(rng.integers(1, 12))
        message = gauges(sequence, readings=readings, displacement=rng.normal(size=3 * readings))
        sequence += readings
        if number == 1500:
            message.channels = 7
        data = bytes(STORE.serialize_cdr(message, 'rtest_msgs/msg/GaugeSamples'))
        if number == 2300:
            data = data[:60]
        bag.add('/rtest/gauges', message, data=data)
        if number not in (1500, 2300):
            sent.append(message)
        if number % 40 == 0:
            bag.end_chunk()
    encoders = [
        joint_state(START + number * 10**7, *((list('XYZBC'), rng.normal(size=5))
                    if number < 1200 else (['Y', 'X'], rng.normal(size=2))))
        for number in range(1300)
    ]
    for message in encoders:
        bag.add('/rtest/cnc/feedback', message)
    # Nowhere is a position like this; the one message is left out.
    bag.add('/rtest/cnc/feedback', joint_state(START + 14 * 10**9, ['Y', 'X'], [1e300, 0.0]))
    return read_recording(bag.close()), sent, encoders


def test_they_are_those_that_rosbags_reads(mixed):
    recording, sent, encoders = mixed
    assert len(recording.gauges) == len(sent)
    for block, message in zip(recording.gauges, sent, strict=True):
        expected = messages.gauge_block(message)
        assert (block.stamp, block.sequence, block.period) == (
            expected.stamp, expected.sequence, expected.period
        )
        np.testing.assert_array_equal(block.displacement, expected.displacement)
        np.testing.assert_array_equal(block.stamps, expected.stamps)
        assert block.displacement.shape == expected.displacement.shape
    assert len(recording.feedback) == len(encoders)
    for sample, message in zip(recording.feedback, encoders, strict=True):
        expected = messages.feedback(message)
        assert (sample.stamp, sample.axes) == (expected.stamp, expected.axes)
        np.testing.assert_array_equal(sample.position, expected.position)
    left_out, other = (line for line in recording.warnings if 'left out' in line)
    assert '/rtest/cnc/feedback: 1 message left out' in other
    assert '2 messages left out' in left_out and 'expected readings x 7' in left_out


def test_pieces_are_the_same_readings(mixed):
    recording, _, _ = mixed
    pieces = list(recording.gauges.pieces())
    assert len(pieces) < 0.75 * len(recording.gauges)
    for name in ('stamps', 'displacement', 'status'):
        np.testing.assert_array_equal(
            np.concatenate([getattr(piece, name) for piece in pieces]),
            np.concatenate([getattr(block, name) for block in recording.gauges]),
        )
    for piece in pieces:
        assert piece.stamps[-1] - piece.stamps[0] < 1.3e9


def test_stamps_that_step_back_are_sorted(tmp_path):
    bag = BagMaker(tmp_path / 'back.mcap')
    bag.add('/rtest/plan', plan())
    for sequence in (0, 10, 20, 30):
        bag.add('/rtest/gauges', gauges(sequence))
    for second in (1, 2, 5, 3, 4):
        bag.add('/rtest/cnc/feedback', feedback(START + second * 10**9))
    recording = read_recording(bag.close())
    assert [(s.stamp - START) // 10**9 for s in recording.feedback] == [1, 2, 3, 4, 5]
    assert isinstance(recording.feedback, Stream)
    assert '/rtest/cnc/feedback: stamps step back 1 time, first to 3.000 s; sorted' in (
        recording.warnings
    )


DEFINITION = """bool good
string name
int16[3] three
float64[] numbers
string[] words
Part[] parts
================================================================================
MSG: test_msgs/Part
uint8 small
float32 value
"""


def test_layout_of_any_definition():
    name = 'test_msgs/msg/Whole'
    STORE.register(get_types_from_msg(DEFINITION, name))
    part = STORE.types['test_msgs/msg/Part']
    message = STORE.types[name](
        True, 'ab', np.array([1, -2, 3], np.int16), np.array([0.5, np.pi]), ['x', 'yz'],
        [part(7, 1.5), part(8, 2.5)],
    )
    data = bytes(STORE.serialize_cdr(message, name))
    found = layout_of(STORE.fielddefs, name, data).columns([data, data])
    expected = {
        'good': [1], 'three': [1, -2, 3], 'numbers': [0.5, np.pi], 'parts[0].small': [7],
        'parts[0].value': [1.5], 'parts[1].small': [8], 'parts[1].value': [2.5],
    }
    assert found.keys() == expected.keys()
    for key, values in expected.items():
        np.testing.assert_array_equal(found[key], [values, values])
    # Another text is another layout; so is what is cut off.
    message.name = 'cd'
    other = bytes(STORE.serialize_cdr(message, name))
    assert layout_of(STORE.fielddefs, name, data).columns([data, other]) is None
    assert layout_of(STORE.fielddefs, name, data[:30]) is None


def a_plan(axes):
    return CyclePlan(
        0, 's', 'c', Kind.STATIC, '1a', np.zeros(3), axes, np.zeros((1, len(axes))), 0.3
    )


def test_feedback_one_by_one_is_feedback_in_columns():
    rng = np.random.default_rng(1)
    stamps = np.cumsum(rng.integers(0, 3, 500)) + 5
    positions = rng.normal(size=(500, 2))
    whole, single = FeedbackBuffer(), FeedbackBuffer()
    dropped = whole.extend(('B', 'X'), stamps, positions)
    assert dropped == sum(
        single.extend(('B', 'X'), stamps[k : k + 1], positions[k : k + 1]) for k in range(500)
    )
    assert dropped == 500 - len(np.unique(stamps)) > 50
    for buffer in (whole, single):
        buffer.forget(100)
        assert buffer.first == stamps[stamps >= 100][0] and buffer.last == stamps[-1]
        times, found = buffer.window(a_plan(('X', 'C', 'B')), 150, 300)
        first = np.unique(stamps, return_index=True)[1]
        first = first[(stamps[first] >= 150) & (stamps[first] <= 300)]
        np.testing.assert_array_equal(times, stamps[first])
        np.testing.assert_array_equal(found[:, [2, 0]], positions[first])
        assert np.isnan(found[:, 1]).all()


def test_many_small_blocks_and_few_large_ones_give_the_same_window():
    rng = np.random.default_rng(2)
    values = rng.normal(size=(3000, 3))
    small, large = GaugeBuffer(), GaugeBuffer()
    status = np.zeros((3000, 3), np.uint8)
    for first in range(0, 3000, 3):
        rows = slice(first, first + 3)
        small.append(GaugeBlock(first * 10**6, first, 1e-3, values[rows], status[rows]))
    large.append(GaugeBlock(0, 0, 1e-3, values, status))
    for before in (0, 1_000_500_000):
        small.forget(before)
        for window in ((1_200_000_000, 2_000_000_000), (2_995_000_000, 4_000_000_000)):
            for one, other in zip(small.window(*window), large.window(*window), strict=True):
                np.testing.assert_array_equal(one, other)
    assert len(small.blocks) < 400 and small.last == large.last
