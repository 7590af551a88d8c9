"""Folders of a checkpoint: written whole or not at all, refused when anything in them is damaged.

``manifest.json`` names schema, version and the SHA-256 of every other file; a folder that has its
final name is complete, because it is renamed to it after everything has reached the disk.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from robo_manip_baselines.runs.errors import RequestError

SCHEMA = "robo_manip_baselines/checkpoint"
SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
CHECKPOINTS = "checkpoints"
"""Folder of a run that holds its checkpoints."""

_STEP_NAME = re.compile(r"step_(\d{8,})")
_BLOCK = 1 << 20


def step_folder(run: Path, step: int) -> Path:
    """Where a run keeps the checkpoint of a step."""
    return run / CHECKPOINTS / f"step_{step:08d}"


def list_checkpoints(run: Path) -> list[tuple[int, Path]]:
    """The complete checkpoints of a run folder as (step, folder), oldest first."""
    parent = run / CHECKPOINTS
    found = [
        (int(match[1]), path)
        for path in (parent.iterdir() if parent.is_dir() else ())
        if (match := _STEP_NAME.fullmatch(path.name)) and path.is_dir()
    ]
    return sorted(found)


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
    reason = (
        "its run has saved none yet"
        if (path / CHECKPOINTS).is_dir()
        else f"it has neither {MANIFEST} nor {CHECKPOINTS}/step_*"
    )
    raise RequestError(f"'{path}' is no checkpoint: {reason}; give a folder that bin/Train.py made")


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """Give a temporary folder; write its manifest and rename it to ``folder`` at the end.

    A block that raises leaves nothing; a killed process leaves a name that no reader takes and
    `remove_partial` removes.

    Raises:
        FileExistsError: there is such a folder already.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists")
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        digests = {path.name: file_digest(path) for path in sorted(temporary.iterdir())}
        manifest = {"schema": SCHEMA, "version": SCHEMA_VERSION, "sha256": digests}
        write_json(temporary / MANIFEST, manifest)
        mode = (temporary / MANIFEST).stat().st_mode
        for path in temporary.iterdir():
            path.chmod(mode)  # safetensors gives its files to the owner alone
            _flush(path)
        _flush(temporary)
        temporary.rename(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    with suppress(OSError):  # some network file systems cannot flush a folder
        _flush(folder.parent)


def remove_partial(run: Path) -> None:
    """Remove what killed processes left among a run's checkpoints."""
    for path in (run / CHECKPOINTS).glob(".step_*.partial"):
        shutil.rmtree(path, ignore_errors=True)


def read_manifest(folder: Path) -> dict[str, str]:
    """Return file name -> SHA-256 of a checkpoint folder.

    Raises:
        RequestError: it is not a checkpoint, or of a newer schema.
    """
    manifest = read_json(folder / MANIFEST)
    if manifest.get("schema") != SCHEMA:
        raise RequestError(f"'{folder}' is no checkpoint: {MANIFEST} does not say '{SCHEMA}'")
    version = manifest.get("version")
    if version != SCHEMA_VERSION:
        raise RequestError(
            f"checkpoint '{folder}' has version {version}, this package reads {SCHEMA_VERSION}; "
            "use the package that wrote it"
        )
    digests = manifest.get("sha256")
    if not isinstance(digests, dict):
        raise RequestError(f"checkpoint '{folder}' is damaged: {MANIFEST} lists no files")
    return digests


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


def file_digest(path: Path) -> str:
    """SHA-256 of a file, 64 hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def write_json(path: Path, value: Any) -> None:
    """Write JSON for people to read: indented, keys in the given order, no NaN."""
    text = json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        RequestError: it is missing, or no JSON object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RequestError(f"cannot read '{path}': {error.strerror or error}") from error
    except ValueError as error:
        raise RequestError(f"'{path}' is damaged: {error}") from error
    if not isinstance(value, dict):
        raise RequestError(f"'{path}' is damaged: it holds no JSON object")
    return value


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
