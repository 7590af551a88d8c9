"""Which environments there are. Adding one is a module and a line here."""

from __future__ import annotations

from typing import Any

import gymnasium

from robo_manip_baselines.runs.errors import require_choice

NAMESPACE = "robo_manip_baselines"

ENVS: dict[str, tuple[str, int]] = {
    "FeedingEnv": ("robo_manip_baselines.envs.mujoco.tasks.feeding.env:FeedingEnv", 600),
}
"""Name -> entry point and steps until truncation. 600 steps of 0.02 s are 12 s."""


def env_id(name: str) -> str:
    """Return the Gymnasium id of an environment.

    Raises:
        RequestError: there is no such environment.
    """
    return f"{NAMESPACE}/{require_choice('environment', name, ENVS)}-v0"


def register_envs() -> None:
    """Make every environment known to Gymnasium."""
    for name, (entry_point, max_episode_steps) in ENVS.items():
        gymnasium.register(
            env_id(name), entry_point=entry_point, max_episode_steps=max_episode_steps
        )


def make_env(name: str, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Make an environment by its name.

    Raises:
        RequestError: there is no such environment, or an argument is not valid.
    """
    return gymnasium.make(env_id(name), **kwargs)
