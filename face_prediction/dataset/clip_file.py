"""The file of one clip of a dataset: frames, sequences and their images as JPEG.

Legend: T frames, N sequences, F frames of one, P images.
"""

from __future__ import annotations

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
from robo_manip_baselines.runs.files import atomic_file
from robo_manip_baselines.runs.images import REDUCTIONS

SCHEMA = "face_dataset_clip"
VERSION = 1

READ_ERRORS = (KeyError, ValueError, OSError, RuntimeError, TypeError, OverflowError, MemoryError)
"""Errors that h5py and HDF5 raise on damaged bytes."""

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
    with atomic_file(path) as temporary, h5py.File(temporary, "w", libver=_HDF5_FORMAT) as file:
        file.attrs["schema"] = SCHEMA
        file.attrs["version"] = VERSION
        file.attrs["record"] = json.dumps(dict(record), sort_keys=True)
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
        _write(file, "pictures/data", whole, _CHUNK_BYTES)


def _write(file: h5py.File, name: str, values: np.ndarray, chunk: int = 0) -> h5py.Dataset:
    """An array with checksums, in pieces of ``chunk`` rows (0: all)."""
    if not len(values):
        return file.create_dataset(name, data=values, track_times=False)
    rows = min(chunk or len(values), len(values))
    shape = (rows, *values.shape[1:])
    return file.create_dataset(name, data=values, chunks=shape, fletcher32=True, track_times=False)


def open_clip(path: Path) -> h5py.File:
    """Open the file of a clip for reading; the caller closes it.

    Raises:
        RequestError: it is absent, damaged, or of another schema or version.
    """
    if not path.is_file():
        raise RequestError(f"{path}: no such file; expected a '{SCHEMA}' .h5")
    with ExitStack() as stack:
        try:
            file = stack.enter_context(h5py.File(path, "r"))
            schema, version = file.attrs.get("schema"), file.attrs.get("version")
        except READ_ERRORS as error:
            raise RequestError(f"{path}: {damage(error)}") from None
        if schema != SCHEMA or version != VERSION:
            expected = f"expected '{SCHEMA}' {VERSION}; make the dataset again"
            raise RequestError(f"{path}: schema '{schema}' version {version}, {expected}")
        stack.pop_all()
        return file


def read_array(path: Path, file: h5py.File, name: str, rows: Any = ()) -> np.ndarray:
    """Rows of one array of an open clip file.

    Raises:
        RequestError: it is missing or damaged; the message names file and array.
    """
    try:
        item = file[name]
        if not isinstance(item, h5py.Dataset):
            raise KeyError("no array")
        return np.asarray(item[rows])
    except READ_ERRORS as error:
        raise RequestError(f"{path}: '{name}': {damage(error)}") from None


def read_record(path: Path, file: h5py.File) -> dict[str, Any]:
    """Sources and settings of the file, with ``image_size`` and the counts.

    Raises:
        RequestError: it is damaged.
    """
    try:
        texts = [str(file.attrs[name]) for name in ("record", "counts")]
        record, counts = (convert(parse_json(text, str(path)), dict, str(path)) for text in texts)
        return {**record, **counts}
    except RequestError:
        raise
    except READ_ERRORS as error:
        raise RequestError(f"{path}: {damage(error)}") from None


def damage(error: BaseException) -> str:
    """One line on an error of `READ_ERRORS`."""
    text = " ".join(str(error).split()) or type(error).__name__
    return f"damaged ({text[:160]}); make the dataset again"
