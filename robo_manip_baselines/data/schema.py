"""What an episode file holds: the one table that writer, reader, verifier and docs are made from.

Shape symbols: T control steps, A actions, J arm joints, G grippers, Q positions and V velocities
of the simulator's state. One arm has A=7, J=6, G=1; two arms have A=14, J=12, G=2, left before
right.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

SCHEMA = "robo_manip_baselines/episode"
SCHEMA_VERSION = 2
READABLE_VERSIONS = (1, 2)
"""A file says the lowest that describes it, so that one without newer fields stays the same."""

# A group for each camera: `data`, the pictures one after another; `offset` (T + 1,), where each
# begins; `checksum` (T,), the CRC-32 of each. HDF5's own type for rows of varying length is not
# used: it has no checksum, and a changed byte in it can make the library loop for ever.
IMAGE_GROUP = "images"

Size = int | str
AttributeKind = Literal["text", "json", "int", "float", "bool", "vector"]
Rule = Literal["", "unit quaternion", "increasing", "not negative", "phase index"]

SYMBOLS: Mapping[str, str] = {
    "T": "control steps of the episode",
    "A": "actions: 7 for one arm, 14 for two (left, then right)",
    "J": "arm joints: 6 or 12",
    "G": "grippers: 1 or 2",
    "Q": "simulator positions (`model.nq`)",
    "V": "simulator velocities (`model.nv`)",
}
ALLOWED_SIZES: Mapping[str, tuple[int, ...]] = {"A": (7, 14), "J": (6, 12), "G": (1, 2)}


@dataclass(frozen=True)
class Field:
    """One array of an episode, a row for each control step."""

    name: str
    shape: tuple[Size, ...]
    dtype: str
    unit: str
    frame: str
    description: str
    rule: Rule = ""
    since: int = 1  # schema version; not in files of a lower one


@dataclass(frozen=True)
class Attribute:
    """One attribute of the file's root group; ``derived`` ones are filled in by the writer."""

    name: str
    kind: AttributeKind
    description: str
    derived: bool = False
    length: int = 0  # of a vector


FIELDS: tuple[Field, ...] = (
    Field("time", ("T",), "float64", "s", "", "Simulated time since reset", "increasing"),
    Field(
        "action",
        ("T", "A"),
        "float64",
        "rad, m",
        "joint",
        "What was given to `env.step` after this row was observed: for each arm 6 joint targets "
        "(rad) and the finger target (m)",
    ),
    Field("joint_position", ("T", "J"), "float64", "rad", "joint", "Arm joint angles"),
    Field("joint_velocity", ("T", "J"), "float64", "rad/s", "joint", "Arm joint velocities"),
    Field("gripper_position", ("T", "G"), "float64", "m", "joint", "Finger slide position"),
    Field("gripper_velocity", ("T", "G"), "float64", "m/s", "joint", "Finger slide velocity"),
    Field(
        "end_effector_position",
        ("T", 3),
        "float64",
        "m",
        "world",
        "Right gripper site: x, y, z",
    ),
    Field(
        "end_effector_orientation",
        ("T", 4),
        "float64",
        "1",
        "world",
        "Right gripper site: quaternion w, x, y, z",
        "unit quaternion",
    ),
    Field(
        "mouth_position",
        ("T", 6, 3),
        "float64",
        "m",
        "world",
        "True mouth centre now (k = 0) and k = 1…5 frames of `prediction_period` ahead: x, y, z",
    ),
    Field(
        "predicted_mouth",
        ("T", 5, 3),
        "float64",
        "m",
        "world",
        "Mouth centre k = 1…5 frames ahead as a trained predictor foretold it, its last error held "
        "between video frames: x, y, z; only where the recorded motion came with predictions",
        since=2,
    ),
    Field(
        "head_orientation",
        ("T", 4),
        "float64",
        "1",
        "world",
        "True head orientation now: quaternion w, x, y, z",
        "unit quaternion",
    ),
    Field(
        "jaw_opening",
        ("T",),
        "float64",
        "m",
        "",
        "Distance between the middle of the inner lips, now",
        "not negative",
    ),
    Field(
        "object_pose",
        ("T", 7),
        "float64",
        "m, 1",
        "world",
        "The cube: x, y, z, then quaternion w, x, y, z",
        "unit quaternion",
    ),
    Field(
        "phase",
        ("T",),
        "int8",
        "",
        "",
        "Phase in which this row's action was chosen: index into the attribute `phase_names`",
        "phase index",
    ),
    Field(
        "is_success",
        ("T",),
        "bool",
        "",
        "",
        "Whether the task's condition held after this row's action",
    ),
    Field(
        "is_success_strict",
        ("T",),
        "bool",
        "",
        "",
        "Whether the strict condition held after this row's action",
    ),
    Field("qpos", ("T", "Q"), "float64", "m, rad, 1", "joint", "Simulator positions, all of them"),
    Field(
        "qvel",
        ("T", "V"),
        "float64",
        "m/s, rad/s",
        "joint",
        "Simulator velocities, all of them",
    ),
)
FIELD_BY_NAME: Mapping[str, Field] = {field.name: field for field in FIELDS}

ATTRIBUTES: tuple[Attribute, ...] = (
    Attribute("schema", "text", f"Always `{SCHEMA}`", derived=True),
    Attribute("schema_version", "int", "Version of this page's tables", derived=True),
    Attribute("content_sha256", "text", "SHA-256 over everything else in the file", derived=True),
    Attribute("num_steps", "int", "T", derived=True),
    Attribute("env_id", "text", "Registered Gymnasium id"),
    Attribute("env_kwargs", "json", "Keyword arguments given to `gymnasium.make`"),
    Attribute("seed", "int", "Seed given to `env.reset`"),
    Attribute("expert", "text", "Name of the expert or operator that acted"),
    Attribute("is_success", "bool", "Whether the episode fulfilled the task"),
    Attribute("is_success_strict", "bool", "Whether it fulfilled the strict condition"),
    Attribute("completion_time", "float", "Completion time in s; NaN if the task was not done"),
    Attribute("motion_clip", "text", "Clip that the face's motion was recorded from"),
    Attribute("motion_subject", "text", "Person in that clip"),
    Attribute("motion_start_index", "int", "First sample of the segment in the motion library"),
    Attribute("motion_start_time", "float", "Start of the segment within its run, in s"),
    Attribute("face_offset", "vector", "Offset of the face's base position, in m", length=3),
    Attribute(
        "object_initial_pose", "vector", "Start pose of the cube, as `object_pose`", length=7
    ),
    Attribute("control_period", "float", "Time between rows, in s"),
    Attribute("prediction_period", "float", "Time between horizons of `mouth_position`, in s"),
    Attribute("phase_names", "json", "List of names that `phase` points into"),
    Attribute("joint_names", "json", "List of J names, the columns of `joint_position`"),
    Attribute("action_names", "json", "List of A names, the columns of `action`"),
    Attribute("xml_hash", "text", "SHA-256 of the compiled model's XML"),
    Attribute("versions", "json", "Versions of python, mujoco, numpy and of this package"),
    Attribute("cameras", "json", "List of the cameras recorded, perhaps empty", derived=True),
    Attribute("image_codec", "text", "`jpeg`, `png` or `raw`"),
    Attribute("image_quality", "int", "JPEG quality, 1…100; without meaning for other codecs"),
    Attribute(
        "image_size",
        "json",
        "Height and width of every image, in pixels; [0, 0] without cameras",
        derived=True,
    ),
)
ATTRIBUTE_BY_NAME: Mapping[str, Attribute] = {item.name: item for item in ATTRIBUTES}


def version_of(fields: Iterable[str]) -> int:
    """Return the schema version of a file with these fields."""
    return max([1, *(FIELD_BY_NAME[name].since for name in fields)])


def fields_of(version: int) -> tuple[str, ...]:
    """Return the names of the fields that files of a schema version hold."""
    return tuple(field.name for field in FIELDS if field.since <= version)


def shape_text(field: Field) -> str:
    """``(T, 3)`` and the like."""
    return f"({', '.join(map(str, field.shape))}{',' if len(field.shape) == 1 else ''})"


def field_table() -> str:
    """The fields as a Markdown table, as printed in ``docs/episode_format.md``."""
    lines = ["| name | shape | type | unit | frame | what it is |", "|---|---|---|---|---|---|"]
    lines += [
        f"| `{f.name}` | {shape_text(f)} | {f.dtype} | {f.unit or '–'} | {f.frame or '–'} "
        f"| {f.description} |"
        for f in FIELDS
    ]
    return "\n".join(lines)


def attribute_table() -> str:
    """The attributes as a Markdown table, as printed in ``docs/episode_format.md``."""
    lines = ["| name | kind | what it is |", "|---|---|---|"]
    for item in ATTRIBUTES:
        kind = f"{item.length} numbers" if item.kind == "vector" else item.kind
        lines.append(f"| `{item.name}` | {kind} | {item.description} |")
    return "\n".join(lines)


def symbol_table() -> str:
    """The shape symbols as a Markdown table, as printed in ``docs/episode_format.md``."""
    lines = ["| symbol | size |", "|---|---|"]
    lines += [f"| {symbol} | {text} |" for symbol, text in SYMBOLS.items()]
    return "\n".join(lines)
