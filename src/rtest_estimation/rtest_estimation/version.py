"""Which code it was: a recording says by what it was made."""

from __future__ import annotations

from functools import lru_cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path


@lru_cache
def code_version(package: str) -> str:
    """Version of a package of this project and what its code is, as ``0.1.0 (code 1a2b3c4d5e6f)``.

    The second number is the beginning of the SHA-256 of the package's Python files with their
    names; it also tells apart what was changed without a new version.
    """
    try:
        number = version(package)
    except PackageNotFoundError:
        number = 'not installed'
    (folder,) = (Path(place) for place in find_spec(package).submodule_search_locations)
    digest = sha256()
    for path in sorted(folder.rglob('*.py')):
        digest.update(f'{path.relative_to(folder)}\0'.encode())
        digest.update(path.read_bytes())
    return f'{number} (code {digest.hexdigest()[:12]})'
