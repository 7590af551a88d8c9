"""Ranges of numbers: declared once, in the types of dataclasses, for command lines and files alike.

A field ``Annotated[int, Interval(ge=1, le=5)]`` holds 1 to 5. `runs.command.parse` and
`runs.documents.convert` check what they make; a dataclass that is made in other ways, too, calls
`require_ranges` in its ``__post_init__``.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Iterable, Iterator
from functools import cache
from typing import Annotated, Any, Literal

from annotated_types import Interval

from robo_manip_baselines.runs.documents import shown
from robo_manip_baselines.runs.errors import RequestError

MAX_SEED = 2**53 - 1
"""Largest seed: JavaScript, which shows reports, has all integers up to it."""

Seed = Annotated[int, Interval(ge=0, le=MAX_SEED)]
Count = Annotated[int, Interval(ge=1, le=10**9)]
NonNegativeInt = Annotated[int, Interval(ge=0, le=10**9)]
Episodes = Annotated[int, Interval(ge=1, le=10**6)]
Processes = Annotated[int, Interval(ge=0, le=1024)]
Quality = Annotated[int, Interval(ge=1, le=100)]
"""Quality of JPEG."""
Amount = Annotated[float, Interval(ge=0.0)]
Positive = Annotated[float, Interval(gt=0.0)]
Fraction = Annotated[float, Interval(ge=0.0, lt=1.0)]

_INTEGER = Interval(ge=-(1 << 63), lt=1 << 63)
"""Range of numbers that declare none."""


def require_ranges(config: Any, given: str = "{} {}") -> None:
    """Require every number of a dataclass, and of dataclasses in it, to be within its range.

    Floats are finite, whatever their range; None is valid. Values of a ``Literal`` are one of it,
    or a number where the type has one beside it.

    Args:
        config: a dataclass.
        given: format of a name and a value in messages.

    Raises:
        RequestError: naming the first number that is not.
    """
    for name, option, interval in number_fields(type(config)):
        value = getattr(config, name)
        for number in value if isinstance(value, (tuple, list)) else (value,):
            _require(given.format(option, shown(number)), number, interval)
    for name, choices, numbers in _choices(type(config)):
        value = getattr(config, name)
        if value not in (*choices, None) and not isinstance(value, numbers):
            valid = ", ".join([*map(str, choices), *["a number"] * bool(numbers)])
            raise RequestError(f"{given.format(name, shown(value))}: unknown; valid: {valid}")
    for item in dataclasses.fields(config):
        part = getattr(config, item.name)
        if dataclasses.is_dataclass(part) and not isinstance(part, type):
            require_ranges(part, given)


def require_range(name: str, value: float, kind: Any) -> None:
    """Require a number to be within the range of a type such as `Count`.

    Raises:
        RequestError: it is not.
    """
    _require(f"{name} {shown(value)}", value, _range_of(_parts(kind)))


def describe_range(interval: Interval | None, is_float: bool = False) -> str:
    """Describe a range: ``1 to 5``, ``0 or more, less than 1``, ``more than 0, and finite``."""
    if interval is None:
        return "finite" if is_float else "of 64 bits"
    ge, gt, le, lt = (_plain(end) for end in (interval.ge, interval.gt, interval.le, interval.lt))
    if ge is not None and le is not None:
        return f"{ge} to {le}"
    low = f"{ge} or more" if ge is not None else f"more than {gt}" if gt is not None else ""
    high = f"{le} or less" if le is not None else f"less than {lt}" if lt is not None else ""
    both = ", ".join(part for part in (low, high) if part)
    return both if high or not is_float else f"{both}, and finite"


def _require(given: str, number: Any, interval: Interval | None) -> None:
    if not isinstance(number, (int, float)):
        return
    is_float = isinstance(number, float)
    if not _holds(number, interval or (Interval() if is_float else _INTEGER)):
        wanted = describe_range(interval, is_float)
        raise RequestError(f"{given}: must be {wanted}")


def _range_of(parts: Iterable[Any]) -> Interval | None:
    return next((part for part in parts if isinstance(part, Interval)), None)


def _plain(end: Any) -> str | None:
    return None if end is None else f"{end:.15g}" if isinstance(end, float) else str(end)


def _holds(number: float, interval: Interval) -> bool:
    ends: Any = interval
    return (
        (isinstance(number, int) or math.isfinite(number))
        and (ends.ge is None or number >= ends.ge)
        and (ends.gt is None or number > ends.gt)
        and (ends.le is None or number <= ends.le)
        and (ends.lt is None or number < ends.lt)
    )


@cache
def number_fields(kind: type) -> list[tuple[str, str, Interval | None]]:
    """Return the fields of a dataclass that hold numbers.

    Each is (name, name on a command line, range); the range is None where none is declared.
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    found = []
    for item in dataclasses.fields(kind):
        parts = list(_parts(hints[item.name]))
        if any(part in (int, float) for part in parts):
            option = next((name for part in parts if (name := getattr(part, "name", None))), None)
            found.append((item.name, option or item.name, _range_of(parts)))
    return found


@cache
def _choices(kind: type) -> list[tuple[str, tuple[Any, ...], tuple[type, ...]]]:
    """Return the fields of a dataclass whose type is a ``Literal``, or one of those and a number.

    Each is (name, values of the ``Literal``, types of numbers).
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    found = []
    for item in dataclasses.fields(kind):
        parts = list(_parts(hints[item.name]))
        numbers = tuple(part for part in parts if part in (int, float))
        literals = [part for part in parts if typing.get_origin(part) is Literal]
        found += [(item.name, typing.get_args(part), numbers) for part in literals]
    return found


def _parts(hint: Any) -> Iterator[Any]:
    """Yield a type with all types and annotations in it."""
    yield hint
    for part in (*typing.get_args(hint), *getattr(hint, "__metadata__", ())):
        yield from _parts(part)
