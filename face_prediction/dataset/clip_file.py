"""The file of one clip of a dataset: frames, sequences and their images as JPEG.

Legend: T frames, N sequences, F frames of one, P images.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from face_prediction.dataset.sequences import STATISTICS, ClipFrames, Sequences
from robo_manip_baselines.runs.documents import convert, parse_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_hdf5
from robo_manip_baselines.runs.hdf5 import IN_USE, READ_ERRORS, attribute_of, dataset_of, open_hdf5
from robo_manip_baselines.runs.images import REDUCTIONS
from robo_manip_baselines.runs.npz import add_array

SCHEMA = "face_dataset_clip"
VERSION = 1

_HDF5_FORMAT = ("v110", "v110")  # from this release on, HDF5 keeps checksums of its own structure
_CHUNK_BYTES = 65536  # of the images; a sequence of 256 x 256 images is some ten of these
_CHUNK_FRAMES = 25  # of landmarks; a sequence reads three or four of these

FRAME_ARRAYS: tuple[tuple[str, tuple[int, ...], str, str, str], ...] = (
    ("landmarks", (468, 3), "float32", "image", "Normalised image coordinates, as in a FaceTrack"),
    ("valid", (), "bool", "", "The face was found"),
    ("interpolated", (), "bool", "", "Made from two decoded frames"),
    ("timestamps", (), "float64", "s", "On the video's clock"),
    ("mouth", (3,), "float64", "m", "Mouth centre, camera frame"),
    ("orientation", (4,), "float64", "1", "Quaternion w, x, y, z: camera from head"),
    ("jaw", (), "float64", "m", "Between the inner lips"),
    ("source_frame", (), "int64", "", "The decoded frame nearest in time"),
    ("image_lag", (), "float64", "s", "That frame's time less this one's"),
)
"""Arrays of a clip, a row for each frame: name, shape after T, type, unit, description."""

_ARRAYS: dict[str, tuple[str, int, tuple[int, ...]]] = {
    **{f"frames/{n}": (dtype, 432_000, shape) for n, shape, dtype, _, _ in FRAME_ARRAYS},
    "sequences/start": ("int64", 432_000, ()),
    "sequences/crop": ("int64", 432_000, (3,)),
    **{f"sequences/{name}": ("float64", 432_000, ()) for name in STATISTICS},
    "pictures/index": ("int64", 432_000, (-1,)),
    "pictures/offset": ("int64", 10**8, ()),
    "pictures/checksum": ("uint32", 10**8, ()),
    "pictures/data": ("uint8", 2**40, ()),
}
"""Arrays of a file: type, most rows (two hours of frames), shape of a row; -1 for any size."""

_IMAGES = "pictures/data"
"""The one array that is never read whole; ``pictures/checksum`` stands for it in the digest."""


def reduction(crop_size: int, size: int) -> int:
    """The reduction of images of side ``crop_size`` to side ``size``, one of `REDUCTIONS`.

    Raises:
        RequestError: there is none.
    """
    for reduce in REDUCTIONS:
        if size * reduce == crop_size:
            return reduce
    sizes = ", ".join(str(crop_size // reduce) for reduce in REDUCTIONS)
    raise RequestError(
        f"images of {size} pixels: this dataset can give {sizes}; "
        "use one with images of the size that the network was trained with"
    )


@dataclass(frozen=True)
class EncodedImages:
    """Images of the sequences of a clip, each once, in the order of the sequences.

    Attributes:
        encoded: P arrays of JPEG bytes.
        index: (N, F) int: the image of each frame.
    """

    encoded: Sequence[np.ndarray]
    index: np.ndarray


def write_clip(
    path: Path,
    frames: ClipFrames,
    sequences: Sequences,
    images: EncodedImages,
    statistics: Mapping[str, np.ndarray],
    record: Mapping[str, Any],
) -> None:
    """Write the file of one clip, whole or not at all. The same content gives the same bytes.

    ``statistics`` are the columns of `STATISTICS`, each (N,), ``record`` sources and settings.
    """
    with atomic_hdf5(path, _HDF5_FORMAT) as file:
        file.attrs["schema"] = SCHEMA
        file.attrs["version"] = VERSION
        counts = {
            "image_size": list(frames.image_size),
            "sequences": len(sequences),
            "candidates": sequences.candidates,
            "dropped": dict(sequences.dropped),
        }
        file.attrs["counts"] = json.dumps(counts, sort_keys=True)
        for name, shape, dtype, unit, description in FRAME_ARRAYS:
            values = np.asarray(getattr(frames, name)).astype(dtype)
            if values.shape != (len(frames), *shape):
                raise ValueError(f"'{name}' is {values.shape}, not {(len(frames), *shape)}")
            item = _write(file, f"frames/{name}", values, _CHUNK_FRAMES if shape == (468, 3) else 0)
            item.attrs["unit"], item.attrs["description"] = unit, description
        _write(file, "sequences/start", sequences.start.astype(np.int64))
        corners = [(crop.left, crop.top, crop.side) for crop in sequences.crops]
        _write(file, "sequences/crop", np.array(corners, dtype=np.int64).reshape(-1, 3))
        for name, (unit, description) in STATISTICS.items():
            item = _write(file, f"sequences/{name}", statistics[name].astype(np.float64))
            item.attrs["unit"], item.attrs["description"] = unit, description
        _write(file, "pictures/index", images.index.astype(np.int64))
        _write(file, "pictures/offset", np.cumsum([0, *map(len, images.encoded)], dtype=np.int64))
        sums = [zlib.crc32(data.tobytes()) for data in images.encoded]
        _write(file, "pictures/checksum", np.array(sums, dtype=np.uint32))
        whole = np.concatenate([*images.encoded, np.zeros(0, dtype=np.uint8)])
        _write(file, _IMAGES, whole, _CHUNK_BYTES)
        file.attrs["record"] = json.dumps(dict(record), sort_keys=True)
        file.flush()  # arrays count as stored from here on
        digest = content_digest(path, file)
        file.attrs["record"] = json.dumps({**record, "content_sha256": digest}, sort_keys=True)


def _write(file: h5py.File, name: str, values: np.ndarray, chunk: int = 0) -> h5py.Dataset:
    """An array with checksums, in pieces of ``chunk`` rows (0: all)."""
    if not len(values):
        return file.create_dataset(name, data=values, track_times=False)
    rows = min(chunk or len(values), len(values))
    shape = (rows, *values.shape[1:])
    return file.create_dataset(name, data=values, chunks=shape, fletcher32=True, track_times=False)


def open_clip(path: Path, *, verify: bool = True) -> h5py.File:
    """Open the file of a clip for reading; the caller closes it.

    Args:
        path: the file.
        verify: read all arrays but the images, and compare them with the digest in the file.

    Raises:
        RequestError: it is absent, damaged, of another schema or version, or was changed after it
            was made.
    """
    if not path.is_file():
        raise RequestError(f"{path}: no such file; expected a '{SCHEMA}' .h5")
    with ExitStack() as stack:
        try:
            file = stack.enter_context(open_hdf5(path))
            given = ("schema", "version")
            schema, version = (attribute_of(file, n) if n in file.attrs else None for n in given)
        except READ_ERRORS as error:
            raise RequestError(f"{path}: {damage(error)}") from None
        if schema != SCHEMA or version != VERSION:
            expected = f"expected '{SCHEMA}' {VERSION}; make the dataset again"
            raise RequestError(f"{path}: schema '{schema}' version {version}, {expected}")
        if verify:
            recorded = read_record(path, file).get("content_sha256")  # files of older releases: no
            if recorded is not None and recorded != content_digest(path, file):
                problem = "was changed after it was made (its SHA-256 is another)"
                raise RequestError(f"{path}: {problem}; make the dataset again")
        stack.pop_all()
        return file


def content_digest(path: Path, file: h5py.File) -> str:
    """Return the SHA-256 of sources, settings and arrays, with checksums in place of the images.

    Raises:
        RequestError: an array is missing or damaged.
    """
    digest = hashlib.sha256()
    record = read_record(path, file)
    record.pop("content_sha256", None)
    digest.update(json.dumps(record, sort_keys=True).encode())
    for name in _ARRAYS:
        if name != _IMAGES:
            add_array(digest, name, read_array(path, file, name))
    return digest.hexdigest()


def clip_array(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """Return one array of an open clip file, checked but not read.

    Raises:
        RequestError: it is missing, damaged, or of another type or shape.
    """
    dtype, rows, shape = _ARRAYS[name]
    try:
        item = dataset_of(file, name)
        fits = item.ndim == 1 + len(shape) and all(
            size in (-1, got) for size, got in zip(shape, item.shape[1:], strict=True)
        )
        if not fits or item.dtype != np.dtype(dtype) or len(item) > rows:
            raise ValueError(f"{item.dtype} {item.shape}, not {dtype} ({rows} rows or less)")
    except READ_ERRORS as error:
        raise RequestError(f"{path}: '{name}': {damage(error)}") from None
    return item


def read_array(path: Path, file: h5py.File, name: str, rows: Any = ()) -> np.ndarray:
    """Rows of one array of an open clip file.

    Raises:
        RequestError: it is missing or damaged; the message names file and array.
    """
    return read_rows(path, clip_array(path, file, name), name, rows)


def read_rows(path: Path, array: h5py.Dataset, name: str, rows: Any = ()) -> np.ndarray:
    """Rows of an array from `clip_array`. Raises as `read_array` does."""
    try:
        return np.asarray(array[rows])
    except READ_ERRORS as error:
        raise RequestError(f"{path}: '{name}': {damage(error)}") from None


def read_record(path: Path, file: h5py.File) -> dict[str, Any]:
    """Sources and settings of the file, with ``image_size`` and the counts.

    Raises:
        RequestError: it is damaged.
    """
    result: dict[str, Any] = {}
    try:
        for name in ("record", "counts"):
            given = attribute_of(file, name)
            text = given if isinstance(given, str) else given.decode()
            result |= convert(parse_json(text, f"'{name}'"), dict, f"'{name}'")
        size = result["image_size"]
        if not (isinstance(size, list) and [type(x) for x in size] == [int, int] and min(size) > 0):
            raise ValueError(f"image_size {str(size)[:40]}")
    except (AttributeError, *READ_ERRORS) as error:
        raise RequestError(f"{path}: {damage(error)}") from None
    return result


def damage(error: BaseException) -> str:
    """One line on an error of `READ_ERRORS`."""
    if str(error).startswith(IN_USE):
        return str(error)
    text = " ".join(str(error).split()) or type(error).__name__
    return f"damaged ({text[:160]}); make the dataset again"
