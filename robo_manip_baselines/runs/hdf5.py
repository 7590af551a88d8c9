"""HDF5 files, opened for reading, of which only plain arrays of their own are taken.

A file that was read from outside may name other files (external links, virtual and external
storage), plugins (filters), or sizes that it does not hold. HDF5 follows all of these; here they
are refused before any data are read.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robo_manip_baselines.runs.npz import MAX_INFLATION

if TYPE_CHECKING:
    import h5py

READ_ERRORS = (KeyError, ValueError, OSError, RuntimeError, TypeError, OverflowError, MemoryError)
"""Errors that h5py and HDF5 raise on damaged bytes, and that the functions here raise."""

IN_USE = "in use: another program holds it open for writing; close it there and try again"

MAX_LINKS = 1000
"""Members of a group."""

MAX_ATTRIBUTE = 2**20
"""Bytes of an attribute."""

_MAX_CHUNK = 2**20
"""Bytes of a chunk that is larger than its array."""


def open_hdf5(path: Path) -> h5py.File:
    """Open a file for reading.

    Raises:
        ValueError: there is no such file, it is in use, or no HDF5 file or a truncated one.
    """
    import h5py

    if not path.is_file():
        raise ValueError("no file")
    try:
        file = h5py.File(path, "r")
    except (OSError, RuntimeError, KeyError) as error:
        reason = one_line(error)
        if isinstance(error, PermissionError):
            raise ValueError("not readable: permission denied") from error
        if isinstance(error, BlockingIOError) or "unable to lock file" in reason:
            raise ValueError(IN_USE) from error
        if "already open for" in reason:  # a mark in the file itself, where locks do not work
            raise ValueError(f"{IN_USE}, or run h5clear -s if that program was killed") from error
        raise ValueError(f"no HDF5 file, or a damaged one: {reason}") from error
    try:
        require_own_links(file)
    except BaseException:
        file.close()
        raise
    return file


def require_own_links(group: h5py.Group) -> None:
    """Require that the members of a group lie in this file, under this name.

    Raises:
        ValueError: one is a soft or external link, or there are too many.
    """
    low = _low_level()
    if len(group) > MAX_LINKS:
        raise ValueError(f"{len(group)} members in '{group.name}'; at most {MAX_LINKS} are read")
    links = group.id.links
    for name in group.id:
        if links.get_info(name).type != low.h5l.TYPE_HARD:
            shown = name.decode(errors="replace")
            raise ValueError(f"'{shown}' is a link to another place or file")


def dataset_of(file: h5py.Group, name: str) -> h5py.Dataset:
    """Return an array of plain numbers that lies in the file itself; nothing of it is read.

    Raises:
        KeyError: there is none of that name.
        ValueError: it is of another kind, or lies elsewhere.
    """
    import h5py

    low = _low_level()
    item: Any = file.id
    for part in name.encode().split(b"/"):
        if not isinstance(item, low.h5g.GroupID) or not item.links.exists(part):
            raise KeyError(f"no dataset '{name}'")
        if item.links.get_info(part).type != low.h5l.TYPE_HARD:
            raise ValueError(f"'{name}' is a link to another place or file")
        item = low.h5o.open(item, part)
    if not isinstance(item, low.h5d.DatasetID):
        raise KeyError(f"no dataset '{name}'")
    if problem := _storage_problem(item):
        raise ValueError(f"'{name}' {problem}")
    return h5py.Dataset(item)


def read_whole(dataset: h5py.Dataset) -> np.ndarray:
    """Return all numbers of an array from `dataset_of`. Raises one of `READ_ERRORS`."""
    low = _low_level()
    values = np.empty(dataset.shape, dataset.dtype)
    if values.size:
        dataset.id.read(low.h5s.ALL, low.h5s.ALL, values)
    return values


def attribute_of(file: h5py.Group | h5py.Dataset, name: str) -> Any:
    """Return an attribute as h5py does.

    Raises:
        KeyError: there is none of that name.
        ValueError: it is too large, or neither numbers nor one text.
    """
    low = _low_level()
    if not low.h5a.exists(file.id, name.encode()):
        raise KeyError(f"attribute '{name}' is missing")
    item = low.h5a.open(file.id, name.encode())
    kind = item.get_type()
    is_text = kind.get_class() == low.h5t.STRING and item.shape == ()
    if not is_text and kind.get_class() not in (low.h5t.INTEGER, low.h5t.FLOAT, low.h5t.ENUM):
        raise ValueError(f"attribute '{name}' is neither a number nor text")
    if item.shape is None:
        raise ValueError(f"attribute '{name}' is empty")
    if item.get_storage_size() > MAX_ATTRIBUTE:
        raise ValueError(f"attribute '{name}' has {item.get_storage_size()} bytes")
    if is_text and kind.is_variable_str():
        return file.attrs[name]
    value = np.empty(item.shape, item.dtype)
    item.read(value)
    return value if value.ndim else value[()]


def one_line(error: BaseException) -> str:
    """Return the message of an exception as one line."""
    message = error.args[0] if isinstance(error, KeyError) and error.args else error
    if re.search("filter returned failure|Fletcher32", str(message)):  # HDF5 2 and 1 say it so
        return "its checksum is wrong"
    return " ".join(str(message).split()) or type(error).__name__


def _low_level() -> Any:
    """Return h5py for the use of its low-level modules, which pyright does not know."""
    import h5py

    return h5py


def _storage_problem(dataset: Any) -> str:
    """Return why the data of an array cannot be trusted to lie in the file, or nothing."""
    low = _low_level()
    if dataset.get_type().get_class() not in (low.h5t.INTEGER, low.h5t.FLOAT, low.h5t.ENUM):
        return "holds no plain numbers"
    shape, dtype = dataset.shape, dataset.dtype
    if shape is None or dtype.kind not in "biuf":
        return "holds no plain numbers"
    layout = dataset.get_create_plist()
    kind = layout.get_layout()
    if kind == low.h5d.VIRTUAL or layout.get_external_count():
        return "has its data in another file"
    filters = {layout.get_filter(index)[0] for index in range(layout.get_nfilters())}
    if not filters <= {low.h5z.FILTER_DEFLATE, low.h5z.FILTER_SHUFFLE, low.h5z.FILTER_FLETCHER32}:
        return "is compressed by a filter other than gzip"
    size = math.prod(shape) * dtype.itemsize
    chunk = math.prod(layout.get_chunk()) * dtype.itemsize if kind == low.h5d.CHUNKED else 0
    if chunk > max(size, _MAX_CHUNK):
        return f"has chunks of {chunk} bytes"
    stored = int(dataset.get_storage_size())
    if size > stored * (MAX_INFLATION if low.h5z.FILTER_DEFLATE in filters else 1):
        return f"declares {size} bytes, of which the file cannot hold all"
    return ""
