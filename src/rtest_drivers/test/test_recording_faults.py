"""Faults at random points: what was on the disk is there, what is not is said.

A few points of each kind; bench/recording_faults.py takes many.
"""

from pathlib import Path

import pytest
from recording_faults import chunk_ends, cut, fill_disk, kill, misframe, random_places, stall

from rtest_drivers.mcap_file import McapFile
from rtest_drivers.message_types import MessageTypes

SHORT = Path(__file__).resolve().parents[3] / 'bags' / 'short' / 'short.mcap'


@pytest.mark.parametrize('torn', [False, True])
def test_a_session_cut_anywhere(tmp_path, torn):
    assert len(chunk_ends(SHORT)) > 20
    outcome = cut(SHORT, random_places(SHORT, 25, seed=3), tmp_path, torn)
    assert (outcome.opened, outcome.told, outcome.lost) == (25, 25, 0)


def test_a_small_file_cut_at_every_byte(tmp_path):
    file = McapFile(tmp_path / 'tiny')
    definition = MessageTypes().definition('std_msgs/msg/String')
    file.add_topic('/a', definition.name, definition.text, definition.type_hash)
    for number in range(4):
        file.write('/a', 1_700_000_000_000_000_000 + number, 0, number, b'\0\1\0\0\2\0\0\0x\0')
        if number % 2:
            file.flush()
    file.close()
    size = file.path.stat().st_size
    assert [count for _, count in chunk_ends(file.path)] == [2, 4]
    outcome = cut(file.path, range(size), tmp_path)
    assert (outcome.opened, outcome.told, outcome.lost) == (size, size, 0)


def test_a_bit_in_the_opcode_or_length_of_a_chunk(tmp_path):
    outcome = misframe(SHORT, 20, 4, tmp_path)
    assert (outcome.opened, outcome.told, outcome.lost) == (20, 20, 0)


def test_killed_while_it_takes_a_thousand_messages_a_second(tmp_path):
    # How soon something is on the disk depends on the computer; that it is whole does not.
    outcome = kill(tmp_path, 3, seed=5, longest=2.0, promise=60.0)
    assert (outcome.opened, outcome.told, outcome.lost) == (3, 3, 0)


def test_a_disk_that_becomes_full(tmp_path):
    outcome = fill_disk(tmp_path, 2, seed=6)
    assert (outcome.opened, outcome.told, outcome.lost) == (2, 2, 0)


def test_a_disk_that_does_not_answer(tmp_path):
    outcome = stall(tmp_path, 20_000_000, 80_000_000)
    assert (outcome.told, outcome.lost) == (1, 0)
    assert outcome.notes['dropped'] > 1000
    assert outcome.notes['waiting'] <= 20_000_000
    # What the process has beside: the chunk being made, and what the allocator keeps.
    assert outcome.notes['grown'] < 40_000_000
