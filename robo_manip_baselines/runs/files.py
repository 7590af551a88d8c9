"""Files and folders that are either complete or absent, what may be replaced, and locks.

Strings hold bytes of paths that are no UTF-8 as Python does (``surrogateescape``): text files keep
the bytes, JSON has them as escapes.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robo_manip_baselines.runs.errors import RequestError, WriteError, disk_problem

if TYPE_CHECKING:
    import h5py

LOCK = ".lock"
"""File by which a process holds a folder."""

_TEMPORARY_NAME = re.compile(r"\..+\.(\d+)\.partial")
_SURROGATE = re.compile(r"[\ud800-\udfff]")


@contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to ``path`` when the block succeeds.

    The data reach the disk before the name does. A block that raises leaves nothing; a killed
    process leaves a name that no reader takes and `remove_temporaries` removes.

    Raises:
        RequestError: the folder cannot be created or written to.
        WriteError: the disk is full, or fails.
    """
    path = Path(path)
    temporary = _temporary(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as error:
        raise _not_writable(path.parent, error) from error
    with disk_errors(path):
        try:
            yield temporary
            flush_to_disk(temporary)
            temporary.replace(path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
    with suppress(OSError):  # some network file systems cannot flush a folder
        flush_to_disk(path.parent)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; rename it to ``folder`` when the block succeeds.

    Raises:
        FileExistsError: ``folder`` exists already.
        WriteError: the disk is full, or fails.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists")
    temporary = _temporary(folder)
    shutil.rmtree(temporary, ignore_errors=True)
    with disk_errors(folder):
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


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn errors of a full or failing disk, while ``path`` is written, into a `WriteError`.

    Raises:
        WriteError: naming the path and the reason.
    """
    try:
        yield
    except (RequestError, WriteError):
        raise
    except Exception as error:
        if reason := disk_problem(error):
            raise _not_written(path, reason) from error
        raise


@contextmanager
def atomic_hdf5(path: str | Path, libver: tuple[str, str]) -> Iterator[h5py.File]:
    """Yield an HDF5 file in memory; write it to ``path``, whole or not at all, at the end.

    HDF5 cannot close a file that it could not write: on a full disk the process crashes later.

    Raises:
        RequestError: the folder cannot be created or written to.
        WriteError: the disk is full, or fails.
    """
    import h5py  # not needed by most commands

    with h5py.File("memory", "w", libver=libver, driver="core", backing_store=False) as file:
        yield file
        file.flush()
        content = file.id.get_file_image()
    with atomic_file(path) as temporary:
        temporary.write_bytes(content)


class AppendFile:
    """File that grows by whole records.

    Args:
        path: made if it does not exist.
        is_flushed: whether a record has reached the disk when `append` returns.
    """

    def __init__(self, path: Path, *, is_flushed: bool = False) -> None:
        self._path, self._is_flushed = path, is_flushed
        with disk_errors(path):
            self._file = path.open("ab", buffering=0)

    def append(self, record: bytes) -> None:
        """Append a record.

        Raises:
            WriteError: the disk is full, or fails; the file is as it was.
        """
        rest = memoryview(record)
        size = os.fstat(self._file.fileno()).st_size
        with disk_errors(self._path):
            try:
                while rest:
                    rest = rest[self._file.write(rest) :]
                if self._is_flushed:
                    os.fsync(self._file.fileno())
            except OSError:
                with suppress(OSError):
                    os.ftruncate(self._file.fileno(), size)
                raise

    def close(self) -> None:
        """Close the file; may be called again."""
        self._file.close()


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
def locked(folder: Path, *, wait: bool = False, is_kept: bool = True) -> Iterator[None]:
    """Hold a folder for this process; a killed process holds nothing.

    It has the file ``.lock`` from then on. After a request that is refused, the file is removed if
    it is new, and so is a folder that was made for it.

    Args:
        folder: to be written.
        wait: wait for another process that holds the folder, instead of refusing.
        is_kept: whether the file stays in the folder at the end.

    Raises:
        RequestError: another process holds it, or it cannot be written to.
    """
    is_new = not (folder / LOCK).exists()
    with _lock(folder / LOCK, folder, wait) as lock:
        try:
            yield
        except (RequestError, WriteError):
            if is_new:
                lock.unlink(missing_ok=True)
            raise
        finally:
            if not is_kept:
                lock.unlink(missing_ok=True)


@contextmanager
def locked_file(path: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold one file that is to be written, as `locked` does a folder; nothing is left beside it.

    Raises:
        RequestError: another process holds it, or its folder cannot be written to.
    """
    with _lock(path.with_name(f".{path.name}{LOCK}"), path, wait) as lock:
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


@contextmanager
def _lock(lock: Path, what: Path, wait: bool) -> Iterator[Path]:
    """Yield the file by which ``what`` is held; it may be removed while it is.

    Folders that are made for it are removed again if they are empty at the end.
    """
    made = [path for path in lock.parents if not path.exists()]
    while True:
        prepare_folder(lock.parent)
        try:
            descriptor = os.open(lock, os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:  # another process has just removed the folder, which it had made
            continue
        except OSError as error:
            raise _not_writable(lock.parent, error) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            # The process that held it may have removed the file before it let go of it.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(descriptor), lock.stat()):
                    break
        except BlockingIOError as error:
            os.close(descriptor)
            raise RequestError(
                f"'{what}' is being written by another process; choose another --out, or wait for "
                "its end"
            ) from error
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
    try:
        yield lock
    finally:
        os.close(descriptor)
        with suppress(OSError):  # the first that is not empty
            for path in made:
                path.rmdir()


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically; bytes of paths that are no UTF-8 are kept."""
    with atomic_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape")


def to_json(value: Any, indent: int = 2) -> str:
    """Return JSON for people to read: indented, keys in the given order, no NaN."""
    text = json.dumps(value, indent=indent, allow_nan=False, ensure_ascii=False) + "\n"
    return escape_surrogates(text)


def escape_surrogates(json_text: str) -> str:
    """Escape, in JSON, bytes of paths that are no UTF-8: every program reads it then."""
    return _SURROGATE.sub(lambda found: f"\\u{ord(found[0]):04x}", json_text)


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


def _not_writable(folder: Path, error: OSError) -> RequestError | WriteError:
    reason = error.strerror or error
    if error.errno != errno.EROFS and disk_problem(error):
        return _not_written(folder, str(reason))
    return RequestError(f"cannot write to '{folder}': {reason}; choose another folder")


def _not_written(path: Path, reason: str) -> WriteError:
    return WriteError(f"cannot write '{path}': {reason}; make room, or choose another folder")


# -- what a command may write, and where ----------------------------------------------------------


@dataclass(frozen=True)
class FileKind:
    """Kind of file that a command makes.

    Attributes:
        name: for messages.
        read: raises RequestError for a file of any other kind; only what it takes is replaced.
        suffix: that the name must have; empty: any.
    """

    name: str
    read: Callable[[Path], object]
    suffix: str = ""


@dataclass(frozen=True)
class FolderKind:
    """Kind of folder that a command makes.

    Attributes:
        name: for messages.
        is_own: returns whether a folder is of this kind, by files with a schema; may raise
            RequestError.
        begun: returns whether a path in a folder is what the command makes first, so that it may
            be alone there after a run was killed.
    """

    name: str
    is_own: Callable[[Path], bool]
    begun: Callable[[Path], bool] = lambda path: False


def require_out_file(
    out: Path, kind: FileKind, inputs: Iterable[Path | None] = (), *, option: str = "--out"
) -> None:
    """Make sure that a file can be written and that nothing is lost by it, before any work.

    Args:
        out: the file; it may exist if it is of ``kind``.
        kind: of file that the command makes.
        inputs: files and folders that the command reads, and other files that it writes; nothing
            is written over or into them.
        option: name of the option, for messages.

    Raises:
        RequestError: naming what is in the way.
    """
    mode = _mode(out, option)
    if mode is not None and stat.S_ISDIR(mode):
        raise RequestError(f"{option} {out}: is a folder; name a file")
    if mode is not None and not stat.S_ISREG(mode):
        raise RequestError(f"{option} {out}: is a device or a pipe; name a file")
    for given in filter(None, inputs):
        is_same = mode is not None and given.exists() and out.samefile(given)
        if is_same or out.resolve() == given.resolve():
            raise RequestError(
                f"{option} {out}: is '{given}', which this command reads or writes, too; name "
                "another file"
            )
        if given.is_dir() and out.resolve().is_relative_to(given.resolve()):
            raise RequestError(
                f"{option} {out}: is in '{given}', which is read; name a file elsewhere"
            )
    if kind.suffix and out.suffix.lower() != kind.suffix:
        raise RequestError(f"{option} {out}: is no {kind.name}; name an {kind.suffix} file")
    if mode is not None:
        try:
            kind.read(out)
        except RequestError as error:
            raise RequestError(
                f"{error}; it is in the way of {option}, so remove it first, or name another file"
            ) from None
    _require_writable(out.parent, out, option)


def require_out_folder(
    out: Path,
    kind: FolderKind | None = None,
    inputs: Iterable[Path | None] = (),
    *,
    option: str = "--out",
) -> None:
    """Make sure that a folder can be written to and that nothing is lost by it, before any work.

    Args:
        out: the folder; it may exist if it is empty or of ``kind``.
        kind: of folder that the command makes; None: any, files in it are checked one by one.
        inputs: folders that the command reads; none of them may be ``out``.
        option: name of the option, for messages.

    Raises:
        RequestError: naming what is in the way.
    """
    mode = _mode(out, option)
    if mode is not None and not stat.S_ISDIR(mode):
        raise RequestError(f"{option} {out}: is a file; name a folder")
    if mode is not None:
        if any(given.exists() and out.samefile(given) for given in filter(None, inputs)):
            raise RequestError(f"{option} {out}: is read; name another folder")
        if kind and not kind.is_own(out):
            ours = (LOCK, ".partial")
            try:
                others = [p for p in out.iterdir() if not (p.name.endswith(ours) or kind.begun(p))]
            except OSError as error:
                raise RequestError(f"{option} {out}: {error.strerror}; name a new folder") from None
            if others:
                names = sorted(path.name for path in others)
                listed = ", ".join([*names[:3], *["..."] * (len(names) > 3)])
                raise RequestError(
                    f"{option} {out}: holds {listed} and no {kind.name}; name another folder"
                )
    _require_writable(out, out, option)


def _mode(out: Path, option: str) -> int | None:
    """Return the mode of what is at a path; None where nothing is."""
    try:
        return out.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RequestError(f"{option} {out}: {reason}; choose another name") from None


def _require_writable(folder: Path, out: Path, option: str) -> None:
    """Make sure that a folder can be written to, or made; nothing is left."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise RequestError(f"{option} {out}: '{folder}' is no folder; choose another folder")
    try:
        probe = folder / f".probe.{os.getpid()}.partial"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise _not_writable(out, error) from error


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
