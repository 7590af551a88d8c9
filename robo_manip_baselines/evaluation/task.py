"""The environment in which a policy is evaluated, as something that can be sent to a process."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import gymnasium

from robo_manip_baselines.envs.mujoco.registration import make_env
from robo_manip_baselines.envs.mujoco.vx300s import ARM_JOINTS
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.observation.vector import vector_names


@dataclass(frozen=True)
class Task:
    """An environment and what a policy is shown there.

    Attributes:
        env: name of the environment.
        spec: what the policy is shown.
        env_kwargs: further arguments of the environment, such as ``face_motion``.
    """

    env: str
    spec: ObservationSpec
    env_kwargs: dict[str, Any] = field(default_factory=dict)

    @property
    def vector_size(self) -> int:
        """S, elements of all vectors together."""
        return len(vector_names(self.spec))

    @property
    def action_size(self) -> int:
        """A: joints and gripper of each arm."""
        return (len(ARM_JOINTS) + 1) * len(self.spec.arm_names)

    @property
    def image_shape(self) -> tuple[int, ...]:
        """(N, H, W, 3) of the images of all cameras."""
        return (len(self.spec.cameras), *self.spec.image_size, 3)

    def make(self, **changes: Any) -> gymnasium.Env[Any, Any]:
        """Make the environment, without cameras: whoever wants a view renders it.

        Args:
            **changes: arguments that shall differ.

        Raises:
            RequestError: an argument is not valid.
        """
        spec = self.spec
        arguments = {
            "obs": spec.obs,
            "horizon": spec.horizon,
            "cameras": (),
            "image_size": spec.image_size,
            "object_pose": spec.object_pose,
            "arms": spec.arms,
            "corruption": spec.corruption and asdict(spec.corruption),
            **self.env_kwargs,
            **changes,
        }
        return make_env(self.env, **arguments)
