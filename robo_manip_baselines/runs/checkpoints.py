"""Checkpoint folders: complete or absent, refused when anything in them is damaged.

``manifest.json`` names schema, version and the SHA-256 of every other file; a folder that has its
final name is complete, because it is renamed to it after everything has reached the disk.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from robo_manip_baselines.runs.documents import Schema, read_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import (
    atomic_folder,
    file_digest,
    remove_folder,
    remove_temporaries,
    write_json,
)

SCHEMA = Schema("robo_manip_baselines/checkpoint", 1)
MANIFEST = "manifest.json"
CHECKPOINTS = "checkpoints"
"""Folder of a run that holds its checkpoints."""

BEST = "best"
"""Folder of a run that holds its best checkpoint, laid out as a run folder."""

_STEP_NAME = re.compile(r"step_(\d{8,})")


@dataclass(frozen=True)
class CheckpointManifest:
    """Content of ``manifest.json``; ``sha256``: file name -> 64 hexadecimal digits."""

    sha256: dict[str, str]


def step_folder(run: Path, step: int) -> Path:
    """Return the folder of the checkpoint of a step."""
    return run / CHECKPOINTS / f"step_{step:08d}"


def list_checkpoints(run: Path) -> list[tuple[int, Path]]:
    """The complete checkpoints of a run folder as (step, folder), oldest first."""
    parent = run / CHECKPOINTS
    folders = [path for path in parent.iterdir() if path.is_dir()] if parent.is_dir() else []
    matches = [(_STEP_NAME.fullmatch(path.name), path) for path in folders]
    return sorted((int(match[1]), path) for match, path in matches if match)


def find_checkpoint(path: Path) -> Path:
    """Return the checkpoint folder that a path means: itself, or the newest of a run folder.

    Raises:
        RequestError: there is none.
    """
    if (path / MANIFEST).is_file():
        return path
    if checkpoints := list_checkpoints(path):
        return checkpoints[-1][1]
    if not path.exists():
        raise RequestError(
            f"checkpoint '{path}' does not exist; give a run folder or a checkpoint folder, "
            f"for example runs/act_current/{CHECKPOINTS}/step_00005000"
        )
    reason = f"it has neither {MANIFEST} nor {CHECKPOINTS}/step_*"
    if (path / CHECKPOINTS).is_dir():
        reason = "its run has saved none yet"
    raise RequestError(f"'{path}' is no checkpoint: {reason}; give a folder that bin/Train.py made")


@contextmanager
def checkpoint_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; write its manifest and rename it to ``folder`` at the end.

    Raises:
        FileExistsError: there is such a folder already.
    """
    with atomic_folder(folder) as temporary:
        yield temporary
        digests = {path.name: file_digest(path) for path in sorted(temporary.iterdir())}
        manifest = {**SCHEMA.to_json(), "sha256": digests}
        write_json(temporary / MANIFEST, manifest)
        mode = (temporary / MANIFEST).stat().st_mode
        for path in temporary.iterdir():
            path.chmod(mode)  # safetensors gives its files to the owner alone


def remove_partial_checkpoints(run: Path) -> None:
    """Remove what killed processes left among a run's checkpoints."""
    remove_temporaries(run / CHECKPOINTS)


def prune_checkpoints(run: Path, kept: int) -> None:
    """Keep the newest checkpoints only."""
    for _, folder in list_checkpoints(run)[:-kept]:
        remove_folder(folder)


def remove_later_checkpoints(run: Path, step: int) -> None:
    """Remove the checkpoints of steps after ``step``."""
    for later, folder in list_checkpoints(run):
        if later > step:
            remove_folder(folder)


def read_manifest(folder: Path) -> dict[str, str]:
    """Return file name -> SHA-256 of a checkpoint folder.

    Raises:
        RequestError: it is not a checkpoint, or of a newer schema.
    """
    return read_json(folder / MANIFEST, CheckpointManifest, SCHEMA).sha256


def verify(folder: Path, digests: Mapping[str, str], name: str) -> Path:
    """Return the path of a file of a checkpoint whose contents are as they were written.

    Raises:
        RequestError: the file is missing, truncated or changed.
    """
    path = folder / name
    if name not in digests or not path.is_file():
        raise RequestError(f"checkpoint '{folder}' is incomplete: {name} is missing")
    if file_digest(path) != digests[name]:
        raise RequestError(
            f"checkpoint '{folder}' is damaged: {name} is not what was written (truncated or "
            "changed); copy it again, or remove the folder to use an earlier checkpoint"
        )
    return path
