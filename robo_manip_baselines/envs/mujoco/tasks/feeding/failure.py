"""Why an episode of feeding failed: one kind for every way of failing, from recorded facts."""

from __future__ import annotations

import numpy as np

from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE

FAILURES = {
    "never_grasped": "the cube was never lifted by 0.10 m",
    "dropped": "the cube was lifted, and lost or let go before it was at the mouth; or there no "
    "more than one finger held it",
    "missed_high": "the gripper brought the cube to the face, within 0.06 m of the mouth along x, "
    "and above the mouth",
    "missed_low": "likewise, below the mouth",
    "missed_left": "likewise, to the person's left (world +y)",
    "missed_right": "likewise, to the person's right (world -y)",
    "too_late": "the episode ended with the cube in the gripper and not yet at the mouth",
}
"""Kind -> what happened. A successful episode has the kind ``""``."""

REACH = 0.06
"""m along world x from the mouth, within which a gripper has come to the face: twice the tolerance
of Algorithm 1, line 10, so that letting go a little early does not hide that the aim was beside."""

APPROACH_LIMIT = 6.0
"""s after the lift within which the gripper should be at the mouth (paper, Algorithm 1, line 10).
``is_success`` has no such limit; the summary counts the successes within it."""


def failure_kind(
    *, is_success: bool, was_released: bool, closest_offset: tuple[float, float, float] | None
) -> str:
    """Say how an episode failed; ``""`` if it did not.

    What counts is the closest approach. A gripper that has come to the face and is beside the mouth
    has missed it, to the side where it is farthest; letting go there is part of the miss.

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
    out, across, up = closest_offset
    if is_within[1:].all() or abs(out) >= REACH:
        return "dropped" if was_released or is_within.all() else "too_late"
    if abs(up) >= abs(across):
        return "missed_high" if up > 0.0 else "missed_low"
    return "missed_left" if across > 0.0 else "missed_right"
