"""Episode files: one HDF5 file an episode, read lazily, written atomically.

Images are RGB, (H, W, 3) uint8, and stored as JPEG, PNG or raw.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from robo_manip_baselines.data.schema import (
    IMAGE_GROUP,
    READABLE_VERSIONS,
    SCHEMA,
    EpisodeSchema,
    content_digest,
    episode_consistency,
    loaded_attribute,
    shape_problems,
    stored_attribute,
    stored_text,
    value_problems,
)
from robo_manip_baselines.envs.mujoco.tasks.registry import TaskEntry, entry_of_id
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import atomic_hdf5
from robo_manip_baselines.runs.images import CODECS, decode_image


def image_checksum(data: np.ndarray) -> int:
    """CRC-32 of an encoded image, as kept beside it in the episode file."""
    return zlib.crc32(np.ascontiguousarray(data).reshape(-1).data)


# Whatever HDF5 and h5py raise on damaged bytes.
READ_ERRORS = (KeyError, ValueError, OSError, RuntimeError, TypeError, OverflowError, MemoryError)


class EpisodeFileError(RequestError):
    """A file that was given is no whole episode: the message names the file and why."""


def read_metadata(path: str | Path) -> dict[str, Any]:
    """The attributes of an episode file, JSON parsed, nothing else read.

    Raises:
        EpisodeFileError: if the file is not there, damaged, or of another schema.
    """
    with EpisodeReader(path) as episode:
        return dict(episode.attributes)


class EpisodeReader:
    """An open episode file. Nothing but attributes is read until it is asked for.

    Use as a context manager. Numbers and frames are checked against their checksums as they are
    read, so that damage is an error and never wrong data.

    Attributes:
        path: the file.
        task: entry of the task that was recorded.
        schema: of its files.
        attributes: name -> value, JSON parsed, vectors as float64 arrays.

    Raises:
        EpisodeFileError: if the file is not there, damaged, or of another schema or version.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._frames: dict[str, FrameStore] = {}
        self._file = open_hdf5(self.path)
        try:
            require_schema(self.path, self._file)
            self.task = task_of(self._file)
            self.schema = EpisodeSchema.of(self.task)
            self.attributes = {
                item.name: loaded_attribute(item, self._file.attrs[item.name])
                for item in self.schema.attributes
            }
        except READ_ERRORS as error:
            self._file.close()
            if isinstance(error, RequestError):
                raise
            raise EpisodeFileError(f"'{self.path}' is damaged: {one_line(error)}") from error

    def __enter__(self) -> EpisodeReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return int(self.attributes["num_steps"])

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that have images."""
        return tuple(self.attributes["cameras"])

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields that the file holds."""
        return self.schema.fields_of(self.attributes["schema_version"], self._file)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Every field that the file holds, read from the file at each call."""
        return {name: self.array(name) for name in self.fields}

    def array(self, name: str) -> np.ndarray:
        """One field, all steps.

        Raises:
            RequestError: for an unknown name.
            EpisodeFileError: if it is missing or damaged.
        """
        require_choice("field", name, self.schema.by_name)
        try:
            return np.asarray(dataset_of(self._file, name)[()])
        except READ_ERRORS as error:
            raise EpisodeFileError(
                f"'{self.path}': '{name}' cannot be read: {one_line(error)}"
            ) from error

    def encoded_frame(self, camera: str, step: int) -> np.ndarray:
        """The bytes of one image, (N,) uint8; with the codec ``raw`` the (H, W, 3) image.

        Raises:
            RequestError: for a camera or step that the episode does not have.
            EpisodeFileError: if the bytes are damaged.
        """
        require_choice("camera", camera, self.cameras)
        if not 0 <= step < len(self):
            raise RequestError(f"'{self.path}' has steps 0…{len(self) - 1}, not {step}")
        try:
            if camera not in self._frames:
                self._frames[camera] = FrameStore(self._file, camera, len(self))
            return self._frames[camera].encoded(step)
        except READ_ERRORS as error:
            raise EpisodeFileError(
                f"'{self.path}': frame {step} of '{camera}' cannot be read: {one_line(error)}"
            ) from error

    def frame(self, camera: str, step: int) -> np.ndarray:
        """One image, (H, W, 3) uint8 RGB. Raises as `encoded_frame` does."""
        data = self.encoded_frame(camera, step)
        try:
            return decode_image(data)
        except ValueError as error:
            raise EpisodeFileError(
                f"'{self.path}': frame {step} of '{camera}': {one_line(error)}"
            ) from error

    def close(self) -> None:
        """Close the file; may be called again."""
        self._file.close()


class FrameStore:
    """The encoded images of one camera in an open file.

    Raises:
        KeyError, ValueError, OSError: see `READ_ERRORS`; if something is missing or damaged.
    """

    def __init__(self, file: h5py.File, camera: str, num_steps: int) -> None:
        group = f"{IMAGE_GROUP}/{camera}"
        self._data = dataset_of(file, f"{group}/data")
        self.checksum: np.ndarray = dataset_of(file, f"{group}/checksum")[()]
        is_joined = self._data.ndim == 1
        self._offset = dataset_of(file, f"{group}/offset")[()] if is_joined else None
        frames = len(self._data) if self._offset is None else len(self._offset) - 1
        if frames != num_steps or self.checksum.shape != (num_steps,):
            raise ValueError(f"{frames} frames instead of {num_steps}")

    def encoded(self, step: int) -> np.ndarray:
        """One image as it was given to the writer; raises if it is not that any more."""
        place = self._offset
        rows = step if place is None else slice(int(place[step]), int(place[step + 1]))
        data = np.asarray(self._data[rows])
        if image_checksum(data) != int(self.checksum[step]):
            raise ValueError("its checksum is wrong")
        return data


def open_hdf5(path: Path) -> h5py.File:
    """Open for reading.

    Raises:
        EpisodeFileError: if there is no such file, or it is no HDF5 file or a truncated one.
    """
    if not path.is_file():
        raise EpisodeFileError(f"'{path}' is no file")
    try:
        return h5py.File(path, "r")
    except PermissionError as error:
        raise EpisodeFileError(f"'{path}' cannot be read: permission denied") from error
    except (OSError, RuntimeError, KeyError) as error:
        raise EpisodeFileError(
            f"'{path}' is no HDF5 file, or a damaged one: {one_line(error)}"
        ) from error


def require_schema(path: Path, file: h5py.File) -> None:
    """Raise `EpisodeFileError` unless this is an episode of the version that this code reads."""
    schema, version = file.attrs.get("schema"), file.attrs.get("schema_version")
    schema = schema.decode(errors="replace") if isinstance(schema, bytes) else schema
    if schema != SCHEMA:
        raise EpisodeFileError(f"'{path}' is no episode: schema {schema!r}, not '{SCHEMA}'")
    if version not in READABLE_VERSIONS:
        raise EpisodeFileError(
            f"'{path}' has schema version {version}; this release reads "
            f"{', '.join(map(str, READABLE_VERSIONS))}"
        )


def task_of(file: h5py.File) -> TaskEntry:
    """Return the entry of the task of an episode file.

    Raises:
        KeyError, ValueError: the attribute ``env_id`` is missing or damaged.
        RequestError: no task of that id is registered here.
    """
    item = EpisodeSchema.of(None).attribute_by_name["env_id"]
    return entry_of_id(loaded_attribute(item, file.attrs[item.name]))


def dataset_of(file: h5py.File, name: str) -> h5py.Dataset:
    """The dataset of that name; raises KeyError if there is none."""
    dataset = file.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise KeyError(f"no dataset '{name}'")
    return dataset


def one_line(error: BaseException) -> str:
    """The message of an exception as one line."""
    message = error.args[0] if isinstance(error, KeyError) and error.args else error
    if re.search("filter returned failure|Fletcher32", str(message)):  # HDF5 2 and 1 say it so
        return "its checksum is wrong"
    return " ".join(str(message).split())


# From this release of the file format on, HDF5 keeps checksums of its own structure.
_HDF5_FORMAT = ("v110", "v110")

_CHECKED: dict[str, Any] = {"fletcher32": True, "track_times": False}

# Of images one after another: about one JPEG of 480 x 640, so that one frame reads one or two.
_CHUNK_BYTES = 65536

EncodedImages = Mapping[str, Sequence[np.ndarray]]


def write_episode(
    path: str | Path,
    arrays: Mapping[str, np.ndarray],
    images: EncodedImages,
    attributes: Mapping[str, Any],
) -> Path:
    """Check an episode against the table, then write it so that it is whole or not there.

    The same content gives the same bytes.

    Args:
        path: file to write, see `files.episode_path`. Replaced if it is there.
        arrays: every field of the task's schema, optional ones where they are known; float32 is
            widened.
        images: camera -> T frames, each from `encode_image` with the codec that
            ``attributes["image_codec"]`` names. Empty without cameras.
        attributes: every attribute of the schema that is not derived.

    Returns:
        ``path``.

    Raises:
        ValueError: if the content does not fit the table; names everything that is wrong.
        RequestError: the folder cannot be created or written to.
        WriteError: the disk is full, or fails.
    """
    path = Path(path)
    schema = EpisodeSchema.of(entry_of_id(attributes["env_id"]))
    fields = _checked_arrays(schema, arrays)
    checksums = {
        camera: np.array([image_checksum(frame) for frame in frames], dtype=np.uint32)
        for camera, frames in sorted(images.items())
    }
    stored, loaded = _checked_attributes(schema, attributes, images, fields)
    problems = episode_consistency(loaded, fields)
    phase = np.asarray(arrays["phase"])
    problems += value_problems(schema.by_name["phase"], phase, len(loaded["phase_names"]))
    if problems:
        raise ValueError(f"episode for '{path}': {'; '.join(problems)}")
    stored["content_sha256"] = stored_text(content_digest(schema, fields, checksums, loaded))
    with atomic_hdf5(path, _HDF5_FORMAT) as file:
        for item in schema.attributes:
            file.attrs[item.name] = stored[item.name]
        for field in schema.fields:
            if field.name in fields:
                _write_array(file, field.name, fields[field.name])
                for name in ("unit", "frame", "description"):
                    file[field.name].attrs[name] = stored_text(getattr(field, name))
        for camera, frames in sorted(images.items()):
            _write_frames(file, f"{IMAGE_GROUP}/{camera}", frames)
            _write_array(file, f"{IMAGE_GROUP}/{camera}/checksum", checksums[camera])
    return path


def _checked_arrays(
    schema: EpisodeSchema, arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    values = {name: np.asarray(array) for name, array in arrays.items()}
    problems = [f"'{name}' is missing" for name in schema.fields_of(3) if name not in values]
    problems += [f"'{name}' is no field" for name in values if name not in schema.by_name]
    problems += shape_problems(schema, {name: value.shape for name, value in values.items()})
    for field in schema.fields:
        given = values[field.name].dtype if field.name in values else field.dtype
        if not np.can_cast(given, field.dtype, "same_kind"):
            problems.append(f"'{field.name}' is {given}, not {field.dtype}")
    if not problems:
        for name, value in values.items():
            problems += value_problems(schema.by_name[name], value, None)
    if problems:
        raise ValueError(f"these arrays are no episode: {'; '.join(problems)}")
    return {name: value.astype(schema.by_name[name].dtype) for name, value in values.items()}


def _checked_attributes(
    schema: EpisodeSchema,
    attributes: Mapping[str, Any],
    images: EncodedImages,
    fields: Mapping[str, np.ndarray],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Both forms of all attributes: as HDF5 keeps them, and as they are read back."""
    given = {item.name for item in schema.attributes if not item.is_derived}
    problems = [f"attribute '{name}' is missing" for name in sorted(given - set(attributes))]
    problems += [f"attribute '{name}' is not for the caller" for name in set(attributes) - given]
    if problems:
        raise ValueError(f"these attributes are no episode's: {'; '.join(problems)}")
    codec = require_choice("image codec", attributes["image_codec"], CODECS)
    num_steps = len(fields["time"])
    values: dict[str, Any] = {
        **attributes,
        "schema": SCHEMA,
        "schema_version": schema.version_of(fields),
        "content_sha256": "",
        "num_steps": num_steps,
        "cameras": sorted(images),
        "image_size": _image_size(images, codec, num_steps),
    }
    stored = {item.name: stored_attribute(item, values[item.name]) for item in schema.attributes}
    loaded = {item.name: loaded_attribute(item, stored[item.name]) for item in schema.attributes}
    return stored, loaded


def _image_size(images: EncodedImages, codec: str, num_steps: int) -> tuple[int, int]:
    """Height and width of all images; raises ValueError where they differ."""
    sizes: dict[str, tuple[int, int]] = {}
    for camera, frames in images.items():
        if len(frames) != num_steps:
            raise ValueError(f"camera '{camera}' has {len(frames)} frames for {num_steps} steps")
        dimensions = 3 if codec == "raw" else 1
        for step, frame in enumerate(frames):
            if frame.dtype != np.uint8 or frame.ndim != dimensions or not frame.size:
                raise ValueError(
                    f"frame {step} of '{camera}' is {frame.shape} {frame.dtype}, no {codec} image"
                )
            if codec == "raw" and frame.shape != frames[0].shape:
                raise ValueError(f"frame {step} of '{camera}' is {frame.shape}, unlike the first")
        sizes[camera] = decode_image(frames[0]).shape[:2]
    if len(set(sizes.values())) > 1:
        raise ValueError(f"images differ in size: {sizes}")
    return next(iter(sizes.values()), (0, 0))


def _write_array(file: h5py.File, name: str, values: np.ndarray) -> None:
    packed: dict[str, Any] = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
    file.create_dataset(name, data=values, chunks=values.shape, **packed, **_CHECKED)


def _write_frames(file: h5py.File, name: str, frames: Sequence[np.ndarray]) -> None:
    """Raw images as (T, H, W, 3), a chunk each; others as bytes one after another."""
    if frames[0].ndim == 1:
        sizes = [frame.size for frame in frames]
        _write_array(file, f"{name}/offset", np.cumsum([0, *sizes], dtype=np.int64))
        shape, chunks = (sum(sizes),), (min(sum(sizes), _CHUNK_BYTES),)
    else:
        shape, chunks = (len(frames), *frames[0].shape), (1, *frames[0].shape)
    dataset = file.create_dataset(f"{name}/data", shape, np.uint8, chunks=chunks, **_CHECKED)
    if frames[0].ndim == 1:
        dataset[:] = np.concatenate(frames)
    else:
        for step, frame in enumerate(frames):
            dataset[step] = frame
