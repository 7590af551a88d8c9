"""Environment of a task as LeRobot expects one. Imports no LeRobot."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv, world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env, task_entry

Step = tuple[dict[str, Any], float, bool, bool, dict[str, bool]]


class LeRobotView(gymnasium.Env[Any, Any]):
    """A task with the observations, attributes and ``info`` that LeRobot reads.

    | observation | content |
    |---|---|
    | ``pixels/<camera>`` | (H, W, 3) uint8 RGB |
    | ``agent_pos`` | (S,) float32, all vectors of the observation: the ``observation.state`` of a
    dataset that ``Dataset.py export --format lerobot`` made with the same options |

    ``info`` has ``is_success`` and ``is_success_strict`` after `reset` and after every `step`.

    Args:
        task: name, such as ``FeedingEnv``.
        max_episode_steps: time limit; that of the task if None.
        **kwargs: of the task's environment.

    Attributes:
        task: name of the task.
        task_description: the task in words, the ``task`` of an exported dataset.
        _max_episode_steps: time limit in steps of 0.02 s; LeRobot asks for it by this name.
    """

    def __init__(self, task: str, max_episode_steps: int | None = None, **kwargs: Any) -> None:
        entry = task_entry(task)
        self._world: FaceEnv = world_of(make_env(task, **kwargs))
        spec = self._world.observation_spec
        self.task = task
        self.task_description = entry.instruction or entry.name
        self._max_episode_steps = max_episode_steps or entry.max_episode_steps
        self._steps = 0
        self.metadata = dict(self._world.metadata)
        self.render_mode = self._world.render_mode
        self.action_space = self._world.action_space
        size = len(spec.vector_names(entry.names))
        spaces: dict[str, gymnasium.Space[Any]] = {
            "agent_pos": gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        }
        if spec.cameras:
            image = gymnasium.spaces.Box(0, 255, (*spec.image_size, 3), np.uint8)
            spaces["pixels"] = gymnasium.spaces.Dict(dict.fromkeys(spec.cameras, image))
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, bool]]:
        """Start an episode. LeRobot's own options are for its wrappers, and ignored here."""
        observation, info = self._world.reset(seed=seed)
        self._steps = 0
        return self._observation(observation), _success(info)

    def step(self, action: NDArray[np.float32]) -> Step:
        """Move for 0.02 s."""
        observation, reward, terminated, _, info = self._world.step(action)
        self._steps += 1
        is_late = self._steps >= self._max_episode_steps
        return self._observation(observation), reward, terminated, is_late, _success(info)

    def render(self) -> NDArray[np.uint8] | None:
        """Return the view of the camera ``angle``, (H, W, 3) uint8."""
        return self._world.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._world.close()

    def _observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        keys = self._world.observation_spec.image_keys()
        images = {camera: observation[key] for key, camera in keys.items()}
        vector = {"agent_pos": self._world.vector.copy()}
        return vector | ({"pixels": images} if images else {})


def _success(info: dict[str, Any]) -> dict[str, bool]:
    # Numbers alone: a vector environment of Gymnasium joins them to arrays.
    return {name: bool(info[name]) for name in ("is_success", "is_success_strict")}
