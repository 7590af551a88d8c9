"""Files and folders that are either complete or absent, and locks on folders."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from robo_manip_baselines.runs.errors import RequestError

_TEMPORARY_NAME = re.compile(r"\..+\.(\d+)\.partial")


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to ``path`` when the block succeeds.

    The data reach the disk before the name does. A block that raises leaves nothing; a killed
    process leaves a name that no reader takes and `remove_temporaries` removes.

    Raises:
        RequestError: the folder cannot be created or written to.
    """
    path = Path(path)
    temporary = _temporary(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as error:
        raise _not_writable(path.parent, error) from error
    try:
        yield temporary
        flush_to_disk(temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    with suppress(OSError):  # some network file systems cannot flush a folder
        flush_to_disk(path.parent)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; rename it to ``folder`` when the block succeeds.

    Raises:
        FileExistsError: ``folder`` exists already.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists")
    temporary = _temporary(folder)
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    try:
        yield temporary
        for path in temporary.iterdir():
            flush_to_disk(path)
        flush_to_disk(temporary)
        temporary.rename(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    with suppress(OSError):
        flush_to_disk(folder.parent)


def remove_folder(folder: Path) -> None:
    """Remove a folder; a process killed meanwhile leaves no folder with files missing."""
    leaving = _temporary(folder)
    folder.rename(leaving)
    shutil.rmtree(leaving, ignore_errors=True)


def remove_temporaries(*folders: Path) -> list[Path]:
    """Remove what killed processes left in ``folders``; return the removed paths.

    Files of a process that is still alive on this machine are left alone.
    """
    removed: list[Path] = []
    for folder in folders:
        for path in sorted(folder.glob(".*.partial")) if folder.is_dir() else ():
            match = _TEMPORARY_NAME.fullmatch(path.name)
            if match and not _is_alive(int(match[1])):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
                removed.append(path)
    return removed


def prepare_folder(folder: str | Path) -> Path:
    """Create ``folder`` if need be and check that files can be written there.

    Raises:
        RequestError: it cannot be created or written to.
    """
    folder = Path(folder)
    probe = folder / f".probe.{os.getpid()}.partial"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise _not_writable(folder, error) from error
    return folder


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a folder for this process, creating it if need be; a killed process holds nothing.

    Args:
        folder: holds the file ``.lock``.
        wait: wait for another process that holds the folder, instead of refusing.

    Raises:
        RequestError: another process holds it, or it cannot be written to.
    """
    prepare_folder(folder)
    descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise RequestError(
                f"'{folder}' is being written by another process; choose another --out"
            ) from error
        yield
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def to_json(value: Any) -> str:
    """Return JSON for people to read: indented, keys in the given order, no NaN."""
    return json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def write_json(path: Path, value: Any) -> None:
    """Write `to_json` of a value atomically."""
    write_text(path, to_json(value))


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def flush_to_disk(path: Path) -> None:
    """Wait until a file or folder has reached the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def _not_writable(folder: Path, error: OSError) -> RequestError:
    reason = error.strerror or error
    return RequestError(f"cannot write to '{folder}': {reason}; choose another folder")


def require_out_file(out: Path, load: Callable[[Path], object] | None = None) -> None:
    """Raise RequestError if ``out`` is a folder, or a file that ``load`` refuses to read."""
    if out.is_dir():
        raise RequestError(f"--out {out}: is a folder; name a file")
    if load is not None and out.exists():
        try:
            load(out)
        except RequestError as error:
            raise RequestError(f"{error}; it is in the way of --out, so remove it first") from None


def require_out_folder(out: Path) -> None:
    """Raise RequestError if ``out`` is a file."""
    if out.exists() and not out.is_dir():
        raise RequestError(f"--out {out}: is a file; name a folder")


def _is_alive(process: int) -> bool:
    if process == os.getpid():
        return False  # a process id that an earlier run had, too
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
