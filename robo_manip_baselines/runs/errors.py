"""The one error that means "the request was wrong", and how its message is phrased."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class RequestError(ValueError):
    """The user asked for something that cannot be done: one line, no traceback, exit code 2.

    The message says what was given, what is valid and what to do.
    """


def require_choice(what: str, given: str, valid: Iterable[str]) -> str:
    """Return ``given`` if it is one of ``valid``.

    Raises:
        RequestError: naming the valid choices, and the nearest one if there is any.
    """
    choices = sorted(valid)
    if given in choices:
        return given
    text = given if len(given) <= 80 else f"{given[:80]}…"
    close = difflib.get_close_matches(text, choices, n=1)
    hint = f" (did you mean '{close[0]}'?)" if close else ""
    raise RequestError(f"unknown {what} '{text}'{hint}; valid: {', '.join(choices)}")


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
