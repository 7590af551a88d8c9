"""The truth that an episode file holds, ready for `observe`.

Legend: T control steps, A arms (left before right), K = 6 frames from now to the longest horizon.
"""

from __future__ import annotations

from robo_manip_baselines.data.episode import EpisodeReader
from robo_manip_baselines.observation.truth import Truth


def recorded_truth(episode: EpisodeReader) -> Truth:
    """Read the (T, ...) truth of an episode of one arm or of both.

    Raises:
        EpisodeFileError: a field is missing or damaged.
    """
    gripper_position = episode.array("gripper_position")
    arms = gripper_position.shape[1]

    return Truth(
        time=episode.array("time"),
        joint_position=episode.array("joint_position").reshape(len(episode), arms, -1),
        joint_velocity=episode.array("joint_velocity").reshape(len(episode), arms, -1),
        gripper_position=gripper_position,
        gripper_velocity=episode.array("gripper_velocity"),
        end_effector_position=episode.array("end_effector_position"),
        mouth_position=episode.array("mouth_position"),
        object_position=episode.array("object_pose")[:, :3],
        predicted_mouth=(
            episode.array("predicted_mouth") if "predicted_mouth" in episode.fields else None
        ),
    )
