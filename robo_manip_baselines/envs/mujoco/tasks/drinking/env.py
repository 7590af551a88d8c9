"""DrinkingEnv: bring a cup with a spout to the mouth of a person who moves, and tilt it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import ARM_BASES, CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.tasks.drinking import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.drinking.cup import (
    BODY_HEIGHT,
    DROP,
    DROPS,
    SLICE,
    LiquidView,
    add_cup,
)
from robo_manip_baselines.envs.mujoco.tasks.drinking.liquid import (
    SERVING,
    Liquid,
    jet_at,
    outflow_speed,
    surface_height,
)
from robo_manip_baselines.envs.mujoco.tasks.drinking.success import (
    UPRIGHT,
    DrinkingProgress,
    Mouth,
    Phase,
    StepMeasurements,
    is_drunk,
    time_to_lips,
)
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv

CUP_LOW = np.array([0.09, 0.42])
CUP_HIGH = np.array([0.16, 0.58])
"""m, world x and y between which the middle of the cup starts: spout and chest stay apart, and a
gripper that is almost level reaches down to it."""

CUP_TURN = 0.05
"""rad, largest random turn of the cup's spout away from the direction of the arm."""

OFF_TABLE = -0.05
"""m, height of the cup's middle below which it has fallen off the table."""

FLIGHT = 0.12
"""s for which drops that miss the mouth are drawn."""

NO_DROPS = np.empty((0, 3))


class DrinkingEnv(FaceEnv):
    """Bring a cup with a spout to the lips of a head that moves as a person moved, and tilt it.

    A person drinks a serving of 40 ml from a feeding cup that stands on the table at first. The
    liquid is a volume with a level surface; above the opening of the spout it flows out
    (``docs/drinking.md``). Units are SI; the world frame is x right, y forward, z up with the
    table's top at z = 0; quaternions are wxyz. Control is at 50 Hz.

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
    | ``object_position`` | (3,) | ``object_pose=True`` | middle of the body of the cup (m) |
    | ``images/<camera>`` | (height, width, 3) | per camera | RGB |

    The time is that of the episode, so that it tells a policy how long the mouth has been moving.
    With a ``corruption`` it is the time at which the mouth was seen, and the mouth is as it was
    reported; the distances are those from the gripper as it is now.

    ## Reward

    1 on the step that first meets ``is_success``, and 1 on the step that first meets
    ``is_success_strict``; 0 otherwise.

    ## Starting state

    The right arm at home with an open gripper, the left arm folded. Drawn from ``reset(seed=...)``:

    - the middle of the cup, uniform in x 0.09 ... 0.16 and y 0.42 ... 0.58, upright on the table;
      its spout points away from the base of the right arm, turned by up to +-0.05 rad;
    - the mouth, (0, 0.5, 0.35) plus a uniform offset of +-0.05 along each axis;
    - the segment of recorded motion, as in `FeedingEnv`; or another ``motion``, with the same cup
      and the same offset.

    The mouth then follows the recorded displacement unchanged, with head orientation and jaw, for
    12 s: from the start (``face_motion="episode"``) or from the moment at which the cup has been
    lifted (``face_motion="after_lift"``). The jaw is held open by ``face.REST_OPENING`` more than
    recorded.

    ## Info

    | key | type | content |
    |---|---|---|
    | ``is_success`` | bool | at least 75 % of the liquid has gone into the mouth: out of a spout
    less than 0.03 m from the mouth's centre, and into the opening between the lips |
    | ``is_success_strict`` | bool | ``is_success``, at most 5 % of the liquid has been spilled, and
    the face has never been pressed with more than 10 N |
    | ``mouth_position`` | (3,) | true mouth (m) |
    | ``gripper_position`` | (3,) | site ``right/gripper`` (m) |
    | ``spout_position`` | (3,) | middle of the spout's opening (m) |
    | ``is_spout_inside`` | bool | that is in the mouth opening, past the front of the lips |
    | ``is_touched`` | bool | a finger touches the cup |
    | ``delivered``, ``spilled`` | float | shares of the liquid, 0 to 1 |
    | ``tilt`` | float | rad, of the cup from upright |
    | ``phase`` | str | reach, grasp, carry, pour or withdraw |
    | ``time_since_lift`` | float or None | s; None before |
    | ``completion_time`` | float or None | s from the lift to ``is_success``; None before |
    | ``face_force`` | float | N, the largest normal force between robot or cup and the face in
    the step |

    ## Episode end

    Terminates when enough was drunk (``is_success``) and the cup has been taken away by 0.12 m and
    is upright within 15 degrees, or when it falls off the table. Truncated after 600 steps (12 s).

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | ``obs`` | ``"baseline"`` | preset: baseline, current, current_pred, history |
    | ``horizon`` | 2 | frames that current_pred looks ahead, 1 to 24 |
    | ``cameras`` | all three | any of top, angle, front_close, or one name; ``()`` for none |
    | ``image_size`` | (480, 640) | height and width |
    | ``render_size`` | None | height and width at which cameras are drawn, before the images are
    cropped about their centre and shrunk to ``image_size``; the same if None |
    | ``object_pose`` | False | show the cup's position |
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
    varying_geoms = (SLICE, DROP)

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        model = self.model
        self._cup_qpos = int(model.joint("cup").qposadr[0])
        self._cup_body = model.body("cup").id
        self._spout_site = model.site("spout").id
        is_cup = (model.geom_bodyid == self._cup_body) & (model.geom_contype != 0)
        self._cup_geoms = frozenset(np.flatnonzero(is_cup).tolist())
        links = [model.body(f"right/{side}_finger_link").id for side in ("left", "right")]
        # For each geom: bit 0 where it is of the left finger, bit 1 of the right.
        self._finger_bits = ((model.geom_bodyid == np.array(links)[:, None]).T @ [1, 2]).tolist()
        self._view = LiquidView(model)

    def add_objects(self, scene: mujoco.MjSpec) -> None:
        """Add the cup."""
        add_cup(scene)

    def reset_task(self, rng: np.random.Generator) -> None:
        """Put a full cup somewhere on the table in front of the head, its spout towards it."""
        self.progress, self.liquid = DrinkingProgress(), Liquid()
        self._clear_contacts()
        x, y = rng.uniform(CUP_LOW, CUP_HIGH)
        base_x, base_y, _ = ARM_BASES["right"][0]
        turn = np.arctan2(y - base_y, x - base_x) + rng.uniform(-CUP_TURN, CUP_TURN)
        pose = (x, y, BODY_HEIGHT / 2, np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
        self.data.qpos[self._cup_qpos : self._cup_qpos + 7] = pose
        up = np.array([0.0, 0.0, 1.0])
        self._view.show(self.model, surface_height(self.liquid.left, up), up, NO_DROPS)

    def object_position(self) -> NDArray[np.float64]:
        """(1, 3) m, world: middle of the body of the cup."""
        return self.data.xpos[self._cup_body][None].copy()

    @property
    def cup_position(self) -> NDArray[np.float64]:
        """(3,) m, world: middle of the body of the cup."""
        return self.data.xpos[self._cup_body].copy()

    @property
    def cup_axes(self) -> NDArray[np.float64]:
        """(3, 3) world from cup: columns towards the spout, across, and up along the body."""
        return self.data.xmat[self._cup_body].reshape(3, 3).copy()

    @property
    def spout_position(self) -> NDArray[np.float64]:
        """(3,) m, world: middle of the spout's opening."""
        return self.data.site_xpos[self._spout_site].copy()

    @property
    def tilt(self) -> float:
        """Angle between the cup's axis and the vertical, rad."""
        return float(np.arccos(np.clip(self.cup_axes[2, 2], -1.0, 1.0)))

    @property
    def mouth(self) -> Mouth:
        """The open mouth now."""
        axes = self.data.site_xmat[self._mouth_site].reshape(3, 3).copy()
        half_width, half_height = self.mouth_opening.tolist()
        return Mouth(self.mouth_position, axes, half_width, half_height)

    @property
    def face_force(self) -> float:
        """N, the largest normal force between robot or cup and the face in the last step."""
        return self._face_force

    @property
    def object_pose(self) -> NDArray[np.float64]:
        """(7,) position (m) and orientation (wxyz) of the cup, world."""
        return self.data.qpos[self._cup_qpos : self._cup_qpos + 7].copy()

    def simulate(self, action: NDArray[np.float32]) -> None:
        """Apply an action for one control period, and let liquid flow."""
        self._clear_contacts()
        super().simulate(action)
        self._pour()

    def advance(self) -> tuple[float, bool]:
        """Evaluate the task after a control step; return reward and whether it has ended."""
        before = self.progress
        self.progress = now = before.advance(self._measure())
        if now.lift_time is not None:
            self.start_motion()
        reward = float(now.is_success and not before.is_success)
        reward += float(now.is_success_strict and not before.is_success_strict)
        return reward, now.is_clear or bool(self.cup_position[2] < OFF_TABLE)

    def task_row(self) -> dict[str, Any]:
        """Return the present pose of the cup, and where its liquid went."""
        liquid = self.liquid
        shares = np.array([liquid.delivered_share, liquid.spilled_share])
        return {"object_pose": self.object_pose, "liquid": shares}

    def show_row(self, row: Mapping[str, NDArray[Any]]) -> None:
        """Show the liquid that was left, without a jet."""
        left, up = SERVING * max(1.0 - float(row["liquid"].sum()), 0.0), self.cup_axes[2]
        self._view.show(self.model, surface_height(left, up), up, NO_DROPS)

    def start_attributes(self) -> dict[str, Any]:
        """Return what `FaceEnv` does, and the cup's start."""
        return {**super().start_attributes(), "object_initial_pose": self.object_pose}

    def info(self) -> dict[str, Any]:
        """Return what the class docstring lists under Info."""
        progress, spout = self.progress, self.spout_position
        return {
            "is_success": progress.is_success,
            "is_success_strict": progress.is_success_strict,
            "mouth_position": self.mouth_position,
            "gripper_position": self.gripper_position,
            "spout_position": spout,
            "is_spout_inside": self.mouth.holds(spout),
            "is_touched": self._fingers_on_cup != 0,
            "delivered": self.liquid.delivered_share,
            "spilled": self.liquid.spilled_share,
            "tilt": self.tilt,
            "phase": progress.phase.name.lower(),
            "time_since_lift": progress.time_since_lift(self.time),
            "completion_time": progress.completion_time,
            "face_force": self.face_force,
        }

    def watch_contacts(self) -> None:
        """Record which fingers touch the cup, and how hard the face is touched."""
        if (pairs := self.touch.pairs) is not self._watched_pairs:  # the same ones add nothing
            self._watched_pairs, cup, bits = pairs, self._cup_geoms, self._finger_bits
            for first, second in pairs:
                if first in cup or second in cup:
                    self._fingers_on_cup |= bits[first] | bits[second]
        self._face_force = max(self._face_force, self.touch.robot_force)

    def _clear_contacts(self) -> None:
        self._fingers_on_cup = 0
        self._face_force = 0.0
        self._watched_pairs: list[list[int]] | None = None

    def _pour(self) -> None:
        """Let liquid flow for one control period, at the pose that the cup has now."""
        axes, up = self.cup_axes, self.cup_axes[2]
        surface, drops = surface_height(self.liquid.left, up), NO_DROPS
        speed = outflow_speed(surface, up)
        if speed > 0.0:
            tip, mouth = self.spout_position, self.mouth
            velocity = speed * self.data.site_xmat[self._spout_site].reshape(3, 3)[:, 0]
            drunk = is_drunk(tip, velocity, mouth)
            self.liquid = self.liquid.flow(speed, CONTROL_PERIOD, drunk)
            # As far as the lips, or on its way down; each step a little further along the jet.
            flight = (time_to_lips(tip, velocity, mouth) or 0.0) if drunk else FLIGHT
            share = (np.arange(DROPS) + 0.37 * self.step_count % 1.0) / DROPS
            drops = (jet_at(flight * share, tip, velocity) - self.cup_position) @ axes
        self._view.show(self.model, surface, up, drops)
        mujoco.mj_kinematics(self.model, self.data)

    def _measure(self) -> StepMeasurements:
        spout, axes = self.spout_position, self.cup_axes
        return StepMeasurements(
            time=self.time,
            is_held=self._fingers_on_cup == 0b11,
            lift=float(self.cup_position[2]) - BODY_HEIGHT / 2,
            liquid=self.liquid,
            face_force=self._face_force,
            spout_distance=float(np.linalg.norm(spout - self.mouth_position)),
            is_upright=bool(axes[2, 2] >= UPRIGHT),
        )
