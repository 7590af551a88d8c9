"""Versions of the software that results depend on."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
"""Folder of robo_manip_baselines."""


def software_versions(*packages: str) -> dict[str, str]:
    """Return the versions of Python and of installed distributions, by name."""
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


@cache
def source_digest(folder: Path = PACKAGE) -> str:
    """Return the SHA-256 over the files of a package: code, models, recorded motion, statistics."""
    found = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            found.update(f"{path.relative_to(folder).as_posix()}\0".encode())
            found.update(hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()
