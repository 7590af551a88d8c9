"""A small episode without a simulator: for tests, benchmarks and trying out readers."""

from __future__ import annotations

from typing import Any

import numpy as np

from robo_manip_baselines.data.schema import OLD_FRAMES, EpisodeSchema
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import MAX_HORIZON
from robo_manip_baselines.runs.images import encode_image


def make_arrays(
    steps: int = 12, seed: int = 0, *, arms: int = 1, version: int = 1
) -> dict[str, np.ndarray]:
    """Every field of the table, filled with finite numbers that obey its rules.

    Args:
        steps: T.
        seed: of the numbers.
        arms: 1 or 2.
        version: of the schema, which decides how far ahead the truth is known.
    """
    schema = EpisodeSchema.of(task_entry("FeedingEnv"))
    rng = np.random.default_rng(seed)
    sizes = {
        "T": steps,
        "A": 7 * arms,
        "J": 6 * arms,
        "G": arms,
        "Q": 23,
        "V": 22,
        "H": 5,
        "R": 11,
        "B": 4,
    }
    sizes["K"] = MAX_HORIZON + 1 if version > 2 else OLD_FRAMES
    arrays: dict[str, np.ndarray] = {}
    # By version, so that the numbers of the older fields are those of an older file.
    for field in sorted(schema.fields, key=lambda field: field.since):
        shape = tuple(sizes[size] if isinstance(size, str) else size for size in field.shape)
        values = rng.normal(size=shape)
        if field.rule == "unit quaternion":
            values[:, -4:] /= np.linalg.norm(values[:, -4:], axis=1, keepdims=True)
        if field.rule == "not negative":
            values = np.abs(values)
        if field.rule == "increasing":
            values = 0.02 * np.arange(steps)
        if field.rule == "phase index":
            values = rng.integers(0, 3, shape)
        if field.dtype == "bool":
            values = values > 0
        arrays[field.name] = values.astype(field.dtype)
    optional = [item.name for item in schema.fields if item.is_optional and item.since <= version]
    present = optional if version > 3 else ()
    return {name: arrays[name] for name in schema.fields_of(version, present)}


def make_frames(steps: int = 12, seed: int = 0, size: tuple[int, int] = (24, 32)) -> np.ndarray:
    """(T, H, W, 3) uint8: a coloured square that moves over a gradient."""
    height, width = size
    frames = np.zeros((steps, height, width, 3), dtype=np.uint8)
    frames[..., 0] = np.linspace(0, 200, width).astype(np.uint8)
    frames[..., 1] = np.linspace(0, 200, height).astype(np.uint8)[:, None]
    for step in range(steps):
        left = (step + seed) % (width - 8)
        frames[step, 8:16, left : left + 8] = (220, 30, 40)
    return frames


def make_images(
    steps: int = 12, codec: str = "jpeg", cameras: tuple[str, ...] = ("front_close", "top")
) -> dict[str, list[np.ndarray]]:
    """Encoded frames of each camera."""
    return {
        camera: [encode_image(frame, codec) for frame in make_frames(steps, index)]
        for index, camera in enumerate(cameras)
    }


def make_attributes(seed: int = 3, *, codec: str = "jpeg", arms: int = 1) -> dict[str, Any]:
    """Every attribute that the caller gives."""
    sides = ("left", "right")[-arms:]
    joints = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
    return {
        "env_id": "robo_manip_baselines/FeedingEnv-v0",
        "env_kwargs": {"cameras": ["top", "front_close"], "obs": "baseline"},
        "seed": seed,
        "expert": "reactive",
        "is_success": True,
        "is_success_strict": False,
        "completion_time": 3.2,
        "motion_clip": "a clip",
        "motion_subject": "someone",
        "motion_start_index": 17,
        "motion_start_time": 17 / 30,
        "face_offset": [0.01, -0.02, 0.03],
        "object_initial_pose": [0.1, 0.5, 0.02, 1.0, 0.0, 0.0, 0.0],
        "control_period": 0.02,
        "prediction_period": 1 / 30,
        "phase_names": ["approach", "grasp", "feed"],
        "joint_names": [f"{side}/{joint}" for side in sides for joint in joints],
        "action_names": [f"{side}/{name}" for side in sides for name in (*joints, "gripper")],
        "xml_hash": "0" * 64,
        "versions": {"python": "3.11.0", "mujoco": "3.17.0", "numpy": "2.0.0"},
        "image_codec": codec,
        "image_quality": 90,
    }
