"""Optional dependencies of the package: the command that installs an extra where it runs."""

from __future__ import annotations

import re
import shlex
import sys
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from robo_manip_baselines.runs.versions import PACKAGE

DISTRIBUTION = "robo_manip_baselines"

_MARKER = re.compile(r"""extra\s*==\s*['"]([^'"]+)['"]""")


def install_command(extra: str, source: Path = PACKAGE.parent) -> str:
    """Return the shell command that installs an extra for the running Python.

    No index holds this package. From a checkout, as `make` installs it, the command installs the
    checkout itself with the tested versions; where only a wheel was installed, it installs the
    requirements of the extra by name.

    Args:
        extra: ``train``, ``face-prediction``, ``ray``, ``rl`` or ``dev``.
        source: folder that holds the package, the root of a checkout or ``site-packages``.
    """
    if (source / "pyproject.toml").is_file():
        pins = source / "constraints.txt"
        tested = ("-c", str(pins)) if pins.is_file() else ()
        return pip_install(*tested, "-e", f"{source}[{extra}]")
    return pip_install(*requirements(extra))


def pip_install(*arguments: str) -> str:
    """Return the shell command that installs something for the running Python."""
    return shlex.join([sys.executable, "-m", "pip", "install", *arguments])


def requirements(extra: str) -> list[str]:
    """Return the requirements that an extra adds to the installed package, without markers.

    Raises:
        ValueError: the package has no such extra.
    """
    try:
        declared = requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        declared = []
    parts = [text.partition(";") for text in declared]
    found = [
        requirement.strip()
        for requirement, _, marker in parts
        if (match := _MARKER.search(marker)) and _plain(match[1]) == _plain(extra)
    ]
    if not found:
        raise ValueError(f"{DISTRIBUTION} has no extra '{extra}'")
    return found


def _plain(extra: str) -> str:
    """Return an extra's name as packaging tools compare it."""
    return re.sub(r"[-_.]+", "-", extra).lower()
