"""Replay of recorded episodes from their seed and their actions alone."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from robo_manip_baselines.data import EpisodeReader
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import entry_of_id, make_env
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Deviation:
    """Largest deviation of the simulator's state from the recorded one.

    Attributes:
        qpos: m, rad.
        qvel: m/s, rad/s.
        steps: how many were compared.
    """

    qpos: float
    qvel: float
    steps: int


def remake_env(episode: EpisodeReader, **changes: Any) -> gymnasium.Env[Any, Any]:
    """Make the environment that an episode was recorded in.

    Args:
        episode: open file.
        **changes: arguments that shall differ, such as the cameras.

    Raises:
        RequestError: this release's environment is not the recorded one.
    """
    recorded = episode.attributes
    task = entry_of_id(recorded["env_id"])
    env = make_env(task.name, **{**recorded["env_kwargs"], **changes})
    xml_hash = world_of(env).xml_hash
    if xml_hash != recorded["xml_hash"]:
        env.close()
        raise RequestError(
            f"'{episode.path}' was recorded with another model (hash {recorded['xml_hash'][:12]}, "
            f"here {xml_hash[:12]}); install the release that recorded it, "
            f"{recorded['versions']['robo_manip_baselines']}"
        )
    return env


def replay(env: gymnasium.Env[Any, Any], episode: EpisodeReader) -> Iterator[int]:
    """Replay an episode; yield each step's index while the environment is as it was before it.

    Args:
        env: from `remake_env`.
        episode: open file.
    """
    env.reset(seed=int(episode.attributes["seed"]))
    for step, action in enumerate(episode.array("action")):
        yield step
        env.step(action)


def deviation(path: Path) -> Deviation:
    """Replay an episode and compare every state with the recorded one.

    Raises:
        RequestError: the file is damaged, or of another model.
    """
    with EpisodeReader(path) as episode, closing(remake_env(episode, cameras=())) as env:
        qpos, qvel = episode.array("qpos"), episode.array("qvel")
        data = world_of(env).data
        worst = np.zeros(2)
        for step in replay(env, episode):
            strays = np.abs(data.qpos - qpos[step]).max(), np.abs(data.qvel - qvel[step]).max()
            worst = np.maximum(worst, strays)
        return Deviation(float(worst[0]), float(worst[1]), len(episode))
