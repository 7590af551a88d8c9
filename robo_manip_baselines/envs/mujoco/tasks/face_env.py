"""Base of every task with a moving face: its scene as a Gymnasium environment."""

from __future__ import annotations

import inspect
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.opengl import viewer_problem
from robo_manip_baselines.envs.mujoco.cell.rendering import MAX_MULTISAMPLES, CameraRenderer
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.cell.window import ViewerWindow
from robo_manip_baselines.envs.mujoco.face import FACES
from robo_manip_baselines.envs.mujoco.face.camera_mouth import CameraMouth
from robo_manip_baselines.envs.mujoco.face.forecasters import (
    MotionForecasters,
    require_no_waiting,
)
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.face.people import PEOPLE
from robo_manip_baselines.envs.mujoco.face.replay import FACE_MOTIONS
from robo_manip_baselines.envs.mujoco.tasks.face_rows import safety_info, start_attributes
from robo_manip_baselines.envs.mujoco.tasks.face_scene import FaceScene, Floats
from robo_manip_baselines.envs.mujoco.tasks.registry import TaskEntry
from robo_manip_baselines.observation import (
    CAMERAS,
    Corruption,
    ObservationSpec,
    ObservedNames,
    State,
    TargetObservation,
)
from robo_manip_baselines.observation.corruption import prediction_problem
from robo_manip_baselines.observation.images import fit_image
from robo_manip_baselines.observation.spec import CameraLatency
from robo_manip_baselines.runs.errors import RequestError, require_choice, require_integer
from robo_manip_baselines.runs.ranges import MAX_SEED

FACE_OFFSET = 0.05
"""m, largest random offset of the face along each axis (paper, Algorithm 1, line 3)."""

RENDER_CAMERA = "angle"
"""Camera of ``render()``."""

# Wide enough for whatever physics may do; observations are not clipped to them.
_BOUNDS = {" position": 2.0 * np.pi, " velocity": 100.0, "t_": 60.0, "": 5.0}
"""Bounds of the elements with this in their names: rad, m; rad/s, m/s; s; m, of all the rest."""


class FaceEnv(FaceScene, gymnasium.Env[Any, Any]):
    """Cell with two arms and a head that moves as a recorded person moved.

    A task derives from it and implements the methods of the section "task": its objects, their
    start, and after each step the reward, the end and ``info``; ``docs/add-an-environment.md``
    makes one. The ``info`` of every task holds ``is_success`` and ``is_success_strict`` (bool),
    ``completion_time`` (s, None before success) and ``phase`` (one of ``phase_names``). `step` and
    `reset` add, for every task:

    | key | type | content |
    |---|---|---|
    | ``face_contacts`` | tuple of `FaceContact` | what touched which region of the face in the
    step, how hard (N), with which impulse (N s) and where; empty where nothing did |
    | ``face_proximity`` | `Proximity` or None | distances of the robot, and of what it carries,
    from face and eyes (m), grippers and mouth; None unless ``measures_proximity`` |
    | ``is_refusing`` | bool or None | the head is turned away; None where the motion has no
    ``turn_away`` |

    Args:
        obs, horizon, cameras, image_size, object_pose, arms, relative, mouth_frame, mouth_time: see
            `ObservationSpec`.
        render_size: height and width at which cameras are drawn, before `fit_image` makes the
            images of observations; ``image_size`` if None.
        corruption: a `Corruption`, or its fields as a dict; None shows the truth.
        mouth_source, camera_latency: see `ObservationSpec` and ``docs/perception.md``.
        face: kind of face: ``visual``, which follows the recorded motion whatever touches it, or
            ``physical``, soft tissue on a head that yields, see ``docs/face_model.md``.
        face_motion: start of the motion: ``episode`` or ``after_lift``.
        motion: of the face by name, as `parse_motion` reads it: ``recorded``, ``sway``, ...
        people: who moves: ``all``, or ``train`` or ``test`` for demonstrations and evaluation with
            different people, see `MotionLibrary.part`.
        clips: ids of recorded clips to draw from; all if None.
        motion_library: file of ``face_prediction export-motion``, or a name of `LIBRARIES`; the
            shipped one if None.
        motion_sha256: digest of the library's motion (`MotionLibrary.sha256`); any if None.
        shadows, multisamples: prettier and slower images, for videos.
        render_mode: ``rgb_array`` or ``human`` (MuJoCo's viewer).

    Copies (``copy.deepcopy``, ``pickle``) go on from the same state, and draw with an OpenGL
    context of their own.

    Attributes:
        task: entry of the task.
        observation_spec: what is observed.
        renders_images: whether observations include images; rollouts clear it for steps whose
            images no policy reads.
        measures_proximity: whether ``info`` has distances from the face, which take a tenth of a
            millisecond a step; evaluations set it.
        vector: (S,) float32, all vectors of the last observation, packed.
        observed_target: the target of the last observation; None where it is the truth.

    Raises:
        RequestError: an argument is not valid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (the name and its kind are Gymnasium's)
        "render_modes": ["rgb_array", "human"],
        "render_fps": round(1.0 / CONTROL_PERIOD),
    }
    task: ClassVar[TaskEntry]
    phase_names: ClassVar[tuple[str, ...]]
    varying_geoms: ClassVar[tuple[str, ...]] = ()
    """Starts of names of geoms whose pose on their body and size the task changes, to show
    something that has no part in the physics."""

    def __init__(
        self,
        *,
        obs: str = "baseline",
        horizon: int = 2,
        cameras: str | Sequence[str] = CAMERAS,
        image_size: tuple[int, int] = (480, 640),
        render_size: tuple[int, int] | None = None,
        object_pose: bool = False,
        relative: bool = False,
        mouth_frame: str = "none",
        mouth_time: str = "now",
        arms: str = "right",
        corruption: Corruption | Mapping[str, Any] | None = None,
        mouth_source: str = "truth",
        camera_latency: CameraLatency = 1,
        face: str = "visual",
        face_motion: str = "episode",
        motion: str | Mapping[str, Any] | Sequence[Any] = "recorded",
        people: str = "all",
        clips: str | Sequence[str] | None = None,
        motion_library: str | Path | None = None,
        motion_sha256: str | None = None,
        shadows: bool = False,
        multisamples: int = 0,
        render_mode: str | None = None,
        **unknown: Any,
    ) -> None:
        for name in unknown:
            require_choice("argument", name, _argument_names(type(self)))
        self.render_mode = _checked_render_mode(render_mode, self.metadata["render_modes"])
        spec = self.observation_spec = ObservationSpec(
            obs=obs,
            horizon=horizon,
            cameras=cameras,  # type: ignore[arg-type]  # one name becomes a tuple
            image_size=image_size,
            render_size=render_size,
            object_pose=object_pose,
            relative=relative,
            mouth_frame=mouth_frame,
            mouth_time=mouth_time,
            arms=arms,
            corruption=_make_corruption(corruption),
            mouth_source=mouth_source,
            camera_latency=camera_latency,
        )
        self.task.require_arms(spec.arms)
        _check_drawing(shadows, multisamples)
        if object_pose and not self.task.names.objects:
            raise RequestError(f"object_pose: {self.task.name} has no objects; leave it out")
        self.renders_images = True
        self.measures_proximity = False
        face = require_choice("face", face, FACES)
        self.face_motion = require_choice("face motion", face_motion, FACE_MOTIONS)
        self.motion = parse_motion(motion)
        self.people = require_choice("people", people, PEOPLE)
        self.clips = _clip_names(clips)
        if not isinstance(motion_library, str | Path | None):
            raise RequestError(f"motion_library {motion_library!r}: must be the path of a file")
        self._pipeline = spec.make_pipeline()
        self.library = MotionLibrary.load(motion_library)
        self.library.require(motion_sha256)
        if self.motion.recorded is not None:
            self.library.part(self.people)  # refuses what cannot be split
        self.task.require_forecasts(spec)
        self._forecasters: MotionForecasters | None = None
        if spec.corruption.prediction != "truth":
            require_no_waiting(self.face_motion)
            self._forecasters = MotionForecasters.of(self.motion, self.library, self.people)
            self._forecasters.require(spec.corruption.prediction)
        if spec.corruption.error == "model":
            if problem := prediction_problem(self.library.predicted_frames, spec.horizon):
                raise RequestError(f"motion library '{self.library.source}' holds {problem}")
            if not self.motion.is_as_recorded:
                raise RequestError(
                    f"error model: predictors have seen recorded motion, not '{self.motion}'; "
                    "choose another error, or the motion 'recorded'"
                )
        if self.clips is not None and self.motion.recorded is None:
            raise RequestError(
                f"clips {', '.join(self.clips)}: the motion '{self.motion}' has no recording; "
                "leave them out, or add 'recorded' to the motion"
            )
        for clip in self.clips or ():
            require_choice("clip", clip, set(self.library.part(self.people).run_clip))
        super().__init__(face, spec.arm_names, (*self.task.names.objects, *self.tools))
        self.renderer = CameraRenderer(
            self.model, *spec.drawn_size, shadows=shadows, multisamples=multisamples
        )
        self.observed_target: TargetObservation | None = None
        self._camera_mouth: CameraMouth | None = None
        if spec.sees_by_camera:
            has_depth = spec.mouth_source == "depth_camera"
            self._camera_mouth = CameraMouth(self.model, spec.camera_latency, has_depth=has_depth)
        self._window: ViewerWindow | None = None
        self._shown_at = 0.0
        self._stage = "made"
        low, high = self.model.actuator_ctrlrange[self._actuators].T.astype(np.float32)
        self.action_space = gymnasium.spaces.Box(low, high)
        self.observation_space = make_observation_space(spec, self.task.names)
        self._slices = spec.slices(self.task.names)

    # -- task -----------------------------------------------------------------------------------

    def reset_task(self, rng: np.random.Generator) -> None:
        """Draw the start of the objects into ``self.data.qpos``, and reset the task's progress."""

    def object_position(self) -> Floats:
        """(O, 3) m, world: centres of the task's objects."""
        return np.empty((0, 3))

    def advance(self) -> tuple[float, bool]:
        """Evaluate the task after a control step; return reward and whether it has ended."""
        raise NotImplementedError

    def info(self) -> dict[str, Any]:
        """Return the ``info`` of the present step."""
        raise NotImplementedError

    def task_row(self) -> dict[str, Any]:
        """Return the present values of the fields that the task adds to episode files."""
        return {}

    def show_row(self, row: Mapping[str, NDArray[Any]]) -> None:
        """Let what is drawn, beyond the simulator's state, be as in a recorded row of `task_row`.

        The bodies are where they were then; the next kinematics place what is drawn.
        """

    def target_track(self) -> Floats:
        """(K, 3) m, world: the true target now and 1 ... 24 frames ahead; the mouth by default."""
        return self.mouth_track

    def predicted_target(self) -> Floats | None:
        """(H, 3) m, world: a predictor's output for the target; None without predictions."""
        return self.predicted_mouth if self.task.predicted_field else None

    # -- Gymnasium ------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start an episode; every random choice comes from ``seed``.

        Args:
            seed: 0 to 2⁵³ - 1; None goes on with the generator of the last one.
            options: there are none: None or empty.

        Raises:
            RequestError: the seed or an option is not valid.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        self._require_open("reset")
        if options:
            given = ", ".join(map(str, options)) if isinstance(options, Mapping) else options
            raise RequestError(
                f"reset option {given}: unknown; an episode has no options, give arguments to "
                "gymnasium.make instead"
            )
        if seed is not None:
            seed = require_integer("seed", seed, 0, MAX_SEED)
        super().reset(seed=seed)
        face_offset = self.np_random.uniform(-FACE_OFFSET, FACE_OFFSET, 3)
        segment = self.motion.draw(
            self.np_random, self.library, seed=seed, clips=self.clips, people=self.people
        )
        self.lay_out(segment, face_offset, 0 if self.face_motion == "episode" else None)
        self.reset_task(self.np_random)
        self.place_face()
        if self._pipeline:
            # Last, so that the world is the same as without corruption.
            drawn = int(self.np_random.integers(2**32)) if seed is None else seed
            self._pipeline.reset(drawn)
            if self._forecasters:
                self._forecast = self._forecasters.forecast_track(
                    self.observation_spec.corruption.prediction, self.replay.mouth, drawn
                )
        if self._camera_mouth:
            self._camera_mouth.reset(self.data)
        self._stage = "reset"
        self._show()
        return self.observe(), {**self.info(), **safety_info(self)}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Move for 0.02 s.

        Raises:
            ValueError: the action has the wrong shape or is not finite.
            gymnasium.error.ResetNeeded: before the first `reset`.
            gymnasium.error.ClosedEnvironmentError: after `close`.
        """
        self._require_episode("step")
        self.simulate(action)
        reward, terminated = self.advance()
        self._show()
        info = {**self.info(), **safety_info(self)}
        return self.observe(), reward, terminated, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the view of the camera ``angle`` as drawn, (H, W, 3) uint8; None in ``human``.

        H and W are those of ``render_size``.
        """
        self._require_episode("render")
        if self.render_mode == "human":
            self._show()
            return None
        return self.renderer.render(self.data, [RENDER_CAMERA])[RENDER_CAMERA]

    def close(self) -> None:
        """Free the OpenGL context, and close the viewer; may be called again."""
        self._stage = "closed"
        self.renderer.close()
        if self._camera_mouth:
            self._camera_mouth.close()
            self._camera_mouth = None
        if self._window is not None:
            self._window.close()
            self._window = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: a viewer's window stays with the original."""
        return {**self.__dict__, "_window": None}

    def _require_open(self, method: str) -> None:
        if self._stage == "closed":
            raise gymnasium.error.ClosedEnvironmentError(
                f"{method}() after close(): make the environment again"
            )

    def _require_episode(self, method: str) -> None:
        self._require_open(method)
        if self._stage == "made":
            raise gymnasium.error.ResetNeeded(f"{method}() before reset(): call reset() first")

    def _show(self) -> None:
        """Show the present state in MuJoCo's viewer, in mode ``human``, no faster than in life."""
        if self.render_mode != "human":
            return
        if self._window is None:
            self._window = ViewerWindow(self.model, self.data)
        if not self._window.viewer.is_running():  # the person has closed it
            return
        self._window.viewer.sync()
        # From one frame to the next, so that a slow step is not followed by hasty ones.
        time.sleep(max(0.0, self._shown_at + CONTROL_PERIOD - time.monotonic()))
        self._shown_at = time.monotonic()

    # -- observation ----------------------------------------------------------------------------

    def state(self) -> State:
        """Return the state before corruption."""
        data = self.data
        return State(
            time=np.asarray(self.time),
            joint_position=data.qpos.take(self._joint_qpos),
            joint_velocity=data.qvel.take(self._joint_dof),
            gripper_position=data.qpos.take(self._finger_qpos),
            gripper_velocity=data.qvel.take(self._finger_dof),
            end_effector_position=self.gripper_position,
            target_position=self.target_track(),
            object_position=self.object_position(),
            predicted_target=self._forecast[self._row()].copy()
            if self._forecasters
            else self.predicted_target(),
        )

    def observe(self) -> dict[str, NDArray[Any]]:
        """Build the observation that the spec asks for, rendering only its cameras.

        The vectors are views of ``vector``. Images are left out where ``renders_images`` is False.
        """
        spec, state = self.observation_spec, self.state()
        self.observed_target = self._observe_target(state)
        self.vector = spec.pack(state, self.observed_target)
        observation: dict[str, NDArray[Any]] = {}
        for name, part in self._slices.items():
            observation[name] = self.vector[part]
        if spec.cameras and self.renders_images:
            views = self.renderer.render(self.data, spec.cameras)
            for key, camera in spec.image_keys().items():
                observation[key] = fit_image(views[camera], spec.image_size)
        return observation

    # -- the mouth as it is observed -------------------------------------------------------------

    def watch_face(self, physics_step: int) -> None:
        """Let the camera that looks for the mouth take its image, if there is one and it is due."""
        if self._camera_mouth:
            self._camera_mouth.watch(self.data, physics_step)

    def _observe_target(self, state: State) -> TargetObservation | None:
        """Return the target as it is observed; None where that is the truth."""
        if self._pipeline:
            return self._pipeline.observe(state)
        if self._camera_mouth is None:
            return None
        past = self.observation_spec.past_frames
        seen = self._camera_mouth.observe(self.time)
        return replace(seen, past=self._camera_mouth.past(self.time, past) if past else None)

    def forecast_mouth(self, seen: float, ahead: float) -> Floats:
        """(3,) m, world: the mouth at ``seen + ahead`` s by what is observed; a `Forecast`.

        The true one where observations show the truth. Otherwise that of the newest report,
        whatever ``seen`` says, with the forecasts in it.
        """
        if self.observed_target is None:
            return self.mouth_at(seen + ahead)
        return self.observed_target.at(seen + ahead)

    @property
    def camera_mouth(self) -> CameraMouth | None:
        """Camera that looks for the mouth, if one does."""
        return self._camera_mouth

    @property
    def frames_without_detection(self) -> int | None:
        """Images of the episode in which no face was found; None where nobody looks for one."""
        return self._camera_mouth.frames_without_face if self._camera_mouth else None

    def start_attributes(self) -> dict[str, Any]:
        """Return the attributes of an episode file that are known after its reset.

        A task with attributes of its own extends it.
        """
        return start_attributes(self)


def world_of(env: gymnasium.Env[Any, Any]) -> FaceEnv:
    """Return the environment inside Gymnasium's wrappers."""
    return cast(FaceEnv, env.unwrapped)


def make_observation_space(spec: ObservationSpec, names: ObservedNames) -> gymnasium.spaces.Dict:
    """Return a ``Dict`` of float32 vectors, and of uint8 images of shape (height, width, 3)."""
    spaces: dict[str, gymnasium.Space[Any]] = {}
    for key, elements in spec.components(names).items():
        bounds = [[bound for part, bound in _BOUNDS.items() if part in name] for name in elements]
        high = np.array([bound[0] for bound in bounds], dtype=np.float32)
        spaces[key] = gymnasium.spaces.Box(-high, high)
    for key in spec.image_keys():
        spaces[key] = gymnasium.spaces.Box(0, 255, (*spec.image_size, 3), np.uint8)
    return gymnasium.spaces.Dict(spaces)


# -- arguments ------------------------------------------------------------------------------------


def _argument_names(env: type) -> list[str]:
    """Return the keyword arguments of an environment and of the classes that it derives from."""
    parameters = [
        parameter
        for owner in env.__mro__
        if issubclass(owner, FaceEnv)
        for parameter in inspect.signature(owner.__init__).parameters.values()
    ]
    return sorted({p.name for p in parameters if p.kind is p.KEYWORD_ONLY})


def _checked_render_mode(mode: Any, valid: Iterable[str]) -> str | None:
    if mode is not None:
        require_choice("render mode", mode, valid)
    if mode == "human" and (problem := viewer_problem()):
        raise RequestError(f"render mode 'human': {problem}; valid here: rgb_array, or None")
    return mode


def _make_corruption(given: Any) -> Corruption:
    """Return a corruption given as such or as a mapping; the spec refuses anything else."""
    if given is None:
        return Corruption()
    return Corruption.from_json(given) if isinstance(given, Mapping) else given


def _check_drawing(shadows: Any, multisamples: Any) -> None:
    if not isinstance(shadows, bool | np.bool_):
        raise RequestError(f"shadows {shadows!r}: must be True or False")
    require_integer("multisamples", multisamples, 0, MAX_MULTISAMPLES)


def _clip_names(given: Any) -> tuple[str, ...] | None:
    """Return the clips to draw from, given one name or several; None for all."""
    if given is None:
        return None
    names = [given] if isinstance(given, str) else given
    if not isinstance(names, Sequence) or not names:
        raise RequestError(f"clips {given!r}: must be ids of clips, at least one, or None for all")
    return tuple(names)
