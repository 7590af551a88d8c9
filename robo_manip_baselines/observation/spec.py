"""What a policy is shown, as one frozen dataclass.

Legend: A arms (1 or 2), H horizon in frames of 1/30 s, C cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from robo_manip_baselines.envs.mujoco.vx300s import ARM_JOINTS
from robo_manip_baselines.errors import RequestError, require_choice
from robo_manip_baselines.observation.error import ERRORS

PRESETS = ("baseline", "current", "current_pred")
"""The paper's three observation groups (section IV.C)."""

CAMERAS = ("top", "angle", "front_close")
"""The paper's three views (Fig. 8)."""

ARMS: dict[str, tuple[str, ...]] = {"right": ("right",), "both": ("left", "right")}
"""Arms that a policy moves and is shown, in the order of the action."""

MAX_HORIZON = 5
"""Frames that the predictor of the paper looks ahead (section IV.A)."""

MAX_IMAGE_SIZE = 4096


@dataclass(frozen=True)
class ObservationSpec:
    """Which components an observation has.

    Attributes:
        obs: preset: ``baseline`` shows the robot and the cameras, ``current`` adds the mouth and
            its distance to the gripper, ``current_pred`` the mouth now and in the next frames.
        horizon: H, frames ahead that ``current_pred`` shows, 1 to 5.
        cameras: views to show, any of ``CAMERAS``, or none at all.
        image_size: (height, width) in pixels.
        object_pose: whether to show the position of the cube.
        error: what stands between the true and the observed mouth.
        arms: which arms the robot's state speaks of.

    Raises:
        RequestError: a value that is not valid.
    """

    obs: str = "baseline"
    horizon: int = 2
    cameras: tuple[str, ...] = CAMERAS
    image_size: tuple[int, int] = (480, 640)
    object_pose: bool = False
    error: str = "none"
    arms: str = "right"

    def __post_init__(self) -> None:
        require_choice("observation preset", self.obs, PRESETS)
        require_choice("error model", self.error, ERRORS)
        require_choice("arms", self.arms, ARMS)
        for camera in self.cameras:
            require_choice("camera", camera, CAMERAS)
        if len(set(self.cameras)) != len(self.cameras):
            raise RequestError(f"cameras {', '.join(self.cameras)}: each may be named once")
        if not 1 <= self.horizon <= MAX_HORIZON:
            raise RequestError(f"horizon {self.horizon}: must be 1 to {MAX_HORIZON} frames")
        if len(self.image_size) != 2 or not all(
            1 <= side <= MAX_IMAGE_SIZE for side in self.image_size
        ):
            raise RequestError(
                f"image size {self.image_size}: must be height and width, 1 to {MAX_IMAGE_SIZE}"
            )

    @property
    def arm_names(self) -> tuple[str, ...]:
        """The arms in the order of state and action."""
        return ARMS[self.arms]

    @property
    def frames(self) -> int:
        """How many mouth positions, from now on, the preset shows."""
        return {"baseline": 0, "current": 1, "current_pred": self.horizon + 1}[self.obs]

    def components(self) -> dict[str, tuple[str, ...]]:
        """Name every element of every vector of the observation, in order."""
        named = {"state": tuple(_state_names(self.arm_names))}
        if self.obs == "current":
            named["mouth"] = ("mouth x", "mouth y", "mouth z", "distance")
        if self.obs == "current_pred":
            steps = range(self.frames)
            named["prediction"] = tuple(
                [f"{axis}_{k}" for k in steps for axis in "txyz"] + [f"distance_{k}" for k in steps]
            )
        if self.object_pose:
            named["object_position"] = ("cube x", "cube y", "cube z")
        return named

    def image_keys(self) -> dict[str, str]:
        """Map keys of the observation to cameras."""
        return {f"images/{camera}": camera for camera in self.cameras}


def _state_names(arms: Sequence[str]) -> list[str]:
    """Name the 14 numbers of each arm: positions, velocities, gripper (paper, section IV.C)."""
    names: list[str] = []
    for arm in arms:
        names += [f"{arm}/{joint} position" for joint in ARM_JOINTS]
        names += [f"{arm}/{joint} velocity" for joint in ARM_JOINTS]
        names += [f"{arm}/gripper position", f"{arm}/gripper velocity"]
    return names
