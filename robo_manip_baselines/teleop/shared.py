"""Shared control: a trained policy acts until a person takes over."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.tasks.face_env import FaceEnv
from robo_manip_baselines.observation.images import fit_image
from robo_manip_baselines.policy.checkpoint import Checkpoint, load_model, read_checkpoint
from robo_manip_baselines.runs.errors import RequestError, require_choice

_ONE = np.zeros(1, np.intp)


def read_shared(policy: str, folder: Path, env: str) -> Checkpoint:
    """Read the checkpoint of the policy that shares control.

    Args:
        policy: its name, as typed.
        folder: of the checkpoint, or ``shipped:NAME``.
        env: name of the task.

    Raises:
        RequestError: there is none, or it is of another policy or task.
    """
    checkpoint = read_checkpoint(folder)
    require_choice("policy of this checkpoint", policy, [checkpoint.policy])
    if checkpoint.env != env:
        raise RequestError(f"checkpoint '{checkpoint.folder}' is of {checkpoint.env}, not of {env}")
    return checkpoint


class CheckpointPolicy:
    """Policy of a checkpoint that acts in one environment.

    The environment draws no images by itself; those that the policy needs are drawn here.

    Args:
        checkpoint: of the policy.
        world: the environment, unwrapped, with the observation of the checkpoint.
        device: of the network.

    Attributes:
        attribute: name, and SHA-256 over weights, configuration and statistics.

    Raises:
        RequestError: the environment is not one that the policy can act in, or there is no such
            device.
    """

    def __init__(self, checkpoint: Checkpoint, world: FaceEnv, device: str = "cpu") -> None:
        from robo_manip_baselines.policy.execution import PolicyRunner  # imports PyTorch
        from robo_manip_baselines.training.device import choose_device

        if tuple(world.action_names) != checkpoint.action_names:
            raise RequestError(
                f"checkpoint '{checkpoint.folder}' moves {', '.join(checkpoint.action_names)}; "
                "choose another --arm"
            )
        if world.xml_hash != checkpoint.xml_hash:
            raise RequestError(
                f"checkpoint '{checkpoint.folder}' was trained in another model of the cell (hash "
                f"{checkpoint.xml_hash[:12]}, here {world.xml_hash[:12]}); choose the --face that "
                "it was trained with"
            )
        self.attribute = {"name": checkpoint.policy, "sha256": checkpoint.content_hash}
        self._world, self._spec = world, checkpoint.spec
        place = choose_device(device)
        self._runner = PolicyRunner(
            load_model(checkpoint, place),
            checkpoint.spec,
            checkpoint.normalization,
            checkpoint.execution,
            encoding=checkpoint.encoding,
            skip=checkpoint.settings.skip,
            num_envs=1,
            device=place,
        )

    def reset(self, seed: int) -> None:
        """Start an episode, or go on after a person has acted."""
        self._runner.reset(_ONE, [seed])

    def act(self) -> NDArray[np.float32]:
        """Return the next action (A,) for the present state."""
        images: NDArray[Any] | None = None
        if self._spec.cameras and self._runner.needs_images(_ONE)[0]:
            views = self._world.renderer.render(self._world.data, self._spec.cameras)
            shown = [fit_image(views[name], self._spec.image_size) for name in self._spec.cameras]
            images = np.stack(shown)[None]
        return self._runner.act(self._world.vector[None].copy(), images, _ONE)[0]
