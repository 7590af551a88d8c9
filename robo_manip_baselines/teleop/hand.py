"""Goals that a person sets by keys and by dragging, and the state that a screen shows.

Devices with a screen share it, whatever their keys are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.expert.phases import DOWN, level_at
from robo_manip_baselines.teleop.device import (
    Floats,
    Mode,
    SessionView,
    TeleopCommand,
    TeleopEvent,
    TeleopInput,
)
from robo_manip_baselines.teleop.goal import Goal

TURN = math.radians(5.0)
"""rad that a key turns the gripper by."""

TURN_SPEED = 1.5
"""rad/s, largest angular velocity of the gripper."""

VIEW_FROM, VIEW_AT = (0.75, -0.45, 0.80), (0.08, 0.5, 0.15)
"""m, world: first place of the camera of a screen, and the point that it looks at."""

MOVES: Mapping[str, tuple[str, Floats]] = {
    "A": ("left", np.array([-1.0, 0.0, 0.0])),
    "D": ("right", np.array([1.0, 0.0, 0.0])),
    "W": ("away", np.array([0.0, 1.0, 0.0])),
    "S": ("towards you", np.array([0.0, -1.0, 0.0])),
    "E": ("up", np.array([0.0, 0.0, 1.0])),
    "Q": ("down", np.array([0.0, 0.0, -1.0])),
}
"""Key -> label, and direction along the world's axes."""

TURNS: Mapping[str, tuple[str, Floats]] = {
    "I": ("tip up", np.array([0.0, -1.0, 0.0])),
    "K": ("tip down", np.array([0.0, 1.0, 0.0])),
    "J": ("turn left", np.array([0.0, 0.0, 1.0])),
    "L": ("turn right", np.array([0.0, 0.0, -1.0])),
    "U": ("roll left", np.array([-1.0, 0.0, 0.0])),
    "O": ("roll right", np.array([1.0, 0.0, 0.0])),
}
"""Key -> label, and axis of the gripper (x out of it)."""

POSES: Mapping[str, str] = {"X": "point down", "C": "point ahead"}
"""Key -> label of an orientation."""


class Drag(NamedTuple):
    """A handle was dragged to a pose."""

    arm: str
    position: Floats
    orientation: Floats


class Key(NamedTuple):
    """A key of `MOVES`, `TURNS` or `POSES`, or the space bar (``space``)."""

    name: str


class Opening(NamedTuple):
    """The slider of the gripper was moved, 0 closed to 1 open."""

    value: float


Action = Drag | Key | Opening | TeleopEvent


class Hand:
    """Goals of the arms that a person sets, without a page.

    Args:
        arms: that the person steers.
    """

    def __init__(self, arms: Sequence[str]) -> None:
        self._arms = tuple(arms)
        self.goals: dict[str, Goal] = {}
        self._shown = (Mode.REVIEW, -1, -1)

    def follow(self, view: SessionView, arms: Iterable[str] | None = None) -> None:
        """Let the goals, or those of some arms, be where the grippers are commanded to be."""
        chosen = self._arms if arms is None else arms
        self.goals |= {arm: Goal.at(view.arms[arm]) for arm in chosen}

    def toggle(self, arm: str) -> None:
        """Close a gripper that is more than half open, or open it."""
        goal = self.goals[arm]
        self.goals[arm] = replace(goal, opening=0.0 if goal.opening > 0.5 else 1.0)

    def take(self, action: Action, view: SessionView, step: float) -> None:
        """Change a goal as the person asks.

        Args:
            action: of the person; events change no goal.
            view: of the session.
            step: m that a key moves the gripper by.
        """
        arm = view.active_arm
        goal, pose = self.goals[arm], view.arms[arm]
        if isinstance(action, Drag):
            dragged = self.goals[action.arm]
            self.goals[action.arm] = Goal(action.position, action.orientation, dragged.opening)
        elif isinstance(action, Opening):
            self.goals[arm] = Goal(goal.position, goal.orientation, action.value)
        elif isinstance(action, Key):
            if action.name in MOVES:
                self.goals[arm] = goal.moved(step * MOVES[action.name][1], pose)
            elif action.name in TURNS:
                self.goals[arm] = goal.turned(TURN * TURNS[action.name][1])
            elif action.name in POSES:
                down = action.name == "X"
                turned = DOWN if down else level_at(goal.position, arm)
                self.goals[arm] = Goal(goal.position, turned.wxyz, goal.opening)
            elif action.name == "space":
                self.toggle(arm)

    def update(
        self, view: SessionView, actions: Iterable[Action], step: float, speed: float
    ) -> TeleopInput:
        """Take what the person did since the last period, and return what is asked for now.

        Args:
            view: of the session. The goals follow the grippers at the start of an episode and
                while a policy acts; keys move nothing then, nor after an episode.
            actions: of the person.
            step: m that a key moves the gripper by.
            speed: m/s, the largest.
        """
        is_new = (view.mode, view.seed) != self._shown[:2] or view.step < self._shown[2]
        self._shown = (view.mode, view.seed, view.step)
        if (is_new and view.step == 0) or view.is_policy_acting or not self.goals:
            self.follow(view)
        events: list[TeleopEvent] = []
        for action in actions:
            if isinstance(action, TeleopEvent):
                events.append(action)
            elif not view.is_policy_acting and view.mode is not Mode.REVIEW:
                self.take(action, view, step)
        return TeleopInput(self.commands(view, speed), tuple(events))

    def commands(self, view: SessionView, speed: float) -> dict[str, TeleopCommand]:
        """Return the motions that lead to the goals at a largest speed in m/s."""
        return {
            arm: goal.command(view.arms[arm], speed, TURN_SPEED) for arm, goal in self.goals.items()
        }


def status_rows(view: SessionView) -> dict[str, str]:
    """Return the state of a session as name -> text, without its mode and message."""
    seconds = view.step * CONTROL_PERIOD
    limit = view.step_limit * CONTROL_PERIOD
    who = "the policy" if view.is_policy_acting else "you"
    rate = "–" if math.isnan(view.rate) else f"{view.rate:.1f} Hz"
    return {
        "episodes": f"{view.saved} of {view.wanted} saved",
        "seed": str(view.seed),
        "time": f"{seconds:.1f} of {limit:.0f} s",
        "task": "done" if view.is_success else "not done yet",
        "arm": view.active_arm,
        "gripper": " ".join(f"{value:.3f}" for value in view.arms[view.active_arm].position),
        **({"acting": who} if view.has_policy else {}),
        "loop": f"{rate}, {view.missed} late",
    }
