"""The folder of a training run: one process at a time, and always the same run."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from face_prediction.errors import RequestError


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder for one training process; a killed process holds nothing.

    Raises:
        RequestError: another process holds it, or it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise RequestError(
            f"--out {folder}: cannot be written ({error.strerror}); choose another folder"
        ) from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RequestError(
                f"--out {folder}: another process trains here; choose another folder"
            ) from None
        for partial in folder.glob(".*.partial"):  # of a process that was killed while writing
            partial.unlink()
        yield
    finally:
        os.close(descriptor)


def require_same_run(folder: Path, there: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Check that the run in ``folder`` is the one that is asked for.

    Raises:
        RequestError: it is another; the first difference is named.
    """
    for name, old, new in _differences(there, now):
        raise RequestError(
            f"--out {folder}: holds a run with {name} {old}, not {new}; "
            "choose another folder, or give the same options"
        )


def _differences(there: Any, now: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    if isinstance(there, Mapping) and isinstance(now, Mapping):
        for key in [*now, *(key for key in there if key not in now)]:
            inner = f"{name}.{key}" if name else str(key)
            yield from _differences(there.get(key), now.get(key), inner)
    elif there != now:
        yield name, there, now
