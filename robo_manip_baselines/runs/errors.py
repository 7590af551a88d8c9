"""Errors that are one line without a traceback: a wrong request, and a disk that takes no data."""

from __future__ import annotations

import difflib
import errno
import operator
import os
import re
from collections.abc import Iterable
from typing import Any

_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
_PATH = {errno.ENAMETOOLONG, errno.ELOOP, errno.EACCES}
_NUMBER = re.compile(r"(?:\[Errno |errno = |os error )(\d+)")  # HDF5 and safetensors say it in text


class RequestError(ValueError):
    """The user asked for something that cannot be done: one line, no traceback, exit code 2.

    The message says what was given, what is valid and what to do.
    """


class WriteError(RuntimeError):
    """The disk took no data, though the request was right: one line, no traceback, exit code 1.

    The message names the file and the reason.
    """


def disk_problem(error: BaseException) -> str | None:
    """Reason for which the disk took no data, if that is the cause of an error; None otherwise."""
    cause: BaseException | None = error
    while cause is not None:
        number = getattr(cause, "errno", None)
        if not isinstance(number, int):
            match = _NUMBER.search(str(cause))
            number = int(match[1]) if match else None
        if number in _DISK:
            return os.strerror(number)
        cause = cause.__cause__ or cause.__context__
    return None


def path_problem(error: BaseException) -> str | None:
    """Reason for which a path cannot be used, with the path, if that is the error; else None."""
    if not isinstance(error, OSError) or error.errno not in _PATH or error.filename is None:
        return None
    return f"'{os.fsdecode(error.filename)}': {os.strerror(error.errno)}; name another path"


def require_choice(what: str, given: str, valid: Iterable[str]) -> str:
    """Return ``given`` if it is one of ``valid``.

    Raises:
        RequestError: naming the valid choices, and the nearest one if there is any.
    """
    choices = sorted(valid)
    if isinstance(given, str) and given in choices:
        return given
    text = given if isinstance(given, str) else " ".join(repr(given).split())
    text = text if len(text) <= 80 else f"{text[:80]}…"
    close = difflib.get_close_matches(text, choices, n=1)
    hint = f" (did you mean '{close[0]}'?)" if close else ""
    raise RequestError(f"unknown {what} '{text}'{hint}; valid: {', '.join(choices)}")


def require_integer(what: str, given: Any, low: int, high: int, unit: str = "") -> int:
    """Return an integer of Python or NumPy as an ``int``, if it is within ``low`` to ``high``.

    Raises:
        RequestError: it is out of range, or no integer; ``True`` is none.
    """
    if not isinstance(given, bool):
        try:
            number = operator.index(given)
        except TypeError:
            number = None
        if number is not None and low <= number <= high:
            return number
    raise RequestError(f"{what} {given!r}: must be {low} to {high}{unit}, a whole number")


def require_printable(what: str, given: str, length: int = 200) -> str:
    """Return ``given`` if it is one line without control characters, and not too long.

    Figures, tables and pages show it as it is.

    Raises:
        RequestError: it is not.
    """
    if len(given) > length:
        raise RequestError(f"{what} '{given[:80]}…': must have {length} characters or fewer")
    for letter in given:
        if not letter.isprintable():
            raise RequestError(f"{what} {given!a}: must be one line, without {letter!a}")
    return given
