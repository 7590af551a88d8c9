"""Large arrays that the processes of one user hold only once between them (Linux).

The memory has no name in any file system: it is freed with the last process that holds it, however
that ends. Processes reach it through one another's open files, which lists in the temporary folder
name.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.files import locked_file, write_text

Bytes = NDArray[np.uint8]


class SharedArray:
    """Array that this process holds together with others.

    Attributes:
        array: uint8, read-only.
    """

    def __init__(self, descriptor: int, shape: tuple[int, ...]) -> None:
        memory = mmap.mmap(descriptor, math.prod(shape), prot=mmap.PROT_READ)
        self.array: Bytes = np.frombuffer(memory, np.uint8).reshape(shape)
        self._descriptor: int | None = descriptor

    def close(self) -> None:
        """Let no further process find the array here; may be called again."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def shared_array(
    key: str, shape: tuple[int, ...], fill: Callable[[Bytes], object], budget: int
) -> SharedArray | None:
    """Return the array of a key; the first process that asks for it fills it, others wait.

    Args:
        key: of the content: letters, digits, - and _, at most 200.
        shape: of the array, not empty.
        fill: writes the content to the array that it is given.
        budget: bytes that the array may take where no process holds it yet.

    Returns:
        The array; None where it exceeds the budget, or the system has no such memory.
    """
    folder = _folder()
    if folder is None or not math.prod(shape):
        return None
    holders = folder / key
    with locked_file(holders, wait=True):
        names = holders.read_text(encoding="ascii").split() if holders.exists() else []
        names = [name for name in names if _is_held(name, key)]
        descriptor = _open(names, math.prod(shape))
        if descriptor is None:
            if math.prod(shape) > budget:
                return None
            descriptor = _make(key, shape, fill)
        write_text(holders, "\n".join([*names, f"/proc/{os.getpid()}/fd/{descriptor}"]))
    return SharedArray(descriptor, shape)


def _is_held(name: str, key: str) -> bool:
    """Return whether the file of a process is still the memory of this key."""
    with suppress(OSError):
        return Path(name).readlink().as_posix().startswith(f"/memfd:{key} ")
    return False


def _open(names: list[str], size: int) -> int | None:
    for name in names:
        with suppress(OSError):  # the process has ended since
            descriptor = os.open(name, os.O_RDONLY)
            if os.fstat(descriptor).st_size == size:
                return descriptor
            os.close(descriptor)
    return None


def _make(key: str, shape: tuple[int, ...], fill: Callable[[Bytes], object]) -> int:
    descriptor = os.memfd_create(key)
    try:
        os.ftruncate(descriptor, math.prod(shape))
        fill(np.frombuffer(mmap.mmap(descriptor, math.prod(shape)), np.uint8).reshape(shape))
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _folder() -> Path | None:
    """Return the folder of the lists, this user's alone; None where there can be none."""
    if not hasattr(os, "memfd_create") or not Path("/proc/self/fd").is_dir():
        return None
    folder = Path(tempfile.gettempdir()) / f"robo_manip_baselines-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return None
    is_private = status.st_uid == os.getuid() and not status.st_mode & 0o077
    return folder if is_private and folder.is_dir() and not folder.is_symlink() else None
