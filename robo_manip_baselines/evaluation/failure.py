"""Why an episode of feeding failed: one kind for every way of failing, from recorded facts."""

from __future__ import annotations

import numpy as np

from robo_manip_baselines.envs.mujoco.feeding_success import MOUTH_TOLERANCE

FAILURES = {
    "never_grasped": "the cube was never lifted by 0.10 m",
    "dropped": "the cube was lifted and lost before the gripper was at the mouth's depth, or at "
    "the mouth no more than one finger held it",
    "missed_high": "the gripper brought the cube to the mouth's depth, and passed above the mouth",
    "missed_low": "likewise, below the mouth",
    "missed_left": "likewise, to the person's left (world +y)",
    "missed_right": "likewise, to the person's right (world -y)",
    "too_late": "the episode ended with the cube in the gripper and still not at the mouth's depth",
}
"""Kind -> what happened. A successful episode has the kind ``""``."""

APPROACH_LIMIT = 6.0
"""s after the lift within which the gripper should be at the mouth (paper, Algorithm 1, line 10).
``is_success`` has no such limit; the summary counts the successes within it."""


def failure_kind(
    *, is_success: bool, was_released: bool, closest_offset: tuple[float, float, float] | None
) -> str:
    """Say how an episode failed; ``""`` if it did not.

    "At the mouth's depth" means within Algorithm 1's 0.03 m along world x. Where the gripper was
    there, the miss is named after the larger part of the offset across the face.

    Args:
        is_success: as in ``info``.
        was_released: the lifted cube was let go of, or lost, before the episode ended.
        closest_offset: (x, y, z) m, world, gripper minus mouth, at the closest approach with the
            cube; None if it was never lifted.
    """
    if is_success:
        return ""
    if closest_offset is None:
        return "never_grasped"
    is_within = np.abs(closest_offset) < MOUTH_TOLERANCE
    if is_within.all():
        return "dropped"
    if not is_within[0]:
        return "dropped" if was_released else "too_late"
    _, across, up = closest_offset
    if abs(up) >= abs(across):
        return "missed_high" if up > 0.0 else "missed_low"
    return "missed_left" if across > 0.0 else "missed_right"
