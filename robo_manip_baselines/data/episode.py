"""Reading an episode file, without loading its images."""

from __future__ import annotations

import re
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from robo_manip_baselines.data.attributes import loaded_attribute
from robo_manip_baselines.data.images import decode_image, image_checksum
from robo_manip_baselines.data.schema import (
    ATTRIBUTES,
    FIELD_BY_NAME,
    IMAGE_GROUP,
    READABLE_VERSIONS,
    SCHEMA,
    fields_of,
)
from robo_manip_baselines.errors import RequestError, require_choice

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
            self.attributes = {
                item.name: loaded_attribute(item, self._file.attrs[item.name])
                for item in ATTRIBUTES
            }
        except READ_ERRORS as error:
            self._file.close()
            if isinstance(error, EpisodeFileError):
                raise
            raise EpisodeFileError(f"'{self.path}' is damaged: {one_line(error)}") from error

    def __enter__(self) -> EpisodeReader:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __len__(self) -> int:
        return int(self.attributes["num_steps"])

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras that have images."""
        return tuple(self.attributes["cameras"])

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields of the table that a file of its schema version holds."""
        return fields_of(self.attributes["schema_version"])

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
        require_choice("field", name, FIELD_BY_NAME)
        try:
            return np.asarray(dataset_of(self._file, name)[()])
        except READ_ERRORS as error:
            raise EpisodeFileError(
                f"'{self.path}': '{name}' cannot be read: {one_line(error)}"
            ) from error

    def encoded_frame(self, camera: str, step: int) -> np.ndarray:
        """The bytes of one picture, (N,) uint8; with the codec ``raw`` the (H, W, 3) image.

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
        """One picture, (H, W, 3) uint8 RGB. Raises as `encoded_frame` does."""
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
    """The encoded pictures of one camera in an open file.

    Raises:
        KeyError, ValueError, OSError: see `READ_ERRORS`; if something is missing or damaged.
    """

    def __init__(self, file: h5py.File, camera: str, num_steps: int) -> None:
        group = f"{IMAGE_GROUP}/{camera}"
        self._data = dataset_of(file, f"{group}/data")
        self.checksum: np.ndarray = dataset_of(file, f"{group}/checksum")[()]
        self._offset: np.ndarray | None = None
        if self._data.ndim == 1:
            self._offset = dataset_of(file, f"{group}/offset")[()]
        frames = len(self._data) if self._offset is None else len(self._offset) - 1
        if frames != num_steps or self.checksum.shape != (num_steps,):
            raise ValueError(f"{frames} frames instead of {num_steps}")

    def encoded(self, step: int) -> np.ndarray:
        """One picture as it was given to the writer; raises if it is not that any more."""
        if self._offset is None:
            data = np.asarray(self._data[step])
        else:
            data = np.asarray(self._data[int(self._offset[step]) : int(self._offset[step + 1])])
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
