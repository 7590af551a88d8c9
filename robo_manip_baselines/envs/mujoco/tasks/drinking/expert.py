"""Scripted experts that let a person drink: one follows the mouth now, one ahead of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mink
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN
from robo_manip_baselines.envs.mujoco.expert.phases import (
    Command,
    ExpertPhase,
    ExpertView,
    Follow,
    Grip,
    PhasedExpert,
    Reach,
    level_at,
)
from robo_manip_baselines.envs.mujoco.expert.servo import Forecast, Hold, Insert, ServoConfig
from robo_manip_baselines.envs.mujoco.tasks.drinking.env import DrinkingEnv
from robo_manip_baselines.envs.mujoco.tasks.drinking.liquid import SPOUT_TIP
from robo_manip_baselines.observation import FRAME_PERIOD

GRASP_PITCH = 0.10
"""rad, the gripper's nose down while it holds the upright cup: level, the wrist would be at its
limit over cups near the base; steeper, the arm would not reach a far mouth with a tilted cup."""

GRASP_HEIGHT = 0.008
"""m, of the gripper above the middle of the cup: nearer to the table its bar would scrape."""

CLEARANCE = 0.10
"""m above the cup at which the gripper waits before it descends."""

LIFT = 0.12
"""m straight up after the grasp, more than ``success.LIFT_HEIGHT``."""

STANDOFF = np.array([0.10, 0.0, 0.0])
"""m from the mouth to the spout where the approach starts, straight in front of it."""

AT_LIPS = np.array([-0.004, 0.0, 0.0])
"""m from the mouth to the spout while the person drinks: 14 mm past the front of the lips, in the
middle of where it delivers."""

AWAY = np.array([0.16, 0.0, 0.0])
"""m from the mouth to the spout at the end."""

WAITING = 0.03
"""m before the mouth where the servo waits until it is in line: 2 cm before the lips."""

INSERTION_SPEED = 0.12
WITHDRAWAL_SPEED = 0.25
"""m/s along x, beside the motion of the mouth, at which the spout comes and goes."""

DRINKING_TIME = 3.4
"""s at the lips, while the cup tilts: until it is empty, and some tenths more."""

SERVO = ServoConfig(tolerance=(0.010, 0.010, 0.010), limit=4.0)
"""Settings of ``servo``: it tilts the cup when the spout is within 10 mm of its place."""

READY_TILT = 0.28
"""rad, of the cup on the way to the lips: a full one pours from 0.33 rad on."""

POUR_TILT = 0.80
"""rad, at which the cup is empty."""

POUR_RATE = 0.20
"""rad/s of the tilt while the person drinks, who then gets about 13 ml/s; healthy adults drink
water at 10 ml/s and more (Hughes and Wiles 1996)."""

TURN_RATE = 0.8
"""rad/s of the tilt at other times."""

SPOUT_IN_GRIPPER = mink.SO3.from_y_radians(-GRASP_PITCH).apply(
    SPOUT_TIP - np.array([0.0, 0.0, GRASP_HEIGHT])
)
"""(3,) m, tip of the spout in the frame of the gripper that holds the cup."""


def reactive(env: DrinkingEnv) -> DrinkingExpert:
    """Make the expert that follows the mouth as it is now."""
    return DrinkingExpert(env)


def servo(env: DrinkingEnv) -> DrinkingServo:
    """Make the visual servo that aims by its own lag ahead of the true mouth."""
    return DrinkingServo(env)


def holding(spout: NDArray[np.float64], tilt: float, finger: float) -> Command:
    """Return the pose of a gripper that holds the cup.

    Args:
        spout: (3,) m, world, of the tip of the spout.
        tilt: rad, of the cup towards the spout.
        finger: m.
    """
    orientation = level_at(spout) @ mink.SO3.from_y_radians(GRASP_PITCH + tilt)
    return Command(spout - orientation.apply(SPOUT_IN_GRIPPER), orientation, finger)


def spout_of(gripper: Command) -> NDArray[np.float64]:
    """Return (3,) m, world: the tip of the spout of the cup that a gripper holds."""
    return gripper.position + gripper.orientation.apply(SPOUT_IN_GRIPPER)


class Tilted:
    """A phase that leads the tip of the spout, while the cup is tilted about it.

    Args:
        phase: gives commands for the tip in place of the gripper.
        tilt: rad, to which the cup is turned.
        rate: rad/s.
    """

    def __init__(self, phase: ExpertPhase, tilt: float, rate: float = TURN_RATE) -> None:
        self._phase, self._goal, self._turn = phase, tilt, rate * CONTROL_PERIOD

    def start(self, view: ExpertView, last: Command) -> None:
        """Start from the tilt and the spout of the last command."""
        forward = last.orientation.as_matrix()[:, 0]
        self._tilt = -float(np.arcsin(np.clip(forward[2], -1.0, 1.0))) - GRASP_PITCH
        self._phase.start(view, replace(last, position=spout_of(last)))

    def step(self, view: ExpertView) -> Command:
        """Lead the spout as the phase does, and come nearer to the tilt."""
        self._tilt += float(np.clip(self._goal - self._tilt, -self._turn, self._turn))
        spout = self._phase.step(view)
        return holding(spout.position, self._tilt, spout.finger)

    def is_done(self, view: ExpertView) -> bool:
        """Done when the phase is."""
        return self._phase.is_done(view)


class DrinkingExpert(PhasedExpert):
    """Scripted expert that takes the cup, follows the mouth and tilts the cup at the lips.

    Args:
        env: the environment, unwrapped.
    """

    def __init__(self, env: DrinkingEnv) -> None:
        super().__init__()
        self._env = env

    def view(self) -> ExpertView:
        """Return the present state; what is led to the target is the spout."""
        env = self._env
        return ExpertView(
            target_track=env.mouth_track,
            object_position=env.cup_position,
            time=env.time,
            gripper_position=env.spout_position,
        )

    def phases(self, home: Command) -> list[ExpertPhase]:
        """Return the phases of one episode, in order."""
        return [
            *self.fetch(),
            Tilted(Follow(AT_LIPS, 1.2, speed=INSERTION_SPEED), READY_TILT),
            Tilted(Follow(AT_LIPS, DRINKING_TIME), POUR_TILT, POUR_RATE),
            Tilted(Follow(AT_LIPS, 0.4), READY_TILT),
            Tilted(Follow(AWAY, 1.2, speed=WITHDRAWAL_SPEED), 0.0),
        ]

    def fetch(self) -> list[ExpertPhase]:
        """Return the phases that take the cup and bring it, upright, before the mouth."""

        def over_cup(view: ExpertView, height: float) -> Command:
            position = view.object_position + np.array([0.0, 0.0, GRASP_HEIGHT + height])
            orientation = level_at(position) @ mink.SO3.from_y_radians(GRASP_PITCH)
            return Command(position, orientation, FINGER_OPEN)

        def lifted(view: ExpertView, last: Command) -> Command:
            return replace(last, position=last.position + np.array([0.0, 0.0, LIFT]))

        def brought(view: ExpertView, last: Command) -> Command:
            return holding(self.mouth(view) + STANDOFF, 0.0, last.finger)

        return [
            Reach(lambda view, last: over_cup(view, CLEARANCE)),
            Reach(lambda view, last: over_cup(view, 0.0), speed=0.15),
            Grip(FINGER_CLOSED, 0.4),
            Reach(lifted),
            Reach(brought, least_duration=1.2),
        ]

    def mouth(self, view: ExpertView) -> NDArray[np.float64]:
        """Return the mouth as the expert sees it, (3,) m, world."""
        return view.target()


class DrinkingServo(DrinkingExpert):
    """Visual servo that lets a person drink: it follows the mouth as it is seen, with a lead.

    Args:
        env: the environment, unwrapped.
        config: lead, delay and limits of the servo.
        forecast: source of the mouth; what the environment observes, or else the truth, if None.
    """

    goes_by_observation = True

    def __init__(
        self,
        env: DrinkingEnv,
        config: ServoConfig | None = None,
        forecast: Forecast | None = None,
    ) -> None:
        super().__init__(env)
        self._config = SERVO if config is None else config
        self._forecast = env.forecast_mouth if forecast is None else forecast

    def phases(self, home: Command) -> list[ExpertPhase]:
        """Return the phases of one episode, in order."""
        forecast, config = self._forecast, self._config
        inside, out = float(AT_LIPS[0]), float(AWAY[0])
        coming: Any = {"goal": inside, "rate": INSERTION_SPEED}
        going: Any = {"goal": out, "rate": WITHDRAWAL_SPEED}
        return [
            *self.fetch(),
            Tilted(Insert(forecast, config, **coming, waiting=WAITING), READY_TILT),
            Tilted(Hold(forecast, config, **coming, duration=DRINKING_TIME), POUR_TILT, POUR_RATE),
            Tilted(Hold(forecast, config, **coming, duration=0.4), READY_TILT),
            Tilted(Hold(forecast, config, **going, duration=0.8), 0.0),
        ]

    def mouth(self, view: ExpertView) -> NDArray[np.float64]:
        """Return the newest mouth seen, (3,) m, world."""
        return self._forecast(view.time - self._config.delay * FRAME_PERIOD, 0.0)
