"""What a session was measured by and with: software, session file, device files (YAML)."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import yaml

from rtest_estimation.version import code_version

TOPIC = 'rtest/configuration'
PACKAGES = ('rtest_drivers', 'rtest_identification', 'rtest_estimation')
_LIBRARIES = ('numpy', 'scipy', 'rosbags', 'mcap', 'ros-rclpy')


def provenance(
    session: str, config: Path, devices: Mapping[str, Path], cycles: Mapping[str, int]
) -> str:
    """Text that is recorded on the topic `TOPIC` at the start of a session.

    session : name; config : session file; devices : device file by driver
    cycles : poses of every cycle that is to be measured
    """
    return yaml.safe_dump(
        {
            'session': session,
            'software': {package: code_version(package) for package in PACKAGES},
            'libraries': {'python': platform.python_version(), **_libraries()},
            'cycles': dict(cycles),
            'session_file': _file(config),
            'devices': {name: _file(path) for name, path in devices.items()},
        },
        sort_keys=False,
        allow_unicode=True,
    )


def _file(path: Path) -> dict[str, str]:
    return {'path': str(path), 'text': path.read_text(encoding='utf-8')}


def _libraries() -> dict[str, str]:
    found = {}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            # Such as rclpy where ROS was not installed by pip.
            found[name] = 'not installed as a Python package'
    return found
