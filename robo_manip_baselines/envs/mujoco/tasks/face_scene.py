"""Scene of every task with a moving face: the cell, its arms, and a head that replays motion."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD, FACE, MOUTH_BASE, build_cell
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.envs.mujoco.face import REST_OPENING, FaceModel, add_face
from robo_manip_baselines.envs.mujoco.face.contact import FaceTouch
from robo_manip_baselines.envs.mujoco.face.model import rotate
from robo_manip_baselines.envs.mujoco.face.motion import SEGMENT_DURATION, MotionSegment
from robo_manip_baselines.envs.mujoco.face.physical import CompliantHead
from robo_manip_baselines.envs.mujoco.face.proximity import FaceProximity, Proximity
from robo_manip_baselines.envs.mujoco.face.replay import FRAMES_AHEAD, FaceReplay
from robo_manip_baselines.observation import ARM_JOINTS

Floats = NDArray[np.float64]

PARKED_QPOS = (0.0, -1.8, 1.55, 0.0, -1.2, 0.0)
"""rad, the left arm folded back over its base, out of the head's way."""


class FaceScene:
    """Cell with two arms and a head that moves as a recorded person moved, step by step.

    It knows physics and geometry; `FaceEnv` makes a Gymnasium environment of it. A task adds its
    objects by `add_objects`.

    Args:
        face_kind: ``visual`` or ``physical``.
        arms: whose servos an action has, the left one first.
        objects: names of the task's objects, which are bodies of the scene.

    Attributes:
        model, data: MuJoCo's.
        face: geometry of the face.
        xml_hash: SHA-256 of the compiled scene.
        substeps: physics steps of a control step.
        touch: contacts of the face in the last control step.
    """

    tools: tuple[str, ...] = ()
    """Bodies of the robot that count by themselves where a face is touched."""

    def __init__(self, face_kind: str, arms: Sequence[str], objects: Sequence[str]) -> None:
        self.face_kind = face_kind
        self.face = FaceModel.load()
        scene = build_cell()
        add_face(scene, self.face_kind)
        self.add_objects(scene)
        self.model: mujoco.MjModel = scene.compile()
        self.xml_hash = hashlib.sha256(scene.to_xml().encode()).hexdigest()
        self.data = mujoco.MjData(self.model)
        self.substeps = round(CONTROL_PERIOD / self.model.opt.timestep)
        self._index_model(arms, objects)

    # -- task --------------------------------------------------------------------------------------

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        """Add the objects of the task to the scene before it is compiled."""

    def watch_contacts(self) -> None:
        """Read the contacts of one physics step."""

    # -- start -------------------------------------------------------------------------------------

    def lay_out(
        self, segment: MotionSegment, face_offset: Floats, motion_start: int | None
    ) -> None:
        """Forget the last episode, lay out the head's motion, and put the arms at their start.

        The task then draws the start of its objects, before `place_face`.

        Args:
            segment: of motion.
            face_offset: (3,) m, world, of the mouth from `MOUTH_BASE`.
            motion_start: control step at which the motion starts; None to wait for `start_motion`.
        """
        mujoco.mj_resetData(self.model, self.data)
        self.step_count, self.motion_start = 0, motion_start
        self.segment, self.face_offset = segment, face_offset
        self.replay = FaceReplay.lay_out(
            self.segment,
            MOUTH_BASE + self.face_offset,
            self.face,
            timestep=self.model.opt.timestep,
            substeps=self.substeps,
        )
        # Of a physical face, the head moves by forces, and the mouth with it.
        placed = ("face/torso",) if self._compliant_head else self.replay.bodies
        numbers = sorted(self._mocap[body] for body in placed)
        is_all = len(numbers) == self.model.nmocap
        self._placed = slice(None) if is_all else numbers  # a slice is much faster
        # One array for all bodies, (P, M, 3) and (P, M, 4), of which each has its part.
        names = sorted(placed, key=self._mocap.__getitem__)
        bodies = self.replay.bodies
        self._positions = np.stack([bodies[name][0] for name in names], axis=1)
        self._orientations = np.stack([bodies[name][1] for name in names], axis=1)
        for column, name in enumerate(names):
            bodies[name] = self._positions[:, column], self._orientations[:, column]
        self._set_arm("left", PARKED_QPOS, FINGER_CLOSED)
        self._set_arm("right", HOME_QPOS, FINGER_OPEN)

    def place_face(self) -> None:
        """Put the face where its motion starts, and derive the state of the scene."""
        row = self._row() * self.substeps
        self.data.mocap_pos[self._placed] = self._positions[row]
        self.data.mocap_quat[self._placed] = self._orientations[row]
        if self._compliant_head is None:
            position, orientation = self.replay.bodies["face/mouth"]
            self.data.joint("face/cavity").qpos = (*position[0], *orientation[0])
        else:
            self._compliant_head.reset(self.data, self.replay)
        mujoco.mj_forward(self.model, self.data)
        self.touch.clear()

    def start_motion(self) -> None:
        """Let the motion start now, if it has been waiting."""
        if self.motion_start is None:
            self.motion_start = self.step_count

    def _set_arm(self, arm: str, joints: Sequence[float], finger: float) -> None:
        for joint, angle in zip(ARM_JOINTS, joints, strict=True):
            self.data.joint(f"{arm}/{joint}").qpos = angle
            self.data.actuator(f"{arm}/{joint}").ctrl = angle
        self.data.joint(f"{arm}/left_finger").qpos = finger
        sign = np.sign(self.model.joint(f"{arm}/right_finger").range.sum())
        self.data.joint(f"{arm}/right_finger").qpos = sign * finger
        self.data.actuator(f"{arm}/gripper").ctrl = finger

    # -- physics -----------------------------------------------------------------------------------

    def simulate(self, action: NDArray[Any]) -> None:
        """Apply an action for one control period, the face moving at every physics step.

        Raises:
            ValueError: the action has the wrong shape or is not finite.
        """
        action = self._checked_action(action)
        low, high = self._action_range
        self.data.ctrl[self._actuators] = np.minimum(np.maximum(action, low), high)
        model, data, touch, head = self.model, self.data, self.touch, self._compliant_head
        touch.clear()
        placed, mocap_pos, mocap_quat = self._placed, data.mocap_pos, data.mocap_quat
        physics_step = self.step_count * self.substeps
        for row in self._physics_rows():
            if head:
                head.drive(data, row)
                head.place_mouth(data)
            mocap_pos[placed] = self._positions[row]
            mocap_quat[placed] = self._orientations[row]
            mujoco.mj_step(model, data)
            touch.read(model, data)
            self.watch_contacts()
            physics_step += 1
            self.watch_face(physics_step)
        self.step_count += 1
        if head:
            head.place_mouth(data)
        # After a step, sites and cameras are still where they were before its integration.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)

    def watch_face(self, physics_step: int) -> None:
        """Look at the face after so many physics steps of the episode, if it is time for it."""

    def _checked_action(self, action: Any) -> Floats:
        """Return an action as float64.

        Raises:
            ValueError: it has the wrong shape, or is not finite.
        """
        form = self._action_form
        try:
            values = np.asarray(action)
        except (TypeError, ValueError):  # rows of different lengths, say
            values = np.asarray(None)
        if values.dtype.kind not in "fiu":
            raise ValueError(f"action {' '.join(repr(action).split())}: {form}")
        values = values.astype(np.float64)
        if values.shape != self._actuators.shape:
            raise ValueError(f"action of shape {values.shape}: {form}")
        if not np.isfinite(values).all():
            bad = np.flatnonzero(~np.isfinite(values))
            place = f"{values[bad[0]]} in element {bad[0]}, {self.action_names[bad[0]]}"
            raise ValueError(f"action with {place}: {form}")
        return values

    def _physics_rows(self) -> Sequence[int]:
        """Rows of the replay's bodies at the ends of the physics steps of a control step."""
        if self.motion_start is None:
            return [0] * self.substeps
        first = (self.step_count - self.motion_start) * self.substeps + 1
        rows, last = range(first, first + self.substeps), len(self._positions) - 1
        return rows if rows[-1] <= last else [min(row, last) for row in rows]

    def _motion_step(self) -> int:
        """Control steps since the motion started; 0 while it waits."""
        return 0 if self.motion_start is None else self.step_count - self.motion_start

    def _row(self) -> int:
        """Row of the replay's arrays at the present step; held at the end of the recording."""
        return min(self._motion_step(), len(self.replay.jaw) - 1)

    # -- state -------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """s since the start of the episode."""
        return self.step_count * CONTROL_PERIOD

    @property
    def gripper_position(self) -> Floats:
        """(3,) m, world: site ``right/gripper``."""
        return self.data.site_xpos[self._gripper_site].copy()

    @property
    def gripper_orientation(self) -> Floats:
        """(4,) wxyz, world from the site ``right/gripper``."""
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self.data.site_xmat[self._gripper_site])
        return quat

    @property
    def action_names(self) -> list[str]:
        """The elements of an action."""
        return [self.model.actuator(actuator).name for actuator in self._actuators]

    @property
    def mouth_position(self) -> Floats:
        """(3,) m, world: the true mouth now, the first of `mouth_track`."""
        if self._compliant_head:
            return self.data.site_xpos[self._mouth_site].copy()
        return self.replay.mouth[self._row(), 0].copy()

    @property
    def mouth_track(self) -> Floats:
        """(K, 3) m, world: the true mouth now and 1 ... 24 frames ahead.

        Of a physical face, the mouth where it is now, and where it will be if nothing touches it:
        the recorded motion.
        """
        track = self.replay.mouth[self._row()].copy()
        if self._compliant_head:
            track[0] = self.data.site_xpos[self._mouth_site]
        return track

    @property
    def predicted_mouth(self) -> Floats | None:
        """(H, 3) m, world: the mouth 1 ... H frames ahead as forecast by a trained predictor.

        None if the motion library holds no predictions.
        """
        predicted = self.replay.predicted
        return None if predicted is None else predicted[self._row()].copy()

    def mouth_at(self, time: ArrayLike) -> Floats:
        """(..., 3) m, world: the true mouth at ``time`` (...) s of the episode, past or future.

        A motion that waits for its start is taken to go on waiting. Of a physical face, it is the
        mouth of the recorded motion, which nothing has touched.
        """
        start = np.inf if self.motion_start is None else self.motion_start * CONTROL_PERIOD
        moving = np.clip(np.asarray(time, dtype=np.float64) - start, 0.0, SEGMENT_DURATION)
        return MOUTH_BASE + self.face_offset + self.segment.displacement_at(moving)

    def landmark_track(self, landmark: int) -> Floats:
        """(K, 3) m, world: a point of the face now and 1 ... 24 frames ahead.

        Landmarks are vertices of `FaceModel`, 0 to 467, numbered as MediaPipe does.
        """
        start = self._row() * CONTROL_PERIOD
        displacement, orientation, jaw = self.segment.at(start + FRAMES_AHEAD)
        mouth, jaw = MOUTH_BASE + self.face_offset + displacement, jaw + REST_OPENING
        head, turn = self.face.body_poses(mouth, orientation, jaw)["face/head"]
        point = self.face.deform(self.face.jaw_angle(jaw), [landmark])[:, 0]
        track = head + rotate(turn, point)
        if self._compliant_head:  # now, as in `mouth_track`
            angle = self._compliant_head.jaw_angle(self.data)
            (here,) = self.face.deform(angle, [landmark])
            track[0] = self._compliant_head.point(self.data, here)
        return track

    def max_face_force(self) -> float:
        """Return the largest normal force between the robot and the face now, N.

        For `watch_contacts`: a control step has several physics steps. The robot has tools, too,
        that the outside of a face stops; food does not count.
        """
        return self.touch.robot_force

    def proximity(self) -> Proximity:
        """Measure the distances of robot and objects from the face now."""
        return self._proximity.measure(self.model, self.data, self.touch.pairs)

    @property
    def jaw_opening(self) -> float:
        """m between the inner lips."""
        if self._compliant_head:
            return float(self.face.jaw_at(self._compliant_head.jaw_angle(self.data)))
        return float(self.replay.jaw[self._row()])

    @property
    def mouth_opening(self) -> Floats:
        """(2,) m: half width and half height of the opening between the inner lips."""
        if self._compliant_head:
            return np.array(self.face.opening(self.jaw_opening))
        return self.replay.opening[self._row()]

    @property
    def head_orientation(self) -> Floats:
        """(4,) wxyz, world from head; identity for an upright face that looks along world +x."""
        if self._compliant_head:
            return self._compliant_head.orientation(self.data)
        return self.data.mocap_quat[self._mocap["face/head"]].copy()

    # -- indices -----------------------------------------------------------------------------------

    def _index_model(self, arms: Sequence[str], objects: Sequence[str]) -> None:
        model = self.model
        joints = np.array([[model.joint(f"{arm}/{j}").id for j in ARM_JOINTS] for arm in arms])
        fingers = np.array([model.joint(f"{arm}/left_finger").id for arm in arms])
        self._joint_qpos, self._joint_dof = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._finger_qpos, self._finger_dof = model.jnt_qposadr[fingers], model.jnt_dofadr[fingers]
        servos = [f"{arm}/{joint}" for arm in arms for joint in (*ARM_JOINTS, "gripper")]
        self._actuators = np.array([model.actuator(servo).id for servo in servos])
        self._action_range = np.ascontiguousarray(model.actuator_ctrlrange[self._actuators].T)
        self._action_form = f"must be ({len(self._actuators)},) finite numbers"
        self._gripper_site = model.site("right/gripper").id
        self._mouth_site = model.site("mouth").id
        outside = (model.geom_contype & FACE) != 0
        self._face_geoms = frozenset(np.flatnonzero(outside).tolist())
        self._mocap = {
            model.body(body).name: int(model.body_mocapid[body])
            for body in range(model.nbody)
            if model.body_mocapid[body] >= 0
        }
        self.touch = FaceTouch(model, objects)
        self._proximity = FaceProximity(model, objects)
        is_physical = self.face_kind == "physical"
        self._compliant_head = CompliantHead(model, self.face) if is_physical else None
