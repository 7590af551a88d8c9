"""Writing an episode file: checked first, then whole or not there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from robo_manip_baselines.data.attributes import (
    content_digest,
    episode_consistency,
    loaded_attribute,
    stored_attribute,
    stored_text,
)
from robo_manip_baselines.data.checks import shape_problems, value_problems
from robo_manip_baselines.data.files import atomic_file
from robo_manip_baselines.data.images import CODECS, decode_image, image_checksum
from robo_manip_baselines.data.schema import (
    ATTRIBUTES,
    FIELD_BY_NAME,
    FIELDS,
    IMAGE_GROUP,
    SCHEMA,
    fields_of,
    version_of,
)
from robo_manip_baselines.errors import require_choice

# From this release of the file format on, HDF5 keeps checksums of its own structure.
_HDF5_FORMAT = ("v110", "v110")

# Of pictures one after another: about one JPEG of 480 x 640, so that one frame reads one or two.
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
        arrays: every field of `schema.FIELDS`, those that are not in every schema version
            where they are known; float32 is widened.
        images: camera -> T frames, each from `images.encode_image` with the codec that
            ``attributes["image_codec"]`` names. Empty without cameras.
        attributes: every attribute of `schema.ATTRIBUTES` that is not derived.

    Returns:
        ``path``.

    Raises:
        ValueError: if the content does not fit the table; names everything that is wrong.
        OSError: if the file cannot be written.
    """
    path = Path(path)
    fields = _checked_arrays(arrays)
    checksums = {
        camera: np.array([image_checksum(frame) for frame in frames], dtype=np.uint32)
        for camera, frames in sorted(images.items())
    }
    stored, loaded = _checked_attributes(
        attributes, images, len(fields["time"]), version_of(fields)
    )
    problems = episode_consistency(loaded, fields)
    problems += value_problems(
        FIELD_BY_NAME["phase"], np.asarray(arrays["phase"]), len(loaded["phase_names"])
    )
    if problems:
        raise ValueError(f"episode for '{path}': {'; '.join(problems)}")
    stored["content_sha256"] = stored_text(content_digest(fields, checksums, loaded))
    with (
        atomic_file(path) as temporary,
        h5py.File(temporary, "w", libver=_HDF5_FORMAT) as file,
    ):
        for item in ATTRIBUTES:
            file.attrs[item.name] = stored[item.name]
        for field in FIELDS:
            if field.name not in fields:
                continue
            _write_array(file, field.name, fields[field.name])
            for name in ("unit", "frame", "description"):
                file[field.name].attrs[name] = stored_text(getattr(field, name))
        for camera, frames in sorted(images.items()):
            _write_frames(file, f"{IMAGE_GROUP}/{camera}", frames)
            _write_array(file, f"{IMAGE_GROUP}/{camera}/checksum", checksums[camera])
    return path


def _checked_arrays(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    values = {name: np.asarray(array) for name, array in arrays.items()}
    problems = [f"'{name}' is missing" for name in fields_of(1) if name not in values]
    problems += [f"'{name}' is no field" for name in values if name not in FIELD_BY_NAME]
    problems += shape_problems({name: value.shape for name, value in values.items()})
    for field in FIELDS:
        if field.name in values and not np.can_cast(
            values[field.name].dtype, field.dtype, "same_kind"
        ):
            given = values[field.name].dtype
            problems.append(f"'{field.name}' is {given}, not {field.dtype}")
    if not problems:
        for name, value in values.items():
            problems += value_problems(FIELD_BY_NAME[name], value, None)
    if problems:
        raise ValueError(f"these arrays are no episode: {'; '.join(problems)}")
    return {name: value.astype(FIELD_BY_NAME[name].dtype) for name, value in values.items()}


def _checked_attributes(
    attributes: Mapping[str, Any], images: EncodedImages, num_steps: int, version: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Both forms of all attributes: as HDF5 keeps them, and as they are read back."""
    given = {item.name for item in ATTRIBUTES if not item.derived}
    problems = [f"attribute '{name}' is missing" for name in sorted(given - set(attributes))]
    problems += [f"attribute '{name}' is not for the caller" for name in set(attributes) - given]
    if problems:
        raise ValueError(f"these attributes are no episode's: {'; '.join(problems)}")
    codec = require_choice("image codec", attributes["image_codec"], CODECS)
    values: dict[str, Any] = {
        **attributes,
        "schema": SCHEMA,
        "schema_version": version,
        "content_sha256": "",
        "num_steps": num_steps,
        "cameras": sorted(images),
        "image_size": _image_size(images, codec, num_steps),
    }
    stored = {item.name: stored_attribute(item, values[item.name]) for item in ATTRIBUTES}
    loaded = {item.name: loaded_attribute(item, stored[item.name]) for item in ATTRIBUTES}
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
        height, width, _ = decode_image(frames[0]).shape
        sizes[camera] = (height, width)
    if len(set(sizes.values())) > 1:
        raise ValueError(f"images differ in size: {sizes}")
    return next(iter(sizes.values()), (0, 0))


def _write_array(file: h5py.File, name: str, values: np.ndarray) -> None:
    file.create_dataset(
        name,
        data=values,
        chunks=values.shape,
        compression="gzip",
        compression_opts=4,
        shuffle=True,
        fletcher32=True,
        track_times=False,
    )


def _write_frames(file: h5py.File, name: str, frames: Sequence[np.ndarray]) -> None:
    """Raw images as (T, H, W, 3), a chunk each; others as bytes one after another."""
    if frames[0].ndim == 1:
        sizes = [frame.size for frame in frames]
        _write_array(file, f"{name}/offset", np.cumsum([0, *sizes], dtype=np.int64))
        shape, chunks = (sum(sizes),), (min(sum(sizes), _CHUNK_BYTES),)
    else:
        shape, chunks = (len(frames), *frames[0].shape), (1, *frames[0].shape)
    dataset = file.create_dataset(
        f"{name}/data", shape, np.uint8, chunks=chunks, fletcher32=True, track_times=False
    )
    if frames[0].ndim == 1:
        dataset[:] = np.concatenate(frames)
    else:
        for step, frame in enumerate(frames):
            dataset[step] = frame
