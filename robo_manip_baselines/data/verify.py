"""Verification of episode files, and of a folder of episodes that should belong together."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from robo_manip_baselines.data.episode import (
    EpisodeFileError,
    FrameStore,
    field_datasets,
    open_episode,
    require_schema,
    task_of,
)
from robo_manip_baselines.data.files import FAILED_FOLDER, list_episodes, list_failures, seed_of
from robo_manip_baselines.data.schema import (
    IMAGE_GROUP,
    POLICY_ATTRIBUTES,
    SCHEMA_VERSION,
    EpisodeSchema,
    attribute_problems,
    content_digest,
    episode_consistency,
    loaded_attribute,
    shape_problems,
    value_problems,
)
from robo_manip_baselines.envs.mujoco.tasks.registry import TaskEntry, without_library_path
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.hdf5 import (
    READ_ERRORS,
    attribute_of,
    one_line,
    read_whole,
    require_own_links,
)
from robo_manip_baselines.runs.images import decode_image
from robo_manip_baselines.runs.progress import track

SHARED_ATTRIBUTES = (*POLICY_ATTRIBUTES, "env_kwargs", "cameras", "image_size")
"""Attributes that the episodes of a folder must share."""

_MAY_DIFFER = "schema_version"
"""Attribute that is a warning where it differs: files of all versions serve short horizons."""


def verify_dataset(folder: str | Path, *, images: bool = True) -> list[Problem]:
    """Everything that is wrong with the episodes of a folder and its ``failed/``.

    Beyond `verify_file`: files of different kinds beside one another, a seed that is there twice,
    a name that does not fit the seed, a failure among the demonstrations, leftovers of killed
    runs.

    Raises:
        RequestError: if there is no such folder, or no episode in it.
    """
    folder = Path(folder)
    paths = list_episodes(folder) + list_failures(folder)
    if not paths:
        raise RequestError(f"'{folder}' holds no episode_*.hdf5 file")
    problems: list[Problem] = []
    with ThreadPoolExecutor(max_workers=2) as pool:  # HDF5 is serial; decoding images is not
        found = pool.map(lambda path: verify_file(path, images=images), paths)
        for of_one_file in track(found, len(paths), "file"):
            problems += of_one_file
    metadata = {path: _metadata(path) for path in paths}
    problems += mixture_problems(metadata) + _misplaced(metadata)
    text, leftovers = "left by a run that was killed; may be deleted", folder.glob("**/.*.partial")
    return problems + [Problem(path, text, True) for path in sorted(leftovers)]


def _metadata(path: Path) -> dict[str, Any]:
    """Return the attributes that can be read; damage has been reported already."""
    try:
        with open_episode(path) as file:
            return readable_attributes(file, _schema(file))[0]
    except (EpisodeFileError, *READ_ERRORS):
        return {}


def mixture_problems(metadata: Mapping[Path, Mapping[str, Any]]) -> list[Problem]:
    """Return the files that differ from most others in what the episodes of a folder share.

    Args:
        metadata: attributes of each file, as far as they can be read.
    """
    problems: list[Problem] = []
    for name in (*SHARED_ATTRIBUTES, _MAY_DIFFER):
        values = {
            path: json.dumps(_comparable(name, attributes[name]), sort_keys=True)
            for path, attributes in metadata.items()
            if name in attributes
        }
        counts = Counter(values.values()).most_common()
        if len(counts) > 1:
            usual, number = counts[0]
            problems += [
                Problem(
                    path,
                    f"{name} is {value}, but {usual} in {number} other files",
                    is_warning=name == _MAY_DIFFER,
                )
                for path, value in values.items()
                if value != usual
            ]
    return problems


def _comparable(name: str, value: Any) -> Any:
    is_kwargs = name == "env_kwargs" and isinstance(value, dict)
    return without_library_path(value) if is_kwargs else value


def _misplaced(metadata: dict[Path, dict[str, Any]]) -> list[Problem]:
    problems: list[Problem] = []
    by_seed: dict[int, list[Path]] = defaultdict(list)
    for path, attributes in metadata.items():
        seed = attributes.get("seed", seed_of(path))
        by_seed[seed].append(path)
        if seed != seed_of(path):
            problems.append(Problem(path, f"holds seed {seed}, which its name does not say"))
        if attributes.get("is_success") is False and path.parent.name != FAILED_FOLDER:
            problems.append(Problem(path, f"is a failure; it belongs in {FAILED_FOLDER}/"))
    for seed, paths in by_seed.items():
        problems += [Problem(path, f"seed {seed} is also in {paths[0]}") for path in paths[1:]]
    return problems


def damage_summary(folder: Path, problems: Sequence[Problem]) -> str:
    """The closing line of a verification."""
    number, kept = len(list_episodes(folder)), len(list_failures(folder))
    errors = [problem for problem in problems if not problem.is_warning]
    files = f"{number} demonstrations" + (f" and {kept} failures" if kept else "")
    warnings = len(problems) - len(errors)
    ending = f", {warnings} warnings" if warnings else ""
    if not errors:
        return f"{folder}: {files}, all whole{ending}"
    damaged = len({problem.path for problem in errors})
    return f"{folder}: {files}; {len(errors)} problems in {damaged} files{ending}"


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

    With ``images``, every image is read and decoded, too; otherwise only their number is checked.
    """
    path = Path(path)
    try:
        with open_episode(path) as file:
            require_schema(path, file)
            return _file_problems(path, file, _schema(file), images)
    except EpisodeFileError as error:
        return [Problem(path, str(error).removeprefix(f"'{path}' ").removeprefix("is "))]
    except READ_ERRORS as error:
        return [Problem(path, f"cannot be read: {one_line(error)}")]


def _schema(file: h5py.File) -> EpisodeSchema:
    """Return the schema of the file's task; what all tasks share if that cannot be read."""
    return EpisodeSchema.of(_task(file))


def _task(file: h5py.File) -> TaskEntry | None:
    """Return the file's task; None if the attribute that names it cannot be read."""
    try:
        return task_of(file)
    except READ_ERRORS as error:
        if isinstance(error, RequestError):
            raise EpisodeFileError(str(error)) from error
        return None


def _file_problems(
    path: Path, file: h5py.File, schema: EpisodeSchema, images: bool
) -> list[Problem]:
    attributes, messages = readable_attributes(file, schema)
    messages += attribute_problems(_task(file), attributes)
    present = schema.fields_of(attributes.get("schema_version", 1), file)
    datasets, found = field_datasets(file, schema, present)
    wrong_shapes = shape_problems(schema, {n: item.shape for n, item in datasets.items()})
    messages += found + wrong_shapes
    arrays: dict[str, np.ndarray] = {}
    if not wrong_shapes:
        phases = attributes.get("phase_names")
        number = len(phases) if isinstance(phases, list) else None
        messages += episode_consistency(attributes, datasets)
        for name, dataset in datasets.items():
            try:
                unit = attribute_of(dataset, "unit") if "unit" in dataset.attrs else b""
                arrays[name] = read_whole(dataset)
            except READ_ERRORS as error:
                messages.append(f"'{name}' cannot be read: {one_line(error)}")
                continue
            unit = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
            if unit != (wanted := schema.by_name[name].unit):
                messages.append(f"'{name}' is in {unit!r}, not in '{wanted}'")
            messages += value_problems(schema.by_name[name], arrays[name], number)
    checksums: dict[str, np.ndarray] = {}
    for camera in _names(attributes.get("cameras")):
        try:
            steps, size = attributes.get("num_steps", 0), attributes.get("image_size", [])
            frames = FrameStore(file, camera, steps, size)
        except READ_ERRORS as error:
            messages.append(f"'{IMAGE_GROUP}/{camera}' cannot be read: {one_line(error)}")
            continue
        checksums[camera] = frames.checksum
        if images:
            messages += _image_problems(frames, camera, attributes)
    if not messages:
        digest = content_digest(schema, arrays, checksums, attributes)
        if digest != attributes["content_sha256"]:
            messages.append("contents do not fit 'content_sha256': something was changed")
    unknown = [f"unknown {name}" for name in _unknown(file, schema, attributes)]
    return [Problem(path, text) for text in messages] + [Problem(path, u, True) for u in unknown]


def readable_attributes(file: h5py.File, schema: EpisodeSchema) -> tuple[dict[str, Any], list[str]]:
    """The attributes that can be read, and what is wrong with the others."""
    attributes: dict[str, Any] = {}
    problems: list[str] = []
    try:
        version = int(attribute_of(file, "schema_version"))
    except READ_ERRORS:  # reported below
        version = SCHEMA_VERSION
    for item in schema.attributes_of(version, file.attrs):
        if item.name not in file.attrs:
            problems.append(f"attribute '{item.name}' is missing")
            continue
        try:
            attributes[item.name] = loaded_attribute(item, attribute_of(file, item.name))
        except READ_ERRORS as error:
            problems.append(f"attribute '{item.name}' cannot be read: {one_line(error)}")
    return attributes, problems


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


def _unknown(file: h5py.File, schema: EpisodeSchema, attributes: dict[str, Any]) -> Iterable[str]:
    """Keys that the table does not know: of another release, or put there by somebody."""
    known = {*schema.by_name, IMAGE_GROUP}
    yield from (f"key '{name}'" for name in file if name not in known)
    named = schema.attribute_by_name
    yield from (f"attribute '{name}'" for name in file.attrs if name not in named)
    cameras = set(_names(attributes.get("cameras")))
    members = file.get(IMAGE_GROUP)
    if isinstance(members, h5py.Group):
        require_own_links(members)
        yield from (f"key '{IMAGE_GROUP}/{name}'" for name in members if name not in cameras)


def _names(value: Any) -> list[str]:
    return [name for name in value if isinstance(name, str)] if isinstance(value, list) else []
