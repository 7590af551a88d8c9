"""From what is true, or was reported of it, to what is observed, on any batch shape.

Legend: ... any leading shape (none in an environment, (T,) for an episode, (B, T) for a batch),
A arms, K = 6 frames from now to the longest horizon.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.observation.corruption import FRAME_RATE
from robo_manip_baselines.observation.spec import ObservationSpec

FRAME_PERIOD = 1.0 / FRAME_RATE
"""s between two frames of the recorded motion and of the prediction (paper, section IV.A)."""


@dataclass(frozen=True)
class Truth:
    """What is so in the world, before anything corrupts it. SI units, world frame.

    Attributes:
        time: (...) s since the start of the episode.
        joint_position: (..., A, 6) rad.
        joint_velocity: (..., A, 6) rad/s.
        gripper_position: (..., A) m, position of a finger.
        gripper_velocity: (..., A) m/s.
        end_effector_position: (..., 3) m, gripper site of the right arm.
        mouth_position: (..., K, 3) m, now and 1 ... 5 frames ahead.
        object_position: (..., 3) m, centre of the cube.
        predicted_mouth: (..., K - 1, 3) m, where a trained predictor says that the mouth will be
            1 ... 5 frames ahead; None where the recorded motion comes without.
    """

    time: NDArray[np.float64]
    joint_position: NDArray[np.float64]
    joint_velocity: NDArray[np.float64]
    gripper_position: NDArray[np.float64]
    gripper_velocity: NDArray[np.float64]
    end_effector_position: NDArray[np.float64]
    mouth_position: NDArray[np.float64]
    object_position: NDArray[np.float64]
    predicted_mouth: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Report:
    """What a detector says of the mouth. SI units, world frame.

    Attributes:
        time: (...) s since the start of the episode: when it was seen.
        mouth: (..., K, 3) m, then and 1 ... 5 frames after that.
    """

    time: NDArray[np.float64]
    mouth: NDArray[np.float64]


def observe(
    spec: ObservationSpec, truth: Truth, report: Report | None = None
) -> dict[str, NDArray[np.float32]]:
    """Build every vector of an observation; images are added by whoever has them.

    Args:
        spec: what to show.
        truth: with any leading shape.
        report: what a `Detector` says of the mouth, of the same leading shape; needed where the
            spec has a corruption.

    Returns:
        The vectors that ``spec.components()`` names, float32 of shape (..., n). The distances are
        those from the gripper as it is now to the mouth as it was reported.

    Raises:
        ValueError: a report is there and should not be, or the other way round.
    """
    if (report is None) != (spec.corruption is None):
        raise ValueError("a report of the mouth goes with a corruption, and only with one")
    told = report or Report(truth.time, truth.mouth_position)
    arms = np.concatenate(
        [
            truth.joint_position,
            truth.joint_velocity,
            truth.gripper_position[..., None],
            truth.gripper_velocity[..., None],
        ],
        axis=-1,
    )
    parts = {"state": arms.reshape(*arms.shape[:-2], -1)}
    if spec.frames:
        mouth = told.mouth[..., : spec.frames, :]
        distance = np.linalg.norm(mouth - truth.end_effector_position[..., None, :], axis=-1)
        if spec.obs == "current":
            parts["mouth"] = np.concatenate([mouth[..., 0, :], distance], axis=-1)
        else:
            time = told.time[..., None] + np.arange(spec.frames) * FRAME_PERIOD
            timed = np.concatenate([time[..., None], mouth], axis=-1)
            parts["prediction"] = np.concatenate(
                [timed.reshape(*timed.shape[:-2], -1), distance], axis=-1
            )
    if spec.object_pose:
        parts["object_position"] = truth.object_position
    return {name: value.astype(np.float32) for name, value in parts.items()}


def vector_names(spec: ObservationSpec) -> list[str]:
    """Name the S elements of the vector."""
    return [name for names in spec.components().values() for name in names]


def to_vector(
    spec: ObservationSpec, observation: Mapping[str, NDArray[Any]]
) -> NDArray[np.float32]:
    """Join the vectors (..., n) of an observation to one of (..., S); images are left out."""
    return np.concatenate([observation[key] for key in spec.components()], axis=-1)
