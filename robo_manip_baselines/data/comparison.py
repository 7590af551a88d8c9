"""Comparison of two episodes: attributes, every column of every array, and images."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data.episode import EpisodeReader
from robo_manip_baselines.data.schema import Field

IGNORED = ("content_sha256",)
"""Attributes that differ wherever anything does."""

COLUMN_NAMES = {
    "action": "action_names",
    "joint_position": "joint_names",
    "joint_velocity": "joint_names",
}
"""Field -> attribute that names its columns."""

AXES = {3: ("x", "y", "z"), 4: ("w", "x", "y", "z"), 7: ("x", "y", "z", "qw", "qx", "qy", "qz")}
"""Number of components of a position, an orientation or a pose -> their names."""


@dataclass(frozen=True)
class ColumnDifference:
    """Difference in one column of an array, over the steps that both episodes have.

    Attributes:
        field: name of the array.
        column: name or indices within a row; empty where a row is one number.
        unit: of the numbers.
        first_step: first step at which they differ.
        steps: number of steps at which they differ.
        largest: largest absolute difference.
        rms: root of the mean square of the difference over the steps.
    """

    field: str
    column: str
    unit: str
    first_step: int
    steps: int
    largest: float
    rms: float


@dataclass(frozen=True)
class ImageDifference:
    """Difference in the images of one camera, over the steps that both episodes have.

    Attributes:
        camera: name.
        first_step: first step whose encoded image differs.
        steps: number of such steps.
        mean: mean absolute difference of the decoded images over those steps, of 255; None where
            they differ in size.
    """

    camera: str
    first_step: int
    steps: int
    mean: float | None


@dataclass(frozen=True)
class EpisodeComparison:
    """Differences between two episodes.

    Attributes:
        lengths: control steps of each.
        attributes: name -> both values; a value is `ABSENT` where a file has no such attribute.
        only_in: fields and cameras that one episode lacks -> 0 or 1, the one that has them.
        shapes: field -> shapes of both, where rows differ in shape.
        columns: differing columns, the field that differs first in time first.
        images: differing cameras.
    """

    lengths: tuple[int, int]
    attributes: Mapping[str, tuple[Any, Any]]
    only_in: Mapping[str, int]
    shapes: Mapping[str, tuple[tuple[int, ...], tuple[int, ...]]]
    columns: tuple[ColumnDifference, ...]
    images: tuple[ImageDifference, ...]

    @property
    def is_same(self) -> bool:
        """Return whether nothing differs."""
        found = (self.attributes, self.only_in, self.shapes, self.columns, self.images)
        return self.lengths[0] == self.lengths[1] and not any(found)

    @property
    def first_step(self) -> int | None:
        """First step at which an array or image differs; None where none does."""
        steps = [item.first_step for item in (*self.columns, *self.images)]
        return min(steps, default=None)


ABSENT = "–"
"""Stands for an attribute that a file does not have."""


def compare_episodes(one: EpisodeReader, other: EpisodeReader) -> EpisodeComparison:
    """Compare two episodes, of the same task or not.

    Raises:
        EpisodeFileError: a file is damaged.
    """
    names = dict.fromkeys((*one.fields, *other.fields))
    cameras = dict.fromkeys((*one.cameras, *other.cameras))
    has = [{*episode.fields, *episode.cameras} for episode in (one, other)]
    only_in = {n: int(n in has[1]) for n in (*names, *cameras) if not (n in has[0] and n in has[1])}
    shapes: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {}
    columns: list[ColumnDifference] = []
    for name in names:
        if name in only_in:
            continue
        a, b = one.array(name), other.array(name)
        if a.shape[1:] != b.shape[1:]:
            shapes[name] = a.shape, b.shape
        else:
            labels = _labels(one, name, a.shape[1:])
            columns += column_differences(one.schema.by_name[name], a, b, labels)
    order = {name: index for index, name in enumerate(names)}
    first = {}
    for item in columns:
        first[item.field] = min(item.first_step, first.get(item.field, item.first_step))
    columns.sort(key=lambda item: (first[item.field], order[item.field]))
    images = [_image_difference(one, other, camera) for camera in cameras if camera not in only_in]
    return EpisodeComparison(
        lengths=(len(one), len(other)),
        attributes=attribute_differences(one.attributes, other.attributes),
        only_in=only_in,
        shapes=shapes,
        columns=tuple(columns),
        images=tuple(filter(None, images)),
    )


def attribute_differences(
    one: Mapping[str, Any], other: Mapping[str, Any]
) -> dict[str, tuple[Any, Any]]:
    """Return the attributes that differ, with both values; parts of JSON objects by themselves."""
    found: dict[str, tuple[Any, Any]] = {}
    for name in dict.fromkeys((*one, *other)):
        a, b = one.get(name, ABSENT), other.get(name, ABSENT)
        if name in IGNORED:
            continue
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            inner = attribute_differences(a, b)
            found |= {f"{name}.{key}": values for key, values in inner.items()}
        elif not _is_equal(a, b):
            found[name] = a, b
    return found


def _is_equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    return a == b or (a != a and b != b)  # NaN is the same as NaN here


def column_differences(
    field: Field, one: NDArray[Any], other: NDArray[Any], labels: list[str]
) -> list[ColumnDifference]:
    """Return the differing columns of two arrays whose rows have one shape.

    Args:
        field: of the schema.
        one: (T, ...) array.
        other: (S, ...) array; the first min(T, S) rows are compared.
        labels: of the columns.
    """
    number = min(len(one), len(other))
    a, b = (x[:number].reshape(number, -1).astype(np.float64) for x in (one, other))
    distance = np.abs(a - b)
    found = []
    for column, label in enumerate(labels):
        steps = np.flatnonzero(distance[:, column])
        if len(steps):
            values = distance[:, column]
            rms = float(np.sqrt(np.mean(values**2)))
            largest = float(values.max())
            given = (int(steps[0]), len(steps), largest, rms)
            found.append(ColumnDifference(field.name, label, field.unit, *given))
    return found


def _labels(episode: EpisodeReader, name: str, shape: tuple[int, ...]) -> list[str]:
    """Name the columns of a field, one for each element of a row of this shape."""
    if not shape:
        return [""]
    if name in COLUMN_NAMES:
        return list(episode.attributes[COLUMN_NAMES[name]])
    field = episode.schema.by_name[name]
    is_vector = field.frame == "world" and shape[-1] in AXES
    last = AXES[shape[-1]] if is_vector else [str(index) for index in range(shape[-1])]
    before = [[str(index) for index in range(size)] for size in shape[:-1]]
    return [" ".join(parts) for parts in itertools.product(*before, last)]


def _image_difference(
    one: EpisodeReader, other: EpisodeReader, camera: str
) -> ImageDifference | None:
    steps, total = [], 0.0
    is_comparable = one.attributes["image_size"] == other.attributes["image_size"]
    for step in range(min(len(one), len(other))):
        if np.array_equal(one.encoded_frame(camera, step), other.encoded_frame(camera, step)):
            continue
        steps.append(step)
        if is_comparable:
            a, b = (episode.frame(camera, step).astype(np.int16) for episode in (one, other))
            total += float(np.abs(a - b).mean())
    if not steps:
        return None
    return ImageDifference(
        camera, steps[0], len(steps), total / len(steps) if is_comparable else None
    )
