"""Definitions and hashes of message types against those that ROS itself made."""

import json
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_share_directory

from rtest_drivers.message_types import MessageTypeError, MessageTypes


def test_hashes_are_those_of_the_installed_packages():
    types = MessageTypes()
    checked = 0
    for package in ('rtest_msgs', 'sensor_msgs', 'diagnostic_msgs', 'visualization_msgs'):
        folder = Path(get_package_share_directory(package)) / 'msg'
        for path in folder.glob('*.json'):
            for entry in json.loads(path.read_text())['type_hashes']:
                name = entry['type_name']
                assert types.definition(name).type_hash == entry['hash_string'], name
                checked += 1
    assert checked > 50


def test_definition_holds_every_part():
    text = MessageTypes().definition('rtest_msgs/msg/Cycle').text
    for part in ('rtest_msgs/CyclePlan', 'rtest_msgs/CyclePoint', 'geometry_msgs/Point'):
        assert f'MSG: {part}\n' in text
    assert 'uint8 NEST_CALIBRATION=2' in text


def test_parts_are_found_in_other_packages(tmp_path, monkeypatch):
    for package, name, text in (
        ('first_msgs', 'Outer', 'second_msgs/Inner[] many\nstd_msgs/Header header\n'),
        ('second_msgs', 'Inner', 'float64 value 1.5  # with a default\n'),
        ('third_msgs', 'Broken', 'missing_msgs/Thing thing\n'),
    ):
        folder = tmp_path / 'share' / package / 'msg'
        folder.mkdir(parents=True)
        (folder / f'{name}.msg').write_text(text)
        index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
        index.mkdir(parents=True, exist_ok=True)
        (index / package).touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path), prepend=':')
    types = MessageTypes()
    assert 'MSG: second_msgs/Inner' in types.definition('first_msgs/msg/Outer').text
    with pytest.raises(MessageTypeError, match=r'third_msgs/msg/Broken: package missing_msgs is'):
        types.definition('third_msgs/msg/Broken')
    with pytest.raises(MessageTypeError, match='defines no first_msgs/msg/Absent'):
        types.definition('first_msgs/msg/Absent')
    with pytest.raises(MessageTypeError, match='package nobody_msgs is not installed'):
        types.definition('nobody_msgs/msg/Any')
