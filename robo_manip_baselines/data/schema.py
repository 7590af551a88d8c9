"""Schema of episode files: the one table that writer, reader, verifier and docs are made from.

Shape symbols: T control steps, A actions, J arm joints, G grippers, Q positions and V velocities
of the simulator's state, K frames of the truth from now on, H frames of a forecast, R regions of
the face, B bodies that touch it. One arm has
A=7, J=6, G=1; two arms have A=14, J=12, G=2, left before right.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike

from robo_manip_baselines.envs.mujoco.tasks.registry import (
    Attribute,
    Field,
    TaskEntry,
    env_kwargs_problem,
)
from robo_manip_baselines.observation import CAMERAS, MAX_HORIZON
from robo_manip_baselines.runs.documents import parse_json
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.images import CODECS, MAX_SIDE
from robo_manip_baselines.runs.npz import add_array

SCHEMA = "robo_manip_baselines/episode"
SCHEMA_VERSION = 5
READABLE_VERSIONS = (1, 2, 3, 4, 5)
"""A file has the lowest version that describes it: 2 added ``predicted_mouth``, 3 the truth more
than 5 frames ahead, and other tasks than feeding, whose fields and attributes are those of the task
that ``env_id`` names, 4 forces on the face, ``region_force`` and ``region_impulse``, 5
teleoperation: ``source`` and the attributes beside it, and ``intervention``."""

TELEOP = "teleop"
"""Value of the attribute ``source`` of an episode in which a person steered."""

OLD_FRAMES = 6
"""K of files of versions 1 and 2: the truth now and 1 ... 5 frames ahead."""

# A group for each camera: `data`, the images one after another; `offset` (T + 1,), where each
# begins; `checksum` (T,), the CRC-32 of each. HDF5's own type for rows of varying length is not
# used: it has no checksum, and a changed byte in it can make the library loop for ever.
IMAGE_GROUP = "images"

POLICY_ATTRIBUTES = (
    "env_id",
    "xml_hash",
    "control_period",
    "prediction_period",
    "action_names",
    "joint_names",
)
"""Attributes that episodes must share for one policy to learn from them."""

SYMBOLS: Mapping[str, str] = {
    "T": "control steps of the episode",
    "A": "actions: 7 for one arm, 14 for two (left, then right)",
    "J": "arm joints: 6 or 12",
    "G": "grippers: 1 or 2",
    "Q": "simulator positions (`model.nq`)",
    "V": "simulator velocities (`model.nv`)",
    "K": "frames of the truth, from now on: 25; in files of versions 1 and 2, 6",
    "H": "frames of the forecast: 1 to 24, as many as the motion library has; the shipped one 24",
    "R": "regions of the face: forehead, eyes, nose, cheeks, lips, chin, tongue, teeth, mouth (its "
    "other walls inside), head (sides and back), neck (with the bust)",
    "B": "what touches it: gripper, arm, anything else, then the objects of the task in order, and "
    "a tool in the gripper (`spoon`)",
}
ALLOWED_SIZES: Mapping[str, tuple[int, ...]] = {
    "A": (7, 14),
    "J": (6, 12),
    "G": (1, 2),
    "K": (OLD_FRAMES, MAX_HORIZON + 1),
    "R": (11,),
}

MAX_SIZES: Mapping[str, int] = {"T": 180_000, "Q": 1000, "V": 1000, "H": MAX_HORIZON, "B": 100}
"""Largest sizes: an hour at 50 steps a second. Checked before memory is taken."""

MAX_BYTES = 2**30
"""Total size of the arrays of an episode, without images."""

_MAX_NAMES = 1000


_STATE_FIELDS = (
    Field("time", ("T",), "Simulated time since reset", "s", rule="increasing"),
    Field(
        "action",
        ("T", "A"),
        "What was given to `env.step` after this row was observed: for each arm 6 joint targets "
        "(rad) and the finger target (m)",
        "rad, m",
        "joint",
    ),
    Field("joint_position", ("T", "J"), "Arm joint angles", "rad", "joint"),
    Field("joint_velocity", ("T", "J"), "Arm joint velocities", "rad/s", "joint"),
    Field("gripper_position", ("T", "G"), "Finger slide position", "m", "joint"),
    Field("gripper_velocity", ("T", "G"), "Finger slide velocity", "m/s", "joint"),
    Field("end_effector_position", ("T", 3), "Right gripper site: x, y, z", "m", "world"),
    Field(
        "end_effector_orientation",
        ("T", 4),
        "Right gripper site: quaternion w, x, y, z",
        "1",
        "world",
        rule="unit quaternion",
    ),
)
"""Fields of every episode, before those of the task."""

_OUTCOME_FIELDS = (
    Field(
        "phase",
        ("T",),
        "Phase in which this row's action was chosen: index into the attribute `phase_names`",
        dtype="int8",
        rule="phase index",
    ),
    Field(
        "is_success",
        ("T",),
        "Whether the task's condition held after this row's action",
        dtype="bool",
    ),
    Field(
        "is_success_strict",
        ("T",),
        "Whether the strict condition held after this row's action",
        dtype="bool",
    ),
    Field(
        "intervention",
        ("T",),
        "Whether a person, and not the policy, chose this row's action; only where both may act",
        dtype="bool",
        since=5,
        is_optional=True,
    ),
    Field("qpos", ("T", "Q"), "Simulator positions, all of them", "m, rad, 1", "joint"),
    Field("qvel", ("T", "V"), "Simulator velocities, all of them", "m/s, rad/s", "joint"),
)
"""Fields of every episode, after those of the task."""

_EPISODE_ATTRIBUTES = (
    Attribute("schema", "text", f"Always `{SCHEMA}`", is_derived=True),
    Attribute("schema_version", "int", "Version of this page's tables", is_derived=True),
    Attribute(
        "content_sha256", "text", "SHA-256 over everything else in the file", is_derived=True
    ),
    Attribute("num_steps", "int", "T", is_derived=True),
    Attribute("env_id", "text", "Registered Gymnasium id"),
    Attribute("env_kwargs", "json", "Keyword arguments given to `gymnasium.make`"),
    Attribute("seed", "int", "Seed given to `env.reset`"),
    Attribute("expert", "text", "Name of the expert or operator that acted"),
    Attribute("is_success", "bool", "Whether the episode fulfilled the task"),
    Attribute("is_success_strict", "bool", "Whether it fulfilled the strict condition"),
    Attribute("completion_time", "float", "Completion time in s; NaN if the task was not done"),
)
"""Attributes of every episode, before those of the task."""

_RECORDING_ATTRIBUTES = (
    Attribute("control_period", "float", "Time between rows, in s"),
    Attribute("prediction_period", "float", "Time between horizons of `mouth_position`, in s"),
    Attribute("phase_names", "json", "List of names that `phase` points into"),
    Attribute("joint_names", "json", "List of J names, the columns of `joint_position`"),
    Attribute("action_names", "json", "List of A names, the columns of `action`"),
    Attribute("xml_hash", "text", "SHA-256 of the compiled model's XML"),
    Attribute("versions", "json", "Versions of python, mujoco, numpy and of this package"),
    Attribute("cameras", "json", "List of the cameras recorded, perhaps empty", is_derived=True),
    Attribute("image_codec", "text", "`jpeg`, `png` or `raw`"),
    Attribute("image_quality", "int", "JPEG quality, 1…100; without meaning for other codecs"),
    Attribute(
        "image_size",
        "json",
        "Height and width of every image, in pixels; [0, 0] without cameras",
        is_derived=True,
    ),
    Attribute(
        "source",
        "text",
        f"`{TELEOP}` where a person steered; absent where a scripted expert did",
        since=5,
        is_optional=True,
    ),
    Attribute("device", "text", "Device of the person, likewise", since=5, is_optional=True),
    Attribute(
        "loop_rate",
        "float",
        "Control steps a second while it was recorded, in Hz, likewise; NaN where nothing kept "
        "time",
        since=5,
        is_optional=True,
    ),
    Attribute(
        "missed_deadlines",
        "int",
        "Control steps that ended later than they should have, likewise",
        since=5,
        is_optional=True,
    ),
    Attribute(
        "policy",
        "json",
        "Policy that acted where `intervention` is false: its name, and the SHA-256 of its "
        "weights; absent where none may act",
        since=5,
        is_optional=True,
    ),
)
"""Attributes of every episode, after those of the task."""


@dataclass(frozen=True)
class EpisodeSchema:
    """Content of the episode files of a task.

    Attributes:
        fields: arrays, in the order of the content digest.
        attributes: likewise.
        version: lowest schema version that describes a file.
    """

    fields: tuple[Field, ...]
    attributes: tuple[Attribute, ...]
    version: int

    @classmethod
    @cache
    def of(cls, task: TaskEntry | None) -> EpisodeSchema:
        """Return the schema of a task; without one, what all tasks have in common."""
        fields, attributes = (task.fields, task.attributes) if task else ((), ())
        return cls(
            (*_STATE_FIELDS, *fields, *_OUTCOME_FIELDS),
            (*_EPISODE_ATTRIBUTES, *attributes, *_RECORDING_ATTRIBUTES),
            task.schema_version if task else SCHEMA_VERSION,
        )

    @cached_property
    def by_name(self) -> dict[str, Field]:
        """Name -> field."""
        return {field.name: field for field in self.fields}

    @cached_property
    def attribute_by_name(self) -> dict[str, Attribute]:
        """Name -> attribute."""
        return {item.name: item for item in self.attributes}

    def version_of(
        self, shapes: Mapping[str, tuple[int, ...]], attributes: Iterable[str] = ()
    ) -> int:
        """Return the schema version of a file with fields of these shapes, and these attributes."""
        fields = [(self.by_name[name], shape) for name, shape in shapes.items()]
        is_long = any(
            symbol == "K" and size > OLD_FRAMES
            for field, shape in fields
            for symbol, size in zip(field.shape, shape, strict=True)
        )
        since = [field.since for field, _ in fields]
        since += [self.attribute_by_name[name].since for name in attributes]
        return max([self.version, 3 if is_long else 1, *since])

    def fields_of(self, version: int, present: Iterable[str] = ()) -> tuple[str, ...]:
        """Return the names of the fields that a file of a schema version holds, or should.

        From version 3 on, optional fields count if they are among the names ``present`` in it.
        """
        found = set(present)
        return tuple(
            item.name
            for item in self.fields
            if (item.name in found if item.is_optional and version > 2 else item.since <= version)
        )

    def attributes_of(self, version: int, present: Iterable[str]) -> tuple[Attribute, ...]:
        """Return the attributes that a file of a schema version holds, or should.

        Optional ones count if they are among the names ``present`` in it.
        """
        found = set(present)
        return tuple(
            item
            for item in self.attributes
            if item.since <= version and (not item.is_optional or item.name in found)
        )


def shape_text(field: Field) -> str:
    """``(T, 3)`` and the like."""
    return f"({', '.join(map(str, field.shape))}{',' if len(field.shape) == 1 else ''})"


def stored_attribute(item: Attribute, value: Any) -> Any:
    """Turn a value into what HDF5 keeps: UTF-8, int64, float64, bool or a float64 vector.

    Raises:
        ValueError: if the value is not of the attribute's kind.
    """
    if item.kind == "json":
        return stored_text(json.dumps(value, sort_keys=True, allow_nan=False, ensure_ascii=False))
    if item.kind == "text" and isinstance(value, str):
        return stored_text(value)
    if item.kind == "bool" and isinstance(value, bool | np.bool_):
        return np.bool_(value)
    if item.kind == "int" and isinstance(value, int | np.integer) and not isinstance(value, bool):
        return np.int64(value)
    if item.kind == "float" and isinstance(value, int | float | np.number):
        return np.float64(value)
    if item.kind == "vector":
        vector = np.asarray(value, dtype=np.float64)
        if vector.shape == (item.length,) and np.isfinite(vector).all():
            return vector
        raise ValueError(f"attribute '{item.name}' needs {item.length} finite numbers: {value!r}")
    raise ValueError(f"attribute '{item.name}' needs {item.kind}, not {value!r}")


def stored_text(text: str) -> np.ndarray:
    """A string as HDF5 keeps it: UTF-8 of fixed length, which lies under the file's checksums."""
    data = text.encode()
    if b"\0" in data:
        raise ValueError(f"text with a null character: {text!r}")
    return np.array(data, dtype=h5py.string_dtype("utf-8", max(len(data), 1)))


def loaded_attribute(item: Attribute, value: Any) -> Any:
    """Undo `stored_attribute`: plain Python values, JSON parsed, vectors as float64 arrays.

    Raises:
        ValueError: if what is in the file is not of the attribute's kind.
    """
    if item.kind == "vector":
        if isinstance(value, np.ndarray) and value.shape == (item.length,):
            return value.astype(np.float64)
    elif item.kind in ("text", "json"):
        value = value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
        if isinstance(value, bytes | str):
            text = value.decode() if isinstance(value, bytes) else value
            if item.kind == "text":
                return text
            try:
                return parse_json(text, f"attribute '{item.name}'")
            except RequestError as error:
                raise ValueError(error) from None
    elif isinstance(value, np.generic):
        kinds = {"bool": "b", "int": "i", "float": "f"}
        if value.dtype.kind == kinds[item.kind]:
            return value.item()
    raise ValueError(f"attribute '{item.name}' is no {item.kind} but {value!r}")


def content_digest(
    schema: EpisodeSchema,
    arrays: Mapping[str, np.ndarray],
    checksums: Mapping[str, np.ndarray],
    attributes: Mapping[str, Any],
) -> str:
    """Return the SHA-256 over the content of an episode, whatever library laid out the file.

    Args:
        schema: of the task.
        arrays: every field of the table that the episode has.
        checksums: camera -> (T,) uint32, the CRC-32 of its encoded frames.
        attributes: every attribute that the episode has, as `loaded_attribute` gives it;
            ``content_sha256`` is skipped.

    Returns:
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for field in schema.fields:
        if field.name in arrays:
            array = np.asarray(arrays[field.name])
            add_array(digest, field.name, array.astype(field.dtype, copy=False))
    for camera in sorted(checksums):
        add_array(digest, camera, np.asarray(checksums[camera], dtype=np.uint32))
    for item in schema.attributes:
        if item.name in attributes and item.name != "content_sha256":
            digest.update(f"{item.name}={_canonical(attributes[item.name])}\n".encode())
    return digest.hexdigest()


def attribute_problems(task: TaskEntry | None, attributes: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with the values of attributes, as `loaded_attribute` gives them."""

    def is_list(kind: type, length: int | None = None) -> Callable[[Any], bool]:
        return lambda value: (
            isinstance(value, list)
            and all(type(item) is kind for item in value)
            and len(value) in (range(_MAX_NAMES + 1) if length is None else (length,))
            and (kind is not str or len(set(value)) == len(value))
        )

    rules: dict[str, tuple[Callable[[Any], bool], str]] = {
        "num_steps": (lambda x: 1 <= x <= MAX_SIZES["T"], f"must be 1 to {MAX_SIZES['T']}"),
        "seed": (lambda x: x >= 0, "must be 0 or more"),
        "control_period": (lambda x: 0.0 < x < math.inf, "must be positive"),
        "prediction_period": (lambda x: 0.0 < x < math.inf, "must be positive"),
        "completion_time": (lambda x: math.isnan(x) or 0.0 <= x < math.inf, "must be 0 or more"),
        "image_codec": (lambda x: x in CODECS, f"must be one of {', '.join(CODECS)}"),
        **{
            name: (lambda x: bool(x) and is_list(str)(x), "must be a list of different names")
            for name in ("phase_names", "joint_names", "action_names")
        },
        "cameras": (
            lambda x: is_list(str)(x) and set(x) <= set(CAMERAS),
            f"must be a list of some of {', '.join(CAMERAS)}",
        ),
        "image_size": (
            lambda x: is_list(int, 2)(x) and min(x) >= 0 and max(x) <= MAX_SIDE,
            f"must be height and width, at most {MAX_SIDE}",
        ),
        "versions": (
            lambda x: isinstance(x, dict) and all(isinstance(v, str) for v in x.values()),
            "must be an object of texts",
        ),
        "xml_hash": (
            lambda x: bool(re.fullmatch("[0-9a-f]{64}", x)),
            "must be 64 hexadecimal digits",
        ),
        "env_kwargs": (lambda x: not env_kwargs_problem(task, x), ""),
        "source": (lambda x: x == TELEOP, f"must be {TELEOP}"),
        "loop_rate": (lambda x: math.isnan(x) or 0.0 < x < math.inf, "must be positive"),
        "missed_deadlines": (lambda x: x >= 0, "must be 0 or more"),
        "policy": (
            lambda x: isinstance(x, dict) and set(x) == {"name", "sha256"},
            "must be an object with name and sha256",
        ),
    }
    problems = []
    for name, (is_valid, valid) in rules.items():
        if name in attributes and not is_valid(attributes[name]):
            wrong = f"is {str(attributes[name])[:80]!r}; it {valid}"
            if name == "env_kwargs":
                wrong = env_kwargs_problem(task, attributes[name])
            problems.append(f"attribute '{name}' {wrong}")
    return problems


def episode_consistency(
    attributes: Mapping[str, Any], arrays: Mapping[str, np.ndarray | h5py.Dataset]
) -> list[str]:
    """Return contradictions between attributes and the shapes of arrays."""
    problems: list[str] = []
    axes = (("joint_names", "joint_position", 1), ("action_names", "action", 1))
    for name, field, axis in (*axes, ("num_steps", "time", 0)):
        if name in attributes and field in arrays and arrays[field].ndim > axis:
            value = attributes[name]
            given = len(value) if isinstance(value, Sequence) else value
            size = arrays[field].shape[axis]
            if given != size:
                problems.append(f"attribute '{name}' says {given}, but '{field}' has {size}")
    return problems


def _canonical(value: Any) -> str:
    if isinstance(value, float):
        return "nan" if math.isnan(value) else value.hex()
    if isinstance(value, np.ndarray):
        return " ".join(float(number).hex() for number in value)
    return json.dumps(value, sort_keys=True, ensure_ascii=False)


# A quaternion that went through float32 somewhere is off by a few 1e-7; a wrong one by far more.
QUATERNION_TOLERANCE = 1e-5


def shape_problems(schema: EpisodeSchema, shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Compare the shapes of all fields present with the table and with one another."""
    problems: list[str] = []
    sizes: dict[str, tuple[int, str]] = {}  # symbol -> (size, field that set it)
    for field in schema.fields:
        shape = shapes.get(field.name)
        if shape is None:
            continue
        if len(shape) != len(field.shape):
            problems.append(f"'{field.name}' has shape {shape}, not {shape_text(field)}")
            continue
        for size, expected in zip(shape, field.shape, strict=True):
            if isinstance(expected, int):
                if size != expected:
                    problems.append(f"'{field.name}' has shape {shape}, not {shape_text(field)}")
                continue
            known, owner = sizes.setdefault(expected, (size, field.name))
            if size != known:
                problems.append(
                    f"'{field.name}' has {expected}={size} where '{owner}' has {expected}={known}"
                )
    for symbol, (size, owner) in sizes.items():
        allowed = ALLOWED_SIZES.get(symbol)
        if size < 1 or (allowed and size not in allowed):
            valid = " or ".join(map(str, allowed)) if allowed else "at least 1"
            problems.append(f"'{owner}' has {symbol}={size}, not {valid}")
        elif size > MAX_SIZES.get(symbol, size):
            problems.append(f"'{owner}' has {symbol}={size}, more than {MAX_SIZES[symbol]}")
    if not problems:
        bytes_of = {f.name: np.dtype(f.dtype).itemsize for f in schema.fields}
        total = sum(math.prod(shape) * bytes_of.get(name, 0) for name, shape in shapes.items())
        if total > MAX_BYTES:
            problems.append(f"the arrays have {total} bytes, more than {MAX_BYTES}")
    return problems


def value_problems(field: Field, values: np.ndarray, num_phases: int | None) -> list[str]:
    """Check the numbers of one field: finite, and obeying the field's rule.

    Args:
        field: what the array should be.
        values: the field's array, already known to have its shape.
        num_phases: length of ``phase_names``; None leaves that rule out.
    """
    name, rule = field.name, field.rule

    def first(bad: ArrayLike, what: str) -> list[str]:
        rows = np.asarray(bad).reshape(len(values), -1).any(axis=1)
        return [f"'{name}' {what} at step {row}" for row in np.flatnonzero(rows)[:1]]

    finite = np.isfinite(values)
    if not finite.all():
        return first(~finite, "is NaN or infinite, first")
    if rule == "increasing":
        return first(np.diff(values, prepend=-np.inf) <= 0, "does not increase")
    if rule == "unit quaternion":
        error = np.abs(np.linalg.norm(values[:, -4:], axis=1) - 1)
        return first(error > QUATERNION_TOLERANCE, "is no unit quaternion")
    if rule == "not negative":
        return first(values < 0, "is negative")
    if rule == "phase index" and num_phases is not None:
        bad = np.flatnonzero((values < 0) | (values >= num_phases))[:1]
        return [f"'{name}' is {values[i]} at step {i}, of {num_phases} phases" for i in bad]
    return []
