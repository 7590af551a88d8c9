"""The VX300s arm: names, limits and poses, and the model itself as a MuJoCo spec to attach.

The model is ``assets/vx300s.xml``; ``docs/robot.md`` says where its figures come from.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import mujoco

HOME_QPOS: Final = (0.0, -0.96, 1.16, 0.0, -0.3, 0.0)
"""Home pose of `ARM_JOINTS`, radians (that of the public ALOHA simulation)."""

FINGER_CLOSED: Final = 0.021
"""Position of a finger when the pads meet, metres (published lower limit)."""

FINGER_OPEN: Final = 0.057
"""Position of a finger when the pads are 72 mm apart, metres (published upper limit)."""


def arm_spec() -> mujoco.MjSpec:
    """Return a fresh, editable model of one arm, its base frame at the origin.

    Attach it with a prefix (``left/``, ``right/``); its joints are `ARM_JOINTS` and the slides
    ``left_finger`` and ``right_finger``, its actuators `ARM_JOINTS` and ``gripper`` (target: a
    finger's position in metres, `FINGER_CLOSED` … `FINGER_OPEN`), its site ``gripper`` lies
    between the pads with x pointing out of the gripper.
    """
    return mujoco.MjSpec.from_file(str(Path(__file__).with_name("assets") / "vx300s.xml"))
