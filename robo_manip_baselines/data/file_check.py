"""Finding damage in one episode file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from robo_manip_baselines.data.attributes import (
    content_digest,
    episode_consistency,
    loaded_attribute,
)
from robo_manip_baselines.data.checks import shape_problems, value_problems
from robo_manip_baselines.data.episode import (
    READ_ERRORS,
    EpisodeFileError,
    FrameStore,
    one_line,
    open_hdf5,
    require_schema,
)
from robo_manip_baselines.data.images import decode_image
from robo_manip_baselines.data.schema import (
    ATTRIBUTE_BY_NAME,
    ATTRIBUTES,
    FIELD_BY_NAME,
    FIELDS,
    IMAGE_GROUP,
)


@dataclass(frozen=True)
class Problem:
    """Something wrong with a file. A warning does not make the file unusable."""

    path: Path
    message: str
    is_warning: bool = False

    def __str__(self) -> str:
        return f"{self.path}: {'warning: ' if self.is_warning else ''}{self.message}"


def verify_file(path: str | Path, *, images: bool = True) -> list[Problem]:
    """Everything that is wrong with one episode file; an empty list means that it is whole.

    Args:
        path: the file.
        images: read and decode every picture, too; without it only their number is checked.
    """
    path = Path(path)
    try:
        with open_hdf5(path) as file:
            require_schema(path, file)
            return _file_problems(path, file, images)
    except EpisodeFileError as error:
        return [Problem(path, str(error).removeprefix(f"'{path}' ").removeprefix("is "))]
    except READ_ERRORS as error:
        return [Problem(path, f"cannot be read: {one_line(error)}")]


def _file_problems(path: Path, file: h5py.File, images: bool) -> list[Problem]:
    attributes, messages = readable_attributes(file)
    arrays, found = _arrays(file, attributes.get("schema_version", 1))
    messages += found
    shapes = {name: array.shape for name, array in arrays.items()}
    wrong_shapes = shape_problems(shapes)
    messages += wrong_shapes
    phases = attributes.get("phase_names")
    if not wrong_shapes:
        for name, array in arrays.items():
            messages += value_problems(
                FIELD_BY_NAME[name], array, len(phases) if isinstance(phases, list) else None
            )
        messages += episode_consistency(attributes, arrays)
    checksums: dict[str, np.ndarray] = {}
    for camera in _names(attributes.get("cameras")):
        try:
            frames = FrameStore(file, camera, attributes.get("num_steps", 0))
        except READ_ERRORS as error:
            messages.append(f"'{IMAGE_GROUP}/{camera}' cannot be read: {one_line(error)}")
            continue
        checksums[camera] = frames.checksum
        if images:
            messages += _image_problems(frames, camera, attributes)
    if not messages and (
        content_digest(arrays, checksums, attributes) != attributes["content_sha256"]
    ):
        messages.append("contents do not fit 'content_sha256': something was changed")
    problems = [Problem(path, message) for message in messages]
    return problems + [
        Problem(path, f"unknown {name}", is_warning=True) for name in _unknown(file, attributes)
    ]


def readable_attributes(file: h5py.File) -> tuple[dict[str, Any], list[str]]:
    """The attributes that can be read, and what is wrong with the others."""
    attributes: dict[str, Any] = {}
    problems: list[str] = []
    for item in ATTRIBUTES:
        if item.name not in file.attrs:
            problems.append(f"attribute '{item.name}' is missing")
            continue
        try:
            attributes[item.name] = loaded_attribute(item, file.attrs[item.name])
        except READ_ERRORS as error:
            problems.append(f"attribute '{item.name}' cannot be read: {one_line(error)}")
    return attributes, problems


def _arrays(file: h5py.File, version: int) -> tuple[dict[str, np.ndarray], list[str]]:
    arrays: dict[str, np.ndarray] = {}
    problems: list[str] = []
    for field in FIELDS:
        dataset = file.get(field.name)
        if dataset is None and field.since > version:
            continue
        if not isinstance(dataset, h5py.Dataset):
            problems.append(f"'{field.name}' is missing")
        elif dataset.dtype != np.dtype(field.dtype):
            problems.append(f"'{field.name}' is {dataset.dtype}, not {field.dtype}")
        else:
            try:
                arrays[field.name] = np.asarray(dataset[()])
            except READ_ERRORS as error:
                problems.append(f"'{field.name}' cannot be read: {one_line(error)}")
                continue
            unit = dataset.attrs.get("unit", b"")
            unit = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
            if unit != field.unit:
                problems.append(f"'{field.name}' is in {unit!r}, not in '{field.unit}'")
    return arrays, problems


def _image_problems(frames: FrameStore, camera: str, attributes: dict[str, Any]) -> Iterable[str]:
    """The first problem of each kind that a camera's frames have."""
    problems: dict[str, str] = {}
    size = attributes.get("image_size")
    for step in range(len(frames.checksum)):
        where = f"frame {step} of '{camera}'"
        try:
            data = frames.encoded(step)
        except READ_ERRORS as error:
            problems.setdefault("read", f"{where} cannot be read: {one_line(error)}")
            continue
        try:
            image = decode_image(data)
        except ValueError as error:
            problems.setdefault("decode", f"{where} cannot be decoded: {one_line(error)}")
            continue
        if list(image.shape) != [*(size or ()), 3] or image.dtype != np.uint8:
            problems.setdefault("size", f"{where} is {image.shape} {image.dtype}, not {size}")
    return problems.values()


def _unknown(file: h5py.File, attributes: dict[str, Any]) -> Iterable[str]:
    """Keys that the table does not know: of another release, or put there by somebody."""
    known = {*FIELD_BY_NAME, IMAGE_GROUP}
    yield from (f"key '{name}'" for name in file if name not in known)
    yield from (f"attribute '{name}'" for name in file.attrs if name not in ATTRIBUTE_BY_NAME)
    cameras = set(_names(attributes.get("cameras")))
    members = file.get(IMAGE_GROUP)
    if isinstance(members, h5py.Group):
        yield from (f"key '{IMAGE_GROUP}/{name}'" for name in members if name not in cameras)


def _names(value: Any) -> list[str]:
    return [name for name in value if isinstance(name, str)] if isinstance(value, list) else []
