"""Finds the configuration files that come with the package."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from rtest_estimation.errors import UserError

PACKAGE = 'rtest_drivers'


def config_path(name: str) -> Path:
    """Path of a file in the package's config folder: of the sources, or installed in share.

    Raises UserError where neither has it.
    """
    share = Path('share') / PACKAGE / 'config'
    prefixes = [Path(p) for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    # PREFIX/lib/pythonX.Y/site-packages/rtest_drivers/config.py
    prefixes += [*Path(__file__).resolve().parents[4:5], Path(sys.prefix)]
    folders = [Path(__file__).resolve().parents[1] / 'config', *(p / share for p in prefixes)]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    raise UserError(f'{name}: not found in {", ".join(dict.fromkeys(map(str, folders)))}')
