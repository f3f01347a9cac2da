"""Give every Python of .venv the environment that ROS 2 needs, without sourcing anything.

`setup_venv.py` copies this file into the site-packages of .venv, beside a .pth file that
imports it when the interpreter starts. The dynamic loader reads LD_LIBRARY_PATH only when a
process starts, so where the environment is not yet right the interpreter executes itself once
more in place: same process id, same arguments, same standard input. Child processes inherit
the environment and start directly.
"""

import os
import sys
from pathlib import Path

# Set to the process id by the process that executes itself again. It guards against a loop
# where the loader drops LD_LIBRARY_PATH (a Python with file capabilities); a child has
# another process id and looks for itself.
GUARD = '_RTEST_ENVIRONMENT'


def environment(prefix: Path, old: dict[str, str]) -> dict[str, str]:
    """Return the environment `old` with the ROS of the virtual environment `prefix` in front."""

    def parts(name: str) -> list[str]:
        return [part for part in old.get(name, '').split(os.pathsep) if part]

    packages = Path(__file__).parent
    ours = {
        'AMENT_PREFIX_PATH': [str(prefix)],
        'LD_LIBRARY_PATH': [str(prefix / 'lib'), *map(str, sorted(packages.glob('ros_*.libs')))],
        'PYTHONPATH': [],
    }
    foreign = ()
    if (prefix / 'share/rclpy').is_dir():
        # The wheels are here: a ROS that is sourced all the same is another distribution or
        # for another Python, and its libraries and modules must not be mixed with ours.
        foreign = tuple(p for p in parts('AMENT_PREFIX_PATH') if p != str(prefix))

    new = dict(old)
    for name, first in ours.items():
        rest = [
            part
            for part in parts(name)
            if part not in first and not any(Path(part).is_relative_to(p) for p in foreign)
        ]
        new[name] = os.pathsep.join([*first, *rest])
        if not new[name]:
            del new[name]
    # The wheels bring the same mechanism, with a random order of the folders; this is its guard.
    new['_ROS_WHEELS_BOOTSTRAP_COMPLETE'] = '1'
    return new


def restart() -> None:
    """Execute this interpreter again if its environment is not the right one."""
    new = environment(Path(sys.prefix), dict(os.environ))
    if new != dict(os.environ) and os.environ.get(GUARD) != str(os.getpid()):
        new[GUARD] = str(os.getpid())
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], new)


restart()
