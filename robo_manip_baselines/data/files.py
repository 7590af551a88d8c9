"""Names of episode files."""

from __future__ import annotations

import re
from pathlib import Path

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import remove_temporaries

FAILED_FOLDER = "failed"
UNRENDERED_FOLDER = "unrendered"
"""Episodes of teleoperation whose images have not been drawn yet."""
_EPISODE_NAME = re.compile(r"episode_(\d{6,})\.hdf5")


def episode_path(folder: str | Path, seed: int, success: bool) -> Path:
    """Return the path of a seed's episode: ``episode_000012.hdf5``, failures under ``failed/``."""
    if seed < 0:
        raise RequestError(f"a seed is 0 or more, not {seed}")
    parent = Path(folder) if success else Path(folder) / FAILED_FOLDER
    return parent / f"episode_{seed:06d}.hdf5"


def seed_of(path: str | Path) -> int | None:
    """The seed in an episode file's name; None if it is not such a name."""
    match = _EPISODE_NAME.fullmatch(Path(path).name)
    return int(match[1]) if match else None


def list_episodes(folder: str | Path) -> list[Path]:
    """The episode files of a folder by seed, without temporaries and without ``failed/``.

    Raises:
        RequestError: if there is no such folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RequestError(f"'{folder}' is no folder; give one that holds episode_*.hdf5 files")
    found = [(seed, path) for path in folder.iterdir() if (seed := seed_of(path)) is not None]
    return [path for _, path in sorted(found)]


def list_failures(folder: str | Path) -> list[Path]:
    """The episode files in ``failed/`` of a folder by seed; none if there is no such folder."""
    failed = Path(folder) / FAILED_FOLDER
    return list_episodes(failed) if failed.is_dir() else []


def finished_seeds(folder: str | Path) -> set[int]:
    """Seeds whose episode is there, as a demonstration or under ``failed/``.

    A killed run leaves only whole files, so a name is enough to know that a seed is done.
    """
    paths = list_episodes(folder) if Path(folder).is_dir() else []
    return {seed for path in paths + list_failures(folder) if (seed := seed_of(path)) is not None}


def remove_partial_episodes(folder: str | Path) -> list[Path]:
    """Remove what killed runs left in ``folder`` and ``failed/``; return the removed paths."""
    return remove_temporaries(Path(folder), Path(folder) / FAILED_FOLDER)
