"""Episodes of ALOHA's public ACT code: one HDF5 file each, two arms, 14 numbers.

Variables, as its ``record_sim_episodes.py`` writes them: ``/observations/qpos`` and ``qvel``,
``/action`` of shape (T, 14), ``/observations/images/<camera>`` of shape (T, H, W, 3) uint8 RGB; the
attribute ``sim``. The 14 are 6 joints in rad and the gripper, 0 (closed) to 1 (open), of the left
arm, then of the right one. Also read: ``compress``, JPEG images of equal padded length.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

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
from robo_manip_baselines.observation.spec import ARM_JOINTS
from robo_manip_baselines.runs.errors import RequestError, WriteError
from robo_manip_baselines.runs.files import atomic_file
from robo_manip_baselines.runs.hdf5 import (
    READ_ERRORS,
    attribute_of,
    dataset_of,
    one_line,
    open_hdf5,
    read_whole,
)

GRIPPER_CLOSED, GRIPPER_OPEN = 0.01844, 0.05800
"""m, positions of a finger at which ALOHA's gripper is 0 and 1 (``constants.py`` of the public ACT
code: ``PUPPET_GRIPPER_POSITION_CLOSE`` and ``PUPPET_GRIPPER_POSITION_OPEN``)."""

PERIOD = 0.02
"""s between two steps (``DT`` there)."""

SIDES = ("left", "right")
OWN_GROUP = "robo_manip_baselines"
"""Group with the fields of the episode as they were, which ACT does not read."""


def export_aloha(folder: Path, out: Path) -> dict[str, str]:
    """Write ``episode_0.hdf5``, ``episode_1.hdf5``, … of the demonstrations of a folder.

    A demonstration of one arm gets a left arm that stays parked.

    Args:
        folder: as ``bin/Rollout.py`` writes it; ``failed/`` is left out.
        out: folder for them; a run that was killed is continued.

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
        target=lambda number, path: f"episode_{number}.hdf5",
        write=_write,
        own=_own,
    )


def import_aloha(
    folder: Path, out: Path, *, cameras: list[str] | None = None, codec: str = "png"
) -> dict[str, str]:
    """Write an episode file for each ``episode_*.hdf5`` of a folder of ALOHA's.

    See `import_recordings`. Episodes that `export_aloha` wrote become what they were, but for the
    encoding of their images; others become demonstrations of `IMPORTED`.
    """
    found = list(folder.glob("episode_*.hdf5")) if folder.is_dir() else []
    found.sort(key=lambda path: (len(path.stem), path.stem))  # 2 before 10
    require_sources(folder, found, "episode_*.hdf5 file")
    return import_recordings(found, out, open_aloha, kind="aloha", cameras=cameras, codec=codec)


def to_gripper(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return finger positions in m as ALOHA has them: 0 closed, 1 open."""
    return (position - GRIPPER_CLOSED) / (GRIPPER_OPEN - GRIPPER_CLOSED)


def from_gripper(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """Undo `to_gripper`."""
    return value * (GRIPPER_OPEN - GRIPPER_CLOSED) + GRIPPER_CLOSED


# -- writing ---------------------------------------------------------------------------------------


def aloha_arrays(episode: EpisodeReader) -> dict[str, NDArray[np.float32]]:
    """Return ``qpos``, ``qvel`` and ``action`` of an episode, (T, 14) each."""
    from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED  # the simulator
    from robo_manip_baselines.envs.mujoco.tasks.face_scene import PARKED_QPOS

    steps = len(episode)

    def both(joints: NDArray[np.float64], finger: NDArray[np.float64], parked: Any) -> Any:
        """Return (T, 14) from (T, A, 6) and (T, A), the left arm ``parked`` if A = 1."""
        by_arm = np.concatenate([joints, finger[..., None]], axis=-1)
        if by_arm.shape[1] == 1:
            left = np.broadcast_to(np.asarray(parked, np.float64), (steps, 1, 7))
            by_arm = np.concatenate([left, by_arm], axis=1)
        return by_arm.reshape(steps, -1).astype(np.float32)

    array = episode.array
    by_arm = array("action").reshape(steps, -1, 7)
    parked = (*PARKED_QPOS, float(to_gripper(np.array(FINGER_CLOSED))))
    position = array("joint_position").reshape(steps, -1, 6)
    velocity = array("joint_velocity").reshape(steps, -1, 6)
    speed = array("gripper_velocity") / (GRIPPER_OPEN - GRIPPER_CLOSED)
    return {
        "observations/qpos": both(position, to_gripper(array("gripper_position")), parked),
        "observations/qvel": both(velocity, speed, (0.0,) * 7),
        "action": both(by_arm[..., :6], to_gripper(by_arm[..., 6]), parked),
    }


def _write(episode: EpisodeReader, target: Path) -> None:
    steps, size = len(episode), tuple(episode.attributes["image_size"])
    # HDF5 cannot close a file that it could not write, and the images do not fit into memory.
    needed = steps * math.prod(size) * 3 * len(episode.cameras) + 2**24
    if (free := shutil.disk_usage(target.parent).free) < needed:
        raise WriteError(f"'{target}' needs {needed} bytes, and the disk has {free}; make room")
    with atomic_file(target) as path, h5py.File(path, "w") as file:
        file.attrs["sim"] = True
        file.attrs[OWN_ATTRIBUTE] = own_attributes(episode)
        for name, values in aloha_arrays(episode).items():
            file.create_dataset(name, data=values)
        for name, values in episode.arrays.items():
            file.create_dataset(f"{OWN_GROUP}/{name}", data=values)
        for camera in episode.cameras:
            shape = (steps, *size, 3)
            images = file.create_dataset(
                f"observations/images/{camera}", shape, np.uint8, chunks=(1, *size, 3)
            )
            for step in range(steps):
                images[step] = episode.frame(camera, step)


def _own(file: h5py.File, path: Path) -> dict[str, Any] | None:
    """Return the attributes of the episode that a file was exported from, if it was."""
    if OWN_ATTRIBUTE not in file.attrs:
        return None
    text = attribute_of(file, OWN_ATTRIBUTE)
    return parse_own_attributes(text.decode() if isinstance(text, bytes) else str(text), path)


# -- reading ---------------------------------------------------------------------------------------


@contextmanager
def open_aloha(path: Path) -> Iterator[Recording]:
    """Open an episode of ALOHA.

    Raises:
        RequestError: it is none, or damaged.
    """
    try:
        with open_hdf5(path) as file:
            yield _recording(file, path)
    except READ_ERRORS as error:
        if isinstance(error, RequestError):
            raise
        raise RequestError(f"'{path}' is no ALOHA episode: {one_line(error)}") from error


def _recording(file: h5py.File, path: Path) -> Recording:
    qpos = read_whole(dataset_of(file, "observations/qpos")).astype(np.float64)
    action = read_whole(dataset_of(file, "action")).astype(np.float64)
    if qpos.ndim != 2 or qpos.shape[1] != 14 or action.shape != qpos.shape:
        raise RequestError(
            f"'{path}': qpos {qpos.shape}, action {action.shape}; episodes of two arms are read, "
            "(T, 14): 6 joints and a gripper of the left arm, then of the right one"
        )
    steps = len(qpos)
    time = PERIOD * np.arange(steps, dtype=np.float64)
    if "observations/qvel" in file:
        qvel = read_whole(dataset_of(file, "observations/qvel")).astype(np.float64)
    else:
        qvel = np.gradient(qpos, time, axis=0)
    own = _own(file, path)
    position, velocity = qpos.reshape(steps, 2, 7), qvel.reshape(steps, 2, 7)
    command = action.reshape(steps, 2, 7).copy()
    command[..., 6] = from_gripper(command[..., 6])
    return Recording(
        time=time,
        action=command,
        joint_position=position[..., :6],
        joint_velocity=velocity[..., :6],
        gripper_position=from_gripper(position[..., 6]),
        gripper_velocity=velocity[..., 6] * (GRIPPER_OPEN - GRIPPER_CLOSED),
        end_effector=_right_poses(position[..., :6]),
        qpos=qpos,
        qvel=qvel,
        joint_names=tuple(f"{side}/{joint}" for side in SIDES for joint in ARM_JOINTS),
        cameras=_cameras(file),
        frames=_frames(file, path),
        attributes={"sim": bool(attribute_of(file, "sim")) if "sim" in file.attrs else False},
        own=None if own is None else (own, _own_fields(file)),
    )


def _right_poses(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (T, 7) poses of the right gripper: ALOHA's arms stand as those here do."""
    from robo_manip_baselines.envs.mujoco.cell.kinematics import gripper_poses  # the simulator

    return gripper_poses(joints, SIDES)[:, 1]


def _own_fields(file: h5py.File) -> dict[str, NDArray[Any]]:
    group = file.get(OWN_GROUP)
    names = map(str, group) if isinstance(group, h5py.Group) else ()
    return {name: read_whole(dataset_of(file, f"{OWN_GROUP}/{name}")) for name in names}


def _cameras(file: h5py.File) -> tuple[str, ...]:
    images = file.get("observations/images")
    return tuple(sorted(map(str, images))) if isinstance(images, h5py.Group) else ()


def _frames(file: h5py.File, path: Path) -> Frames:
    """Return a reader of images; those of real robots may be compressed.

    Compressed ones are decoded as ACT does, whose JPEGs hold RGB where others hold BGR.
    """
    import cv2

    def frames(camera: str) -> Iterator[NDArray[np.uint8]]:
        images = dataset_of(file, f"observations/images/{camera}")
        if images.dtype != np.uint8 or images.ndim not in (2, 4) or images.shape[-1] in (1, 4):
            raise RequestError(f"'{path}': images of '{camera}' are {images.shape} {images.dtype}")
        for step in range(len(images)):
            stored = np.asarray(images[step], dtype=np.uint8)
            image = cv2.imdecode(stored, cv2.IMREAD_COLOR) if stored.ndim == 1 else stored
            if image is None:
                raise RequestError(f"'{path}': image {step} of '{camera}' is damaged")
            yield np.ascontiguousarray(image, dtype=np.uint8)

    return frames
