"""Interface of devices by which a person steers arms, and the registry of devices.

A device is shown the session once in every control period and returns the motion and the events
that the person asks for. Adding one is a module with a class, and a line in `DEVICES`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pkgutil import resolve_name
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.runs.errors import require_choice

Floats = NDArray[np.float64]


class TeleopEvent(Enum):
    """Request of the person other than a motion; the value is the name on screen."""

    RECORD = "record"
    """Put the world back to its start and begin an episode, or begin the running one again."""
    SAVE = "save"
    """End the episode if it is running, keep it, and go on with the next seed."""
    DISCARD = "discard"
    """Drop the episode and go on with the next seed."""
    REDO = "redo"
    """Drop the episode and begin it again, with the same seed."""
    TAKE_OVER = "take over"
    """The person acts, and not the policy."""
    GIVE_BACK = "give back"
    """The policy acts."""
    SWITCH_ARM = "switch arm"
    """Steer the other arm."""
    QUIT = "quit"
    """End the session; a running episode is dropped."""


class Mode(Enum):
    """Mode of a session; the value is its name on screen."""

    PRACTICE = "practice"
    """The arms move, nothing is recorded, and time has no limit."""
    RECORDING = "recording"
    """Every step is recorded, until the task or its time limit ends the episode."""
    REVIEW = "review"
    """The episode has ended; the world stands still until it is saved, discarded or done again."""


@dataclass(frozen=True)
class TeleopCommand:
    """Motion that is asked of one arm for one control period.

    Attributes:
        linear: (3,) m/s, velocity of the gripper along the world's axes.
        angular: (3,) rad/s, angular velocity of the gripper about the world's axes.
        opening: of the gripper, 0 closed to 1 open; None leaves it as it is.
    """

    linear: Floats = field(default_factory=lambda: np.zeros(3))
    angular: Floats = field(default_factory=lambda: np.zeros(3))
    opening: float | None = None


@dataclass(frozen=True)
class TeleopInput:
    """Answer of a device for one control period.

    Attributes:
        arms: name of an arm -> its motion; arms that are not named, or not steered, hold still.
        events: in the order in which they happened.
    """

    arms: Mapping[str, TeleopCommand] = field(default_factory=dict)
    events: tuple[TeleopEvent, ...] = ()


@dataclass(frozen=True)
class ArmPose:
    """Commanded pose of a gripper.

    Attributes:
        position: (3,) m, world.
        orientation: (4,) wxyz, world from gripper, whose x points out of it.
        opening: 0 closed to 1 open.
    """

    position: Floats
    orientation: Floats
    opening: float


@dataclass(frozen=True)
class SessionView:
    """State of a session that a device may show, and needs to turn places into velocities.

    Attributes:
        mode: of the session.
        seed: of the running episode, or of the next one.
        step: control steps of the running episode.
        step_limit: control steps after which it ends.
        saved: episodes that this session has saved.
        wanted: episodes that it is to save.
        steered: arms that the device may move.
        active_arm: one of them: the arm that a device with a single hand moves.
        arms: name of an arm -> commanded pose, of all arms that the task moves.
        is_success: whether the task's condition holds in the running episode.
        has_policy: whether there is a policy that may act.
        is_policy_acting: whether it acts now.
        rate: control steps in the last second, in Hz; NaN in the first one.
        missed: control steps of the running episode that ended too late.
        message: last thing that happened, for the person.
        world: the environment, to be looked at and not to be touched.
    """

    mode: Mode
    seed: int
    step: int
    step_limit: int
    saved: int
    wanted: int
    steered: tuple[str, ...]
    active_arm: str
    arms: Mapping[str, ArmPose]
    is_success: bool
    has_policy: bool
    is_policy_acting: bool
    rate: float
    missed: int
    message: str
    world: FaceEnv


class TeleopDevice(Protocol):
    """Device of a person. It is open when it has been made."""

    is_paced: bool
    """True if the session keeps real time, 50 control steps a second."""

    def update(self, view: SessionView) -> TeleopInput:
        """Show the session, and return what the person asks for now; called every period.

        Must not wait: the next control step does.

        Raises:
            RequestError: the device cannot be used any more; says what to do.
        """
        ...

    def close(self) -> None:
        """Let go of the device; may be called again."""
        ...


DEVICES: Mapping[str, str] = {
    "keyboard": "robo_manip_baselines.teleop.keyboard:KeyboardDevice",
    "spacemouse": "robo_manip_baselines.teleop.spacemouse:SpaceMouseDevice",
    "web": "robo_manip_baselines.teleop.web:WebDevice",
    "replay": "robo_manip_baselines.teleop.replay:ReplayDevice",
}
"""Name of a device -> ``module:class``. The class is made with the arguments that
``commands/teleop.py`` has for it."""


def make_device(name: str, **kwargs: Any) -> TeleopDevice:
    """Open a device.

    Raises:
        RequestError: there is no such device, or it cannot be opened; says what to do.
    """
    return resolve_name(DEVICES[require_choice("device", name, DEVICES)])(**kwargs)
