"""Observation spec: the one declaration of what a policy is shown.

Command-line options, conditions of a benchmark, environment arguments, result rows and labels are
all made from `ObservationSpec`.

Legend: ... any leading shape, A arms (1 or 2), H horizon in frames of 1/30 s, S elements of all
vectors of an observation together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Annotated, Any

import numpy as np
import tyro
from annotated_types import Interval
from numpy.typing import NDArray
from tyro.constructors import PrimitiveConstructorSpec

from robo_manip_baselines.observation.arm import ARM_JOINTS
from robo_manip_baselines.observation.corruption import (
    MAX_DELAY,
    Corruption,
    CorruptionPipeline,
)
from robo_manip_baselines.observation.state import (
    FRAME_PERIOD,
    MAX_HORIZON,
    State,
    TargetObservation,
)
from robo_manip_baselines.runs.documents import convert
from robo_manip_baselines.runs.errors import RequestError, require_choice, require_integer

PRESETS = ("baseline", "current", "current_pred", "history")
"""The paper's three observation groups (section IV.C), and a control without any forecast."""

_AHEAD = np.arange(MAX_HORIZON + 1) * FRAME_PERIOD
"""s ahead of each frame that can be shown."""

HISTORY_FRAMES = 5
"""Frames of the past that ``history`` shows, as many as the paper's longest forecast has."""

CAMERAS = ("top", "angle", "front_close")
"""The paper's three views (Fig. 8)."""

ARMS: dict[str, tuple[str, ...]] = {"right": ("right",), "both": ("left", "right")}
"""Arms that a policy moves and observes, in the order of state and action."""

MOUTH_FRAMES = ("none", "gripper", "actions", "both")
"""Parts that are expressed relative to the mouth."""

MOUTH_TIMES = ("now", "forecast")
"""Mouth that it is relative to: the one observed, or the one forecast for when an action acts."""

MAX_IMAGE_SIZE = 4096

MOUTH_SOURCES = ("truth", "camera", "depth_camera")
"""Sources of the mouth in observations: the simulator's truth, through the corruption, or a
face detector that looks at images of ``front_close``, without or with their depth."""

MEASURED = "measured"
"""Latency of the camera: as long as detector and predictor take; of a policy: as a prediction."""

CameraLatency = Annotated[int, Interval(ge=0, le=MAX_DELAY)] | str
"""Frames of 1/30 s, or ``MEASURED``."""


def parse_image_size(size: str) -> tuple[int, int]:
    """Return (height, width) from ``HEIGHTxWIDTH``.

    Raises:
        RequestError: it is not of that form.
    """
    height, cross, width = size.lower().partition("x")
    if not (cross and height.isdecimal() and width.isdecimal()):
        raise RequestError(f"image size '{size}': must be HEIGHTxWIDTH, for example 480x640")
    return int(height), int(width)


def size_text(size: Sequence[int]) -> str:
    """Format height and width as the option takes them: ``480x640``."""
    return f"{size[0]}x{size[1]}"


_Side = Annotated[int, Interval(ge=1, le=MAX_IMAGE_SIZE)]

ImageSize = Annotated[
    tuple[_Side, _Side],
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="HEIGHTxWIDTH",
        instance_from_str=lambda args: parse_image_size(args[0]),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [size_text(value)],
    ),
]


@dataclass(frozen=True)
class ObservedNames:
    """Names, in the observations of a task, of the tracked point and of the objects.

    Attributes:
        target: point on the face that the task is about.
        objects: objects whose positions ``object_pose`` shows.
    """

    target: str = "mouth"
    objects: tuple[str, ...] = ()


@dataclass(frozen=True)
class ObservationSpec:
    """Declaration of what a policy is shown.

    Attributes:
        obs: Preset: baseline (robot and cameras), current (also the mouth and its distance to the
            gripper), current_pred (the mouth now and in the next frames) or history (current and
            the mouth in the 5 frames before).
        horizon: Frames of 1/30 s that current_pred looks ahead, 1 to 24.
        cameras: Cameras, any of top, angle and front_close, or none.
        image_size: Height and width of the images in pixels.
        render_size: Height and width at which cameras are drawn before `fit_image` makes images of
            ``image_size``; None draws at ``image_size``. Of a trained policy it is the size of its
            demonstrations' images.
        object_pose: Show the positions of the task's objects.
        arms: Arms in state and action: right or both.
        relative: Show the mouth in past and future frames relative to the present one.
        mouth_frame: What is expressed relative to the mouth: none, gripper (its position is also
            observed from the mouth), actions (the policy predicts the gripper's position from the
            mouth in place of waist, shoulder and elbow) or both.
        mouth_time: Mouth of the mouth_frame: now, the one observed, or with current_pred forecast,
            for the time at which the arm is where an action sends it.
        corruption: Corruption of the target between simulator and policy.
        mouth_source: Source of the mouth: truth, or camera: a face detector finds it in images of
            front_close, at its distance by the size of the head; depth_camera: by a depth image.
        camera_latency: Frames of 1/30 s from an image to what was found in it; measured: the time
            that detector and predictor take on this machine, so that results differ between runs.

    Raises:
        RequestError: a value is not valid.
    """

    obs: str = "baseline"
    horizon: Annotated[int, Interval(ge=1, le=MAX_HORIZON)] = 2
    cameras: tuple[str, ...] = CAMERAS
    image_size: ImageSize = (480, 640)
    render_size: tyro.conf.Suppress[ImageSize | None] = None
    object_pose: bool = False
    arms: str = "right"
    relative: bool = False
    mouth_frame: str = "none"
    mouth_time: str = "now"
    corruption: Corruption = field(default_factory=Corruption)
    mouth_source: str = "truth"
    camera_latency: CameraLatency = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "cameras", _camera_names(self.cameras))
        require_choice("observation preset", self.obs, PRESETS)
        require_choice("arms", self.arms, ARMS)
        for camera in self.cameras:
            require_choice("camera", camera, CAMERAS)
        if len(set(self.cameras)) != len(self.cameras):
            raise RequestError(f"cameras {', '.join(self.cameras)}: each may be named once")
        horizon = require_integer("horizon", self.horizon, 1, MAX_HORIZON, " frames")
        object.__setattr__(self, "horizon", horizon)
        if not isinstance(self.object_pose, bool | np.bool_):
            raise RequestError(f"object_pose {self.object_pose!r}: must be True or False")
        object.__setattr__(self, "object_pose", bool(self.object_pose))
        # The other presets show the present frame alone.
        has_frames = self.obs in ("current_pred", "history")
        object.__setattr__(self, "relative", bool(self.relative) and has_frames)
        self._check_mouth_frame()
        object.__setattr__(self, "image_size", _checked_size("image size", self.image_size))
        self._check_render_size()
        if not isinstance(self.corruption, Corruption):
            raise RequestError(
                f"corruption {self.corruption!r}: must be a Corruption, or a dict of its settings, "
                "for example {'error': 'uniform'}"
            )
        self._check_mouth_source()
        if not self.corruption:
            object.__setattr__(self, "corruption", Corruption())
        elif not self.frames:
            raise RequestError(
                f"'{self.corruption.label}' corrupts the mouth, of which the observation preset "
                f"'{self.obs}' shows nothing; leave it out, or choose current, history or "
                "current_pred"
            )
        elif self.obs in ("current", "history") and self.corruption.has_forecast_error:
            error, prediction = self.corruption.error, self.corruption.prediction
            what, off = ("error", "none") if error != "none" else ("prediction", "truth")
            raise RequestError(
                f"the {what} '{error if what == 'error' else prediction}' is one of forecasts, of "
                f"which the observation preset '{self.obs}' shows none; choose current_pred, or "
                f"the {what} {off} (delay, face_dropout and detector_rate go with '{self.obs}', "
                "too)"
            )

    def _check_mouth_source(self) -> None:
        """Check source and latency; the latency of a camera that is not used is the default."""
        require_choice("mouth source", self.mouth_source, MOUTH_SOURCES)
        if self.camera_latency != MEASURED:
            if isinstance(self.camera_latency, str):
                raise RequestError(
                    f"camera_latency '{self.camera_latency}': must be a number of frames of 1/30 s "
                    f"or {MEASURED}"
                )
            unit = f" frames of 1/30 s, or {MEASURED}"
            require_integer("camera_latency", self.camera_latency, 0, MAX_DELAY, unit)
        if not self.sees_by_camera:
            object.__setattr__(self, "camera_latency", type(self).camera_latency)
        elif self.corruption:
            raise RequestError(
                f"mouth_source '{self.mouth_source}' has errors and a latency of its own, and goes "
                f"without '{self.corruption.label}'; leave the corruption out"
            )

    def _check_mouth_frame(self) -> None:
        """Check what is relative to the mouth; a time without it becomes ``now``."""
        require_choice("mouth frame", self.mouth_frame, MOUTH_FRAMES)
        require_choice("mouth time", self.mouth_time, MOUTH_TIMES)
        if self.mouth_frame == "none":
            object.__setattr__(self, "mouth_time", "now")
        elif not self.frames:
            raise RequestError(
                f"mouth_frame '{self.mouth_frame}': the observation preset '{self.obs}' shows no "
                "mouth; choose current, history or current_pred"
            )
        elif self.mouth_time == "forecast" and self.obs != "current_pred":
            raise RequestError(
                f"mouth_time 'forecast': the observation preset '{self.obs}' shows no forecast; "
                "choose current_pred, or the mouth_time now"
            )

    def _check_render_size(self) -> None:
        """Check ``render_size``; the same as ``image_size`` becomes None."""
        if self.render_size is None:
            return
        drawn, shown = _checked_size("render size", self.render_size), self.image_size
        object.__setattr__(self, "render_size", None if drawn == shown else drawn)
        if shown[0] > drawn[0] or shown[1] > drawn[1]:
            raise RequestError(
                f"image size {size_text(shown)}: must be no larger than the render size "
                f"{size_text(drawn)} in either direction"
            )

    # -- other forms ----------------------------------------------------------------------------

    def to_json(self) -> dict[str, Any]:
        """Return what JSON can hold; what is not set is left out, as in files of older releases."""
        values = asdict(self)
        if self.render_size is None:
            del values["render_size"]
        arms, corruption = values.pop("arms"), values.pop("corruption")
        values |= {"error": self.corruption.error, "arms": arms}
        for name in ("relative", "mouth_frame", "mouth_time"):
            if values[name] in (False, "none", "now"):
                del values[name]
        if not self.sees_by_camera:
            del values["mouth_source"], values["camera_latency"]
        if self.corruption.prediction == "truth":
            del corruption["prediction"]
        return values | {"corruption": corruption} if self.corruption else values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> ObservationSpec:
        """Return the spec that ``to_json`` was called on.

        Raises:
            RequestError: a name or a value is not valid.
        """
        given = {name: value for name, value in values.items() if name != "error"}
        return convert({**given, "corruption": given.get("corruption") or {}}, cls, "observation")

    def env_kwargs(self) -> dict[str, Any]:
        """Return the arguments of an environment that shows this."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        corruption = values.pop("corruption")
        return values | {"corruption": asdict(corruption) if corruption else None}

    @property
    def name(self) -> str:
        """Name of the condition, such as ``current_pred_h2_uniform``."""
        horizon = f"_h{self.horizon}" if self.obs == "current_pred" else ""
        corruption = f"_{self.corruption.label}" if self.corruption else ""
        relative = "_relative" if self.relative else ""
        mouth = "" if self.mouth_frame == "none" else f"_mouth_{self.mouth_frame}"
        ahead = "_forecast" if self.mouth_time == "forecast" else ""
        return f"{self.obs}{horizon}{relative}{mouth}{ahead}{corruption}{self._camera_name}"

    @property
    def _camera_name(self) -> str:
        """End of the name where the mouth comes from a camera, such as ``_camera_latency2``."""
        if not self.sees_by_camera:
            return ""
        is_usual = self.camera_latency == type(self).camera_latency
        return f"_{self.mouth_source}" + ("" if is_usual else f"_latency{self.camera_latency}")

    @property
    def sees_by_camera(self) -> bool:
        """True if the mouth is found in images, and not read from the simulator."""
        return self.mouth_source != "truth"

    @property
    def drawn_size(self) -> tuple[int, int]:
        """Height and width at which cameras are drawn."""
        return self.render_size or self.image_size

    # -- content --------------------------------------------------------------------------------

    @property
    def arm_names(self) -> tuple[str, ...]:
        """Arms in the order of state and action."""
        return ARMS[self.arms]

    @property
    def frames(self) -> int:
        """Number of target positions, from now on, that the preset shows."""
        forecast = self.horizon + 1
        return {"baseline": 0, "current": 1, "current_pred": forecast, "history": 1}[self.obs]

    @property
    def past_frames(self) -> int:
        """Number of earlier reports of the target that the preset shows."""
        return HISTORY_FRAMES if self.obs == "history" else 0

    @property
    def shows_gripper(self) -> bool:
        """True if the gripper's position from the mouth is shown."""
        return self.mouth_frame in ("gripper", "both")

    @property
    def moves_gripper(self) -> bool:
        """True if actions have the gripper's position from the mouth."""
        return self.mouth_frame in ("actions", "both")

    def components(self, names: ObservedNames) -> dict[str, tuple[str, ...]]:
        """Return the names of the elements of every vector of the observation, in order."""
        parts = {"state": tuple(_state_names(self.arm_names))}
        if self.obs in ("current", "history"):
            parts[names.target] = (*(f"{names.target} {axis}" for axis in "xyz"), "distance")
        if self.past_frames:
            ago = range(1, self.past_frames + 1)
            parts["history"] = tuple(f"{axis}_-{k}" for k in ago for axis in "xyz")
        if self.obs == "current_pred":
            steps = range(self.frames)
            points = [f"{axis}_{k}" for k in steps for axis in "txyz"]
            parts["prediction"] = (*points, *(f"distance_{k}" for k in steps))
        if self.shows_gripper:
            steps = [f"_{k}" for k in range(self.frames)] if self.mouth_time == "forecast" else [""]
            place = f"gripper from {names.target}"
            parts[place.replace(" ", "_")] = tuple(f"{place} {a}{k}" for k in steps for a in "xyz")
        if self.object_pose:
            objects = [f"{item} {axis}" for item in names.objects for axis in "xyz"]
            parts["object_position"] = tuple(objects)
        return parts

    def vector_names(self, names: ObservedNames) -> list[str]:
        """Return the names of the S elements of the packed vector."""
        return [name for part in self.components(names).values() for name in part]

    def image_keys(self) -> dict[str, str]:
        """Map image keys of the observation to cameras."""
        return {f"images/{camera}": camera for camera in self.cameras}

    def make_pipeline(self) -> CorruptionPipeline | None:
        """Return the corruption pipeline; None where the policy is shown the present truth.

        None also where a camera takes its place.
        """
        if not self.has_pipeline or self.sees_by_camera:
            return None
        return CorruptionPipeline(self.corruption, self.frames - 1, self.past_frames)

    @property
    def has_pipeline(self) -> bool:
        """True if the target is observed, by a camera, corrupted, or with its past."""
        return bool(self.sees_by_camera or self.corruption or self.past_frames)

    def pack(self, state: State, target: TargetObservation | None = None) -> NDArray[np.float32]:
        """Pack all vectors of an observation into one, (..., S) float32.

        The target is of the corruption pipeline, and the truth if None. Distances are those from
        the gripper now to the target as observed.

        Raises:
            ValueError: a target is given without a pipeline, or the other way round.
        """
        if (target is None) == self.has_pipeline:
            raise ValueError("an observed target goes with a pipeline, and only with one")
        observed = target or TargetObservation(state.time, state.target_position)
        fingers = state.gripper_position[..., None], state.gripper_velocity[..., None]
        arms = np.concatenate((state.joint_position, state.joint_velocity, *fingers), axis=-1)
        parts = [arms.reshape(*arms.shape[:-2], -1)]
        if self.frames:
            position = observed.position[..., : self.frames, :]
            gripper = state.end_effector_position[..., None, :] - position
            # As np.linalg.norm does it, which takes three times as long for so few numbers.
            distance = np.sqrt(np.add.reduce(gripper * gripper, axis=-1))
            past = observed.past
            if self.relative:
                now = position[..., :1, :]
                position = np.concatenate([now, position[..., 1:, :] - now], axis=-2)
                past = None if past is None else past - now
            if self.obs != "current_pred":
                parts += [position[..., 0, :], distance]
                if past is not None:
                    parts.append(past.reshape(*past.shape[:-2], -1))
            else:
                time = observed.time[..., None] + _AHEAD[: self.frames]
                timed = np.concatenate((time[..., None], position), axis=-1)
                parts += [timed.reshape(*timed.shape[:-2], -1), distance]
            if self.shows_gripper:
                gripper = gripper if self.mouth_time == "forecast" else gripper[..., :1, :]
                parts.append(gripper.reshape(*gripper.shape[:-2], -1))
        if self.object_pose:
            objects = state.object_position
            parts.append(objects.reshape(*objects.shape[:-2], -1))
        return np.concatenate(parts, axis=-1, dtype=np.float32)

    def split(
        self, vector: NDArray[np.float32], names: ObservedNames
    ) -> dict[str, NDArray[np.float32]]:
        """Return the vectors (..., n) of an observation as views of the packed one (..., S)."""
        return {name: vector[..., part] for name, part in self.slices(names).items()}

    def slices(self, names: ObservedNames) -> dict[str, slice]:
        """Return where the vectors of an observation are in the packed one."""
        components = self.components(names)
        ends = np.cumsum([len(part) for part in components.values()]).tolist()
        starts = (0, *ends[:-1])
        return {name: slice(*span) for name, *span in zip(components, starts, ends, strict=True)}

    def target_positions(self, vector: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the target positions, (..., F, 3) m, in packed vectors (..., S).

        F is 0 for baseline.
        """
        start = len(_state_names(self.arm_names))
        if self.obs in ("current", "history"):
            return vector[..., None, start : start + 3].astype(np.float64)
        timed = vector[..., start : start + 4 * self.frames].astype(np.float64)
        positions = timed.reshape(*vector.shape[:-1], self.frames, 4)[..., 1:]
        if self.relative:
            positions[..., 1:, :] += positions[..., :1, :]
        return positions

    @property
    def posture_places(self) -> list[int]:
        """Places (A,) in the packed vector of what the A elements of an action are targets of."""
        names = _state_names(self.arm_names)
        parts = (*ARM_JOINTS, "gripper")
        return [names.index(f"{arm}/{part} position") for arm in self.arm_names for part in parts]


def _camera_names(given: object) -> tuple[str, ...]:
    """Return the names of cameras: one name, several, and as command lines write them.

    That is ``none`` for no camera, and commas in place of spaces.
    """
    names = [given] if isinstance(given, str) else given
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise RequestError(
            f"cameras {given!r}: must be names of cameras, or () for none; valid: "
            f"{', '.join(CAMERAS)}"
        )
    cameras = tuple(name.strip() for part in names for name in part.split(",") if name.strip())
    return () if cameras == ("none",) else cameras


def _checked_size(what: str, given: object) -> tuple[int, int]:
    """Return height and width as integers.

    Raises:
        RequestError: they are no two numbers from 1 to ``MAX_IMAGE_SIZE``.
    """
    sides = tuple(given) if isinstance(given, Sequence | np.ndarray) else ()
    try:
        height, width = (require_integer(what, side, 1, MAX_IMAGE_SIZE) for side in sides)
    except ValueError:
        raise RequestError(
            f"{what} {given!r}: must be height and width, two whole numbers from 1 to "
            f"{MAX_IMAGE_SIZE}, for example (240, 320)"
        ) from None
    return height, width


def _state_names(arms: Sequence[str]) -> list[str]:
    """Return the 14 names of each arm: positions, velocities, gripper (paper, section IV.C)."""
    names = [f"{joint} {kind}" for kind in ("position", "velocity") for joint in ARM_JOINTS]
    names += ["gripper position", "gripper velocity"]
    return [f"{arm}/{name}" for arm in arms for name in names]
