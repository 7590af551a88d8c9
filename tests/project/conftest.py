"""Input of the project's tests: the files that are, or are about to be, in git."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def project_files(repository: Path) -> list[Path]:
    """Every file of the project, relative to its root: tracked ones, and new ones not ignored."""
    listing = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=repository,
        capture_output=True,
        text=True,
        check=False,
    )
    if listing.returncode:
        pytest.skip("not a git checkout")
    names = [Path(name) for name in listing.stdout.split("\0") if name]
    return [name for name in names if (repository / name).is_file()]
