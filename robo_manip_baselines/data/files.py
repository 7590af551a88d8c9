"""Names of episode files, and files that are either whole or not there."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from robo_manip_baselines.runs.errors import RequestError

FAILED_FOLDER = "failed"
_EPISODE_NAME = re.compile(r"episode_(\d{6,})\.hdf5")
_TEMPORARY_NAME = re.compile(r"\..+\.(\d+)\.partial")


def episode_path(folder: str | Path, seed: int, success: bool) -> Path:
    """Where the episode of a seed belongs: ``episode_000012.hdf5``, failures under ``failed/``."""
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


def finished_seeds(folder: str | Path) -> set[int]:
    """Seeds whose episode is there, as a demonstration or under ``failed/``.

    A killed run leaves only whole files, so a name is enough to know that a seed is done.
    """
    folders = [part for part in (Path(folder), Path(folder) / FAILED_FOLDER) if part.is_dir()]
    names = [path.name for part in folders for path in list_episodes(part)]
    return {seed for name in names if (seed := seed_of(name)) is not None}


def prepare_folder(folder: str | Path) -> Path:
    """Create ``folder`` if need be and make sure that files can be written there.

    Raises:
        RequestError: if it cannot be created or written to.
    """
    folder = Path(folder)
    probe = folder / f".probe.{os.getpid()}.partial"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = error.strerror or error
        raise RequestError(
            f"cannot write to '{folder}': {reason}; choose another folder"
        ) from error
    return folder


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Give a temporary name in the same folder; rename to ``path`` when the block ends well.

    The data are on the disk before the name is. A block that raises leaves nothing; a killed
    process leaves a name that `list_episodes` skips and `remove_temporaries` removes.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield temporary
        _flush_to_disk(temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    with suppress(OSError):  # some network file systems cannot flush a folder
        _flush_to_disk(path.parent)


def remove_temporaries(folder: str | Path) -> list[Path]:
    """Remove what killed runs left in ``folder`` and ``failed/``; returns what was removed.

    Files of a process that is still alive on this machine are left alone.
    """
    removed: list[Path] = []
    for part in (Path(folder), Path(folder) / FAILED_FOLDER):
        for path in sorted(part.glob(".*.partial")) if part.is_dir() else ():
            match = _TEMPORARY_NAME.fullmatch(path.name)
            if match and not _is_alive(int(match[1])):
                path.unlink(missing_ok=True)
                removed.append(path)
    return removed


def _is_alive(process: int) -> bool:
    if process == os.getpid():
        return False  # a number from an earlier run that has come round to us
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _flush_to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
