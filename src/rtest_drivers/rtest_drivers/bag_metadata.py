"""What rosbag2 wants to know of a recording beside its messages: metadata.yaml, version 9."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from rtest_estimation.bagfile import FILE_NAME
from rtest_estimation.errors import UserError
from rtest_estimation.yaml_text import load_yaml

KEY = 'rosbag2_bagfile_information'
VERSION = 9
ROS_DISTRO = 'jazzy'
# rosbag2 says the end of time for the start of an empty bag.
NO_START = 2**63 - 1


@dataclass
class RecordedTopic:
    """One recorded topic.

    qos : YAML list of the publishers' profiles as rosbag2 writes it; '' for none
    count : of messages
    """

    name: str
    type_name: str
    type_hash: str
    qos: str
    count: int = 0


def bag_metadata(
    file: str, topics: Iterable[RecordedTopic], start: int | None, end: int | None
) -> dict[str, Any]:
    """Contents of metadata.yaml below its one key, for a recording of one MCAP file.

    file : its name; start, end : first and last log time [ns], None where there is no message
    """
    listed = list(topics)
    count = sum(topic.count for topic in listed)
    starting = {'nanoseconds_since_epoch': NO_START if start is None else start}
    duration = {'nanoseconds': (end or 0) - (start or 0)}
    return {
        'version': VERSION,
        'storage_identifier': 'mcap',
        'duration': duration,
        'starting_time': starting,
        'message_count': count,
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type_name,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': _profiles(topic.qos),
                    'type_description_hash': topic.type_hash,
                },
                'message_count': topic.count,
            }
            for topic in listed
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file],
        'files': [
            {
                'path': file,
                'starting_time': dict(starting),
                'duration': dict(duration),
                'message_count': count,
            }
        ],
        'custom_data': None,
        'ros_distro': ROS_DISTRO,
    }


def _profiles(text: str) -> list[dict[str, Any]]:
    """Offered profiles in the words of version 9; none where they are in those of older ones."""
    try:
        profiles = load_yaml(text, 'offered_qos_profiles')
    except UserError:
        return []
    if not isinstance(profiles, list):
        return []
    words = [isinstance(one, dict) and isinstance(one.get('history'), str) for one in profiles]
    return profiles if all(words) else []


def write_metadata(folder: Path, metadata: dict[str, Any]) -> None:
    """Replace metadata.yaml as a whole, so that it is never half written.

    Raises OSError where the disk refuses; the previous one then stays.
    """
    draft = folder / f'{FILE_NAME}.tmp'
    with draft.open('w', encoding='utf-8') as file:
        yaml.safe_dump({KEY: metadata}, file, sort_keys=False)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(folder / FILE_NAME)


def sync_folder(folder: Path) -> None:
    """Make the entries of a directory survive a power failure."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
