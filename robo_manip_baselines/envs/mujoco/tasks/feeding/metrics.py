"""Watching an episode from outside: its ``info``, step by step, and what it came to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.feeding.failure import failure_kind
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE, Phase
from robo_manip_baselines.rollout.results import EpisodeResult, Offset

CARRYING = {Phase.CARRY.name.lower(), Phase.DELIVER.name.lower()}
"""Phases from the lift of the cube until it is let go."""

RELEASED = Phase.RELEASE.name.lower()


class EpisodeWatch:
    """Gathers the facts of one episode.

    Args:
        env: name of the environment.
        seed: of the episode.
        motion_clip: recorded clip whose motion the face replays.
        motion_subject: person in that clip.
    """

    def __init__(self, env: str, seed: int, motion_clip: str, motion_subject: str) -> None:
        self._start = {
            "env": env,
            "seed": seed,
            "motion_clip": motion_clip,
            "motion_subject": motion_subject,
        }
        self._steps = 0
        self._force = 0.0
        self._distance: float | None = None
        self._offset: Offset | None = None
        self._nearness = np.inf
        self._cube_offset: Offset | None = None
        self._cube_distance = np.inf

    def see(self, info: Mapping[str, Any]) -> None:
        """Take in the ``info`` of a step."""
        self._steps += 1
        self._force = max(self._force, float(info["face_force"]))
        if info["phase"] not in CARRYING:
            return
        offset = np.asarray(info["gripper_position"]) - np.asarray(info["mouth_position"])
        distance = float(np.linalg.norm(offset))
        self._distance = distance if self._distance is None else min(distance, self._distance)
        nearness = float(np.linalg.norm(offset / MOUTH_TOLERANCE))
        if nearness < self._nearness:
            self._nearness = nearness
            x, y, z = offset.tolist()
            self._offset = (x, y, z)
        cube_distance = float(np.linalg.norm(info["cube_offset"]))
        if cube_distance < self._cube_distance:
            self._cube_distance = cube_distance
            out, across, up = np.asarray(info["cube_offset"]).tolist()
            self._cube_offset = (out, across, up)

    def result(self, info: Mapping[str, Any]) -> EpisodeResult:
        """Return what the episode came to, given the ``info`` of its last step."""
        is_success = bool(info["is_success"])
        return EpisodeResult(
            **self._start,
            is_success=is_success,
            is_success_strict=bool(info["is_success_strict"]),
            completion_time=_seconds(info["completion_time"]),
            time_since_lift=_seconds(info["time_since_lift"]),
            steps=self._steps,
            failure=failure_kind(
                is_success=is_success,
                was_released=info["phase"] == RELEASED,
                closest_offset=self._offset,
            ),
            closest_distance=self._distance,
            closest_offset=self._offset,
            cube_offset=self._cube_offset,
            face_force=self._force,
        )


def _seconds(value: float | None) -> float | None:
    """Times are sums of 0.02 s; microseconds hide what floating point adds to them."""
    return None if value is None else round(float(value), 6)
