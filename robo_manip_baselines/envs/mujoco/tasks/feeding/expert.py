"""Scripted experts that feed: Algorithm 1 of the paper, one that looks ahead, a visual servo."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mink
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN
from robo_manip_baselines.envs.mujoco.expert.phases import (
    DOWN,
    Approach,
    Command,
    ExpertPhase,
    ExpertView,
    Follow,
    Grip,
    PhasedExpert,
    Reach,
    level_at,
)
from robo_manip_baselines.envs.mujoco.expert.servo import (
    Execution,
    Forecast,
    Hold,
    Insert,
    ServoConfig,
    first_of,
)
from robo_manip_baselines.envs.mujoco.tasks.feeding import APPROACH_LIMIT
from robo_manip_baselines.envs.mujoco.tasks.feeding.env import FeedingEnv
from robo_manip_baselines.envs.mujoco.tasks.feeding.spoon import SPOON_FINGER, TOOL
from robo_manip_baselines.envs.mujoco.tasks.feeding.success import is_at_mouth
from robo_manip_baselines.observation import FRAME_PERIOD

GRASP_OFFSET = 0.03
"""m from the gripper site to the cube's centre, along the fingers. The fingers hold the rear of the
cube, so that its centre is at the lips when Algorithm 1's condition is met 0.03 m before them."""

CLEARANCE = 0.10
"""m above the cube at which the gripper waits before it descends."""

LIFT = 0.12
"""m straight up after the grasp, more than ``feeding_success.LIFT_HEIGHT``."""

STANDOFF = np.array([0.20, 0.0, 0.0])
"""m from where the mouth is to where the approach starts, level and straight in front of it."""

INSERTION = np.array([0.028, 0.0, 0.0])
"""m from the mouth to the gripper when it lets go: inside the 0.03 m of Algorithm 1, so that who
learns from it is shown a place where the condition holds, not its edge. The cube's centre is then
between the lips, 2 mm behind the mouth's centre, and the finger tips are 10 mm before it, at the
front of the lips."""

WITHDRAWAL = np.array([0.14, 0.0, 0.0])
"""m from the mouth to the gripper before it turns home."""

WAITING = 0.08
"""m before the mouth, along x, where the servo waits until it is in line: the cube is then 3 cm
before the lips."""

INSERTION_SPEED = 0.10
"""m/s along x, beside the motion of the mouth, at which the servo goes in."""

WITHDRAWAL_SPEED = 0.30
"""m/s, likewise, at which it goes out."""

SPOON_STANDOFF = np.array([0.12, 0.0, 0.0])
SPOON_INSERTION = np.array([-0.004, 0.0, 0.0])
SPOON_WITHDRAWAL = np.array([0.13, 0.0, 0.0])
"""m from the mouth to the middle of the spoon's bowl, likewise: nearer, for the arm is behind it;
and past the lips, so that they can close on the food."""

SPOON_WAITING = 0.06
"""m before the mouth where the servo waits with a spoon, whose bowl is 2 cm long."""

SPOON_TIME = 0.9
"""s in the mouth with a spoon: until the food is there, and the mouth has taken it."""

SPOON_SERVO = ServoConfig(tolerance=(0.030, 0.008, 0.008))
"""Settings of ``servo`` with a spoon."""

ANTICIPATION = 4 * FRAME_PERIOD
"""s by which ``anticipatory`` looks ahead."""


def reactive(env: FeedingEnv) -> FeedingExpert:
    """Make Algorithm 1 as published."""
    return FeedingExpert(env)


def anticipatory(env: FeedingEnv) -> FeedingExpert:
    """Make the expert that knows the recorded future, and aims there."""
    return FeedingExpert(env, lead=ANTICIPATION)


def servo(env: FeedingEnv) -> FeedingServo:
    """Make the visual servo that aims by its own lag ahead of the true mouth."""
    return FeedingServo(env)


def pick_up(orientation: mink.SO3 = DOWN, depth: float = GRASP_OFFSET) -> list[ExpertPhase]:
    """Return the phases that take the cube from the table and lift it.

    Args:
        orientation: world from gripper, which points down.
        depth: m from the gripper site down to the cube's centre.
    """

    def over_object(view: ExpertView, height: float) -> Command:
        position = view.object_position + np.array([0.0, 0.0, height])
        return Command(position, orientation, FINGER_OPEN)

    def lifted(view: ExpertView, last: Command) -> Command:
        return replace(last, position=last.position + np.array([0.0, 0.0, LIFT]))

    return [
        Reach(lambda view, last: over_object(view, depth + CLEARANCE)),
        Reach(lambda view, last: over_object(view, depth), speed=0.15),
        Grip(FINGER_CLOSED, 0.4),
        Reach(lifted, speed=0.2),
    ]


def bring(place: Callable[[ExpertView], NDArray[np.float64]]) -> Reach:
    """Return the phase that brings the gripper, level, to a place (3,) m."""

    def brought(view: ExpertView, last: Command) -> Command:
        position = place(view)
        return Command(position, level_at(position), last.finger)

    return Reach(brought, least_duration=1.2)


class FeedingExpert(PhasedExpert):
    """Scripted expert of Algorithm 1.

    Args:
        env: the environment, unwrapped.
        lead: s; it aims where the mouth will be this much later.
        limit: s since the approach may begin, after which it should be at the mouth.
    """

    def __init__(
        self, env: FeedingEnv, lead: float = 0.0, *, limit: float = APPROACH_LIMIT
    ) -> None:
        if env.meal:
            super().__init__(home=env.start_qpos, finger=SPOON_FINGER, tool=TOOL)
        else:
            super().__init__()
        self._env, self._lead, self._limit = env, lead, limit

    def view(self) -> ExpertView:
        """Return the present state."""
        env, mouth = self._env, self._env.mouth_track
        return ExpertView(
            target_track=mouth,
            object_position=env.cube_position,
            elapsed=env.progress.time_since_lift(env.time),
            is_at_target=is_at_mouth(env.utensil_position, mouth[0]),
            time=env.time,
            gripper_position=env.utensil_position,
        )

    def phases(self, home: Command) -> list[ExpertPhase]:
        """Return the phases of one episode, in order."""
        # Phase 1: approach and grasp the cube, unless food is on a spoon.
        fetch = [] if self._env.meal else pick_up()
        return [*fetch, bring(self.standoff), *self.delivery(home)]

    def standoff(self, view: ExpertView) -> NDArray[np.float64]:
        """Return where the approach to the mouth starts, (3,) m, world."""
        return view.target() + (SPOON_STANDOFF if self._env.meal else STANDOFF)

    def delivery(self, home: Command) -> list[ExpertPhase]:
        """Return the phases from there on: to the mouth, let go, and home."""
        if self._env.meal:
            return [
                Approach(limit=self._limit, lead=self._lead),
                Follow(SPOON_INSERTION, SPOON_TIME, lead=self._lead),
                Follow(SPOON_WITHDRAWAL, 0.8, lead=self._lead, speed=0.3),
                Reach(lambda view, last: home),
            ]
        return [
            # Phase 2: move towards the mouth.
            Approach(limit=self._limit, lead=self._lead),
            # Phase 3: insert the cube into the mouth, let go, retract.
            Follow(INSERTION, 0.4, lead=self._lead),
            Follow(INSERTION, 0.3, finger=FINGER_OPEN, lead=self._lead),
            Follow(WITHDRAWAL, 0.6, lead=self._lead, speed=0.3),
            Reach(lambda view, last: home),
        ]


LIFTED, BROUGHT, INSERTED, WITHDRAWN = 4, 5, 6, 8
"""Phases of a `FeedingServo` that are done when it has lifted the cube, brought it before the
mouth, ended the insertion, and withdrawn."""


class FeedingServo(FeedingExpert):
    """Visual servo that feeds: it fetches the cube as Algorithm 1 does and then tracks the mouth.

    Args:
        env: the environment, unwrapped.
        config: lead, delay and limits of the servo.
        forecast: source of the mouth; what the environment observes, or else the truth, if None.
        execution: of its plans, from the insertion on.
    """

    goes_by_observation = True

    def __init__(
        self,
        env: FeedingEnv,
        config: ServoConfig | None = None,
        forecast: Forecast | None = None,
        execution: Execution = first_of,
    ) -> None:
        super().__init__(env)
        usual = SPOON_SERVO if env.meal else ServoConfig()
        self._config = usual if config is None else config
        self._forecast = env.forecast_mouth if forecast is None else forecast
        self._execution = execution

    def branch(
        self,
        number: int,
        config: ServoConfig,
        forecast: Forecast,
        execution: Execution = first_of,
    ) -> FeedingServo:
        """Return a servo with other settings that goes on from here with the phase ``number``."""
        other = copy.copy(self)
        other._config, other._forecast, other._execution = config, forecast, execution
        other.skip_to(number)
        return other

    def standoff(self, view: ExpertView) -> NDArray[np.float64]:
        """Return where the approach to the mouth starts, (3,) m, world."""
        return self._seen(view) + (SPOON_STANDOFF if self._env.meal else STANDOFF)

    def delivery(self, home: Command) -> list[ExpertPhase]:
        """Return the phases from there on: to the mouth, let go, and home."""
        forecast, config = self._forecast, self._config
        has_spoon = self._env.meal is not None
        inside = float((SPOON_INSERTION if has_spoon else INSERTION)[0])
        out = float((SPOON_WITHDRAWAL if has_spoon else WITHDRAWAL)[0])
        coming: Any = {"goal": inside, "rate": INSERTION_SPEED, "execution": self._execution}
        going: Any = {"goal": out, "rate": WITHDRAWAL_SPEED, "execution": self._execution}
        if has_spoon:
            return [
                Insert(forecast, config, **coming, waiting=SPOON_WAITING),
                Hold(forecast, config, **coming, duration=SPOON_TIME),
                Hold(forecast, config, **going, duration=0.8),
                Reach(lambda view, last: home),
            ]
        return [
            Insert(forecast, config, **coming, waiting=WAITING),
            Hold(forecast, config, **coming, duration=0.3, finger=FINGER_OPEN),
            Hold(forecast, config, **going, duration=0.5),
            Reach(lambda view, last: home),
        ]

    def _seen(self, view: ExpertView) -> NDArray[np.float64]:
        """Return the newest mouth seen, (3,) m."""
        return self._forecast(view.time - self._config.delay * FRAME_PERIOD, 0.0)
