"""Episode files: one HDF5 file an episode, read lazily, written atomically.

Images are RGB, (H, W, 3) uint8, and stored as JPEG, PNG or raw.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from robo_manip_baselines.data.schema import (
    IMAGE_GROUP,
    READABLE_VERSIONS,
    SCHEMA,
    EpisodeSchema,
    attribute_problems,
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
from robo_manip_baselines.runs.hdf5 import (
    READ_ERRORS,
    attribute_of,
    dataset_of,
    one_line,
    open_hdf5,
    read_whole,
)
from robo_manip_baselines.runs.images import CODECS, decode_image, encoded_size


def image_checksum(data: np.ndarray) -> int:
    """CRC-32 of an encoded image, as kept beside it in the episode file."""
    return zlib.crc32(np.ascontiguousarray(data).reshape(-1).data)


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

    Use as a context manager. Arrays are read together, once, and checked against the schema and
    the digest of the file's content; frames are checked against their checksums as they are read.
    Damage and edits are errors, and never wrong data.

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
        self._file = open_episode(self.path)
        try:
            require_schema(self.path, self._file)
            self.task = task_of(self._file)
            self.schema = EpisodeSchema.of(self.task)
            self.attributes = {
                item.name: loaded_attribute(item, attribute_of(self._file, item.name))
                for item in self.schema.attributes_of(
                    int(attribute_of(self._file, "schema_version")), self._file.attrs
                )
            }
            if problems := attribute_problems(self.task, self.attributes):
                raise ValueError(problems[0])
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

    @cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """Every field that the file holds, read together and checked against the file's digest.

        Raises:
            EpisodeFileError: one is missing or damaged, or the file was edited after recording.
        """
        try:
            datasets, problems = field_datasets(self._file, self.schema, self.fields)
            problems += shape_problems(self.schema, {n: item.shape for n, item in datasets.items()})
            problems += episode_consistency(self.attributes, datasets)
            if problems:
                raise ValueError(problems[0])
            arrays = {name: read_whole(item) for name, item in datasets.items()}
            for name, values in arrays.items():
                phases = len(self.attributes["phase_names"])
                if problems := value_problems(self.schema.by_name[name], values, phases):
                    raise ValueError(problems[0])
            checksums = {camera: self._frame_store(camera).checksum for camera in self.cameras}
            digest = content_digest(self.schema, arrays, checksums, self.attributes)
            if digest != self.attributes["content_sha256"]:
                raise ValueError("it was changed after it was recorded (its SHA-256 is another)")
        except READ_ERRORS as error:
            raise EpisodeFileError(
                f"'{self.path}' cannot be used: {one_line(error)}; record this episode again, or "
                "remove the file"
            ) from error
        return arrays

    def array(self, name: str) -> np.ndarray:
        """One field, all steps; see `arrays`.

        Raises:
            RequestError: for an unknown name.
            EpisodeFileError: if the file lacks it, is damaged, or was edited after recording.
        """
        require_choice("field", name, self.schema.by_name)
        if name not in self.arrays:
            raise EpisodeFileError(f"'{self.path}': '{name}' is missing")
        return self.arrays[name]

    def encoded_frame(self, camera: str, step: int) -> np.ndarray:
        """The bytes of one image, (N,) uint8; with the codec ``raw`` the (H, W, 3) image.

        Raises:
            RequestError: for a camera or step that the episode does not have.
            EpisodeFileError: if the bytes are damaged.
        """
        require_choice("camera", camera, self.cameras)
        if not 0 <= step < len(self):
            raise RequestError(f"'{self.path}' has steps 0…{len(self) - 1}, not {step}")
        with self._reading(camera, step):
            return self._sized(self._frame_store(camera).encoded(step))

    def encoded_frames(self, camera: str) -> Iterator[np.ndarray]:
        """The bytes of every image of a camera, in order, as `encoded_frame` returns them.

        They are read together, in less than half the time of one after another.

        Raises:
            RequestError: for a camera that the episode does not have.
            EpisodeFileError: if the bytes are damaged.
        """
        require_choice("camera", camera, self.cameras)
        with self._reading(camera, 0):
            store = self._frame_store(camera)
        frames = store.all_encoded()
        for step in range(len(self)):
            with self._reading(camera, step):
                data = self._sized(next(frames))
            yield data

    def _sized(self, data: np.ndarray) -> np.ndarray:
        """Return the bytes of an image; raise ValueError if they declare another size."""
        if list(size := encoded_size(data)) != self.attributes["image_size"]:
            raise ValueError(f"it is {size}, not {self.attributes['image_size']}")
        return data

    @contextmanager
    def _reading(self, camera: str, step: int) -> Iterator[None]:
        """Say of which image an error is."""
        try:
            yield
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

    def _frame_store(self, camera: str) -> FrameStore:
        if camera not in self._frames:
            size = self.attributes["image_size"]
            self._frames[camera] = FrameStore(self._file, camera, len(self), size)
        return self._frames[camera]

    def close(self) -> None:
        """Close the file; may be called again."""
        self._file.close()


class FrameStore:
    """The encoded images of one camera in an open file.

    Raises:
        KeyError, ValueError, OSError: see `READ_ERRORS`; if something is missing or damaged.
    """

    def __init__(self, file: h5py.File, camera: str, num_steps: int, size: Sequence[int]) -> None:
        group = f"{IMAGE_GROUP}/{camera}"
        self._data = dataset_of(file, f"{group}/data")
        checksum = dataset_of(file, f"{group}/checksum")
        is_joined = self._data.ndim == 1
        offset = dataset_of(file, f"{group}/offset") if is_joined else None
        frames = len(self._data) if offset is None else len(offset) - 1
        if frames != num_steps or checksum.shape != (num_steps,):
            raise ValueError(f"{frames} frames instead of {num_steps}")
        if self._data.dtype != np.uint8 or checksum.dtype != np.uint32:
            raise ValueError(f"bytes of type {self._data.dtype}, checksums {checksum.dtype}")
        self.checksum: np.ndarray = read_whole(checksum)
        self._offset = None
        if offset is None:
            if self._data.shape != (num_steps, *size, 3):
                raise ValueError(f"frames of shape {self._data.shape[1:]}, not {(*size, 3)}")
            return
        if offset.dtype != np.int64 or offset.ndim != 1:
            raise ValueError(f"offsets of type {offset.dtype}")
        place = self._offset = read_whole(offset)
        sizes = np.diff(place)
        if place[0] or place[-1] != len(self._data):
            raise ValueError("its offsets do not divide its bytes")
        if sizes.min() < 0 or sizes.max() > 4 * int(np.prod(size)) * 3 + _CHUNK_BYTES:
            raise ValueError(f"a frame of {sizes.min()} or {sizes.max()} bytes")

    def encoded(self, step: int) -> np.ndarray:
        """One image as it was given to the writer; raises if it is not that any more."""
        place = self._offset
        rows = step if place is None else slice(int(place[step]), int(place[step + 1]))
        return self._checked(np.asarray(self._data[rows]), step)

    def all_encoded(self) -> Iterator[np.ndarray]:
        """Every image in order, as `encoded` returns it; those of a few kB are read together."""
        place, data = self._offset, None
        if place is not None:
            with suppress(*READ_ERRORS):  # of one of them, which is found below
                data = np.asarray(self._data[...])
        for step in range(len(self.checksum)):
            if data is None or place is None:
                yield self.encoded(step)
            else:
                yield self._checked(data[place[step] : place[step + 1]], step)

    def _checked(self, data: np.ndarray, step: int) -> np.ndarray:
        if image_checksum(data) != int(self.checksum[step]):
            raise ValueError("its checksum is wrong")
        return data


def open_episode(path: Path) -> h5py.File:
    """Open for reading.

    Raises:
        EpisodeFileError: if there is no such file, it is in use, or no HDF5 file or a truncated
            one.
    """
    try:
        return open_hdf5(path)
    except READ_ERRORS as error:
        raise EpisodeFileError(f"'{path}' is {one_line(error)}") from error


def field_datasets(
    file: h5py.File, schema: EpisodeSchema, names: Iterable[str]
) -> tuple[dict[str, h5py.Dataset], list[str]]:
    """Return the arrays of these names whose type is right, and what is wrong with the others."""
    found: dict[str, h5py.Dataset] = {}
    problems: list[str] = []
    for name in names:
        field = schema.by_name[name]
        try:
            dataset = dataset_of(file, name)
            if dataset.dtype != np.dtype(field.dtype):
                raise TypeError(f"'{name}' is {dataset.dtype}, not {field.dtype}")
        except KeyError:
            problems.append(f"'{name}' is missing")
            continue
        except READ_ERRORS as error:
            problems.append(one_line(error))
            continue
        found[name] = dataset
    return found, problems


def require_schema(path: Path, file: h5py.File) -> None:
    """Raise `EpisodeFileError` unless this is an episode of the version that this code reads."""
    given = ("schema", "schema_version")
    schema, version = (attribute_of(file, n) if n in file.attrs else None for n in given)
    schema = schema.decode(errors="replace") if isinstance(schema, bytes) else schema
    if schema != SCHEMA:
        raise EpisodeFileError(f"'{path}' is no episode: schema {schema!r}, not '{SCHEMA}'")
    if not isinstance(version, np.integer) or int(version) not in READABLE_VERSIONS:
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
    return entry_of_id(loaded_attribute(item, attribute_of(file, item.name)))


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
        attributes: every attribute of the schema that is not derived, optional ones where they are
            known.

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
    problems = attribute_problems(entry_of_id(attributes["env_id"]), loaded)
    problems += episode_consistency(loaded, fields)
    phase = np.asarray(arrays["phase"])
    problems += value_problems(schema.by_name["phase"], phase, len(loaded["phase_names"]))
    if problems:
        raise ValueError(f"episode for '{path}': {'; '.join(problems)}")
    stored["content_sha256"] = stored_text(content_digest(schema, fields, checksums, loaded))
    with atomic_hdf5(path, _HDF5_FORMAT) as file:
        for name, value in stored.items():
            file.attrs[name] = value
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
    needed = {item.name for item in schema.attributes if not item.is_optional} & given
    problems = [f"attribute '{name}' is missing" for name in sorted(needed - set(attributes))]
    problems += [f"attribute '{name}' is not for the caller" for name in set(attributes) - given]
    if problems:
        raise ValueError(f"these attributes are no episode's: {'; '.join(problems)}")
    codec = require_choice("image codec", attributes["image_codec"], CODECS)
    num_steps = len(fields["time"])
    values: dict[str, Any] = {
        **attributes,
        "schema": SCHEMA,
        "schema_version": schema.version_of(
            {name: values.shape for name, values in fields.items()}, attributes
        ),
        "content_sha256": "",
        "num_steps": num_steps,
        "cameras": sorted(images),
        "image_size": _image_size(images, codec, num_steps),
    }
    items = [item for item in schema.attributes if item.name in values]
    stored = {item.name: stored_attribute(item, values[item.name]) for item in items}
    loaded = {item.name: loaded_attribute(item, stored[item.name]) for item in items}
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
        sizes[camera] = encoded_size(frames[0])
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
