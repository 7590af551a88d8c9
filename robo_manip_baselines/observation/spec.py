"""What a policy is shown, as one frozen dataclass.

Legend: A arms (1 or 2), H horizon in frames of 1/30 s, C cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from robo_manip_baselines.envs.mujoco.cell.vx300s import ARM_JOINTS
from robo_manip_baselines.observation.corruption import MEASURED_ERRORS, Corruption
from robo_manip_baselines.runs.errors import RequestError, require_choice

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
        arms: which arms the robot's state speaks of.
        corruption: what stands between the true and the shown mouth; None, and one that is off,
            which becomes None, show the truth.

    Raises:
        RequestError: a value that is not valid.
    """

    obs: str = "baseline"
    horizon: int = 2
    cameras: tuple[str, ...] = CAMERAS
    image_size: tuple[int, int] = (480, 640)
    object_pose: bool = False
    arms: str = "right"
    corruption: Corruption | None = None

    def __post_init__(self) -> None:
        require_choice("observation preset", self.obs, PRESETS)
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

        if self.corruption and self.corruption.is_off:
            object.__setattr__(self, "corruption", None)
        if self.corruption:
            self._require_something_to_corrupt(self.corruption)

    def _require_something_to_corrupt(self, corruption: Corruption) -> None:
        if not self.frames:
            raise RequestError(
                f"'{corruption.label}' corrupts the mouth, of which the observation preset "
                f"'{self.obs}' shows nothing; leave it out, or choose current or current_pred"
            )
        if self.obs == "current" and corruption.error != "none":
            raise RequestError(
                f"the error '{corruption.error}' is one of forecasts, of which the observation "
                "preset 'current' shows none; choose current_pred, or the error none (delay, "
                "face_dropout and detector_rate go with 'current', too)"
            )

    def to_json(self) -> dict[str, Any]:
        """Return what JSON can hold; without a corruption as releases before there was one."""
        values = asdict(self)
        arms, corruption = values.pop("arms"), values.pop("corruption")
        values |= {"error": self.corruption.error if self.corruption else "none", "arms": arms}
        return values | {"corruption": corruption} if corruption else values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> ObservationSpec:
        """Return the spec that ``to_json`` was called on.

        Raises:
            RequestError: a value that is not valid.
            TypeError: a name that is unknown.
        """
        given: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in values.items()
        }
        corruption = given.pop("corruption", None)
        given.pop("error", None)
        return cls(**given, corruption=corruption and Corruption.of(corruption))

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


@dataclass(frozen=True)
class CorruptionOptions:
    """What stands between the true mouth and the one that a policy is shown; see `Corruption`."""

    error: str | None = None
    """Error of the forecast: none, uniform (the paper's), gaussian, empirical or model."""
    error_stats: Path | None = None
    """File of error statistics; the one that ships with the package if not given."""
    delay: int | None = None
    """Frames of 1/30 s from the camera to the policy; 0 if not given."""
    face_dropout: float | None = None
    """Share of the frames in which the face is lost; 0 if not given."""
    face_dropout_length: float | None = None
    """Mean frames of a loss; 15 if not given."""
    detector_rate: float | None = None
    """Reports of the detector per second, at most 30; one at every step if not given."""
    corruption_seed: int | None = None
    """Seed of errors and losses, beside that of the episode; 0 if not given."""
    corruption: bool = True
    """--no_corruption shows the truth, whatever else is said."""

    def apply(self, before: Corruption | None = None) -> Corruption | None:
        """Return the corruption that results when what was given replaces what was there before.

        Raises:
            RequestError: a value that is not valid.
        """
        given = {
            "error": self.error,
            "error_stats": self.error_stats and str(self.error_stats),
            "delay": self.delay,
            "face_dropout": self.face_dropout,
            "face_dropout_length": self.face_dropout_length,
            "detector_rate": self.detector_rate,
            "seed": self.corruption_seed,
        }
        changes = {name: value for name, value in given.items() if value is not None}
        if not self.corruption:
            return None
        start = before or Corruption()
        if changes.get("error", start.error) not in MEASURED_ERRORS:
            start = replace(start, error_stats=None, stats_sha256=None)
        elif self.error_stats is not None:
            start = replace(start, stats_sha256=None)
        result = replace(start, **changes)
        return None if result.is_off else result


def parse_cameras(cameras: tuple[str, ...]) -> tuple[str, ...]:
    """Return camera names; ``none`` stands for no camera at all, and commas may separate them."""
    names = tuple(name for part in cameras for name in part.split(",") if name)
    return () if names == ("none",) else names


def parse_image_size(size: str) -> tuple[int, int]:
    """Return (height, width) from ``HEIGHTxWIDTH``.

    Raises:
        RequestError: it is not of that form.
    """
    height, cross, width = size.lower().partition("x")
    if not (cross and height.isdecimal() and width.isdecimal()):
        raise RequestError(f"image size '{size}': must be HEIGHTxWIDTH, for example 480x640")
    return int(height), int(width)
