"""Where results are written: what cannot be is a user's mistake, told in one line."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from rtest_estimation.errors import UserError


def check_folder(folder: Path) -> None:
    """Refuse a folder that cannot be made because there is a file (UserError); makes nothing."""
    for place in (folder, *folder.absolute().parents):
        if place.exists():
            if not place.is_dir():
                raise UserError(f'{folder}: cannot be written: {place} is not a directory')
            return


@contextlib.contextmanager
def writing(folder: Path) -> Iterator[None]:
    """What the system refuses while results are written to `folder` is a UserError."""
    try:
        yield
    except OSError as error:
        where = error.filename or folder
        raise UserError(f'{where}: cannot be written: {error.strerror or error}') from error
