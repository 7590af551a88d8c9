"""FeedingGoalEnv: feeding as a goal-conditioned environment, for reinforcement learning.

Legend: ... any leading shape.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import mink
import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import MOUTH_BASE
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.envs.mujoco.expert.kinematics import ArmKinematics
from robo_manip_baselines.envs.mujoco.expert.phases import level_at
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import OFF_TABLE, FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import GRASP_OFFSET
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import MOUTH_TOLERANCE
from robo_manip_baselines.observation import ARM_JOINTS, FRAME_PERIOD
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.extras import install_command
from robo_manip_baselines.runs.ranges import MAX_SEED
from robo_manip_baselines.runs.seeds import stream_generator

try:
    from gymnasium_robotics.core import GoalEnv
except ImportError as error:
    raise RequestError(
        f"FeedingGoalEnv needs gymnasium-robotics ({error}); run: {install_command('rl')}"
    ) from None

REWARDS = ("sparse", "dense")
"""-1 away from the goal and 0 at it; minus the distance from it in m."""

STARTS = ("table", "grasped")
"""The cube lies on the table; it is in the gripper, before the face."""

ACTIONS = ("delta", "target")
"""Changes of the targets of the servos, normalised; the targets, as `FeedingEnv` takes them."""

MAX_TURN = 0.04
"""rad by which an action changes a joint's target, at most: 2 rad/s."""

MAX_GRIP = 0.0012
"""m by which an action changes a finger's target, at most: 0.6 s from open to closed."""

START_DISTANCE = (0.15, 0.25)
"""m along x between which a grasped start is before the middle of the places of the mouth."""

START_SPREAD = 0.08
"""m along y and z, likewise: the face is within 0.05 m of that middle, and moves."""

_PARTS = {
    "joint_position": ARM_JOINTS,
    "joint_velocity": ARM_JOINTS,
    "gripper": ("position", "velocity"),
    "gripper_position": ("x", "y", "z"),
    "cube_from_gripper": ("x", "y", "z"),
    "mouth_velocity": ("x", "y", "z"),
    "target": (*ARM_JOINTS, "gripper"),
}
"""Parts of ``observation`` and their elements; the gripper has no target in a grasped start."""

_BOUNDS = {"joint_position": 2 * np.pi, "target": 2 * np.pi, "joint_velocity": 100.0}
"""rad, rad, rad/s: bounds of these parts, wide enough for whatever physics may do; 5 of others."""


class FeedingGoalEnv(GoalEnv):
    """Bring the cube to the mouth, goal-conditioned: gymnasium-robotics' `GoalEnv`.

    The world is that of `FeedingEnv`; its docstring describes cell, face and motion. The achieved
    goal is the centre of the cube, the desired goal the centre of the mouth, which moves. Reward,
    termination and truncation depend on these two alone, so that hindsight replay can compute them
    for any other goal.

    ## Action space

    ``Box(n,)`` float32, right arm: n = 7, the six joints and the gripper, with ``start="table"``;
    n = 6, the joints, with ``start="grasped"``, where the gripper stays closed.

    | ``action`` | range | meaning |
    |---|---|---|
    | ``"delta"`` | -1 ... 1 | change of the servos' targets, which stay within the joints' limits:
    at 1, 0.04 rad of a joint and 0.0012 m of a finger |
    | ``"target"`` | as `FeedingEnv` | the targets, rad and m |

    ## Observation space

    A ``Dict`` of float32 vectors. ``env.unwrapped.observation_names`` names every element.

    | key | shape | content |
    |---|---|---|
    | ``observation`` | (30,) or (29,) | joint positions (6, rad) and velocities (6, rad/s), gripper
    position (m) and velocity (m/s), place of the gripper (3, m), cube from gripper (3, m), velocity
    of the mouth (3, m/s, over the last 1/30 s), targets of the servos (n, rad and m) |
    | ``achieved_goal`` | (3,) | centre of the cube, m |
    | ``desired_goal`` | (3,) | centre of the mouth, m |

    ## Reward

    | ``reward`` | away from the goal | at the goal |
    |---|---|---|
    | ``"sparse"`` | -1 | 0 |
    | ``"dense"`` | minus the distance from cube to mouth, m | likewise |

    The cube is at the goal while it is nearer to the mouth than ``tolerance`` along x, y and z; by
    default the spatial condition of Algorithm 1, asked of the cube. The face may be touched;
    ``info`` holds the force.

    ## Starting state

    That of `FeedingEnv`; the motion of the face begins at once. With ``start="grasped"`` the closed
    gripper holds the cube, level, 0.15 to 0.25 m before the middle of the places of the mouth and
    up to 0.08 m beside, above or below it.

    ## Info

    | key | type | content |
    |---|---|---|
    | ``is_success`` | bool | the cube is at the goal |
    | ``distance`` | float | m from cube to mouth |
    | ``face_force`` | float | N, the largest normal force between robot and face in the step |

    ## Episode end

    Terminates at the goal with ``continuing=False``, and never by default: who is there should stay
    there, as the mouth moves. Truncated when the cube has fallen off the table, and after 600 steps
    (12 s). A fall is no termination since every step costs: to drop the cube would pay.

    ## Arguments

    | name | default | meaning |
    |---|---|---|
    | ``reward`` | ``"sparse"`` | sparse or dense |
    | ``start`` | ``"table"`` | table or grasped |
    | ``action`` | ``"delta"`` | delta or target |
    | ``tolerance`` | (0.03, 0.01, 0.01) | m along x, y and z, or one number for all |
    | ``continuing`` | True | go on at the goal |
    | ``motion``, ``people``, ``clips``, ``motion_library``, ``motion_sha256`` | as `FeedingEnv` |
    motion of the face |
    | ``render_size`` | (480, 640) | height and width of ``render()`` |
    | ``render_mode`` | None | rgb_array or human |

    Raises ``RequestError``, a ``ValueError``, when an argument or a seed is not valid.

    ## Version history

    - v0: first release.
    """

    metadata: dict[str, Any] = FeedingEnv.metadata

    def __init__(
        self,
        *,
        reward: str = "sparse",
        start: str = "table",
        action: str = "delta",
        tolerance: float | Sequence[float] = tuple(MOUTH_TOLERANCE.tolist()),
        continuing: bool = True,
        motion: str | Mapping[str, Any] | Sequence[Any] = "recorded",
        people: str = "all",
        clips: str | Sequence[str] | None = None,
        motion_library: str | Path | None = None,
        motion_sha256: str | None = None,
        render_size: tuple[int, int] = (480, 640),
        render_mode: str | None = None,
        **unknown: Any,
    ) -> None:
        for name in unknown:
            require_choice("argument", name, set(inspect.signature(type(self)).parameters))
        self.reward = require_choice("reward", reward, REWARDS)
        self.start = require_choice("start", start, STARTS)
        self.action = require_choice("action", action, ACTIONS)
        self.tolerance = _checked_tolerance(tolerance)
        self.continuing = continuing
        self.feeding = FeedingEnv(
            cameras=(),
            image_size=render_size,
            motion=motion,
            people=people,
            clips=clips,
            motion_library=motion_library,
            motion_sha256=motion_sha256,
            render_mode=render_mode,
        )
        self.render_mode = render_mode
        is_grasped = self.start == "grasped"
        self._size = len(ARM_JOINTS) + (not is_grasped)
        bounds = self.feeding.action_space
        assert isinstance(bounds, gymnasium.spaces.Box)
        self._low, self._high = bounds.low, bounds.high
        one = np.ones(self._size, dtype=np.float32)
        self.action_space = (
            gymnasium.spaces.Box(-one, one)
            if self.action == "delta"
            else gymnasium.spaces.Box(self._low[: self._size], self._high[: self._size])
        )
        self._scale = np.array([MAX_TURN] * len(ARM_JOINTS) + [MAX_GRIP])[: self._size]
        parts = {**_PARTS, "target": _PARTS["target"][: self._size]}
        self.observation_names = [
            f"{part}_{name}" for part, names in parts.items() for name in names
        ]
        high = np.concatenate(
            [np.full(len(n), _BOUNDS.get(part, 5.0)) for part, n in parts.items()]
        )
        goal = np.full(3, 5.0, dtype=np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            observation=gymnasium.spaces.Box(-high.astype(np.float32), high.astype(np.float32)),
            achieved_goal=gymnasium.spaces.Box(-goal, goal),
            desired_goal=gymnasium.spaces.Box(-goal, goal),
        )

    @property
    def model(self) -> mujoco.MjModel:
        """MuJoCo's model of the cell."""
        return self.feeding.model

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's state of it."""
        return self.feeding.data

    def reset(  # type: ignore[override]  # the return type of GoalEnv's is not declared
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        """Start an episode; every random choice comes from ``seed``.

        Raises:
            RequestError: the seed or an option is not valid.
        """
        self.feeding.reset(seed=seed, options=options)
        super().reset(seed=seed)
        self._target = np.array([*HOME_QPOS, FINGER_OPEN])
        if self.start == "grasped":
            drawn = int(self.feeding.np_random.integers(MAX_SEED)) if seed is None else seed
            rng = stream_generator(drawn, "grasped start")
            away = rng.uniform(
                *np.transpose([START_DISTANCE, *[(-START_SPREAD, START_SPREAD)] * 2])
            )
            self._target[:6] = reach_level(np.array(MOUTH_BASE) + away)
            self._target[6] = FINGER_CLOSED
            self.feeding.hold_cube(self._target[:6], GRASP_OFFSET)
        observation = self._observe()
        return observation, self._info(observation)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, NDArray[np.float32]], float, bool, bool, dict[str, Any]]:
        """Move for 0.02 s.

        Raises:
            ValueError: the action has the wrong shape or is not finite.
        """
        moved = np.asarray(action, dtype=np.float64)
        if moved.shape != (self._size,):
            raise ValueError(f"action of shape {moved.shape}: must be ({self._size},) numbers")
        if self.action == "delta":
            moved = self._target[: self._size] + self._scale * np.clip(moved, -1.0, 1.0)
        target = np.clip([*moved, *self._target[self._size :]], self._low, self._high)
        self.feeding.step(target)
        self._target = target
        observation = self._observe()
        info = self._info(observation)
        goals = observation["achieved_goal"], observation["desired_goal"]
        return (
            observation,
            float(self.compute_reward(*goals, info)),
            bool(self.compute_terminated(*goals, info)),
            bool(self.compute_truncated(*goals, info)),
            info,
        )

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """Return the reward, (...), of goals (..., 3) m; ``info`` is not read."""
        if self.reward == "dense":
            return -np.linalg.norm(_difference(achieved_goal, desired_goal), axis=-1)
        return self.is_at_goal(achieved_goal, desired_goal) - 1.0

    def compute_terminated(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> Any:
        """Return, (...) bool, whether goals (..., 3) m end an episode; ``info`` is not read."""
        return self.is_at_goal(achieved_goal, desired_goal) & (not self.continuing)

    def compute_truncated(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any
    ) -> Any:
        """Return, (...) bool, whether the cube (..., 3) m has fallen; ``info`` is not read."""
        return np.asarray(achieved_goal)[..., 2] < OFF_TABLE

    def is_at_goal(self, achieved_goal: ArrayLike, desired_goal: ArrayLike) -> Any:
        """Return, (...) bool, whether the cube is nearer to the mouth than the tolerance."""
        return np.all(np.abs(_difference(achieved_goal, desired_goal)) < self.tolerance, axis=-1)

    def render(self) -> NDArray[np.uint8] | None:
        """Return the view of the camera ``angle``, (H, W, 3) uint8; None in ``human``."""
        return self.feeding.render()

    def close(self) -> None:
        """Free the OpenGL context, and close the viewer; may be called again."""
        self.feeding.close()

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        feeding, state = self.feeding, self.feeding.state()
        mouth, cube = state.target_position[0], state.object_position[0]
        gripper = state.end_effector_position
        before = feeding.mouth_at(feeding.time - FRAME_PERIOD)
        parts = (
            state.joint_position[0],
            state.joint_velocity[0],
            state.gripper_position,
            state.gripper_velocity,
            gripper,
            cube - gripper,
            (mouth - before) / FRAME_PERIOD,
            self._target[: self._size],
        )
        return {
            "observation": np.concatenate(parts).astype(np.float32),
            "achieved_goal": cube.astype(np.float32),
            "desired_goal": mouth.astype(np.float32),
        }

    def _info(self, observation: Mapping[str, NDArray[np.float32]]) -> dict[str, Any]:
        cube, mouth = observation["achieved_goal"], observation["desired_goal"]
        return {
            "is_success": bool(self.is_at_goal(cube, mouth)),
            "distance": float(np.linalg.norm(_difference(cube, mouth))),
            "face_force": self.feeding.face_force,
        }


def reach_level(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the joints (6,) rad of the right arm with its gripper level at (3,) m, world."""
    pose = mink.SE3.from_rotation_and_translation(level_at(position), position)
    return ArmKinematics("right").inverse(pose, np.array(HOME_QPOS))


def _difference(achieved_goal: ArrayLike, desired_goal: ArrayLike) -> NDArray[np.float64]:
    """Return goals (..., 3) m from one another, the same for one pair and for many."""
    return np.subtract(achieved_goal, desired_goal, dtype=np.float64)


def _checked_tolerance(given: Any) -> NDArray[np.float64]:
    """Return a tolerance as (3,) m.

    Raises:
        RequestError: it is not one number or three, or not positive.
    """
    try:
        tolerance = np.broadcast_to(np.asarray(given, dtype=np.float64), (3,)).copy()
    except (TypeError, ValueError):
        tolerance = np.zeros(3)
    if not (np.isfinite(tolerance) & (tolerance > 0)).all():
        raise RequestError(f"tolerance {given!r}: must be one positive number or three, in m")
    return tolerance
