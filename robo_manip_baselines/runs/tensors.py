"""Reading ``.safetensors`` files, whose header is checked before memory is taken.

The format: 8 bytes with the length of the header, the header as JSON (name -> dtype, shape and
place of the data, with texts under ``__metadata__``), then the data without gaps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robo_manip_baselines.runs.documents import convert, parse_json
from robo_manip_baselines.runs.errors import RequestError

if TYPE_CHECKING:
    from torch import Tensor

MAX_HEADER = 2**24
"""Bytes; some 100,000 tensors."""

_SIZES = {
    **{"F64": 8, "F32": 4, "F16": 2, "BF16": 2},
    **{"I64": 8, "I32": 4, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1},
}
"""Bytes of an element of each type that is read."""

_METADATA = "__metadata__"
_MAX_DIMENSIONS = 16


def read_tensors(
    path: Path, *, name: str | None = None, remedy: str = "give a file that training wrote"
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read all tensors of a file to the CPU, and the texts in its header.

    Args:
        path: the file.
        name: of the file in messages; the path if None.
        remedy: for messages, after what is wrong.

    Raises:
        RequestError: the file is absent, no safetensors file, or damaged.
    """
    import safetensors.torch

    name = name or str(path)
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            start = file.read(8)
            header = file.read(_header_length(start, size))
            metadata = _check_header(header, size - 8 - len(header))
            data = start + header + file.read()
        tensors = safetensors.torch.load(data)
    except FileNotFoundError:
        raise RequestError(f"{name}: no such file; {remedy}") from None
    except (OSError, ValueError, KeyError, MemoryError, safetensors.SafetensorError) as error:
        reason = " ".join(str(error).split())[:200]
        problem = f"damaged or no safetensors file ({reason})"
        raise RequestError(f"{name}: {problem}; {remedy}") from None
    return tensors, metadata


def require_finite(tensors: Mapping[str, Tensor], name: str | Path) -> None:
    """Require that no tensor holds NaN or infinity.

    Raises:
        RequestError: naming ``name`` and the first tensor that does.
    """
    for key, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise RequestError(
                f"{name}: tensor '{key}' holds NaN or infinity; use an earlier checkpoint"
            )


def require_alike(
    tensors: Mapping[str, Tensor], wanted: Mapping[str, Tensor], name: str | Path
) -> None:
    """Require the names, types and shapes of other tensors.

    Raises:
        RequestError: naming ``name`` and the first tensor that differs.
    """
    for key in sorted({*wanted, *tensors}):
        if key not in tensors:
            raise RequestError(f"{name}: tensor '{key}' is missing")
        if key not in wanted:
            raise RequestError(f"{name}: tensor '{key}' is none of this network")
        found, expected = (f"{x.dtype} {tuple(x.shape)}" for x in (tensors[key], wanted[key]))
        if found != expected:
            raise RequestError(f"{name}: tensor '{key}' is {found}, expected {expected}")


def _header_length(start: bytes, size: int) -> int:
    if start[:2] in (b"PK", b"\x80\x02", b"\x80\x04", b"\x80\x05"):
        raise ValueError("it begins as files of pickled objects do, which are not read")
    length = int.from_bytes(start, "little")
    if len(start) < 8 or length > size - 8:
        raise ValueError("its header does not fit into the file")
    if length > MAX_HEADER:
        raise ValueError(f"a header of {length} bytes; at most {MAX_HEADER} are read")
    return length


def _check_header(header: bytes, size: int) -> dict[str, str]:
    """Check types, shapes and places against ``size`` bytes of data; return the texts."""
    entries = convert(parse_json(header.decode("utf-8"), "its header"), dict, "its header")
    metadata = entries.pop(_METADATA, {})
    if not isinstance(metadata, dict) or not _all_of(str, metadata.values()):
        raise ValueError(f"'{_METADATA}' is no object of texts")
    places = sorted(_place(name, entry) for name, entry in entries.items())
    end = 0
    for first, last, name in places:
        if first != end:
            raise ValueError(f"tensor '{name[:80]}' begins at byte {first}, not at {end}")
        end = last
    if end != size:
        raise ValueError(f"tensors of {end} bytes in {size} bytes of data")
    return metadata


def _place(name: str, entry: Any) -> tuple[int, int, str]:
    """Return first and last byte of a tensor, and its name."""
    name = name[:80]
    if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
        raise ValueError(f"tensor '{name}' is not described by dtype, shape and data_offsets")
    dtype, shape, offsets = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(dtype, str) or dtype not in _SIZES:
        raise ValueError(f"tensor '{name}' has type {str(dtype)[:20]!r}")
    is_shape = isinstance(shape, list) and len(shape) <= _MAX_DIMENSIONS and _all_of(int, shape)
    if not is_shape or any(not 0 <= size < 2**48 for size in shape):
        raise ValueError(f"tensor '{name}' has shape {str(shape)[:80]}")
    if not isinstance(offsets, list) or len(offsets) != 2 or not _all_of(int, offsets):
        raise ValueError(f"tensor '{name}' has data_offsets {str(offsets)[:80]}")
    first, last = offsets
    if not 0 <= first <= last or last - first != math.prod(shape) * _SIZES[dtype]:
        raise ValueError(f"tensor '{name}' of {dtype} {shape} does not fit into {offsets}")
    return first, last, name


def _all_of(kind: type, values: Iterable[Any]) -> bool:
    return all(type(value) is kind for value in values)
