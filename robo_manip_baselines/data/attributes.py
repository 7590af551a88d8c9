"""Attributes of an episode file: checked, stored, read back, and the digest of the contents."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import h5py
import numpy as np

from robo_manip_baselines.data.schema import ATTRIBUTES, FIELDS, Attribute


def stored_attribute(item: Attribute, value: Any) -> Any:
    """Turn a value into what HDF5 keeps: UTF-8, int64, float64, bool or a float64 vector.

    Raises:
        ValueError: if the value is not of the attribute's kind.
    """
    if item.kind == "json":
        return stored_text(json.dumps(value, sort_keys=True, allow_nan=False, ensure_ascii=False))
    if item.kind == "text" and isinstance(value, str):
        return stored_text(value)
    if item.kind == "bool" and isinstance(value, bool | np.bool_):
        return np.bool_(value)
    if item.kind == "int" and isinstance(value, int | np.integer) and not isinstance(value, bool):
        return np.int64(value)
    if item.kind == "float" and isinstance(value, int | float | np.number):
        return np.float64(value)
    if item.kind == "vector":
        vector = np.asarray(value, dtype=np.float64)
        if vector.shape == (item.length,) and np.isfinite(vector).all():
            return vector
        raise ValueError(f"attribute '{item.name}' needs {item.length} finite numbers: {value!r}")
    raise ValueError(f"attribute '{item.name}' needs {item.kind}, not {value!r}")


def stored_text(text: str) -> np.ndarray:
    """A string as HDF5 keeps it: UTF-8 of fixed length, which lies under the file's checksums."""
    data = text.encode()
    if b"\0" in data:
        raise ValueError(f"text with a null character: {text!r}")
    return np.array(data, dtype=h5py.string_dtype("utf-8", max(len(data), 1)))


def loaded_attribute(item: Attribute, value: Any) -> Any:
    """Undo `stored_attribute`: plain Python values, JSON parsed, vectors as float64 arrays.

    Raises:
        ValueError: if what is in the file is not of the attribute's kind.
    """
    if item.kind == "vector":
        if isinstance(value, np.ndarray) and value.shape == (item.length,):
            return value.astype(np.float64)
    elif item.kind in ("text", "json"):
        value = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
        if isinstance(value, bytes | str):
            text = value.decode() if isinstance(value, bytes) else value
            return text if item.kind == "text" else json.loads(text)
    elif isinstance(value, np.generic):
        kinds = {"bool": "b", "int": "i", "float": "f"}
        if value.dtype.kind == kinds[item.kind]:
            return value.item()
    raise ValueError(f"attribute '{item.name}' is no {item.kind} but {value!r}")


def content_digest(
    arrays: Mapping[str, np.ndarray],
    checksums: Mapping[str, np.ndarray],
    attributes: Mapping[str, Any],
) -> str:
    """SHA-256 over everything an episode says, whatever the library that laid out the file.

    Args:
        arrays: every field of the table that the episode has.
        checksums: camera -> (T,) uint32, the CRC-32 of its encoded frames.
        attributes: every attribute as `loaded_attribute` gives it; ``content_sha256`` is skipped.

    Returns:
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for field in FIELDS:
        if field.name in arrays:
            array = np.asarray(arrays[field.name]).astype(field.dtype)
            _add_array(digest, field.name, array)
    for camera in sorted(checksums):
        _add_array(digest, camera, np.asarray(checksums[camera], dtype=np.uint32))
    for item in ATTRIBUTES:
        if item.name != "content_sha256":
            digest.update(f"{item.name}={_canonical(attributes[item.name])}\n".encode())
    return digest.hexdigest()


def episode_consistency(
    attributes: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> list[str]:
    """What attributes and arrays say about one another."""
    problems: list[str] = []
    for name, field, axis in (
        ("joint_names", "joint_position", 1),
        ("action_names", "action", 1),
        ("num_steps", "time", 0),
    ):
        if name in attributes and field in arrays and arrays[field].ndim > axis:
            value = attributes[name]
            given = len(value) if isinstance(value, Sequence) else value
            size = arrays[field].shape[axis]
            if given != size:
                problems.append(f"attribute '{name}' says {given}, but '{field}' has {size}")
    return problems


def _add_array(digest: Any, name: str, array: np.ndarray) -> None:
    array = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
    digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
    digest.update(np.ascontiguousarray(array).tobytes())


def _canonical(value: Any) -> str:
    if isinstance(value, float):
        return "nan" if math.isnan(value) else value.hex()
    if isinstance(value, np.ndarray):
        return " ".join(float(number).hex() for number in value)
    return json.dumps(value, sort_keys=True, ensure_ascii=False)
