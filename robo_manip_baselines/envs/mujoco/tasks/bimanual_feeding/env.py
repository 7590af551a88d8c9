"""BimanualFeedingEnv: fetch a cube with one hand, pass it to the other, bring it to the mouth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding import ENTRY
from robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding.success import Handover, Hands
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import Phase, StepMeasurements

CUBE_LOW = np.array([-0.44, 0.17])
CUBE_HIGH = np.array([-0.34, 0.27])
"""m, world x and y between which the cube starts: beside the left arm's base. It is 0.84 m or more
from the right arm's shoulder, which reaches 0.80 m with its finger tips."""

LEFT_HOME_QPOS = (-1.3, *HOME_QPOS[1:])
"""rad, the left arm at home but turned away from the head, towards the cube."""


class BimanualFeedingEnv(FeedingEnv):
    """Fetch a cube with the left hand, pass it to the right one, and bring it to a moving mouth.

    `FeedingEnv` with the cube out of the right arm's reach, beside the left arm's base, and without
    a left arm that could reach the mouth past the head: one arm cannot do it. Units, frames and
    rate are those of `FeedingEnv`.

    ## Action space

    ``Box(14,)`` float32, targets of the position servos of both arms, left arm first. Values
    outside the bounds are clipped to them.

    | num | action | min | max | joint | unit |
    |---|---|---|---|---|---|
    | 0, 7 | waist | -pi | pi | left/waist, right/waist | rad |
    | 1, 8 | shoulder | -1.850 | 1.257 | .../shoulder | rad |
    | 2, 9 | elbow | -1.763 | 1.606 | .../elbow | rad |
    | 3, 10 | forearm roll | -pi | pi | .../forearm_roll | rad |
    | 4, 11 | wrist angle | -1.868 | 2.234 | .../wrist_angle | rad |
    | 5, 12 | wrist rotate | -pi | pi | .../wrist_rotate | rad |
    | 6, 13 | gripper, position of a finger | 0.021 (closed) | 0.057 (open) | .../left_finger | m |

    ## Observation space

    That of `FeedingEnv` with ``arms="both"``: ``state`` is (28,), the left arm's 14 elements first.
    Distances are those from the right gripper to the mouth.

    ## Reward

    1 on the step that first meets ``is_success``, and 1 on the step that first meets
    ``is_success_strict``; 0 otherwise.

    ## Starting state

    The right arm at home, the left arm at home but turned by -1.3 rad, towards the cube; both
    grippers open. The cube's centre is uniform in x -0.44 ... -0.34 and y 0.17 ... 0.27, on the
    table. Mouth and motion are drawn as in `FeedingEnv`.

    The mouth moves for 12 s, which is as long as an episode lasts: from the start
    (``face_motion="episode"``) or from the moment at which the left hand has lifted the cube
    (``face_motion="after_lift"``). It never comes to rest within an episode.

    ## Info

    That of `FeedingEnv`, and

    | key | type | content |
    |---|---|---|
    | ``is_success`` | bool | after a hand-over, Algorithm 1's condition has been met with the cube
    held by the right gripper: gripper and mouth less than 0.03 m apart along x, 0.01 m along y,
    0.01 m along z |
    | ``is_success_strict`` | bool | ``is_success``, and the cube was let go, for the first time
    since the lift, with its centre inside the mouth opening; since the lift neither arm has touched
    lips, face or shoulders |
    | ``phase`` | str | reach, grasp, pass (lifted, and not yet in the right gripper alone), carry,
    deliver or release |
    | ``handover_time`` | float or None | s from the lift until the right gripper alone held the
    cube; None before, and without a hand-over in the air |

    Either hand may lift the cube. A cube that was dropped before the hand-over and picked up again
    cannot be handed over any more.

    ## Episode end

    Terminates when the cube was delivered (``is_success``) and let go and the right gripper has
    withdrawn by 0.12 m, or when the cube falls off the table. Truncated after 600 steps (12 s).

    ## Arguments

    Those of `FeedingEnv`, except

    | name | default | meaning |
    |---|---|---|
    | ``arms`` | ``"both"`` | both; ``"right"`` is refused |
    | ``utensil`` | ``"gripper"`` | gripper; ``"spoon"`` is refused |

    Raises ``RequestError``, a ``ValueError``, when an argument, a seed (0 to 2⁵³ - 1) or an option
    of ``reset`` (there are none) is not valid.

    ## Version history

    - v0: first release.
    """

    task = ENTRY
    phase_names = ("reach", "grasp", "pass", "carry", "deliver", "release")

    def __init__(self, *, arms: str = "both", **kwargs: Any) -> None:
        super().__init__(arms=arms, **kwargs)

    def reset_task(self, rng: np.random.Generator) -> None:
        """Put the cube somewhere on the table beside the left arm, which is ready for it."""
        super().reset_task(rng)
        self.handover = Handover()
        self._set_arm("left", LEFT_HOME_QPOS, FINGER_OPEN)

    def draw_cube(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw where the cube starts, (2,) m, world x and y."""
        return rng.uniform(CUBE_LOW, CUBE_HIGH)

    def advance(self) -> tuple[float, bool]:
        """Evaluate the task after a control step; return reward and whether it has ended."""
        progress = self.progress
        is_carried = progress.lift_time is not None and progress.release_time is None
        self.handover = self.handover.advance(self.time, self._hands(), is_carried=is_carried)
        return super().advance()

    def info(self) -> dict[str, Any]:
        """Return what the class docstring lists under Info."""
        progress, time, info = self.progress, self.handover.time, super().info()
        if progress.phase is Phase.CARRY and time is None:
            info["phase"] = "pass"
        return {**info, "handover_time": None if time is None else progress.time_since_lift(time)}

    def _hands(self) -> Hands:
        return Hands(self._fingers_on("left"), self._fingers_on("right"))

    def _measure(self) -> StepMeasurements:
        """Return the measurements of feeding, where either hand may hold the cube.

        Only the right one brings it to the mouth, and only after a hand-over.
        """
        step, hands = super()._measure(), self._hands()
        is_brought = hands.right == 2 and self.handover.time is not None
        return replace(
            step,
            is_held=hands.is_held,
            is_touched=hands != Hands(),
            is_at_mouth=step.is_at_mouth and is_brought,
        )
