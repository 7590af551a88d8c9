"""Tasks of robo_manip_baselines as environments of LeRobot.

LeRobot finds them by ``--env.discover_packages_path=lerobot_env_robo_manip_baselines``, or by the
name of the installed distribution, as ``--env.type=robo_manip_baselines_feeding`` and so on.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from lerobot_env_robo_manip_baselines.view import LeRobotView
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import CAMERAS, Corruption, ObservationSpec

FPS = 50


@dataclass
class RoboManipBaselinesConfig(EnvConfig):
    """Settings that all tasks share.

    Attributes:
        obs, horizon, object_pose, relative: content of ``agent_pos``, see `ObservationSpec`.
        error, delay, face_dropout, prediction: corruption of the observed target, likewise.
        cameras: of the observation.
        observation_height, observation_width: of the images in pixels.
        arms: ``right`` or ``both``; those of the task if None.
        motion, people, face: of the head, see `FaceEnv`.
        episode_length: time limit in steps; that of the task if None.
        arguments: further ones of the task's environment.
    """

    task: str | None = "FeedingEnv"
    fps: int = FPS
    obs: str = "baseline"
    horizon: int = 2
    object_pose: bool = False
    relative: bool = False
    error: str = "none"
    delay: int = 0
    face_dropout: float = 0.0
    prediction: str = "truth"
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))
    observation_height: int = 480
    observation_width: int = 640
    arms: str | None = None
    motion: str = "recorded"
    people: str = "all"
    face: str = "visual"
    episode_length: int | None = None
    arguments: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        entry = task_entry(self.task or "")
        size = (self.observation_height, self.observation_width)
        state = len(self.spec.vector_names(entry.names))
        actions = 7 * len(self.spec.arm_names)
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(actions,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(state,)),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
        for camera in self.spec.cameras:
            key = f"pixels/{camera}"
            self.features[key] = PolicyFeature(type=FeatureType.VISUAL, shape=(*size, 3))
            self.features_map[key] = f"{OBS_IMAGES}.{camera}"

    @property
    def spec(self) -> ObservationSpec:
        """Observation spec."""
        return ObservationSpec(
            obs=self.obs,
            horizon=self.horizon,
            cameras=tuple(self.cameras),
            image_size=(self.observation_height, self.observation_width),
            object_pose=self.object_pose,
            relative=self.relative,
            arms=self.arms or task_entry(self.task or "").arms[0],
            corruption=Corruption(
                error=self.error,
                delay=self.delay,
                face_dropout=self.face_dropout,
                prediction=self.prediction,
            ),
        )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `LeRobotView`."""
        world = {"motion": self.motion, "people": self.people, "face": self.face}
        limit = {"max_episode_steps": self.episode_length}
        given = {**self.spec.env_kwargs(), **world, **self.arguments}
        return {**given, **limit, "render_mode": "rgb_array"}

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gymnasium.vector.VectorEnv]]:
        """Return ``n_envs`` environments of the task as one, in processes if asked for."""
        make = partial(LeRobotView, self.task or "", **self.gym_kwargs)
        same_step = gymnasium.vector.AutoresetMode.SAME_STEP
        if use_async_envs and n_envs > 1:
            envs: gymnasium.vector.VectorEnv = gymnasium.vector.AsyncVectorEnv(
                [make] * n_envs, context="forkserver", autoreset_mode=same_step
            )
        else:
            envs = gymnasium.vector.SyncVectorEnv([make] * n_envs, autoreset_mode=same_step)
        return {self.type: {0: envs}}


@EnvConfig.register_subclass("robo_manip_baselines_feeding")
@dataclass
class FeedingConfig(RoboManipBaselinesConfig):
    """Bring a cube to the mouth of a person who moves."""

    task: str | None = "FeedingEnv"


@EnvConfig.register_subclass("robo_manip_baselines_drinking")
@dataclass
class DrinkingConfig(RoboManipBaselinesConfig):
    """Bring a cup to the mouth and pour."""

    task: str | None = "DrinkingEnv"


@EnvConfig.register_subclass("robo_manip_baselines_wiping")
@dataclass
class WipingConfig(RoboManipBaselinesConfig):
    """Wipe a residue off the cheek."""

    task: str | None = "FaceWipingEnv"


@EnvConfig.register_subclass("robo_manip_baselines_bimanual_feeding")
@dataclass
class BimanualFeedingConfig(RoboManipBaselinesConfig):
    """Feed with two arms that hand the cube over."""

    task: str | None = "BimanualFeedingEnv"
