"""RoboManipBaselines' ``.rmb`` episodes: a folder with ``main.rmb.hdf5`` and a video a camera.

Keys, units and attributes are those of its ``DataKey`` and ``DataManager`` (RmbData-Compact). Also
read: RmbData-SingleHDF5, one ``.hdf5`` file with the images in it.

Legend: T steps, A arms (left before right), J = 7 A elements of joints and grippers.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robo_manip_baselines.data.episode import EpisodeReader
from robo_manip_baselines.data.formats.exported import export_episodes
from robo_manip_baselines.data.formats.imported import (
    OWN_ATTRIBUTE,
    Frames,
    Recording,
    import_recordings,
    own_attributes,
    parse_own_attributes,
    require_sources,
)
from robo_manip_baselines.data.formats.video import VideoEncoding, VideoReader, VideoWriter
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_folder
from robo_manip_baselines.runs.hdf5 import (
    READ_ERRORS,
    attribute_of,
    dataset_of,
    one_line,
    open_hdf5,
    read_whole,
)

MAIN = "main.rmb.hdf5"
IMAGE, VIDEO = "_rgb_image", "_rgb_image.rmb.mp4"
"""Endings of a camera's key, and of its video's name."""

ENCODING = VideoEncoding("h264", 23, gop=10)
"""Of the videos, which every decoder reads."""

OLD_KEYS = {
    "measured_joint_pos": ("joint_pos",),
    "command_joint_pos": ("action",),
    "measured_joint_vel": ("joint_vel",),
    "measured_eef_pose": ("measured_eef",),
}
"""Key -> what older releases of RoboManipBaselines called it."""

DERIVED = (
    "time",
    "action",
    "joint_position",
    "joint_velocity",
    "gripper_position",
    "gripper_velocity",
    "end_effector_position",
    "end_effector_orientation",
)
"""Fields of an episode that its keys hold; all others are written under their own names."""


def export_rmb(folder: Path, out: Path, encoding: VideoEncoding = ENCODING) -> dict[str, str]:
    """Write a ``.rmb`` folder for each demonstration of a folder.

    Args:
        folder: as ``bin/Rollout.py`` writes it; ``failed/`` is left out.
        out: folder for them; a run that was killed is continued.
        encoding: of the videos.

    Returns:
        Rows of the closing table.

    Raises:
        RequestError: there is no episode, or ``out`` holds others.
        EpisodeFileError: an episode is damaged.
        WriteError: the disk is full, or fails.
    """
    return export_episodes(
        folder,
        out,
        target=lambda number, path: f"{path.stem}.rmb",
        write=lambda episode, target: _write(episode, target, encoding),
        own=_own,
        main=MAIN,
    )


def import_rmb(
    folder: Path, out: Path, *, cameras: list[str] | None = None, codec: str = "png"
) -> dict[str, str]:
    """Write an episode file for each ``.rmb`` folder or RmbData-SingleHDF5 file of a folder.

    See `import_recordings`. Episodes that `export_rmb` wrote become what they were, but for their
    images; others become demonstrations of `IMPORTED`.
    """
    found = sorted(
        path
        for path in (folder.iterdir() if folder.is_dir() else ())
        if path.suffix in (".rmb", ".hdf5") and not path.name.startswith(".")
    )
    require_sources(folder, found, ".rmb folder or .hdf5 file")
    return import_recordings(found, out, open_rmb, kind="rmb", cameras=cameras, codec=codec)


# -- writing ---------------------------------------------------------------------------------------


def _write(episode: EpisodeReader, target: Path, encoding: VideoEncoding) -> None:
    attributes = episode.attributes
    fps = round(1.0 / attributes["control_period"])
    size = tuple(attributes["image_size"])
    with atomic_folder(target) as folder:
        with h5py.File(folder / MAIN, "w") as file:
            for name, values in rmb_arrays(episode).items():
                file.create_dataset(name, data=values)
            for name, value in _attributes(episode).items():
                file.attrs[name] = value
        for camera in episode.cameras:
            with VideoWriter(folder / f"{camera}{VIDEO}", size, fps, encoding) as video:
                for step in range(len(episode)):
                    video.add(episode.frame(camera, step))


def _attributes(episode: EpisodeReader) -> dict[str, Any]:
    """Return the attributes of ``main.rmb.hdf5``."""
    task, attributes = episode.task, episode.attributes
    return {
        "demo": task.name,  # until RoboManipBaselines called it
        "demo_name": task.name,
        "task_desc": attributes.get("instruction") or task.instruction,
        "version": version("robo_manip_baselines"),
        "env": task.name,
        "world_idx": attributes["seed"],
        "camera_names": list(episode.cameras),
        "tactile_names": [],
        "format": "RmbData-Compact",
        OWN_ATTRIBUTE: own_attributes(episode),
    }


def rmb_arrays(episode: EpisodeReader) -> dict[str, NDArray[Any]]:
    """Return the arrays of ``main.rmb.hdf5`` by their keys.

    Poses are x, y, z in m and the quaternion w, x, y, z in the world frame, of each arm. The
    commanded pose is that of the commanded joints; RoboManipBaselines has the target of its inverse
    kinematics there.
    """
    from robo_manip_baselines.envs.mujoco.cell.kinematics import gripper_poses  # the simulator

    array, steps = episode.array, len(episode)
    arms = tuple(dict.fromkeys(n.partition("/")[0] for n in episode.attributes["joint_names"]))
    number = len(arms)

    def joined(joints: str, grippers: str) -> NDArray[np.float64]:
        by_arm = array(joints).reshape(steps, number, -1)
        return np.concatenate([by_arm, array(grippers)[..., None]], axis=-1).reshape(steps, -1)

    command = array("action").reshape(steps, number, -1)
    measured_pose = gripper_poses(array("joint_position").reshape(steps, number, -1), arms)
    # The recorded pose, where there is one: of the right arm.
    measured_pose[:, -1, :3] = array("end_effector_position")
    measured_pose[:, -1, 3:] = array("end_effector_orientation")
    command_pose = gripper_poses(command[..., :-1], arms)
    result = {
        "time": array("time"),
        "measured_joint_pos": joined("joint_position", "gripper_position"),
        "command_joint_pos": array("action"),
        "measured_joint_vel": joined("joint_velocity", "gripper_velocity"),
        "measured_gripper_joint_pos": array("gripper_position"),
        "command_gripper_joint_pos": command[..., -1],
        "measured_eef_pose": measured_pose.reshape(steps, -1),
        "command_eef_pose": command_pose.reshape(steps, -1),
        "measured_eef_pose_rel": relative_poses(measured_pose),
        "command_eef_pose_rel": relative_poses(command_pose),
    }
    for name in ("measured_joint_pos", "command_joint_pos"):
        result[f"{name}_rel"] = np.diff(result[name], axis=0, prepend=result[name][:1])
    own = {name: values for name, values in episode.arrays.items() if name not in DERIVED}
    return result | own


def relative_poses(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each pose in the frame of the one before it, zero at first.

    Args:
        poses: (T, A, 7) x, y, z and quaternion w, x, y, z.

    Returns:
        (T, 6 A) x, y, z in m, and roll, pitch and yaw in rad: turns about the fixed axes x, y, z.
    """
    steps, arms, _ = poses.shape
    before = np.concatenate([poses[:1], poses[:-1]])

    def turn(values: NDArray[np.float64]) -> Rotation:
        return Rotation.from_quat(values[..., 3:].reshape(-1, 4), scalar_first=True)

    inverse = turn(before).inv()
    way = inverse.apply((poses - before)[..., :3].reshape(-1, 3))
    angles = (inverse * turn(poses)).as_euler("xyz")
    return np.concatenate([way, angles], axis=-1).reshape(steps, 6 * arms)


# -- reading ---------------------------------------------------------------------------------------


@contextmanager
def open_rmb(path: Path) -> Iterator[Recording]:
    """Open a ``.rmb`` folder or an RmbData-SingleHDF5 file.

    Raises:
        RequestError: it is none, damaged, or of a robot with other joints.
    """
    main = path / MAIN if path.is_dir() else path
    try:
        with open_hdf5(main) as file:
            yield _recording(file, path)
    except READ_ERRORS as error:
        if isinstance(error, RequestError):
            raise
        raise RequestError(f"'{path}' is no RMB episode: {one_line(error)}") from error


def _recording(file: h5py.File, path: Path) -> Recording:
    own = _own(file, path)
    time = read_whole(dataset_of(file, "time")).astype(np.float64)
    measured, command = _array(file, "measured_joint_pos"), _array(file, "command_joint_pos")
    steps, width = measured.shape
    if width not in (7, 14) or command.shape != measured.shape or time.shape != (steps,):
        raise RequestError(
            f"'{path}': time {time.shape}, measured_joint_pos {measured.shape}, "
            f"command_joint_pos {command.shape}; one or two arms of 6 joints and a gripper are "
            "read: (T, 7), (T, 14)"
        )
    if steps < 2 or not (np.diff(time) > 0.0).all():
        raise RequestError(f"'{path}': {steps} steps, or time does not increase")
    by_arm = measured.reshape(steps, -1, 7)
    velocity = _velocity(file, by_arm, time)
    pose = _array(file, "measured_eef_pose")
    if pose.ndim != 2 or pose.shape[1] < 7 or len(pose) != steps:
        raise RequestError(f"'{path}': measured_eef_pose {pose.shape}, not ({steps}, 7 or more)")
    pose = pose[:, -7:].copy()
    if own is None:  # an exported one is unit already, and shall stay as it is
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    sides = ("left", "right")[-by_arm.shape[1] :]
    fields: dict[str, NDArray[Any]] = {}
    if own is not None:
        fields = {
            name: read_whole(dataset_of(file, name))
            for name in map(str, file)
            if name not in _WRITTEN and not name.endswith(IMAGE)
        }
    attributes = _plain_attributes(file)
    return Recording(
        time=time,
        action=command.reshape(steps, -1, 7),
        joint_position=by_arm[..., :6],
        joint_velocity=velocity[..., :6],
        gripper_position=by_arm[..., 6],
        gripper_velocity=velocity[..., 6],
        end_effector=pose,
        qpos=measured,
        qvel=velocity.reshape(steps, -1),
        joint_names=tuple(f"{side}/joint_{k}" for side in sides for k in range(6)),
        cameras=_cameras(file, path),
        frames=_frames(file, path),
        attributes=attributes,
        instruction=str(attributes.get("task_desc", "")),
        own=None if own is None else (own, fields),
    )


_WRITTEN = frozenset(
    f"{which}_{name}"
    for which in ("measured", "command")
    for name in (
        "joint_pos",
        "joint_pos_rel",
        "joint_vel",
        "gripper_joint_pos",
        "eef_pose",
        "eef_pose_rel",
    )
) | {"time"}


def _array(file: h5py.File, key: str) -> NDArray[np.float64]:
    for name in (key, *OLD_KEYS.get(key, ())):
        if name in file:
            return read_whole(dataset_of(file, name)).astype(np.float64)
    raise KeyError(f"no dataset '{key}'")


def _velocity(
    file: h5py.File, position: NDArray[np.float64], time: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (T, A, 7) velocities; differences of the positions where there are none."""
    differences = np.gradient(position, time, axis=0)
    try:
        measured = _array(file, "measured_joint_vel")
    except KeyError:
        return differences
    steps, arms, _ = position.shape
    measured = measured.reshape(steps, arms, -1)
    if measured.shape[-1] == 6:  # of the joints alone
        return np.concatenate([measured, differences[..., 6:]], axis=-1)
    return measured


def _own(file: h5py.File, path: Path) -> dict[str, Any] | None:
    """Return the attributes of the episode that a file was exported from, if it was."""
    if OWN_ATTRIBUTE not in file.attrs:
        return None
    text = attribute_of(file, OWN_ATTRIBUTE)
    return parse_own_attributes(text.decode() if isinstance(text, bytes) else str(text), path)


def _plain_attributes(file: h5py.File) -> dict[str, Any]:
    """Return attributes that are one number or text; lists of names are not needed."""
    found: dict[str, Any] = {}
    for name in file.attrs:
        try:
            value = attribute_of(file, name)
        except READ_ERRORS:
            continue
        value = value.decode(errors="replace") if isinstance(value, bytes) else value
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, str | int | float | bool) and value == value and name != OWN_ATTRIBUTE:
            found[name] = value
    return found


def _cameras(file: h5py.File, path: Path) -> tuple[str, ...]:
    if path.is_dir():
        return tuple(sorted(p.name.removesuffix(VIDEO) for p in path.glob(f"*{VIDEO}")))
    return tuple(
        sorted(name.removesuffix(IMAGE) for name in map(str, file) if name.endswith(IMAGE))
    )


def _frames(file: h5py.File, path: Path) -> Frames:
    def of_video(camera: str) -> Iterator[NDArray[np.uint8]]:
        with VideoReader(path / f"{camera}{VIDEO}") as video:
            yield from video

    def of_file(camera: str) -> Iterator[NDArray[np.uint8]]:
        images = dataset_of(file, f"{camera}{IMAGE}")
        if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8:
            raise RequestError(f"'{path}': images of '{camera}' are {images.shape} {images.dtype}")
        return iter(images)

    return of_video if path.is_dir() else of_file
