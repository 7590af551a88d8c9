"""ChinTouchEnv: touch the chin of a person who moves with the closed gripper."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from chin_touch import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv

CHIN = 199
"""Landmark of the face in the middle of the chin."""

FINGER_LENGTH = 0.018
"""m from the site ``right/gripper`` to the finger tips."""

CLOSED = 0.03
"""m, position of a finger below which the gripper is closed."""

TOLERANCE = 0.01
"""m between finger tips and chin within which the chin is touched."""

GENTLE_FORCE = 5.0
"""N up to which a touch is gentle."""

CLEAR_DISTANCE = 0.10
"""m between finger tips and chin from which the gripper has withdrawn."""


class ChinTouchEnv(FaceEnv):
    """Touch the chin of a head that moves as a person moved.

    Action space, observation space (with ``chin`` in place of ``mouth``) and arguments are those of
    `FeedingEnv`, without ``object_pose``.

    ## Reward

    1 on the step that first meets ``is_success``; 0 otherwise.

    ## Starting state

    The right arm at home with an open gripper, the left arm folded; face and motion are drawn from
    ``reset(seed=...)`` as `FeedingEnv` does.

    ## Info

    | key | type | content |
    |---|---|---|
    | ``is_success`` | bool | the tips of the closed fingers have come within 0.01 m of the chin |
    | ``is_success_strict`` | bool | ``is_success``, and no force on the face has exceeded 5 N |
    | ``completion_time`` | float or None | s from the start to ``is_success``; None before |
    | ``phase`` | str | approach or withdraw |
    | ``chin_distance`` | float | m between finger tips and chin |
    | ``face_force`` | float | N, the largest normal force between robot and face in the step |

    ## Episode end

    Terminates when the chin was touched and the gripper has withdrawn by 0.10 m. Truncated after
    400 steps (8 s).

    ## Version history

    - v0: first release.
    """

    task = ENTRY
    phase_names = ("approach", "withdraw")

    def reset_task(self, rng: np.random.Generator) -> None:
        """Forget the episode before."""
        self._force = self._largest_force = 0.0
        self._touch_time: float | None = None

    def target_track(self) -> NDArray[np.float64]:
        """(K, 3) m, world: the true chin now and 1 ... 24 frames ahead."""
        return self.landmark_track(CHIN)

    @property
    def chin_distance(self) -> float:
        """m between finger tips and chin."""
        forward = self.data.site("right/gripper").xmat.reshape(3, 3)[:, 0]
        tips = self.gripper_position + FINGER_LENGTH * forward
        return float(np.linalg.norm(tips - self.target_track()[0]))

    @property
    def is_closed(self) -> bool:
        """The right gripper is closed."""
        return bool(self.data.joint("right/left_finger").qpos[0] < CLOSED)

    def simulate(self, action: NDArray[Any]) -> None:
        """Apply an action for one control period, recording the force on the face."""
        self._force = 0.0
        super().simulate(action)

    def watch_contacts(self) -> None:
        """Record how hard the robot touches the face."""
        self._force = max(self._force, self.max_face_force())

    def advance(self) -> tuple[float, bool]:
        """Evaluate the task after a control step; return reward and whether it has ended."""
        self.start_motion()
        self._largest_force = max(self._largest_force, self._force)
        distance, reward = self.chin_distance, 0.0
        if self._touch_time is None and self.is_closed and distance < TOLERANCE:
            self._touch_time, reward = self.time, 1.0
        return reward, self._touch_time is not None and distance >= CLEAR_DISTANCE

    def info(self) -> dict[str, Any]:
        """Return what the class docstring lists under Info."""
        is_touched = self._touch_time is not None
        return {
            "is_success": is_touched,
            "is_success_strict": is_touched and self._largest_force <= GENTLE_FORCE,
            "completion_time": self._touch_time,
            "phase": "withdraw" if is_touched else "approach",
            "chin_distance": self.chin_distance,
            "face_force": self._force,
        }

    def task_row(self) -> dict[str, Any]:
        """Return the present value of the field that the task adds to episode files."""
        return {"chin_position": self.target_track()}
