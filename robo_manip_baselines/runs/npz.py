"""Reading and writing ``.npz`` files that carry a schema name and a version.

Nothing of a file is trusted before it has been checked: each array is declared in a table, and its
type, shape and size are compared with the table before any of its data are read.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from robo_manip_baselines.runs.documents import convert, parse_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

Arrays = dict[str, np.ndarray]

MAX_FILE_BYTES = 2**32
"""Total size of the arrays of one file."""

MAX_MEMBERS = 64
MAX_TEXT = 2**24
"""Characters of one text, such as metadata as JSON."""

MAX_NAME = 1024
"""Characters of each element of an array of names."""

MAX_INFLATION = 1032
"""Bytes that one byte of a deflated member can hold at most."""

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_MAGIC = b"\x93NUMPY"
_MAX_HEADER = 4096
_HEADER = re.compile(
    r"\{\s*'descr': '([<>|=]?)([a-zA-Z])(\d{0,9})', 'fortran_order': (True|False), "
    r"'shape': \(((?:\d{1,18}, ?)*(?:\d{1,18})?)\),? *\}\s*"
)
_BLOCK = 2**20

_READ_ERRORS = (
    *(OSError, ValueError, TypeError, EOFError, LookupError, OverflowError, MemoryError),
    *(RuntimeError, AttributeError, struct.error, zlib.error, zipfile.BadZipFile),
)
"""Errors that ``zipfile`` raises on damaged bytes."""


@dataclass(frozen=True)
class ArrayType:
    """Declared type of an array of a file.

    Attributes:
        kind: accepted NumPy kind letters, such as ``"f"``, ``"iu"``, ``"b"`` or ``"U"``.
        shape: sizes; a name stands for a size that the arrays of a file share.
        rule: that the numbers obey; ``"any"`` allows NaN and infinity. Rules apply to the last
            axis of quaternions and to the whole of other arrays.
        is_optional: a file may lack the array.
    """

    kind: str
    shape: tuple[int | str, ...] = ()
    rule: Literal["finite", "any", "not negative", "positive", "increasing", "quaternion"] = (
        "finite"
    )
    is_optional: bool = False


@dataclass(frozen=True)
class FileType:
    """Declared content of a kind of ``.npz`` file.

    Attributes:
        schema: name of the kind.
        version: that this release reads.
        arrays: name -> type, beside ``schema`` and ``version``, in the order of the file.
        limits: name of a shared size -> largest size.
        quaternion_tolerance: of the length of quaternions.
        has_others: whether there may be further arrays, which are not read.
    """

    schema: str
    version: int
    arrays: Mapping[str, ArrayType]
    limits: Mapping[str, int] = field(default_factory=dict)
    quaternion_tolerance: float = 1e-5
    has_others: bool = False


@dataclass(frozen=True)
class _Member:
    """Array of an open file, of which the header alone has been read."""

    info: zipfile.ZipInfo
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    fortran_order: bool
    offset: int

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=object)) * self.dtype.itemsize


def write_npz(path: Path, arrays: Arrays) -> None:
    """Write ``arrays`` compressed to ``path``, whole or not at all.

    The file is first written under a temporary name in the same folder, so that a run killed at
    any moment leaves either the old file or the new one.

    Raises:
        RequestError: the folder cannot be written.
    """
    with atomic_file(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def read_npz(
    path: Path, kind: FileType, *, name: str | None = None, remedy: str = "make the file again"
) -> Arrays:
    """Read the arrays of an ``.npz`` file, in the native byte order and the order of the table.

    Args:
        path: the file.
        kind: its declared content.
        name: of the file in messages; the path if None.
        remedy: for messages, after what is wrong.

    Raises:
        RequestError: the file is absent, damaged, of another schema or version, or its arrays are
            not as declared; the message names the file and the array.
    """
    name = name or str(path)
    if not path.is_file():
        raise RequestError(f"{name}: no such file; expected a '{kind.schema}' .npz; {remedy}")
    try:
        with path.open("rb") as stream:
            start = stream.read(8)
            if start.startswith(_MAGIC):
                raise ValueError("a single array in the format .npy; an .npz file holds several")
            if not start.startswith(b"PK"):
                raise ValueError("it does not begin as a zip archive does")
            with zipfile.ZipFile(stream) as archive:
                members = _members(archive, kind, path.stat().st_size)
                problem = _problem(archive, members, kind)
                known = [item for item in kind.arrays if item in members]
                arrays = {} if problem else {item: _read(archive, members[item]) for item in known}
    except _READ_ERRORS as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise RequestError(f"{name}: damaged or not an .npz file ({reason}); {remedy}") from None
    problem = problem or next(
        filter(None, (_value_problem(kind, *item) for item in arrays.items())), ""
    )
    if problem:
        raise RequestError(f"{name}: {problem}; {remedy}")
    return arrays


def read_json_array(arrays: Arrays, key: str, name: str | Path) -> dict[str, Any]:
    """Return the JSON object that ``arrays[key]`` holds as text.

    Raises:
        RequestError: it is no JSON object; ``name`` is that of the file.
    """
    source = f"{name}: '{key}'"
    return convert(parse_json(str(arrays[key]), source), dict, source)


def add_array(digest: Any, name: str, array: np.ndarray) -> None:
    """Add name, type, shape and numbers of an array to a digest of ``hashlib``."""
    array = array.astype(array.dtype.newbyteorder("<"), order="C", copy=False)
    digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
    digest.update(array.reshape(-1).view(np.uint8).data)


def _members(archive: zipfile.ZipFile, kind: FileType, file_size: int) -> dict[str, _Member]:
    """Read the headers of all declared arrays; raise ValueError where one cannot be trusted."""
    infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise ValueError(f"{len(infos)} members; at most {MAX_MEMBERS} are read")
    members: dict[str, _Member] = {}
    names: set[str] = set()
    for info in infos:
        name = info.filename.removesuffix(".npy")
        if name in names:
            raise ValueError(f"'{name}' is there twice")
        names.add(name)
        if name not in kind.arrays and name not in ("schema", "version"):
            continue  # refused by name once the schema is known; its data are never read
        if info.flag_bits & 1:
            raise ValueError(f"'{name}' is encrypted")
        if info.compress_type not in _METHODS:
            raise ValueError(f"'{name}' is compressed by method {info.compress_type}, not deflate")
        inflation = 1 if info.compress_type == zipfile.ZIP_STORED else MAX_INFLATION
        if not 0 <= info.compress_size <= file_size:
            raise ValueError(f"'{name}' lies outside the file")
        if info.file_size > inflation * info.compress_size:
            raise ValueError(f"'{name}' declares {info.file_size} bytes and holds fewer")
        members[name] = _header(archive, info, name)
    total = sum(member.size for member in members.values())
    if total > MAX_FILE_BYTES:
        raise ValueError(f"arrays of {total} bytes; at most {MAX_FILE_BYTES} are read")
    return members


def _header(archive: zipfile.ZipFile, info: zipfile.ZipInfo, name: str) -> _Member:
    """Read the header of one array; raise ValueError if it is not plain, or not the data's."""
    with archive.open(info) as stream:
        start = stream.read(8)
        if start[:6] != _MAGIC or start[6:7] not in (b"\1", b"\2", b"\3"):
            raise ValueError(f"'{name}' is no array")
        width = 2 if start[6] == 1 else 4
        length = int.from_bytes(stream.read(width), "little")
        if length > _MAX_HEADER:
            raise ValueError(f"'{name}' has a header of {length} bytes")
        match = _HEADER.fullmatch(stream.read(length).decode("latin-1"))
    if not match or match[2] not in "biufUSO":
        raise ValueError(f"'{name}' holds no plain numbers or text")
    if match[2] == "O":
        raise ValueError(f"'{name}' holds Python objects; arrays of numbers or text are read")
    dtype = np.dtype(match[1] + match[2] + match[3])
    shape = tuple(int(size) for size in match[5].replace(" ", "").split(",") if size)
    member = _Member(info, dtype, shape, match[4] == "True", 8 + width + length)
    if member.offset + member.size != info.file_size:
        raise ValueError(
            f"'{name}' declares {member.size} bytes of data, its member holds "
            f"{info.file_size - member.offset}"
        )
    return member


def _problem(archive: zipfile.ZipFile, members: dict[str, _Member], kind: FileType) -> str:
    """Compare the headers with the table; return what differs first, or nothing."""
    if (schema := _text(archive, members.get("schema"))) != kind.schema:
        return f"schema '{schema}', expected '{kind.schema}'"
    if (version := _text(archive, members.get("version"))) != str(kind.version):
        return f"version {version} of '{kind.schema}', this program reads {kind.version}"
    for info in archive.infolist():
        if not kind.has_others and info.filename.removesuffix(".npy") not in members:
            return f"unknown array {info.filename[:80]!a}; a '{kind.schema}' file has none"
    sizes: dict[str, int] = {}
    for name, wanted in kind.arrays.items():
        if name not in members:
            if wanted.is_optional:
                continue
            return f"key '{name}' is missing"
        member = members[name]
        expected = tuple(
            sizes.get(size, "any") if isinstance(size, str) else size for size in wanted.shape
        )
        fits = len(member.shape) == len(expected) and all(
            size in ("any", got) for size, got in zip(expected, member.shape, strict=True)
        )
        if not fits or member.dtype.kind not in wanted.kind:
            expectation = f"kind '{wanted.kind}' and shape {expected}"
            return f"'{name}' is {member.dtype} {member.shape}, expected {expectation}"
        for size, got in zip(wanted.shape, member.shape, strict=True):
            if isinstance(size, str):
                sizes[size] = got
                if got > kind.limits[size]:
                    return f"'{name}' has shape {member.shape}; at most {kind.limits[size]} {size}"
        if member.dtype.kind == "U" and member.dtype.itemsize > 4 * (
            MAX_NAME if member.shape else MAX_TEXT
        ):
            return f"'{name}' holds texts of {member.dtype.itemsize // 4} characters"
    return ""


def _text(archive: zipfile.ZipFile, member: _Member | None) -> str:
    """Return a short scalar as text; "none" if there is none."""
    if member is None or member.shape or not 0 < member.size <= 4 * MAX_NAME:
        return "none"
    return str(_read(archive, member))


def _read(archive: zipfile.ZipFile, member: _Member) -> np.ndarray:
    """Read the data of an array whose header has been checked."""
    data = np.empty(member.size, np.uint8)
    place = 0
    with archive.open(member.info) as stream:
        stream.read(member.offset)
        while block := stream.read(_BLOCK):
            data[place : place + len(block)] = np.frombuffer(block, np.uint8)
            place += len(block)
    name = member.info.filename.removesuffix(".npy")
    if place != member.size:
        raise ValueError(f"'{name}' ends after {place} of {member.size} bytes")
    if member.dtype.kind == "b" and place and data.max() > 1:
        raise ValueError(f"'{name}' holds values that are neither true nor false")
    if not place:
        return np.zeros(member.shape, member.dtype)
    array = data.view(member.dtype).reshape(
        member.shape, order="F" if member.fortran_order else "C"
    )
    if array.dtype.byteorder == ">":
        array = array.astype(array.dtype.newbyteorder("="))
    if array.dtype.kind == "U":
        codes = np.ascontiguousarray(array).reshape(-1).view(np.uint32)
        if np.any((codes > 0x10FFFF) | ((codes >= 0xD800) & (codes <= 0xDFFF))):
            raise ValueError(f"'{name}' holds no valid text")
    return array


def _value_problem(kind: FileType, name: str, array: np.ndarray) -> str:
    """Return what is wrong with the numbers of an array, or nothing."""
    rule = kind.arrays[name].rule
    if array.dtype.kind not in "iuf" or rule == "any":
        return ""
    if not np.all(np.isfinite(array)):
        return f"'{name}' holds NaN or infinity"
    if rule == "not negative" and np.any(array < 0):
        return f"'{name}' is negative at row {np.argwhere(array < 0)[0][0]}"
    if rule == "positive" and np.any(array <= 0):
        return f"'{name}' must be positive"
    if rule == "increasing" and np.any(np.diff(array) <= 0):
        return f"'{name}' does not increase at row {np.flatnonzero(np.diff(array) <= 0)[0] + 1}"
    if rule == "quaternion":
        length = np.linalg.norm(array.astype(np.float64), axis=-1)
        if np.any(np.abs(length - 1) > kind.quaternion_tolerance):
            return f"'{name}' holds quaternions that are not of unit length"
    return ""
