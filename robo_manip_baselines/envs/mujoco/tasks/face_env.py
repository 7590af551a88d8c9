"""What every task with a moving face shares: the cell, the replayed head, arms, observations."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, cast

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.rendering import CameraRenderer
from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE, build_cell
from robo_manip_baselines.envs.mujoco.cell.vx300s import (
    ARM_JOINTS,
    FINGER_CLOSED,
    FINGER_OPEN,
    HOME_QPOS,
)
from robo_manip_baselines.envs.mujoco.face import FaceModel, add_face
from robo_manip_baselines.envs.mujoco.face.motion import (
    SEGMENT_DURATION,
    MotionLibrary,
    MotionSegment,
)
from robo_manip_baselines.envs.mujoco.face.replay import FACE_MOTIONS, FaceReplay
from robo_manip_baselines.observation import ObservationSpec, Truth, observe
from robo_manip_baselines.observation.detector import NO_PREDICTION, Detector
from robo_manip_baselines.runs.errors import RequestError, require_choice

CONTROL_PERIOD = 0.02
"""s between two actions (paper, Algorithm 1, line 2)."""

FACE_OFFSET = 0.05
"""m, largest random offset of the face along each axis (paper, Algorithm 1, line 3)."""

PARKED_QPOS = (0.0, -1.8, 1.55, 0.0, -1.2, 0.0)
"""rad, the left arm folded back over its base, out of the head's way."""

RENDER_CAMERA = "angle"
"""What ``render()`` shows."""


class FaceEnv(gymnasium.Env[Any, Any]):
    """A cell with two arms and a head that moves as a recorded person moved.

    A task derives from it: it adds its objects to the scene, draws their start, and says after
    each step what has been achieved.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (the name and its kind are Gymnasium's)
        "render_modes": ["rgb_array"],
        "render_fps": round(1.0 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        *,
        spec: ObservationSpec,
        face_motion: str,
        clips: Sequence[str] | None,
        motion_library: str | None,
        shadows: bool,
        multisamples: int,
        render_mode: str | None,
    ) -> None:
        if render_mode is not None:
            require_choice("render mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.observation_spec = spec
        self.face_motion = require_choice("face motion", face_motion, FACE_MOTIONS)
        self._detector = Detector.of(spec)
        self.library = MotionLibrary.load(motion_library)
        if spec.corruption and spec.corruption.error == "model" and self.library.predicted is None:
            raise RequestError(f"motion library '{self.library.source}' holds {NO_PREDICTION}")
        self.clips = (
            None
            if clips is None
            else tuple(require_choice("clip", clip, set(self.library.run_clip)) for clip in clips)
        )
        self.face = FaceModel.load()
        scene = build_cell()
        add_face(scene)
        self.add_objects(scene)
        self.model: mujoco.MjModel = scene.compile()
        self.xml_hash = hashlib.sha256(scene.to_xml().encode()).hexdigest()
        self.data = mujoco.MjData(self.model)
        self.substeps = round(CONTROL_PERIOD / self.model.opt.timestep)
        height, width = spec.image_size
        self.renderer = CameraRenderer(
            self.model, height, width, shadows=shadows, multisamples=multisamples
        )
        self._index_model()
        self.action_space = self._make_action_space()
        self.observation_space = observation_space(spec)

    # -- what a task says -----------------------------------------------------------------------

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        """Add the objects of the task to the scene before it is compiled."""
        raise NotImplementedError

    def reset_objects(self, rng: np.random.Generator) -> None:
        """Draw where the objects start, into ``self.data.qpos``."""
        raise NotImplementedError

    def object_position(self) -> NDArray[np.float64]:
        """(3,) m, world: centre of the object that the policy handles."""
        raise NotImplementedError

    # -- indices --------------------------------------------------------------------------------

    def _index_model(self) -> None:
        model = self.model
        arms = self.observation_spec.arm_names
        joints = np.array([[model.joint(f"{arm}/{j}").id for j in ARM_JOINTS] for arm in arms])
        fingers = np.array([model.joint(f"{arm}/left_finger").id for arm in arms])
        self._joint_qpos, self._joint_dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._finger_qpos, self._finger_dof = model.jnt_qposadr[fingers], model.jnt_dofadr[fingers]
        self._actuators = np.array(
            [[model.actuator(f"{arm}/{j}").id for j in (*ARM_JOINTS, "gripper")] for arm in arms]
        ).ravel()
        self._gripper_site = model.site("right/gripper").id
        self._mouth_site = model.site("mouth").id
        self._mocap = {
            model.body(body).name: int(model.body_mocapid[body])
            for body in range(model.nbody)
            if model.body_mocapid[body] >= 0
        }

    def _make_action_space(self) -> gymnasium.spaces.Box:
        low, high = self.model.actuator_ctrlrange[self._actuators].T
        return gymnasium.spaces.Box(low.astype(np.float32), high.astype(np.float32))

    # -- Gymnasium ------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start an episode; every random choice comes from ``seed``."""
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.step_count = 0
        self.motion_start: int | None = 0 if self.face_motion == "episode" else None
        self.face_offset = self.np_random.uniform(-FACE_OFFSET, FACE_OFFSET, 3)
        self.segment: MotionSegment = self.library.draw(self.np_random, clips=self.clips)
        self.replay = FaceReplay.lay_out(
            self.segment,
            MOUTH_BASE + self.face_offset,
            self.face,
            duration=SEGMENT_DURATION,
            timestep=self.model.opt.timestep,
            substeps=self.substeps,
        )
        self._set_arm("left", PARKED_QPOS, FINGER_CLOSED)
        self._set_arm("right", HOME_QPOS, FINGER_OPEN)
        self.reset_objects(self.np_random)
        self._place_face(0)
        position, orientation = self.replay.bodies["face/mouth"]
        self.data.joint("face/cavity").qpos = (*position[0], *orientation[0])
        mujoco.mj_forward(self.model, self.data)
        if self._detector:
            # Last, so that the world is the one that it would be without corruption.
            drawn = int(self.np_random.integers(2**32)) if seed is None else seed
            self._detector.reset(drawn)
        return self.observe(), {}

    def simulate(self, action: NDArray[Any]) -> None:
        """Apply an action for one control period, the face moving at every physics step.

        Raises:
            ValueError: the action has the wrong shape or is not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self._actuators.shape or not np.isfinite(action).all():
            raise ValueError(
                f"action of shape {action.shape} must be {self._actuators.shape} finite numbers"
            )
        low, high = self.model.actuator_ctrlrange[self._actuators].T
        self.data.ctrl[self._actuators] = np.clip(action, low, high)
        for substep in range(self.substeps):
            self._place_face(substep + 1)
            mujoco.mj_step(self.model, self.data)
            self.watch_contacts()
        self.step_count += 1
        # After a step, sites and cameras are still where they were before its integration.
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def watch_contacts(self) -> None:
        """Look at the contacts of one physics step; a task that cares overrides it."""

    def start_motion(self) -> None:
        """Let the recorded motion start now, if it has been waiting."""
        if self.motion_start is None:
            self.motion_start = self.step_count

    def render(self) -> NDArray[np.uint8]:
        """Return the view of the camera ``angle``, (H, W, 3) uint8."""
        return self.renderer.render(self.data, [RENDER_CAMERA])[RENDER_CAMERA]

    def close(self) -> None:
        """Free the OpenGL context."""
        self.renderer.close()

    # -- state ----------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """s since the start of the episode."""
        return self.step_count * CONTROL_PERIOD

    @property
    def gripper_position(self) -> NDArray[np.float64]:
        """(3,) m, world: site ``right/gripper``."""
        return self.data.site_xpos[self._gripper_site].copy()

    @property
    def gripper_orientation(self) -> NDArray[np.float64]:
        """(4,) wxyz, world from the site ``right/gripper``."""
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self.data.site_xmat[self._gripper_site])
        return quat

    @property
    def head_orientation(self) -> NDArray[np.float64]:
        """(4,) wxyz, world from head; identity for an upright face that looks along world +x."""
        return self.data.mocap_quat[self._mocap["face/head"]].copy()

    @property
    def joint_names(self) -> list[str]:
        """The columns of joint positions and velocities."""
        return [f"{arm}/{joint}" for arm in self.observation_spec.arm_names for joint in ARM_JOINTS]

    @property
    def action_names(self) -> list[str]:
        """The elements of an action."""
        return [self.model.actuator(actuator).name for actuator in self._actuators]

    @property
    def mouth_track(self) -> NDArray[np.float64]:
        """(K, 3) m, world: the true mouth now and 1 ... 5 frames ahead."""
        return self.replay.mouth[self.replay.control_index(self._motion_step())].copy()

    @property
    def predicted_mouth(self) -> NDArray[np.float64] | None:
        """(K - 1, 3) m, world: the mouth 1 ... 5 frames ahead as a trained predictor foretold it.

        None if the motion library holds no predictions.
        """
        predicted = self.replay.predicted
        index = self.replay.control_index(self._motion_step())
        return None if predicted is None else predicted[index].copy()

    @property
    def jaw_opening(self) -> float:
        """m between the inner lips."""
        return float(self.replay.jaw[self.replay.control_index(self._motion_step())])

    @property
    def mouth_opening(self) -> NDArray[np.float64]:
        """(2,) m: half width and half height of the opening between the inner lips."""
        return self.replay.opening[self.replay.control_index(self._motion_step())]

    def truth(self) -> Truth:
        """What is so now, uncorrupted."""
        data = self.data
        return Truth(
            time=np.asarray(self.time),
            joint_position=data.qpos[self._joint_qpos],
            joint_velocity=data.qvel[self._joint_dof],
            gripper_position=data.qpos[self._finger_qpos],
            gripper_velocity=data.qvel[self._finger_dof],
            end_effector_position=self.gripper_position,
            mouth_position=self.mouth_track,
            object_position=self.object_position(),
            predicted_mouth=self.predicted_mouth,
        )

    def observe(self) -> dict[str, NDArray[Any]]:
        """Build the observation that the spec asks for, rendering only its cameras."""
        truth = self.truth()
        report = self._detector.report(truth) if self._detector else None
        observation: dict[str, NDArray[Any]] = {**observe(self.observation_spec, truth, report)}
        if self.observation_spec.cameras:
            views = self.renderer.render(self.data, self.observation_spec.cameras)
            for key, camera in self.observation_spec.image_keys().items():
                observation[key] = views[camera]
        return observation

    def _motion_step(self) -> int:
        """Control steps since the recorded motion started; 0 while it waits."""
        return 0 if self.motion_start is None else self.step_count - self.motion_start

    def _place_face(self, substep: int) -> None:
        moving = 0 if self.motion_start is None else substep
        row = self.replay.physics_index(self._motion_step() * self.substeps + moving)
        for body, (position, orientation) in self.replay.bodies.items():
            self.data.mocap_pos[self._mocap[body]] = position[row]
            self.data.mocap_quat[self._mocap[body]] = orientation[row]

    def _set_arm(self, arm: str, joints: Sequence[float], finger: float) -> None:
        for joint, angle in zip(ARM_JOINTS, joints, strict=True):
            self.data.joint(f"{arm}/{joint}").qpos = angle
            self.data.actuator(f"{arm}/{joint}").ctrl = angle
        self.data.joint(f"{arm}/left_finger").qpos = finger
        sign = np.sign(self.model.joint(f"{arm}/right_finger").range.sum())
        self.data.joint(f"{arm}/right_finger").qpos = sign * finger
        self.data.actuator(f"{arm}/gripper").ctrl = finger


def world_of(env: gymnasium.Env[Any, Any]) -> FaceEnv:
    """Return the environment inside Gymnasium's wrappers."""
    return cast(FaceEnv, env.unwrapped)


# Wide enough for whatever physics may do; observations are not clipped to them.
_BOUNDS = {" position": 2.0 * np.pi, " velocity": 100.0, "t_": 60.0}
"""rad, m; rad/s, m/s; s."""

_LENGTH_BOUND = 5.0
"""m, of everything else."""


def observation_space(spec: ObservationSpec) -> gymnasium.spaces.Dict:
    """Return a ``Dict`` of float32 vectors, and of uint8 images of shape (height, width, 3)."""
    spaces: dict[str, gymnasium.Space[Any]] = {}
    for key, names in spec.components().items():
        high = np.array([_bound(name) for name in names], dtype=np.float32)
        spaces[key] = gymnasium.spaces.Box(-high, high)
    for key in spec.image_keys():
        spaces[key] = gymnasium.spaces.Box(0, 255, (*spec.image_size, 3), np.uint8)
    return gymnasium.spaces.Dict(spaces)


def _bound(name: str) -> float:
    """Return a generous bound of an observed quantity, in its unit."""
    matches = [bound for part, bound in _BOUNDS.items() if part in name]
    return matches[0] if matches else _LENGTH_BOUND
