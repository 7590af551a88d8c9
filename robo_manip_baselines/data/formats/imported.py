"""Episodes of other programs as episode files, and what an exported episode keeps of its own.

Legend: T steps, A arms (left before right), Q elements of the recorded robot state.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data.episode import EpisodeReader, read_metadata, write_episode
from robo_manip_baselines.data.files import (
    episode_path,
    finished_seeds,
    remove_partial_episodes,
)
from robo_manip_baselines.data.schema import EpisodeSchema
from robo_manip_baselines.envs.mujoco.tasks.registry import entry_of_id, imported_entry
from robo_manip_baselines.observation import CAMERAS, FRAME_PERIOD
from robo_manip_baselines.runs.documents import parse_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import locked
from robo_manip_baselines.runs.images import DEFAULT_QUALITY, encode_image
from robo_manip_baselines.runs.progress import track
from robo_manip_baselines.runs.versions import software_versions

OWN_ATTRIBUTE = "robo_manip_baselines_episode"
"""Attribute of an exported file: all attributes of the episode, as JSON."""

Floats = NDArray[np.float64]
Frames = Callable[[str], Any]
"""Name of a camera in the source -> its T images in order, (H, W, 3) uint8 RGB."""


@dataclass(frozen=True)
class Recording:
    """Episode of another program, in SI units.

    Attributes:
        time: (T,) s.
        action: (T, A, 7) joint targets in rad, and the target of the gripper.
        joint_position, joint_velocity: (T, A, 6) rad, rad/s.
        gripper_position, gripper_velocity: (T, A).
        end_effector: (T, 7) pose of the right gripper: x, y, z in m, quaternion w, x, y, z.
        qpos, qvel: (T, Q) state as the source has it.
        joint_names: 6 A names.
        cameras: of the source.
        frames: their images.
        attributes: of the source.
        instruction: the task in words; empty if the source does not say.
        own: attributes and further fields of an episode file, if the source was made from one.
    """

    time: Floats
    action: Floats
    joint_position: Floats
    joint_velocity: Floats
    gripper_position: Floats
    gripper_velocity: Floats
    end_effector: Floats
    qpos: Floats
    qvel: Floats
    joint_names: tuple[str, ...]
    cameras: tuple[str, ...]
    frames: Frames
    attributes: Mapping[str, Any]
    instruction: str = ""
    own: tuple[dict[str, Any], dict[str, NDArray[Any]]] | None = None


def own_attributes(episode: EpisodeReader) -> str:
    """Return all attributes of an episode as JSON; NaN is null."""
    values = {
        name: value.tolist()
        if isinstance(value, np.ndarray)
        else None
        if isinstance(value, float) and math.isnan(value)
        else value
        for name, value in episode.attributes.items()
    }
    return json.dumps(values, sort_keys=True, allow_nan=False)


def parse_own_attributes(text: str, source: Path) -> dict[str, Any]:
    """Undo `own_attributes`.

    Raises:
        RequestError: it is damaged.
    """
    values = parse_json(text, f"'{source}': {OWN_ATTRIBUTE}")
    if not isinstance(values, dict) or not isinstance(values.get("env_id"), str):
        raise RequestError(f"'{source}': {OWN_ATTRIBUTE} names no environment")
    schema = EpisodeSchema.of(entry_of_id(values["env_id"]))
    kinds = {item.name: item.kind for item in schema.attributes}
    return {
        name: math.nan if value is None and kinds.get(name) == "float" else value
        for name, value in values.items()
    }


def camera_map(names: Sequence[str]) -> dict[str, str]:
    """Read ``top=cam_high``, or ``top`` alone for a camera of that name: ours -> the source's.

    Raises:
        RequestError: a name is not one of `CAMERAS`, or is there twice.
    """
    pairs = [(own, other or own) for own, _, other in (name.partition("=") for name in names)]
    for own, _ in pairs:
        require_choice("camera", own, CAMERAS)
    if len({own for own, _ in pairs}) < len(pairs):
        raise RequestError(f"cameras {' '.join(names)}: each may be named once")
    return dict(pairs)


def import_recordings(
    sources: Sequence[Path],
    out: Path,
    read: Callable[[Path], AbstractContextManager[Recording]],
    *,
    kind: str,
    cameras: Sequence[str] | None,
    codec: str,
) -> dict[str, str]:
    """Write an episode file for each source. A run that was killed goes on where it was.

    Args:
        sources: in order; the number of one is the seed of its episode, unless it was exported
            from an episode, whose seed it keeps.
        out: folder of episode files.
        read: opens a source.
        kind: of the sources, ``rmb`` or ``aloha``.
        cameras: see `camera_map`; None takes those whose names are known here, and refuses others.
        codec: of the images.

    Returns:
        Rows of the closing table.

    Raises:
        RequestError: a source cannot be read, or ``out`` holds other episodes.
    """
    chosen = None if cameras is None else camera_map(cameras)
    with locked(out, is_kept=False):
        remove_partial_episodes(out)
        before = len(finished_seeds(out))
        for number, source in enumerate(track(sources, len(sources), "episode", "import")):
            with read(source) as recording:
                _write(recording, number, source, out, kind, chosen, codec)
    found = finished_seeds(out)
    return {
        "written to": str(out),
        "episodes": f"{len(found)}, of which {len(found) - before} new",
        "format": kind,
    }


def _write(
    recording: Recording,
    number: int,
    source: Path,
    out: Path,
    kind: str,
    cameras: dict[str, str] | None,
    codec: str,
) -> None:
    """Write one episode, unless it is there."""
    if recording.own:
        given, fields = recording.own
        attributes: dict[str, Any] = {
            item.name: given[item.name]
            for item in EpisodeSchema.of(entry_of_id(given["env_id"])).attributes
            if not item.is_derived and item.name in given
        }
    else:
        attributes, fields = _imported_attributes(recording, number, source, kind), {}
    attributes |= {"image_codec": codec, "image_quality": DEFAULT_QUALITY}
    seed, success = attributes["seed"], bool(attributes["is_success"])
    for path in (episode_path(out, seed, True), episode_path(out, seed, False)):
        if path.exists():
            _require_same(path, attributes, source)
            return
    images = {
        own: [encode_image(image, codec) for image in recording.frames(other)]
        for own, other in _chosen_cameras(recording, source, cameras).items()
    }
    for camera, frames in images.items():
        if len(frames) != len(recording.time):
            raise RequestError(
                f"'{source}': {len(frames)} images of '{camera}' for {len(recording.time)} steps; "
                "cut the longer one"
            )
    try:
        write_episode(
            episode_path(out, seed, success), _arrays(recording) | fields, images, attributes
        )
    except (ValueError, TypeError) as error:
        if isinstance(error, RequestError):
            raise
        raise RequestError(f"'{source}' cannot be imported: {error}") from error


def _require_same(path: Path, attributes: Mapping[str, Any], source: Path) -> None:
    """Require that an episode that is there already was imported from this source."""
    there = read_metadata(path)
    names = ("env_id", "source_name", "source_attributes", "xml_hash", "expert", "is_success")
    for name in names:
        if name in attributes and there.get(name) != attributes[name]:
            raise RequestError(
                f"'{path}' is not that of '{source}' ({name} differs); choose another folder"
            )


def _chosen_cameras(
    recording: Recording, source: Path, cameras: dict[str, str] | None
) -> dict[str, str]:
    """Return names here -> names in the source."""
    there = ", ".join(recording.cameras) or "none"
    if cameras is None:
        if unknown := [name for name in recording.cameras if name not in CAMERAS]:
            raise RequestError(
                f"'{source}' has the cameras {there}; '{unknown[0]}' has no name here; choose with "
                f"--cameras, for example {CAMERAS[0]}={unknown[0]} (valid: {', '.join(CAMERAS)})"
            )
        return {name: name for name in recording.cameras}
    for other in cameras.values():
        if other not in recording.cameras:
            raise RequestError(f"'{source}' has no camera '{other}'; valid: {there}")
    return cameras


def _arrays(recording: Recording) -> dict[str, NDArray[Any]]:
    """Return the fields that every episode file has."""
    steps = len(recording.time)
    is_last = np.arange(steps) == steps - 1

    def flat(values: Floats) -> Floats:
        return values.reshape(steps, -1)

    pose = recording.end_effector
    return {
        "time": recording.time,
        "action": flat(recording.action),
        "joint_position": flat(recording.joint_position),
        "joint_velocity": flat(recording.joint_velocity),
        "gripper_position": recording.gripper_position,
        "gripper_velocity": recording.gripper_velocity,
        "end_effector_position": pose[:, :3],
        "end_effector_orientation": pose[:, 3:],
        "phase": np.zeros(steps, np.int8),
        "is_success": is_last,
        "is_success_strict": np.zeros(steps, bool),
        "qpos": recording.qpos,
        "qvel": recording.qvel,
    }


def _imported_attributes(
    recording: Recording, number: int, source: Path, kind: str
) -> dict[str, Any]:
    """Return the attributes of an episode that another program recorded."""
    steps, time = len(recording.time), recording.time
    if steps < 2:
        raise RequestError(f"'{source}': {steps} steps; an episode has 2 or more")
    period = float(np.median(np.diff(time)))
    sides = dict.fromkeys(name.partition("/")[0] for name in recording.joint_names)
    names = [
        name
        for side in sides
        for name in (*(n for n in recording.joint_names if n.startswith(side)), f"{side}/gripper")
    ]
    return {
        "env_id": imported_entry().env_id,
        "env_kwargs": {},
        "seed": number,
        "expert": kind,
        "is_success": True,
        "is_success_strict": False,
        "completion_time": float(time[-1] - time[0]),
        "source_format": kind,
        "source_name": source.name,
        "source_attributes": dict(recording.attributes),
        "instruction": recording.instruction,
        "control_period": period,
        "prediction_period": FRAME_PERIOD,
        "phase_names": ["imported"],
        "joint_names": list(recording.joint_names),
        "action_names": names,
        "xml_hash": "0" * 64,
        "versions": software_versions("numpy", "robo_manip_baselines"),
    }


def require_sources(folder: Path, found: Sequence[Path], what: str) -> None:
    """Require that a folder holds something to import.

    Raises:
        RequestError: it does not.
    """
    if not folder.is_dir():
        raise RequestError(f"'{folder}' is no folder; give one that holds {what}")
    if not found:
        raise RequestError(f"'{folder}' holds no {what}")
