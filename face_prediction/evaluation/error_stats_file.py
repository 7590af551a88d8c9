"""``error_stats.json``: writing and reading `ErrorStats`."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from face_prediction.errors import RequestError
from face_prediction.evaluation.camera import Camera
from face_prediction.evaluation.error_stats import ErrorStats, HorizonErrors, ResidualRun
from face_prediction.whole_file import whole_file

SCHEMA = "error_stats"
VERSION = 1


def save_error_stats(path: Path, stats: ErrorStats) -> None:
    """Write ``stats`` to ``path``, whole or not at all.

    Raises:
        RequestError: the folder cannot be written.
    """
    text = json.dumps(
        {"schema": SCHEMA, "version": VERSION, **asdict(stats)}, allow_nan=False, indent=1
    )
    # numbers of one innermost list side by side: shorter, and readable. In JSON only the layout
    # has line breaks, so no text is touched.
    text = re.sub(r"\[\n\s*([-+0-9.eE,\s]+?)\n\s*\]", lambda m: f"[{' '.join(m[1].split())}]", text)
    with whole_file(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def load_error_stats(path: Path) -> ErrorStats:
    """Read and check ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema or version, or breaks a
            promise of `ErrorStats`; the message names the file and the key.
    """
    if not path.is_file():
        raise RequestError(f"{path}: no such file; expected '{SCHEMA}' as JSON")
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RequestError(f"{path}: damaged or not JSON ({error}); make it again") from None
    found = stored.get("schema") if isinstance(stored, dict) else None
    if found != SCHEMA:
        raise RequestError(f"{path}: schema '{found}', expected '{SCHEMA}'")
    if stored.get("version") != VERSION:
        raise RequestError(
            f"{path}: version {stored.get('version')} of '{SCHEMA}', this program reads {VERSION}; "
            "make the file again"
        )
    try:
        return _from_record(stored)
    except RequestError as error:
        raise RequestError(f"{path}: {error}; make the file again") from None


def _from_record(stored: Mapping[str, Any]) -> ErrorStats:
    values = {key: value for key, value in stored.items() if key not in ("schema", "version")}
    values["camera"] = _build(Camera, stored.get("camera"), "camera")
    for key, kind in (("horizons", HorizonErrors), ("residuals", ResidualRun)):
        items = stored.get(key)
        if not isinstance(items, list):
            raise RequestError(f"'{key}' is missing or is not a list")
        values[key] = [_build(kind, item, f"{key}[{i}]") for i, item in enumerate(items)]
    return _build(ErrorStats, values, "")


def _build(kind: type[Any], record: Any, where: str) -> Any:
    """A dataclass from a mapping with exactly its fields, lists made tuples."""
    if not isinstance(record, Mapping):
        raise RequestError(f"'{where}' is missing or is not an object")
    wanted = kind.__dataclass_fields__
    for key in [*wanted, *record]:
        if key not in record:
            raise RequestError(f"'{where and where + '.'}{key}' is missing")
        if key not in wanted:
            raise RequestError(f"'{where and where + '.'}{key}' is not a key of this schema")
    for key, field in wanted.items():
        if not _fits(record[key], field.type):
            raise RequestError(f"'{where and where + '.'}{key}' is not of type {field.type}")
    return kind(**{key: _as_tuples(record[key]) for key in wanted})


def _fits(value: Any, annotation: str) -> bool:
    """Whether ``value`` is what a field with this annotation stands as in JSON."""
    if annotation.startswith("tuple["):
        inner = annotation.removeprefix("tuple[").removesuffix(", ...]")
        return isinstance(value, list) and all(_fits(item, inner) for item in value)
    if annotation in ("int", "float"):
        kinds = int if annotation == "int" else (int, float)
        return isinstance(value, kinds) and not isinstance(value, bool)
    return annotation != "str" or isinstance(value, str)


def _as_tuples(value: Any) -> Any:
    return tuple(_as_tuples(item) for item in value) if isinstance(value, list) else value
