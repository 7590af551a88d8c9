"""Recorded quantities of environments with a face: rows of episode files, safety of each step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.observation import ARM_JOINTS, FRAME_PERIOD

if TYPE_CHECKING:
    from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv

REFUSAL_ANGLE = np.radians(20.0)
"""rad by which the face has turned from world +x where it refuses: more than people who talk turn
for long, and less than `TurnAway` does."""


def episode_row(env: FaceEnv) -> dict[str, Any]:
    """Return the present row of an episode file: the state before an action."""
    state = env.state()
    predicted = env.predicted_mouth
    return {
        "time": env.time,
        "joint_position": state.joint_position.ravel(),
        "joint_velocity": state.joint_velocity.ravel(),
        "gripper_position": state.gripper_position,
        "gripper_velocity": state.gripper_velocity,
        "end_effector_position": state.end_effector_position,
        "end_effector_orientation": env.gripper_orientation,
        "mouth_position": env.mouth_track,
        **({} if predicted is None else {"predicted_mouth": predicted}),
        "head_orientation": env.head_orientation,
        "jaw_opening": env.jaw_opening,
        "phase": np.int8(env.phase_names.index(env.info()["phase"])),
        "qpos": env.data.qpos.copy(),
        "qvel": env.data.qvel.copy(),
        **env.task_row(),
    }


def start_attributes(env: FaceEnv) -> dict[str, Any]:
    """Return the attributes that every episode file has and that are known after its reset."""
    segment, arms = env.segment, env.observation_spec.arm_names
    return {
        "motion_clip": segment.clip,
        "motion_subject": segment.subject,
        "motion_start_index": segment.index,
        "motion_start_time": segment.start / segment.fps,
        "face_offset": env.face_offset,
        "control_period": CONTROL_PERIOD,
        "prediction_period": FRAME_PERIOD,
        "phase_names": list(env.phase_names),
        "joint_names": [f"{arm}/{joint}" for arm in arms for joint in ARM_JOINTS],
        "action_names": env.action_names,
        "xml_hash": env.xml_hash,
    }


def safety_info(env: FaceEnv) -> dict[str, Any]:
    """Return what ``info`` says of contacts and distances of the face in the last step."""
    return {
        "face_contacts": env.touch.contacts,
        "face_proximity": env.proximity() if env.measures_proximity else None,
        "is_refusing": is_refusing(env),
    }


def is_refusing(env: FaceEnv) -> bool | None:
    """Return True while a head that refuses is turned away; None where it never refuses."""
    if not env.motion.refuses:
        return None
    return bool(facing_angle(env.head_orientation) > REFUSAL_ANGLE)


def facing_angle(orientation: ArrayLike) -> NDArray[np.float64]:
    """Return the angle (...) rad between the face's normal and world +x, given (..., 4) wxyz."""
    w, x, y, z = np.moveaxis(np.asarray(orientation, dtype=np.float64), -1, 0)
    return np.arccos(np.clip(w**2 + x**2 - y**2 - z**2, -1.0, 1.0))
