"""The one error that means "the request was wrong", and how its message is phrased."""

from __future__ import annotations

import difflib
import operator
from collections.abc import Iterable
from typing import Any


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
    text = given if isinstance(given, str) else " ".join(repr(given).split())
    if isinstance(given, str) and given in choices:
        return given
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
