"""Device that plays back the end-effector motion of recorded episodes, as if a person did it.

It is deterministic, needs no display and no person: tests and measurements use it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mink
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.data import EpisodeReader
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN
from robo_manip_baselines.envs.mujoco.expert.kinematics import ArmKinematics
from robo_manip_baselines.observation import ARM_JOINTS
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.teleop.device import (
    ArmPose,
    Mode,
    SessionView,
    TeleopCommand,
    TeleopEvent,
    TeleopInput,
)


class GripperMotion:
    """Commanded motion of one gripper in a recorded episode of T steps.

    Args:
        arm: ``left`` or ``right``.
        actions: (T, 7): 6 joint targets in rad, finger target in m.
    """

    def __init__(self, arm: str, actions: NDArray[np.float64]) -> None:
        kinematics = ArmKinematics(arm)
        poses = [kinematics.forward(row) for row in actions[:, :-1]]
        self.positions = [pose.translation() for pose in poses]
        self.orientations = [pose.rotation() for pose in poses]
        self.openings = (actions[:, -1] - FINGER_CLOSED) / (FINGER_OPEN - FINGER_CLOSED)

    def command(self, step: int, now: ArmPose) -> TeleopCommand:
        """Return the motion that leads from where the gripper is commanded to its next pose."""
        turn = self.orientations[step] @ mink.SO3(now.orientation).inverse()
        return TeleopCommand(
            (self.positions[step] - now.position) / CONTROL_PERIOD,
            turn.log() / CONTROL_PERIOD,
            float(self.openings[step]),
        )


class ReplayDevice:
    """Plays back recorded episodes: records and saves an episode for each of their seeds.

    Args:
        episodes: files of `EpisodeReader`, of different seeds.
        arms: to move.

    Raises:
        RequestError: there is no episode, or a seed is there twice.
        EpisodeFileError: a file is damaged.
    """

    is_paced = False

    def __init__(self, episodes: Sequence[Path], arms: Sequence[str]) -> None:
        self._paths: dict[int, Path] = {}
        for path in episodes:
            with EpisodeReader(path) as episode:
                seed = int(episode.attributes["seed"])
            if seed in self._paths:
                raise RequestError(f"'{path}': seed {seed} is also in '{self._paths[seed]}'")
            self._paths[seed] = path
        if not self._paths:
            raise RequestError("no episode to play back; give --episodes FILES or a folder of them")
        self._arms, self._seed = tuple(arms), -1
        self._motions: dict[str, GripperMotion] = {}

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the episodes."""
        return tuple(sorted(self._paths))

    def update(self, view: SessionView) -> TeleopInput:
        """Return the next motion; record at the start of an episode, and save at its end."""
        if view.mode is Mode.PRACTICE:
            self._load(view.seed)
            return TeleopInput(events=(TeleopEvent.RECORD,))
        motions = self._motions
        if view.mode is Mode.REVIEW or view.step >= len(next(iter(motions.values())).positions):
            return TeleopInput(events=(TeleopEvent.SAVE,))
        return TeleopInput({a: m.command(view.step, view.arms[a]) for a, m in motions.items()})

    def close(self) -> None:
        """Nothing is open."""

    def _load(self, seed: int) -> None:
        if seed == self._seed:
            return
        if seed not in self._paths:
            raise RequestError(f"no episode of seed {seed} to play back")
        with EpisodeReader(self._paths[seed]) as episode:
            actions = episode.array("action")
            names = episode.attributes["action_names"]
        parts = len(ARM_JOINTS) + 1
        recorded = [name.partition("/")[0] for name in names[::parts]]
        self._motions = {
            arm: GripperMotion(arm, actions[:, i * parts : (i + 1) * parts])
            for i, arm in enumerate(recorded)
            if arm in self._arms
        }
        if not self._motions:
            raise RequestError(
                f"'{self._paths[seed]}' moves the arm {', '.join(recorded)}, not "
                f"{', '.join(self._arms)}; choose another --arm"
            )
        self._seed = seed
