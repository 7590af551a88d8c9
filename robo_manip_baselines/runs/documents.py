"""Text documents read from outside: JSON, JSON lines and YAML, checked and converted to a type.

Every text document of the package is read here. It is refused in one line (`RequestError`) unless
it is a regular file within its size, is UTF-8, is nested no deeper than `MAX_DEPTH`, has each name
once, and holds finite numbers and integers of 64 bits only. Its values are then converted to a
type: a dataclass, a ``TypedDict``, a ``dict``, a ``list`` or ``tuple``, a ``Literal``, a number
with a range (``Annotated[int, Interval(ge=1)]``). Nothing is coerced: ``"1"`` is no number, and an
unknown name is refused.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
import re
import stat
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from typing_extensions import is_typeddict

from robo_manip_baselines.runs.errors import RequestError

if typing.TYPE_CHECKING:
    from pydantic_core import ErrorDetails, SchemaValidator

Kind = TypeVar("Kind")

MAX_DEPTH = 64
"""Deepest nesting; the deepest document of the package is 8 deep."""

MAX_NAMES = 10_000
"""Most names of an object."""

MAX_BYTES = 16 << 20
"""Default size of a JSON document."""

IGNORES_OTHERS = {"strict": True, "extra": "ignore", "allow_inf_nan": False}
"""``__pydantic_config__`` of a dataclass that declares a part of a document only."""

MAX_YAML_BYTES = 1 << 20
"""Size of a YAML document, which people write by hand."""

MAX_LINES_BYTES = 1 << 30
"""Size of a file of JSON lines; a line is a document of its own."""

_SHOWN = 80
"""Characters of a value that a message repeats."""

_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_BYTES = range(0xDC80, 0xDD00)
"""Characters that stand for bytes of paths that are no UTF-8 (``surrogateescape``)."""
_TO_PRIVATE = {byte: 0x10FF00 + n for n, byte in enumerate(_BYTES)}
_FROM_PRIVATE = {private: byte for byte, private in _TO_PRIVATE.items()}
"""Characters for private use in place of those, which pydantic's JSON cannot hold."""
_NO_BRACKETS = re.compile(r"[^][{}]+")

_YAML_CONSTANTS = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_YAML_INTEGER = re.compile(r"[-+]?[0-9]+")
_YAML_FLOAT = re.compile(
    r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
)

_PROBLEMS = {
    "missing": "is missing",
    "int_type": "must be a whole number, not {}",
    "int_from_float": "must be a whole number, not {}",
    "float_type": "must be a number, not {}",
    "finite_number": "must be a finite number",
    "string_type": "must be text, not {}",
    "bool_type": "must be true or false, not {}",
    "none_required": "must be null, not {}",
    "list_type": "must be a list, not {}",
    "tuple_type": "must be a list, not {}",
    "dict_type": "must be an object, not {}",
    "dataclass_type": "must be an object, not {}",
    "path_type": "must be a path, not {}",
    "greater_than": "{}: must be more than {gt}",
    "greater_than_equal": "{}: must be {ge} or more",
    "less_than": "{}: must be less than {lt}",
    "less_than_equal": "{}: must be {le} or less",
    "literal_error": "{}: unknown; valid: {expected}",
    "string_pattern_mismatch": "{}: must match {pattern}",
    "string_too_short": "must have {min_length} characters or more",
    "string_too_long": "must have {max_length} characters or fewer",
    "too_short": "must have {min_length} elements or more, not {actual_length}",
    "too_long": "must have {max_length} elements or fewer",
}
"""Kind of a problem, as pydantic calls it -> message about a value."""


def read_bytes(path: Path, limit: int = MAX_BYTES) -> bytes:
    """Read a regular file of at most ``limit`` bytes.

    Raises:
        RequestError: it cannot be read, is a folder, pipe or device, or is larger.
    """
    try:
        # without waiting: opening a pipe would wait for somebody who writes to it
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise RequestError(f"cannot read '{path}': it is a folder, pipe or device, no file")
            with open(descriptor, "rb", closefd=False) as file:
                content = file.read(limit + 1)
        finally:
            os.close(descriptor)
    except RequestError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a path with a null character
        reason = getattr(error, "strerror", None) or error
        raise RequestError(f"cannot read '{path}': {reason}") from error
    if len(content) > limit:
        raise RequestError(f"'{path}' is too large: a file of its kind has {_bytes(limit)} or less")
    return content


def parse_json(text: str, source: str, limit: int = MAX_BYTES) -> Any:
    """Parse JSON from outside.

    Args:
        text: JSON.
        source: first words of messages, such as the quoted path of the file.
        limit: bytes of the text.

    Returns:
        None, bool, int (64 bits), float (finite), str, list or dict.

    Raises:
        RequestError: the text is no JSON, is too large or too deeply nested, has a name twice, a
            number that is not finite, or an integer of more than 64 bits.
    """
    if len(text) > limit:
        raise RequestError(f"{source} is too large: a text of its kind has {_bytes(limit)} or less")
    if _depth(text) > MAX_DEPTH:
        raise RequestError(f"{source} is damaged: nested more than {MAX_DEPTH} deep")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(pairs) > MAX_NAMES:
            raise RequestError(f"{source} is damaged: an object with more than {MAX_NAMES} names")
        names = dict(pairs)
        if len(names) < len(pairs):
            seen: set[str] = set()
            twice = next(name for name, _ in pairs if name in seen or seen.add(name))
            raise RequestError(f"{source} is damaged: {shown(twice)} is there twice")
        return names

    def number(text: str) -> float:
        return _finite(text, source)

    try:
        value = json.loads(
            text,
            object_pairs_hook=unique,
            parse_int=lambda text: _integer(text, source),
            parse_float=number,
            parse_constant=number,
        )
        if _SURROGATE.search(text):
            json.dumps(value, ensure_ascii=False).encode(errors="surrogateescape")
        else:
            text.encode(errors="surrogateescape")
    except RequestError:
        raise
    except UnicodeEncodeError:
        raise RequestError(f"{source} is damaged: it holds half of a surrogate pair") from None
    except ValueError as error:
        raise RequestError(f"{source} is damaged: {shortened(error)}") from None
    return value


Place = tuple[int | str, ...]
"""Names and indices from the top of a document to a value in it."""


class YamlDocument(NamedTuple):
    """Value of a YAML document, and the line on which each value in it begins."""

    value: Any
    lines: dict[Place, int]


def parse_json_bytes(content: bytes, source: str, limit: int = MAX_BYTES) -> Any:
    """Parse JSON in UTF-8; see `parse_json`."""
    return parse_json(_decoded(content, source), source, limit)


def parse_settings(texts: Iterable[str], option: str) -> dict[str, Any]:
    """Parse settings of a command line, NAME=VALUE each: JSON, or else text.

    Raises:
        RequestError: one of them has no value.
    """
    values = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not name or not equals:
            raise RequestError(f"{option} {shown(text)}: must be NAME=VALUE, such as steps=200")
        try:
            values[name] = parse_json(value, f"{option} {name}")
        except RequestError:
            values[name] = value
    return values


def parse_yaml(text: str, source: str) -> YamlDocument:
    """Parse YAML of plain values: text, numbers, true, false, null, lists and mappings.

    Scalars are read as YAML 1.2 does (its core schema): ``1e-4`` is a number, and ``no`` and
    ``2026-01-31`` are text. Anchors, aliases, tags and names that are no scalars are refused.

    Raises:
        RequestError: the text is no such YAML; the message has the line.
    """
    import yaml  # slow to import

    if len(text) > MAX_YAML_BYTES:
        raise RequestError(
            f"{source} is too large: a text of its kind has {_bytes(MAX_YAML_BYTES)} or less"
        )
    reader = _YamlReader(source)
    try:
        # The fast one refuses bytes of paths that are no UTF-8.
        is_plain = _SURROGATE.search(text) is None
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader) if is_plain else yaml.SafeLoader
        for event in yaml.parse(text, Loader=loader):
            reader.take(event)
    except RequestError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f", line {mark.line + 1}" if mark else ""
        problem = shortened(error.problem or error.context or "not valid")
        raise RequestError(f"{source}{place} is no YAML: {problem}") from None
    except (yaml.YAMLError, ValueError, OverflowError, UnicodeError) as error:
        raise RequestError(f"{source} is no YAML: {shortened(error)}") from None
    return YamlDocument(reader.value, reader.lines)


class _YamlReader:
    """Plain value of a stream of YAML events, without recursion."""

    def __init__(self, source: str) -> None:
        self._source = source
        self.value: Any = None
        self.lines: dict[Place, int] = {}
        self._documents = 0
        self._open: list[list[Any] | dict[str, Any]] = []
        self._names: list[str | None] = []  # of each open collection: name that awaits its value

    def take(self, event: Any) -> None:
        """Include the next event."""
        kind = type(event).__name__
        if kind == "DocumentStartEvent":
            self._documents += 1
            if self._documents > 1:
                raise self._problem(event, "it holds more than one document")
        elif kind == "AliasEvent" or getattr(event, "anchor", None) is not None:
            raise self._problem(event, "anchors and aliases are not read; write the value out")
        elif kind in ("SequenceStartEvent", "MappingStartEvent"):
            is_map = kind[0] == "M"
            if event.tag not in (None, "!", f"tag:yaml.org,2002:{'map' if is_map else 'seq'}"):
                raise self._problem(event, "tags are not read; leave it out")
            if len(self._open) == MAX_DEPTH:
                raise self._problem(event, f"nested more than {MAX_DEPTH} deep")
            if self._awaits_name():
                raise self._problem(event, "a name must be text")
            self._mark(event)
            self._open.append({} if is_map else [])
            self._names.append(None)
        elif kind in ("SequenceEndEvent", "MappingEndEvent"):
            self._names.pop()
            self._put(self._open.pop())
        elif kind == "ScalarEvent":
            if event.tag not in (None, "!"):
                raise self._problem(event, "tags are not read; leave it out")
            if any("\ud800" <= letter <= "\udfff" for letter in event.value.translate(_TO_PRIVATE)):
                raise self._problem(event, "it holds half of a surrogate pair")
            if self._awaits_name():
                self._begin(event)
            else:
                self._mark(event)
                self._put(self._scalar(event))

    def _mark(self, event: Any) -> None:
        """Note the line of the value that begins."""
        pairs = zip(self._open, self._names, strict=True)
        place = tuple(len(part) if isinstance(part, list) else str(name) for part, name in pairs)
        self.lines[place] = event.start_mark.line + 1

    def _awaits_name(self) -> bool:
        return bool(self._open) and isinstance(self._open[-1], dict) and self._names[-1] is None

    def _begin(self, event: Any) -> None:
        if event.value in self._open[-1]:
            raise self._problem(event, f"{shown(event.value)} is there twice")
        if len(self._open[-1]) == MAX_NAMES:
            raise self._problem(event, f"a mapping with more than {MAX_NAMES} names")
        if event.value == "<<" and event.implicit[0]:
            raise self._problem(event, "'<<' is not read; write the values out")
        self._names[-1] = event.value

    def _put(self, value: Any) -> None:
        if not self._open:
            self.value = value
            return
        parent, name = self._open[-1], self._names[-1]
        if isinstance(parent, list):
            parent.append(value)
        elif name is not None:
            parent[name], self._names[-1] = value, None

    def _scalar(self, event: Any) -> Any:
        text = event.value
        if not event.implicit[0]:  # quoted
            return text
        if text in _YAML_CONSTANTS:
            return _YAML_CONSTANTS[text]
        source = f"{self._source}, line {event.start_mark.line + 1}"
        if _YAML_INTEGER.fullmatch(text):
            return _integer(text, source)
        if _YAML_FLOAT.fullmatch(text):
            return _finite(text.replace(".", "", 1) if text[-1].isalpha() else text, source)
        return text

    def _problem(self, event: Any, problem: str) -> RequestError:
        return RequestError(f"{self._source}, line {event.start_mark.line + 1}: {problem}")


class Schema(NamedTuple):
    """Name and version of a kind of document, which it holds as ``schema`` and ``version``."""

    name: str
    version: int

    def to_json(self) -> dict[str, Any]:
        """Return the two entries of a document."""
        return {"schema": self.name, "version": self.version}

    def without(self, value: Any, source: str) -> dict[str, Any]:
        """Return an object without its ``schema`` and ``version``.

        Raises:
            RequestError: it is no object, or of another schema or version.
        """
        rest = dict(convert(value, dict, source))
        name, version = rest.pop("schema", None), rest.pop("version", None)
        if type(version) is not int or (name, version) != self:
            raise RequestError(
                f"{source}: schema {shown(name)} version {shown(version)}, this release reads "
                f"'{self.name}' {self.version}; use the release that wrote it"
            )
        return rest


def read_json(
    path: Path,
    kind: type[Kind] = dict,
    schema: Schema | None = None,
    *,
    limit: int = MAX_BYTES,
    complete: bool = False,
) -> Kind:
    """Read a JSON document; its default kind is any object.

    Args:
        path: of the file.
        kind: type to convert it to, see `convert`.
        schema: of the document, where it has one; no part of ``kind``.
        limit: bytes of the file.
        complete: see `convert`.

    Raises:
        RequestError: it cannot be read, or is no JSON of that kind; the message names the file and
            the first field that is wrong.
    """
    source = f"'{path}'"
    value = parse_json_bytes(read_bytes(path, limit), source, limit)
    rest = schema.without(value, source) if schema else value
    return convert(rest, kind, source, complete=complete)


def read_yaml(path: Path, kind: type[Kind] = dict) -> Kind:
    """Read a YAML document; an empty one is an empty mapping.

    Raises:
        RequestError: it cannot be read, or is no YAML of that kind; the message names the file and
            the first field that is wrong.
    """
    value, lines = load_yaml(path)
    return convert(value, kind, f"'{path}'", lines)


def load_yaml(path: Path) -> YamlDocument:
    """Read a YAML document with its lines; an empty one is an empty mapping.

    Raises:
        RequestError: it cannot be read, or is no YAML of plain values.
    """
    source = f"'{path}'"
    value, lines = parse_yaml(_decoded(read_bytes(path, MAX_YAML_BYTES), source), source)
    return YamlDocument({} if value is None else value, lines)


def read_json_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the number and the text of each complete line of a file of JSON lines.

    A last line that has no end was cut off while it was written, and is left out.

    Raises:
        RequestError: the file cannot be read, or a line is not UTF-8.
    """
    content = read_bytes(path, MAX_LINES_BYTES)
    for number, line in enumerate(content.split(b"\n")[:-1], start=1):
        yield number, _decoded(line, f"'{path}', line {number}")


def convert(
    value: Any,
    kind: type[Kind],
    source: str,
    lines: Mapping[Place, int] | None = None,
    *,
    complete: bool = False,
) -> Kind:
    """Convert plain values, as `parse_json` and `parse_yaml` return them, to a type.

    Lists become the tuples, text the paths that the type declares; a whole number is accepted for
    a float, and nothing else is converted. ``__post_init__`` of dataclasses is called.

    Args:
        value: plain.
        kind: dataclass, ``TypedDict``, or any type of the standard library that JSON can hold.
        source: first words of messages, such as the quoted path of the file.
        lines: of a YAML document, for messages.
        complete: require every field of dataclasses, those with a default, too: it may be another
            default than when the document was written.

    Raises:
        RequestError: the first field that is wrong, its path and what is valid. A `RequestError`
            of a ``__post_init__`` keeps its message.
    """
    from pydantic import ValidationError  # 0.1 s

    try:
        # As JSON once more: only there a strict conversion takes lists for tuples.
        text = json.dumps([value], ensure_ascii=False, default=_plain)
        private = text.translate(_TO_PRIVATE)
        result = _validator(kind).validate_json(private)[0]
        if private != text:
            result = _with_bytes(result)
    except TypeError as error:
        raise RequestError(f"{source}: {error}") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = list(first["loc"][1:])
        while place and tuple(place) not in (lines or {}):
            place.pop()
        line = f", line {lines[tuple(place)]}" if lines and place else ""
        raise RequestError(f"{source}{line}: {_problem(kind, first)}") from None
    if complete and (missing := next(_missing(value, result), "")):
        raise RequestError(f"{source}: {missing}: is missing")
    return result


def as_json(value: Any) -> Any:
    """Return plain values as JSON gives them back: tuples become lists."""
    return json.loads(json.dumps(value))


def shown(value: Any) -> str:
    """Return a value as a message repeats it: short, whatever it is."""
    if isinstance(value, Mapping):
        return "an object"
    if isinstance(value, (list, tuple)):
        return f"a list of {len(value)}"
    if isinstance(value, str):
        return f"'{shortened(value)}'"
    if isinstance(value, int) and value.bit_length() > 128:  # printing it may not be possible
        return f"an integer of {value.bit_length()} bits"
    return shortened(repr(value) if isinstance(value, float) else json.dumps(value, default=str))


def shortened(message: object, length: int = _SHOWN) -> str:
    """Return a message on one line, without control characters, cut to a length."""
    text = str(message)[: 4 * length]
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= length else f"{text[:length]}…"


@cache
def _validator(kind: Any) -> SchemaValidator:
    from pydantic import ConfigDict, TypeAdapter
    from pydantic_core import SchemaValidator

    # Dataclasses take their settings from what holds them: a tuple of one.
    settings = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    wrapped: Any = types.GenericAlias(tuple, (kind,))
    adapter = TypeAdapter(wrapped, config=settings)
    return SchemaValidator(_ending_early(adapter.core_schema))


def _ending_early(schema: Any) -> Any:
    """Return a schema whose lists end with their first problem: a million would take gigabytes."""
    if isinstance(schema, list):
        return [_ending_early(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    parts = {name: _ending_early(part) for name, part in schema.items()}
    return parts | {"fail_fast": True} if schema.get("type") in ("list", "tuple") else parts


def _plain(value: Any) -> Any:
    """Return a number of NumPy, which Python code may give, as Python's; raise TypeError else."""
    if callable(item := getattr(value, "item", None)) and getattr(value, "ndim", None) == 0:
        return item()
    raise TypeError(f"a value of type {type(value).__name__}: must be text, a number or a list")


def _with_bytes(value: Any) -> Any:
    """Return a converted value with the bytes of paths that were replaced by private characters."""
    if isinstance(value, (str, Path)):
        return type(value)(str(value).translate(_FROM_PRIVATE))
    if isinstance(value, dict):
        return {_with_bytes(name): _with_bytes(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(map(_with_bytes, value))
    if dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            object.__setattr__(value, item.name, _with_bytes(getattr(value, item.name)))
    return value


def _problem(kind: Any, error: ErrorDetails) -> str:
    """Return a line about the first problem of a document."""
    place = list(error["loc"][1:])
    given = error.get("ctx", {}).items()
    context = {k: f"{v:.15g}" if isinstance(v, float) else v for k, v in given}
    template = ""
    if error["type"] in ("unexpected_keyword_argument", "extra_forbidden"):
        *place, name = place
        problem = _unknown_name(str(name), _names_at(kind, place))
    elif isinstance(context.get("error"), Exception):
        problem = str(context["error"])
    else:
        template = _PROBLEMS.get(error["type"], "")
        problem = template.format(shown(error["input"]), **context) or error["msg"]
    where = _place(place)
    sign = " " if template.startswith("{}") else ": "  # "horizon 9: must be ..."
    return f"{where}{sign}{problem}" if where else problem


def _place(place: Sequence[int | str]) -> str:
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return shortened("".join(parts).removeprefix("."))


def _missing(value: Any, result: Any, place: str = "") -> Iterator[str]:
    """Yield the fields of dataclasses in a converted value that the plain one lacks."""
    if isinstance(result, (list, tuple)) and result and dataclasses.is_dataclass(result[0]):
        for number, pair in enumerate(zip(value, result, strict=True)):
            yield from _missing(*pair, f"{place}[{number}]")
    elif dataclasses.is_dataclass(result):
        for item in dataclasses.fields(result):
            name = f"{place}.{item.name}" if place else item.name
            if item.name not in value:
                yield name
            else:
                yield from _missing(value[item.name], getattr(result, item.name), name)


def _unknown_name(name: str, valid: Sequence[str]) -> str:
    close = difflib.get_close_matches(name[:_SHOWN], valid, n=1)
    hint = f" (did you mean '{close[0]}'?)" if close else ""
    return f"unknown name {shown(name)}{hint}; valid: {', '.join(valid)}"


def _names_at(kind: Any, place: Sequence[int | str]) -> list[str]:
    """Return the names of the fields of the dataclass at a place of a type."""
    for part in (*place, None):
        while not dataclasses.is_dataclass(kind) and not is_typeddict(kind):
            arguments = [a for a in typing.get_args(kind) if a not in (type(None), ...)]
            if not arguments:
                return []
            if typing.get_origin(kind) in (list, tuple, dict):
                break
            kind = arguments[0]  # of Annotated, or of a type that may be null
        if part is None:
            break
        if isinstance(part, int) or typing.get_origin(kind) is dict:
            kind = typing.get_args(kind)[-1 if typing.get_origin(kind) is dict else 0]
        else:
            kind = typing.get_type_hints(kind).get(part)
    if not (dataclasses.is_dataclass(kind) or is_typeddict(kind)):
        return []
    if dataclasses.is_dataclass(kind):
        return [item.name for item in dataclasses.fields(kind)]
    return list(typing.get_type_hints(kind))


def _depth(text: str) -> int:
    """Return how deep the brackets of JSON are nested, without parsing it."""
    # Escapes are only in texts; without them, every second part between quotes is outside.
    outside = text.replace("\\\\", "").replace('\\"', "").split('"')[::2]
    brackets = _NO_BRACKETS.sub("", "".join(outside))
    return max(accumulate(1 if bracket in "[{" else -1 for bracket in brackets), default=0)


def _integer(text: str, source: str) -> int:
    # The length first: int() of thousands of digits raises, or takes long.
    if len(text) > 20 or not -(1 << 63) <= int(text) < 1 << 63:
        raise RequestError(f"{source}: {shortened(text)} is an integer of more than 64 bits")
    return int(text)


def _finite(text: str, source: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise RequestError(f"{source}: {shortened(text)} is no finite number")
    return value


def _decoded(content: bytes, source: str) -> str:
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise RequestError(f"{source} is damaged: no UTF-8 at byte {error.start}") from None


def _bytes(count: int) -> str:
    return f"{count >> 20} MiB"
