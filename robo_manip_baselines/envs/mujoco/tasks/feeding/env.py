"""FeedingEnv: bring a cube to the mouth of a person who moves."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CUBE_SIZE, add_cube
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, HOME_QPOS
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.feeding.spoon import (
    SPOON,
    SPOON_FINGER,
    SPOON_HOME_QPOS,
    SPREAD,
    Meal,
    add_food,
    add_spoon,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import (
    FACE_FORCE,
    FeedingProgress,
    Phase,
    StepMeasurements,
    is_at_mouth,
)
from robo_manip_baselines.envs.mujoco.tasks.mouth import from_mouth, is_inside_mouth
from robo_manip_baselines.runs.errors import require_choice

CUBE_LOW = np.array([0.12, 0.42])
CUBE_HIGH = np.array([0.22, 0.58])
"""m, world x and y between which the cube starts: between the arm and the head (public ALOHA: x 0
to 0.2, y 0.4 to 0.6), far enough from the chin for a gripper that comes from above."""

OFF_TABLE = -0.05
"""m, height of the cube's centre below which it has fallen off the table."""

SETTLING_STEPS = 100
"""Physics steps, 0.2 s, in which the fingers close on a cube that is put between them."""


_FINGER_BITS = {"right": (1, 2), "left": (4, 8)}
"""Bits of the left and the right finger of each arm."""


class FeedingEnv(FaceEnv):
    """Pick up a red cube and bring it to the mouth of a head that moves as a person moved.

    The task of the paper's section IV.C; with ``utensil="spoon"``, food on a spoon in place of the
    cube. Units are SI; the world frame is x right, y forward, z up
    with the table's top at z = 0; quaternions are wxyz. Control is at 50 Hz.

    ## Action space

    ``Box(7,)`` float32, targets of the right arm's position servos; with ``arms="both"``
    ``Box(14,)``, left arm first. Values outside the bounds are clipped to them.

    | num | action | min | max | joint | unit |
    |---|---|---|---|---|---|
    | 0 | waist | -pi | pi | right/waist | rad |
    | 1 | shoulder | -1.850 | 1.257 | right/shoulder | rad |
    | 2 | elbow | -1.763 | 1.606 | right/elbow | rad |
    | 3 | forearm roll | -pi | pi | right/forearm_roll | rad |
    | 4 | wrist angle | -1.868 | 2.234 | right/wrist_angle | rad |
    | 5 | wrist rotate | -pi | pi | right/wrist_rotate | rad |
    | 6 | gripper, position of a finger | 0.021 (closed) | 0.057 (open) | right/left_finger | m |

    ## Observation space

    A ``Dict`` of float32 vectors and uint8 images, chosen by ``obs``, ``cameras`` and
    ``object_pose``. ``env.unwrapped.observation_spec.components()`` names every element.

    | key | shape | when | content |
    |---|---|---|---|
    | ``state`` | (14,), both arms (28,) | always | per arm: 6 joint positions (rad), 6 joint
    velocities (rad/s), gripper position (m) and velocity (m/s) |
    | ``mouth`` | (4,) | ``obs="current"``, ``"history"`` | mouth x, y, z (m) and distance
    gripper-mouth (m) |
    | ``history`` | (15,) | ``obs="history"`` | for k = 1 ... 5: mouth x, y, z (m) as it was
    reported k frames of 1/30 s ago; before the start, the first report |
    | ``prediction`` | (5 (H+1),) | ``obs="current_pred"`` | for k = 0 ... H: time (s) and mouth
    x, y, z (m) k frames of 1/30 s ahead; then the H+1 distances gripper-mouth (m) |
    | ``gripper_from_mouth`` | (3,), per frame with ``mouth_time="forecast"`` |
    ``mouth_frame="gripper"``, ``"both"`` | gripper less mouth: x, y, z (m) |
    | ``object_position`` | (3,) | ``object_pose=True`` | centre of the cube (m) |
    | ``images/<camera>`` | (height, width, 3) | per camera | RGB |

    The time is that of the episode, so that it tells a policy how long the mouth has been moving.
    With a ``corruption`` it is the time at which the mouth was seen, and the mouth is as it was
    reported; the distances are those from the gripper as it is now.

    ## Reward

    1 on the step that first meets ``is_success``, and 1 on the step that first meets
    ``is_success_strict``; 0 otherwise.

    ## Starting state

    The right arm at home with an open gripper, the left arm folded. Drawn from ``reset(seed=...)``:

    - the cube's centre, uniform in x 0.12 ... 0.22 and y 0.42 ... 0.58, on the table;
    - the mouth, (0, 0.5, 0.35) plus a uniform offset of +-0.05 along each axis;
    - with a spoon, in place of that: the food on its bowl, +-0.002 m from the middle along and
      across, and the arm with the spoon level, 0.1 m or more before the mouth;
    - the segment of recorded motion, its start uniform over all starts of the library; or another
      ``motion``, with the same cube and the same offset.

    The mouth then follows the recorded displacement unchanged, with head orientation and jaw, for
    12 s: from the start (``face_motion="episode"``) or from the moment at which the cube has been
    lifted (``face_motion="after_lift"``, Algorithm 1). The jaw is held open by
    ``face.REST_OPENING`` more than recorded: a person who waits to be fed.

    ## Info

    | key | type | content |
    |---|---|---|
    | ``is_success`` | bool | Algorithm 1's condition has been met with the cube held and lifted:
    gripper and mouth less than 0.03 m apart along x, 0.01 m along y, 0.01 m along z |
    | ``is_success_strict`` | bool | ``is_success``, and the cube was let go with its centre inside
    the mouth opening, and since the lift the gripper has not touched lips or face |
    | ``mouth_position`` | (3,) | true mouth (m) |
    | ``utensil_position`` | (3,) | what has to come to the mouth (m): the gripper's site, or the
    middle of the rim of the spoon's bowl |
    | ``gripper_position`` | (3,) | site ``right/gripper`` (m) |
    | ``cube_offset`` | (3,) | centre of the cube from the mouth (m) in the face's axes: out along
    its normal, across to the person's left, up |
    | ``phase`` | str | reach, grasp, carry, deliver or release |
    | ``time_since_lift`` | float or None | s; None before |
    | ``completion_time`` | float or None | s from the lift to ``is_success``; None before |
    | ``face_force`` | float | N, the largest normal force between the robot and the face in the
    step |

    and what `FaceEnv` adds for every task.

    ## With a spoon

    The gripper holds the spoon for good, whatever the fingers do; the food, a cube of 0.014 m, lies
    free on its bowl. It counts as lifted from the start. ``is_success`` is the same condition on
    the middle of the bowl's rim, the food on it. The mouth closes on food that has been inside
    it, on the spoon, for 0.3 s, and keeps it; ``is_success_strict`` is ``is_success`` with the food
    taken so, and never more than 10 N between robot and face. Food that leaves the bowl otherwise
    is spilled. The episode ends when the bowl has withdrawn by 0.12 m. The spoon counts
    by itself (``spoon``) in ``face_contacts``.

    ## Episode end

    Terminates when the cube was delivered (``is_success``) and let go and the gripper has
    withdrawn by 0.12 m, or when the cube falls off the table. Truncated after 600 steps (12 s).

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | ``obs`` | ``"baseline"`` | preset: baseline, current, current_pred, history |
    | ``horizon`` | 2 | frames that current_pred looks ahead, 1 to 24 |
    | ``cameras`` | all three | any of top, angle, front_close, or one name; ``()`` for none |
    | ``image_size`` | (480, 640) | height and width |
    | ``render_size`` | None | height and width at which cameras are drawn, before the images are
    cropped about their centre and shrunk to ``image_size``; the same if None |
    | ``object_pose`` | False | show the cube's position |
    | ``relative`` | False | show past and future frames of the mouth relative to the present one |
    | ``mouth_frame`` | "none" | ``gripper`` or ``both`` also show the gripper's position from the
    mouth; ``actions`` is for policies, and changes nothing here |
    | ``mouth_time`` | "now" | with ``forecast`` it is shown from the mouth in each frame |
    | ``corruption`` | None | what stands between true and shown mouth: an
    ``observation.Corruption`` or its fields as a dict, such as ``{"error": "uniform", "delay":
    3}``; None shows the truth |
    | ``mouth_source`` | ``"truth"`` | truth, or camera or depth_camera: a face detector finds the
    mouth in images of ``front_close`` (needs the extra ``face_prediction`` and OpenGL) |
    | ``camera_latency`` | 1 | frames of 1/30 s from an image to its report, or ``"measured"`` |
    | ``arms`` | ``"right"`` | right or both |
    | ``face`` | ``"visual"`` | kind of face: visual, or physical, soft tissue on a head that
    yields |
    | ``utensil`` | ``"gripper"`` | gripper or spoon |
    | ``face_motion`` | ``"episode"`` | episode or after_lift |
    | ``motion`` | ``"recorded"`` | of the face by name: recorded, still, nod, turn, sway, tremor,
    dyskinetic, spasm, turn_away, chew, with parameters and as sums, see ``parse_motion`` |
    | ``people`` | ``"all"`` | all, or train or test: different people, drawn before their starts |
    | ``clips`` | None | ids of recorded clips to draw from; all if None |
    | ``motion_library`` | None | a file of ``face_prediction export-motion``, or ``"extended"``,
    the shipped one with more people; the shipped one of recordings alone if None |
    | ``motion_sha256`` | None | digest of the library's motion; any if None |
    | ``shadows``, ``multisamples`` | False, 0 | prettier and slower images, for videos |
    | ``render_mode`` | None | ``"rgb_array"``: ``render()`` gives the camera ``angle``;
    ``"human"``: MuJoCo's viewer |

    Raises ``RequestError``, a ``ValueError``, when an argument, a seed (0 to 2⁵³ - 1) or an option
    of ``reset`` (there are none) is not valid.

    ## Version history

    - v0: first release.
    """

    task = ENTRY
    phase_names = tuple(phase.name.lower() for phase in Phase)

    def __init__(self, *, utensil: str = "gripper", **kwargs: Any) -> None:
        valid = self.task.choices.get("utensil", ("gripper",))
        self.utensil = require_choice("utensil", utensil, valid)
        has_spoon = self.utensil == SPOON
        self.tools = (SPOON,) if has_spoon else ()
        super().__init__(**kwargs)
        model = self.model
        self.meal = Meal(model) if has_spoon else None
        self._utensil_site = model.site(SPOON if has_spoon else "right/gripper").id
        self._cube_qpos = int(model.joint("cube").qposadr[0])
        self._cube_body = model.body("cube").id
        self._cube_geom = model.geom("cube").id
        # For each geom: bits 0 and 1 where it is of a finger of the right arm, 2 and 3 of the left.
        self._finger_bits = [_finger_bits(model, geom) for geom in range(model.ngeom)]

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        """Add the red cube, or a spoon and food for it."""
        if self.utensil == SPOON:
            add_spoon(scene)
            add_food(scene)
        else:
            add_cube(scene)

    def reset_task(self, rng: np.random.Generator) -> None:
        """Put the cube where `draw_cube` says, flat on the table, or food on the spoon."""
        self.progress = FeedingProgress()
        self._clear_contacts()
        if self.meal:
            self._set_arm("right", SPOON_HOME_QPOS, SPOON_FINGER)
            self.meal.place(self.model, self.data, rng.uniform(-SPREAD, SPREAD, 2))
            return
        x, y = self.draw_cube(rng)
        self.data.qpos[self._cube_qpos : self._cube_qpos + 7] = (x, y, CUBE_SIZE / 2, 1, 0, 0, 0)

    def draw_cube(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw where the cube starts, (2,) m, world x and y."""
        return rng.uniform(CUBE_LOW, CUBE_HIGH)

    @property
    def start_qpos(self) -> tuple[float, ...]:
        """(6,) rad, joints of the right arm at the start."""
        return SPOON_HOME_QPOS if self.meal else HOME_QPOS

    def hold_cube(self, joints: NDArray[np.float64], offset: float) -> None:
        """Go on, after a reset, with the cube in the closed gripper of the right arm.

        Args:
            joints: (6,) rad.
            offset: m from the gripper site to the cube's centre, along the fingers.
        """
        self._set_arm("right", joints.tolist(), FINGER_CLOSED + CUBE_SIZE / 2)
        self.data.actuator("right/gripper").ctrl = FINGER_CLOSED
        mujoco.mj_kinematics(self.model, self.data)
        forward = self.data.site("right/gripper").xmat.reshape(3, 3)[:, 0]
        place = self.gripper_position + offset * forward
        pose = (*place, *self.gripper_orientation)
        self.data.qpos[self._cube_qpos : self._cube_qpos + 7] = pose
        mujoco.mj_step(self.model, self.data, SETTLING_STEPS)
        mujoco.mj_forward(self.model, self.data)

    def object_position(self) -> NDArray[np.float64]:
        """(1, 3) m, world: centre of the cube."""
        return self.data.xpos[self._cube_body][None].copy()

    @property
    def cube_position(self) -> NDArray[np.float64]:
        """(3,) m, world: centre of the cube."""
        return self.data.xpos[self._cube_body].copy()

    @property
    def cube_offset(self) -> NDArray[np.float64]:
        """(3,) m: centre of the cube from the mouth, see ``from_mouth``."""
        axes = self.data.site_xmat[self._mouth_site].reshape(3, 3)
        return from_mouth(self.cube_position, self.mouth_position, axes)

    @property
    def utensil_position(self) -> NDArray[np.float64]:
        """(3,) m, world: the gripper's site, or the middle of the spoon's bowl."""
        return self.data.site_xpos[self._utensil_site].copy()

    @property
    def face_force(self) -> float:
        """N, the largest normal force between the robot and the face in the last step."""
        return self._face_force

    @property
    def object_pose(self) -> NDArray[np.float64]:
        """(7,) position (m) and orientation (wxyz) of the cube, world."""
        return self.data.qpos[self._cube_qpos : self._cube_qpos + 7].copy()

    def simulate(self, action: NDArray[np.float32]) -> None:
        """Apply an action for one control period, counting contacts afresh."""
        self._clear_contacts()
        super().simulate(action)
        if self.meal:
            self.meal.advance(self.model, self.data, is_inside=self._is_inside_mouth())

    def advance(self) -> tuple[float, bool]:
        """Evaluate the task after a control step; return reward and whether it has ended."""
        before = self.progress
        self.progress = now = before.advance(self._measure())
        if now.lift_time is not None:
            self.start_motion()
        reward = float(now.is_success and not before.is_success)
        reward += float(now.is_success_strict and not before.is_success_strict)
        delivered = now.is_success and now.is_clear
        return reward, delivered or bool(self.data.xpos[self._cube_body, 2] < OFF_TABLE)

    def task_row(self) -> dict[str, Any]:
        """Return the present pose of the cube."""
        return {"object_pose": self.object_pose}

    def start_attributes(self) -> dict[str, Any]:
        """Return what `FaceEnv` does, and the cube's start."""
        return {**super().start_attributes(), "object_initial_pose": self.object_pose}

    def info(self) -> dict[str, Any]:
        """Return what the class docstring lists under Info."""
        progress = self.progress
        return {
            "is_success": progress.is_success,
            "is_success_strict": progress.is_success_strict,
            "mouth_position": self.mouth_position,
            "gripper_position": self.gripper_position,
            "utensil_position": self.utensil_position,
            "cube_offset": self.cube_offset,
            "phase": progress.phase.name.lower(),
            "time_since_lift": progress.time_since_lift(self.time),
            "completion_time": progress.completion_time,
            "face_force": self.face_force,
        }

    def watch_contacts(self) -> None:
        """Record which fingers touch the cube, and how hard the robot touches the face."""
        if (pairs := self.touch.pairs) is not self._watched_pairs:  # the same ones add nothing
            self._watched_pairs, cube, bits = pairs, self._cube_geom, self._finger_bits
            for first, second in pairs:
                if first == cube or second == cube:
                    self._fingers_on_cube |= bits[first] | bits[second]
        self._face_force = max(self._face_force, self.touch.robot_force)
        if self.meal:
            self.meal.hold(self.data)

    def _clear_contacts(self) -> None:
        self._fingers_on_cube = 0
        self._face_force = 0.0
        self._watched_pairs: list[list[int]] | None = None

    def _fingers_on(self, arm: str) -> int:
        """Return how many fingers of an arm touched the cube in the last step."""
        left, right = _FINGER_BITS[arm]
        return bool(self._fingers_on_cube & left) + bool(self._fingers_on_cube & right)

    def _is_inside_mouth(self) -> bool:
        half_width, half_height = self.mouth_opening.tolist()
        return is_inside_mouth(self.cube_offset, half_width, half_height)

    def _measure(self) -> StepMeasurements:
        mouth, utensil = self.mouth_position, self.utensil_position
        way = utensil - mouth
        is_on_spoon = self.meal is not None and self.meal.is_on_spoon(self.data)
        fingers = self._fingers_on("right")
        return StepMeasurements(
            time=self.time,
            is_held=is_on_spoon if self.meal else fingers == 2,
            is_touched=is_on_spoon if self.meal else fingers > 0,
            cube_height=float(self.data.xpos[self._cube_body, 2]),
            is_at_mouth=is_at_mouth(utensil, mouth),
            is_inside_mouth=self._is_inside_mouth(),
            touches_face=self._face_force > FACE_FORCE[self.utensil],
            gripper_distance=math.sqrt(way.dot(way)),
        )


def _finger_bits(model: mujoco.MjModel, geom: int) -> int:
    """Return the bit of the finger that a geom belongs to; 0 if it is of none."""
    body = model.body(int(model.geom_bodyid[geom])).name
    arm, _, link = body.partition("/")
    fingers = ("left_finger_link", "right_finger_link")
    return _FINGER_BITS[arm][fingers.index(link)] if link in fingers else 0
