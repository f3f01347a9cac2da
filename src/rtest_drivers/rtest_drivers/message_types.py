"""Definitions and hashes of message types, as a recording needs them; no ROS node, no build.

The common packages come from the type store of rosbags, everything else (``rtest_msgs``, a
user's own) from the .msg files of the installed package, found through the ament index.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore


class MessageTypeError(LookupError):
    """A message type whose definition cannot be found or read; says which and where."""


@dataclass(frozen=True)
class Definition:
    """What a reader without ROS needs to know about a message type.

    name : for example ``sensor_msgs/msg/JointState``
    text : definition with everything it is made of, in the ``ros2msg`` form of MCAP
    type_hash : ROS 2 type hash (REP 2016), ``RIHS01_...``
    """

    name: str
    text: str
    type_hash: str


class MessageTypes:
    """Looks definitions up; every package's files are read at most once."""

    def __init__(self) -> None:
        self._store: Typestore = get_typestore(Stores.ROS2_JAZZY)
        self._read: set[str] = set()

    def definition(self, name: str) -> Definition:
        """Definition of ``package/msg/Type``.

        Raises MessageTypeError where the type or one of its parts is not installed.
        """
        self._require(name, name)
        text, _ = self._store.generate_msgdef(name, ros_version=2)
        return Definition(name, text, self._store.hash_rihs01(name))

    def _require(self, name: str, wanted: str) -> None:
        """Read the packages that `name` needs until the store knows all its parts."""
        if name not in self._store.fielddefs:
            package = name.partition('/')[0]
            if package not in self._read:
                self._read.add(package)
                self._store.register(_package_types(package, wanted))
            if name not in self._store.fielddefs:
                raise MessageTypeError(f'{wanted}: package {package} defines no {name}')
            # The types the store came with are complete; only new ones have parts to look for.
            for _, field in self._store.fielddefs[name][1]:
                for part in _parts(field):
                    self._require(part, wanted)


def _parts(field: Any) -> list[str]:
    """Names of the message types in one field's description."""
    kind, detail = field
    if kind == Nodetype.NAME:
        return [detail]
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return _parts(detail[0])
    return []


def _package_types(package: str, wanted: str) -> dict[str, Any]:
    """Parse every .msg file of an installed package."""
    try:
        folder = Path(get_package_share_directory(package)) / 'msg'
    except (PackageNotFoundError, ValueError):
        raise MessageTypeError(
            f'{wanted}: package {package} is not installed (looked in AMENT_PREFIX_PATH)'
        ) from None
    types: dict[str, Any] = {}
    for path in sorted(folder.glob('*.msg')):
        try:
            types.update(
                get_types_from_msg(path.read_text(encoding='utf-8'), f'{package}/msg/{path.stem}')
            )
        except (OSError, UnicodeDecodeError, TypesysError) as error:
            raise MessageTypeError(f'{wanted}: {path}: {error}') from error
    return types
