"""Reading and writing ``.npz`` files that carry a schema name and a version."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

Arrays = dict[str, np.ndarray]


def write_npz(path: Path, arrays: Arrays) -> None:
    """Write ``arrays`` compressed to ``path``, whole or not at all.

    The file is first written under a temporary name in the same folder, so that a run killed at
    any moment leaves either the old file or the new one.

    Raises:
        RequestError: the folder cannot be written.
    """
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def read_npz(path: Path, schema: str, version: int) -> Arrays:
    """Read every array of the ``.npz`` file at ``path``.

    Raises:
        RequestError: the file is absent, damaged, of another schema or of another version.
    """
    if not path.is_file():
        raise RequestError(f"{path}: no such file; expected a '{schema}' .npz")
    try:
        # opened and checked here, because NumPy leaves a damaged file open
        with path.open("rb") as stream, zipfile.ZipFile(stream):
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as stored:
                arrays = {key: stored[key] for key in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, KeyError) as error:
        raise RequestError(
            f"{path}: damaged or not an .npz file ({type(error).__name__}: {error}); make it again"
        ) from None
    found = str(arrays["schema"]) if "schema" in arrays else "none"
    if found != schema:
        raise RequestError(f"{path}: schema '{found}', expected '{schema}'")
    found_version = arrays.get("version")
    if found_version is None or found_version.shape != () or int(found_version) != version:
        wrong = f"version {found_version} of '{schema}', this program reads {version}"
        raise RequestError(f"{path}: {wrong}; make the file again")
    return arrays


def require_array(
    path: Path, arrays: Arrays, key: str, shape: tuple[int | None, ...], kind: str
) -> np.ndarray:
    """Return ``arrays[key]`` if it has ``shape`` (None: any length) and a dtype of ``kind``.

    ``kind`` holds the accepted NumPy kind letters, such as ``"f"``, ``"iu"``, ``"b"`` or ``"U"``.

    Raises:
        RequestError: the key is missing, or its shape or type is another one.
    """
    if key not in arrays:
        raise RequestError(f"{path}: key '{key}' is missing; make the file again")
    array = arrays[key]
    fits = array.ndim == len(shape) and all(
        wanted in (None, got) for wanted, got in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in kind:
        expected = f"kind '{kind}' and shape {tuple('any' if n is None else n for n in shape)}"
        raise RequestError(f"{path}: '{key}' is {array.dtype} {array.shape}, expected {expected}")
    return array


def require_json(path: Path, arrays: Arrays, key: str) -> dict[str, Any]:
    """Return the JSON object that ``arrays[key]`` holds as text.

    Raises:
        RequestError: the key is missing, or is no JSON object.
    """
    try:
        value = json.loads(str(require_array(path, arrays, key, (), "U")))
    except json.JSONDecodeError:
        value = None
    if not isinstance(value, dict):
        raise RequestError(f"{path}: '{key}' is not a JSON object; make the file again")
    return value
