"""One demonstration: a scripted expert acts in an environment, and everything is written down."""

from __future__ import annotations

import platform
from collections import defaultdict
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data import encode_image
from robo_manip_baselines.envs.mujoco.face_env import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.feeding_env import FeedingEnv
from robo_manip_baselines.envs.mujoco.feeding_success import Phase
from robo_manip_baselines.expert.feeding import EXPERTS, FeedingExpert
from robo_manip_baselines.observation import FRAME_PERIOD


@dataclass(frozen=True)
class Demonstration:
    """What one episode leaves behind, as ``data.write_episode`` takes it.

    Attributes:
        arrays: field -> (T, ...) array.
        images: camera -> T encoded frames.
        attributes: attribute -> value.
    """

    arrays: dict[str, NDArray[Any]]
    images: dict[str, list[NDArray[np.uint8]]]
    attributes: dict[str, Any]


def demonstrate(
    env: gymnasium.Env[Any, Any], expert: str, seed: int, *, codec: str, quality: int
) -> Demonstration:
    """Let an expert act through one episode.

    Args:
        env: made by ``make_env``; its cameras are recorded.
        expert: a name of ``EXPERTS``.
        seed: of the episode.
        codec: see ``data.encode_image``.
        quality: of JPEG, 1 to 100.
    """
    world = env.unwrapped
    if not isinstance(world, FeedingEnv):
        raise TypeError(f"the scripted experts act in FeedingEnv, not in {type(world).__name__}")
    actor = FeedingExpert(world, EXPERTS[expert])
    rows: dict[str, list[Any]] = defaultdict(list)
    images: dict[str, list[NDArray[np.uint8]]] = {
        camera: [] for camera in world.observation_spec.cameras
    }
    observation, _ = env.reset(seed=seed)
    start = world.object_pose
    actor.reset()
    ended = False
    while not ended:
        action = actor.act()
        for name, value in _row(world).items():
            rows[name].append(value)
        rows["action"].append(action)
        for key, camera in world.observation_spec.image_keys().items():
            images[camera].append(encode_image(observation[key], codec, quality))
        observation, _, terminated, truncated, _ = env.step(action)
        rows["is_success"].append(world.progress.is_success)
        rows["is_success_strict"].append(world.progress.is_success_strict)
        ended = terminated or truncated
    attributes = {
        **_attributes(env, world),
        "seed": seed,
        "expert": expert,
        "object_initial_pose": start,
        "image_codec": codec,
        "image_quality": quality,
    }
    return Demonstration(
        {name: np.asarray(values) for name, values in rows.items()}, images, attributes
    )


def _row(world: FeedingEnv) -> dict[str, Any]:
    """Return what is so before an action."""
    truth = world.truth()
    return {
        "time": world.time,
        "joint_position": truth.joint_position.ravel(),
        "joint_velocity": truth.joint_velocity.ravel(),
        "gripper_position": truth.gripper_position,
        "gripper_velocity": truth.gripper_velocity,
        "end_effector_position": truth.end_effector_position,
        "end_effector_orientation": world.gripper_orientation,
        "mouth_position": truth.mouth_position,
        **({} if truth.predicted_mouth is None else {"predicted_mouth": truth.predicted_mouth}),
        "head_orientation": world.head_orientation,
        "jaw_opening": world.jaw_opening,
        "object_pose": world.object_pose,
        "phase": np.int8(world.progress.phase),
        "qpos": world.data.qpos.copy(),
        "qvel": world.data.qvel.copy(),
    }


def _attributes(env: gymnasium.Env[Any, Any], world: FeedingEnv) -> dict[str, Any]:
    """Return where the episode came from and how it ended."""
    if env.spec is None:
        raise ValueError("the environment must be made by its id, so that it can be made again")
    segment, progress = world.segment, world.progress
    joints, actions = world.joint_names, world.action_names
    return {
        "env_id": env.spec.id,
        "env_kwargs": dict(env.spec.kwargs),
        "is_success": progress.is_success,
        "is_success_strict": progress.is_success_strict,
        "completion_time": np.nan if progress.completion_time is None else progress.completion_time,
        "motion_clip": segment.clip,
        "motion_subject": segment.subject,
        "motion_start_index": segment.index,
        "motion_start_time": segment.start / segment.fps,
        "face_offset": world.face_offset,
        "control_period": CONTROL_PERIOD,
        "prediction_period": FRAME_PERIOD,
        "phase_names": [phase.name.lower() for phase in Phase],
        "joint_names": joints,
        "action_names": actions,
        "xml_hash": world.xml_hash,
        "versions": {
            "python": platform.python_version(),
            "mujoco": mujoco.__version__,
            "numpy": np.__version__,
            "robo_manip_baselines": version("robo_manip_baselines"),
        },
    }
